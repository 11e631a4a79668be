"""Unusual inputs, each made from its kind and random numbers: files, commands, expected refusals.

Many inputs are valid ones with a single fault that the format forbids (`refuse` says which). The others are changed
at random, in their numbers, their structure or their bytes, and may be accepted or refused.
"""

import copy
import csv
import io
import json
import random
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final

import numpy as np
import yaml

from bench.base.yaml_files import load_document
from benchmarks.campaign import ROOT

# --- damage to valid inputs ------------------------------------------------------------------------------


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
    "name", "description", "title", "reason", "text", "serial", "type", "resource", "label", "procedure",
}  # fmt: skip


def spoilt_bytes(rng: random.Random, data: bytes) -> bytes:
    """Return bytes of which some are cut, doubled, exchanged or replaced."""
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
    """Return the paths of all values in a tree of mappings and lists."""
    inside = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [place, *(p for key, value in inside for p in places(value, (*place, key)))]


def at(tree: Any, place: Sequence[Any]) -> Any:
    """Return the value at a path of a tree."""
    for key in place:
        tree = tree[key]
    return tree


def weird(rng: random.Random) -> Any:
    """Return an unusual value."""
    word = rng.choice(WEIRD)
    numbers = (0, -1, 1e308, 10**25)
    containers: tuple[Any, ...] = ([], {}, [word], [[word]], {word: word}, [1, 2, 3, 4])
    return rng.choice((word, word, word, None, True, *numbers, *containers))


def spoilt_tree(rng: random.Random, tree: Any) -> Any:
    """Return a tree in which a value is replaced, removed, doubled or moved."""
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


SIZES: Final = (
    "0", "-1", "1", "2", "0.5", "-0", "1e-300", "1e300", "1e9", "1e-9", "360", "1000000000", "99999",
)  # fmt: skip


def other_numbers(rng: random.Random, tree: Any) -> Any:
    """Return a tree in which one or two numbers are replaced by extreme ones."""
    tree = copy.deepcopy(tree)
    texts = [p for p in places(tree) if isinstance(at(tree, p), str)]
    numbers = [p for p in texts if re.match(r"[+-]?[\d.]+", at(tree, p))]
    for place in rng.sample(numbers, min(len(numbers), rng.choice((1, 1, 2)))):
        word = rng.choice(SIZES)
        at(tree, place[:-1])[place[-1]] = re.sub(r"^[+-]?[\d.]+(?:e[+-]?\d+)?", word, at(tree, place))
    return tree


def as_yaml(tree: Any) -> bytes:
    """Return a tree as YAML."""
    text = yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=1000)
    return text.encode("utf-8", "surrogatepass")


def faulty_yaml(rng: random.Random, tree: Any) -> tuple[bytes, str]:
    """Return a YAML file with one fault that must be refused, and a description of the fault."""
    tree = copy.deepcopy(tree)
    texts = [p for p in places(tree) if isinstance(at(tree, p), str)]
    quantities = [
        p for p in texts if QUANTITY.fullmatch(at(tree, p)) and not _FREE_TEXT & set(map(str, p[-2:]))
    ]
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
            unknown = rng.choice(("nonsense", "Name", "\x1b", "steps "))
            return as_yaml({**tree, unknown: "x"}), "an unknown key"
        case _:
            text = as_yaml(tree)
            return text + rng.choice((b"\xff", b"more: [\n", b"more: {a: *b}\n", b"\tx: y\n")), "no YAML"


# --- inputs ----------------------------------------------------------------------------------------------


@dataclass
class Case:
    """One input: files to write, commands with an input stream, and the reason why it must be refused.

    `doubt` is a text that the output must contain; `pipes` are names of pipes without a writer.
    """

    commands: list[list[str]]
    files: dict[str, bytes] = field(default_factory=dict)
    stdin: bytes = b""
    refuse: str = ""
    record: bool = False
    doubt: str = ""
    pipes: tuple[str, ...] = ()


# --- readings, models, results ------------------------------------------------------------------------


@cache
def readings() -> list[list[str]]:
    """Return a valid readings file as rows, header first: two passes of a run of the tests."""
    rng = np.random.default_rng(1)
    names = ["installation", "pass", "point", "angle_deg", "direction", "ux_v", "uy_v", "uz_v"]
    rows = [[*names, "note"]]
    with (ROOT / "tests/data/records/readings.csv").open(encoding="utf-8", newline="") as file:
        taken = list(csv.DictReader(file))
    for number in "12":
        for row in taken:
            if row["installation"] != "V" or number == "1":
                signals = [f"{float(row[name]) + rng.normal(0, 1e-6):.7f}" for name in names[5:]]
                rows.append([row["installation"], number, *(row[n] for n in names[2:5]), *signals, "a"])
    return rows


def as_csv(rows: Sequence[Sequence[str]]) -> bytes:
    """Return rows as a CSV file."""
    out = io.StringIO()
    csv.writer(out).writerows(rows)
    return out.getvalue().encode("utf-8", "surrogatepass")


def csv_case(rng: random.Random) -> Case:
    """Return a readings file to be calibrated, verified or imported."""
    rows = [list(row) for row in readings()]
    row, column = rng.randrange(1, len(rows)), rng.randrange(9)
    refuse = ""
    match rng.randrange(9):
        case 0:
            word = rng.choice(("nan", "inf", "9.9e37", "-9.91E37", "", "1,5", "x", "0x1", "1_0"))
            rows[row][rng.choice((5, 6, 7))] = word
            refuse = f"a signal {word!r} in row {row}"
        case 1:
            rows[row] += ["1"] if rng.random() < 0.5 else []
            rows[row] = rows[row] if len(rows[row]) > 9 else rows[row][: rng.randrange(1, 8)]
            refuse = "a wrong count of cells"
        case 2:
            rows.append(list(rows[row]))
            refuse = "a reading that stands twice"
        case 3:
            column = rng.choice((0, 1, 2, 3))
            rows[row][column] = word = rng.choice(("nan", "721", "é", "1e10", "x", "-inf"))
            refuse = "" if word == "721" and column in {1, 2} else f"{word} in row {row}"
        case 4:
            column = rng.choice((0, 1, 2, 3, 5, 6, 7))
            names = [w for w in ("x", "angle_deg", "ux_v", "ux_mv") if w != rows[0][column]]
            rows[0][column] = rng.choice(names)
            refuse = "a column that lacks or stands twice"
        case 5 | 6:
            rows[row if rng.random() < 0.7 else 0][column] = rng.choice(WEIRD)
        case _:
            pass
    data = as_csv(rows)
    if refuse == "" and rng.random() < 0.6:
        data = spoilt_bytes(rng, data)
    calibrate = ["calibrate", "r.csv", "--json", "-"]
    command = rng.choice((calibrate, calibrate, ["verify", "r.csv"], ["import", "r.csv", "--name", "r"]))
    commands = [command]
    if not refuse and rng.random() < 0.2:
        commands[0] = ["calibrate", "r.csv", "--skip-bad-rows", "--json", "-"]
    if command[0] == "import" and not refuse:
        commands += [["export", "r", "--csv", "-"], ["show", "r"]]
    return Case(commands, {"r.csv": data}, refuse=refuse)


@cache
def result() -> dict[str, Any]:
    """Return a valid result of `calibrate --json` for the same run, with the members that other commands read."""
    whole = json.loads((ROOT / "tests/data/records/calibrate.json").read_text(encoding="utf-8"))
    names = ("unit", "g_m_s2", "per", "made_at", "simulated", "coefficients", "order", "covariance", "noise")
    kept = {name: whole[name] for name in names}
    return {**kept, "g_m_s2": 9.81, "simulated": False, "unit_under_test": {"type": "T", "serial": "1"}}


PLACES: Final[tuple[tuple[Any, ...], ...]] = (
    ("g_m_s2",), ("noise", "reading_v"), ("coefficients", "Kxx", "value"), ("unit",), ("order", 3),
)  # fmt: skip


def json_case(rng: random.Random) -> Case:
    """Return a result of an earlier calibration to be verified with, compared, or written in other forms."""
    tree, refuse = copy.deepcopy(result()), ""
    i, j = rng.sample(range(12), 2)
    c = tree["covariance"]
    data = b""
    match rng.randrange(10):
        case 0:
            c[i][j] += 10 ** rng.uniform(-6, 3) * (c[i][i] * c[j][j]) ** 0.5
            refuse = "a covariance that is not symmetric"
        case 1:
            c[i][j] = c[j][i] = rng.choice((1.01, -1.5, 1e6)) * (c[i][i] * c[j][j]) ** 0.5
            refuse = "a correlation beyond 1"
        case 2:
            c[i][i] = rng.choice((-c[i][i], 0.0, "1e-9", True, None, [1e-9], 10**400))
            refuse = "a variance that is none"
        case 3:
            direction = np.random.default_rng(rng.randrange(1000)).normal(size=12)
            whole = np.array(c)
            along = direction / np.sqrt(direction @ direction)
            tree["covariance"] = (whole - 1.1 * (along @ whole @ along) * np.outer(along, along)).tolist()
            refuse = "a combination of negative variance"
        case 4:
            where = rng.choice(PLACES)
            no_size: Any = -1e9 if where[0] in {"g_m_s2", "noise"} else {}
            at(tree, where[:-1])[where[-1]] = rng.choice((None, "x", True, [], no_size))
            refuse = f"nonsense at {where}"
        case 5:
            word = rng.choice((b"NaN", b"Infinity", b"-Infinity", b"1e999"))
            data = json.dumps(tree).encode().replace(b"9.81", word, 1)
            refuse = f"{word.decode()} in it"
        case 6:
            data = json.dumps(tree).encode().replace(b'"unit": "V"', b'"unit": "V", "unit": "V"', 1)
            refuse = "a key that stands twice"
        case 7:
            text = json.dumps(spoilt_tree(rng, tree), ensure_ascii=rng.random() < 0.5)
            data = text.encode("utf-8", "surrogatepass")
        case _:
            data = spoilt_bytes(rng, json.dumps(tree).encode())
    files = {"c.json": data or json.dumps(tree).encode(), "d.json": json.dumps(result()).encode()}
    files["r.csv"] = as_csv(readings())
    commands = [
        ["verify", "r.csv", "--coefficients", "c.json", "--json", "-"],
        ["compare", "c.json", "d.json", "--json", "-"],
        ["coefficients", "c.json", "--as", "all", "--json", "-"],
    ]
    return Case([rng.choice(commands)], files, refuse=refuse)


# --- YAML -----------------------------------------------------------------------------------------------


@cache
def shipped(folder: str) -> list[Any]:
    """Return the shipped files of a folder, each as a tree of texts."""
    return [load_document(file).data for file in sorted((ROOT / folder).glob("*.yaml"))]


def _yaml_case(rng: random.Random, tree: Any) -> tuple[bytes, str]:
    match rng.randrange(6):
        case 0 | 1:
            return faulty_yaml(rng, tree)
        case 2 | 3:
            return as_yaml(other_numbers(rng, tree)), ""
        case 4:
            return as_yaml(spoilt_tree(rng, tree)), ""
        case _:
            return spoilt_bytes(rng, as_yaml(tree)), ""


def bench_case(rng: random.Random) -> Case:
    """Return a bench file to be checked with a procedure."""
    data, refuse = _yaml_case(rng, rng.choice(shipped("config")))
    return Case([["check", "quick", "--bench", "b.yaml"]], {"b.yaml": data}, refuse=refuse)


def procedure_case(rng: random.Random) -> Case:
    """Return a procedure to be checked, which may include others."""
    tree = rng.choice(shipped("procedures"))
    data, refuse = _yaml_case(rng, tree)
    files = {"p.yaml": data}
    if rng.random() < 0.2:
        part = {"steps": tree["steps"]}
        inside, refuse = _yaml_case(rng, part)
        steps = [{"include": rng.choice(("q.yaml", "./q.yaml"))}]
        files = {"p.yaml": as_yaml({**tree, "steps": steps}), "q.yaml": inside}
    elif rng.random() < 0.05:
        odd = ("a\0.yaml", "x" * 400 + ".yaml", "\ud800.yaml")
        name = rng.choice(("/etc/passwd", "/dev/zero", "p.yaml", ".", "", *odd))
        files = {"p.yaml": as_yaml({**tree, "steps": [{"include": name}]})}
        refuse = f"include: {name!r}"
    bench = rng.choice(("paper-stand", "bench-lan", "bench-motorised"))
    return Case([["check", "p.yaml", "--bench", bench]], files, refuse=refuse)


MODEL: Final = {
    "model_file": "1", "name": "m", "parent": "paper",
    "effects": [
        {"name": "quadratic_nonlinearity", "channels": ["x", "y"],
        "parameters": {"K2": {"value": "60 ug/g^2", "u": "4 ug/g^2"}}},
        {"name": "scale_asymmetry",
         "parameters": {"Kabs": {"x": {"value": "1 ug/g", "u": "1 ug/g"}, "z": "2 ug/g"}}},
    ],
}  # fmt: skip


def model_case(rng: random.Random) -> Case:
    """Return a model file to be used in a calibration."""
    data, refuse = _yaml_case(rng, MODEL)
    command = ["calibrate", "r.csv", "--model", "m.yaml", "--json", "-"]
    return Case([command], {"m.yaml": data, "r.csv": as_csv(readings())}, refuse=refuse)


# --- records, names ------------------------------------------------------------------------------------


def record_case(rng: random.Random) -> Case:
    """Return commands on a run folder in which a file is damaged: show, list, evaluate, resume.

    The trial itself damages the file.
    """
    commands = [["show", "run", "--verify"], ["show", "run"], ["runs"], ["calibrate", "run"],
                ["export", "run", "--csv", "-"],
                ["resume", "run"], ["abort", "run"], ["report", "run"]]  # fmt: skip
    return Case(rng.sample(commands, 2), record=True)


NAMES: Final = (
    *WEIRD, "-x", "--help", ".", "..", "a/b", "a" * 101, "ä", "run\n", " run", "\udcff", "a\ud800",
    "CON.txt", "~", "$HOME", "run.json",
)  # fmt: skip


def name_case(rng: random.Random) -> Case:
    """Return an unusual name of a run, an operator or a path."""
    name = rng.choice(NAMES) if rng.random() < 0.7 else rng.choice(NAMES) + rng.choice(NAMES)
    files = {"r.csv": as_csv(readings()), "p.yaml": b"procedure: p\nsteps: [{wait: {for: 1 s}}]\n"}
    run = ["run", "p.yaml", "--dry-run", "--name", "run"]
    calibrate = ["calibrate", "r.csv"]
    commands = rng.choice((
        [["import", "r.csv", "--name", name], ["runs"]], [[*run, "--operator", name], ["show", "run"], ["runs"]],
        [["calibrate", name]], [[*calibrate, "--bench", name]], [["check", name]], [["show", name, "--runs", name]],
        [[*calibrate, "--json", name]], [[*calibrate, "--model", name]],
        [["verify", "r.csv", "--coefficients", name]], [["verify", "r.csv", "--limit", name]],
        [[*calibrate, "--g", name]], [[*calibrate, "--estimator", name]], [["control", name, name]],
        [["compare", "r.csv", "r.csv", "--date", name, "--date", name]], [["abort", name]], [["init", name]],
        [[*run[:3], "--name", name]], [[name, name]], [["resume", "--runs", name]],
        [["report", "r.csv", "--out", name]],
    ))  # fmt: skip
    refuse = ""
    if "--operator" in commands[0] and re.search("[\ud800-\udfff]", name):
        refuse = "an operator's name that is no text"
    if commands[0][0] == "import" and not re.fullmatch(r"\w[\w.+-]{0,99}", name) and not name.startswith("-"):
        refuse = "a run's name" if name else ""
    given = [[word.replace("\0", "") for word in command] for command in commands]
    return Case(given, files, refuse=refuse if "\0" not in name else "")


MADE: Final[dict[str, Callable[[random.Random], Case]]] = {
    "readings": csv_case, "bench": bench_case, "procedure": procedure_case, "model": model_case,
    "result": json_case,
    "record": record_case, "names": name_case,
}  # fmt: skip
"""Functions that make the inputs of commands, by kind."""
