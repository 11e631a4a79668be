"""How the inputs of the fuzz campaign are spoilt: bytes, trees of mappings and lists, YAML files."""

from __future__ import annotations

import copy
import random
import re
from collections.abc import Sequence
from typing import Any, Final

import yaml

WEIRD: Final = (
    "", "x", "nan", "inf", "-inf", "NaN", "1e999", "-1", "0", "1e-320", "1_000", "٣", "0x10", "true",
    "null", "~", "=1+1",
    "\x1b[2J\x1b]0;t\x07", "\u202e\u2066", "\u2028", "\ufeff", "\x00", "\x7f", "a" * 5000, "9" * 5000,
    "1 V^999999999", "1 V/0",
    "−1 mV", "1 kg", "1 V V V", "*", "&a", "{}", "[]", "%s%n", "../../etc/passwd", "/dev/zero", "CON",
    "\\", "'", '"', ";", ",",
    "\r", "\t", "\n", "9.9e37", "-9.91e37", "+0", "1e5", "1.5", "z", "xyz", "V", "S", "🎉", "e\u0301",
)  # fmt: skip
TOKENS: Final = (
    b"[" * 3000, b"{" * 3000, b"- " * 2000, b"\x00", b"\xff\xfe", b"\xed\xa0\x80", b"\xc3", b"&a [*a]",
    b"<<: *a", b"!!python/object:os.system x",
    b"!x", b"%YAML 9.9\n---\n", b"\n---\n", b"\t", b": ", b"? ", b"|\n", b'"', b"'", b"\r", b"\x1b[31m",
    b"NaN", b"Infinity", b"1e400",
    b"\xe2\x80\xae", b"\xef\xbb\xbf", b",", b";", b"\n", b"\r\n", b"9" * 400, b"{}", b"[]", b"null",
    b"true", b"-", b"#",
)  # fmt: skip
QUANTITY: Final = re.compile(r"[+-]?[\d.]+(?:e[+-]?\d+)? [A-Za-z/^\d]+")
_FREE_TEXT: Final = {
    "name",
    "description",
    "title",
    "reason",
    "text",
    "serial",
    "type",
    "resource",
    "label",
    "procedure",
}


def spoilt_bytes(rng: random.Random, data: bytes) -> bytes:
    """Return bytes with some of them cut, doubled, swapped or replaced."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        at, end = sorted(rng.randrange(len(data) + 1) for _ in "ab")
        end = min(end, at + rng.choice((1, 5, 50, 500)))
        match rng.randrange(5):
            case 0:
                data = data[:at] + rng.choice(TOKENS) + data[at:]
            case 1:
                data = data[:at] + data[end:]
            case 2:
                data = data[:end] + data[at:end] * rng.choice((1, 1, 20)) + data[end:]
            case 3:
                data = data[:at] + bytes(rng.randrange(256) for _ in range(min(end - at, 8))) + data[end:]
            case _:
                data = data[:at]
    return data


def places(tree: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the place of everything in a tree of mappings and lists."""
    inside = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [place, *(p for key, value in inside for p in places(value, (*place, key)))]


def at(tree: Any, place: Sequence[Any]) -> Any:
    """Return what stands at a place."""
    for key in place:
        tree = tree[key]
    return tree


def weird(rng: random.Random) -> Any:
    """Return a value that nobody expects."""
    word = rng.choice(WEIRD)
    return rng.choice(
        (
            word,
            word,
            word,
            None,
            True,
            0,
            -1,
            1e308,
            10**25,
            [],
            {},
            [word],
            [[word]],
            {word: word},
            [1, 2, 3, 4],
        )
    )


def spoilt_tree(rng: random.Random, tree: Any) -> Any:
    """Return a tree with something in it replaced, removed, doubled or moved."""
    tree = copy.deepcopy(tree)
    for _ in range(rng.choice((1, 1, 2, 3))):
        place = rng.choice([p for p in places(tree) if p] or [("x",)])
        above = at(tree, place[:-1])
        match rng.randrange(5):
            case 0:
                del above[place[-1]]
            case 1 if isinstance(above, dict):
                above[rng.choice(WEIRD)] = above.pop(place[-1])
            case 2 if isinstance(above, list):
                above.extend(copy.deepcopy(above[place[-1] :]))
            case 3:
                above[place[-1]] = copy.deepcopy(at(tree, rng.choice(places(tree))))
            case _:
                above[place[-1]] = weird(rng)
        if not isinstance(tree, dict | list) or not tree:
            break
    return tree


def other_numbers(rng: random.Random, tree: Any) -> Any:
    """Return a tree in which one or two numbers are others, as large, small or many as can be written."""
    tree = copy.deepcopy(tree)
    numbers = [
        p for p in places(tree) if isinstance(at(tree, p), str) and re.match(r"[+-]?[\d.]+", at(tree, p))
    ]
    for place in rng.sample(numbers, min(len(numbers), rng.choice((1, 1, 2)))):
        word = rng.choice(
            ("0", "-1", "1", "2", "0.5", "-0", "1e-300", "1e300", "1e9", "1e-9", "360", "1000000000", "99999")
        )
        at(tree, place[:-1])[place[-1]] = re.sub(r"^[+-]?[\d.]+(?:e[+-]?\d+)?", word, at(tree, place))
    return tree


def as_yaml(tree: Any) -> bytes:
    """Return a tree as YAML."""
    text = yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=1000)
    return text.encode("utf-8", "surrogatepass")


def faulty_yaml(rng: random.Random, tree: Any) -> tuple[bytes, str]:
    """Return a good YAML file with one fault that must be refused, and which."""
    tree = copy.deepcopy(tree)
    quantities = [
        p for p in places(tree)
        if isinstance(at(tree, p), str) and QUANTITY.fullmatch(at(tree, p))
        and not _FREE_TEXT & set(map(str, p[-2:]))
    ]  # fmt: skip
    match rng.randrange(5):
        case 0 if quantities:
            place = rng.choice(quantities)
            at(tree, place[:-1])[place[-1]] = at(tree, place).split()[0] + " kg"
            return as_yaml(tree), f"a wrong unit at {place}"
        case 1 if quantities:
            place = rng.choice(quantities)
            word = rng.choice(("nan", "inf", "-inf", "1e999", ""))
            at(tree, place[:-1])[place[-1]] = f"{word} {at(tree, place).split()[1]}"
            return as_yaml(tree), f"no number at {place}"
        case 2:
            text = as_yaml(tree)
            line = rng.choice([part for part in text.split(b"\n") if re.match(rb"[a-z_]+:", part)])
            key = line.split(b":")[0]
            return text + key + b": again\n", f"{key.decode()} stands twice"
        case 3:
            return as_yaml(
                {**tree, rng.choice(("nonsense", "Name", "\x1b", "steps ")): "x"}
            ), "an unknown key"
        case _:
            text = as_yaml(tree)
            return text + rng.choice((b"\xff", b"more: [\n", b"more: {a: *b}\n", b"\tx: y\n")), "no YAML"
