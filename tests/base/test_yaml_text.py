"""YAML read from the parser's events, held against the nodes that the library composes of the same text."""

import random
from pathlib import Path

import pytest
import yaml

from bench.base.yaml_files import read_yaml

ROOT = Path(__file__).parents[2]
SHIPPED = sorted([*(ROOT / "procedures").glob("*.yaml"), *(ROOT / "config").glob("*.yaml")])
NULL = "tag:yaml.org,2002:null"
WORDS = ["a", "1", "0012", "3e-4 g", "yes", "null", "~", "", "a: b", "# no", " x ", "ü", "=", "<<", "-"]


def composed(node, place, lines):
    """The data of a node of the library, with the line of every place in `lines`."""
    if isinstance(node, yaml.MappingNode):
        found = {}
        for key, value in node.value:
            lines[(*place, key.value)] = key.start_mark.line + 1
            found[key.value] = composed(value, (*place, key.value), lines)
        return found
    if isinstance(node, yaml.SequenceNode):
        items = []
        for index, item in enumerate(node.value):
            lines[(*place, index)] = item.start_mark.line + 1
            items.append(composed(item, (*place, index), lines))
        return items
    return None if node.tag == NULL else node.value


def invented(rng, deep=0):
    kind = rng.random()
    if deep < 4 and kind < 0.4:
        return {rng.choice(WORDS): invented(rng, deep + 1) for _ in range(rng.randrange(4))}
    if deep < 4 and kind < 0.7:
        return [invented(rng, deep + 1) for _ in range(rng.randrange(4))]
    return rng.choice([rng.choice(WORDS), rng.choice(WORDS), None, 17, 1.5, True])


def agrees(text):
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    lines = {(): root.start_mark.line + 1}
    data = composed(root, (), lines)
    read = read_yaml(text)
    assert (read.data, read.lines, read.slips) == (data, lines, [])


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_files_read_as_the_library_composes_them(path):
    agrees(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("seed", range(60))
def test_invented_texts_read_as_the_library_composes_them(seed):
    rng = random.Random(seed)  # noqa: S311 - nothing secret
    data = {"first": invented(rng), "second": invented(rng)}
    agrees(
        yaml.safe_dump(
            data,
            default_flow_style=rng.choice([True, False, None]),
            default_style=rng.choice([None, None, '"', "'", "|"]),
            allow_unicode=rng.choice([True, False]),
            width=rng.choice([10, 80]),
        )
    )


@pytest.mark.parametrize(
    ("text", "data", "slips"),
    [
        (
            "a: 1\nb: 2\na: [3, {c: 4}]\n",
            {"a": "1", "b": "2"},
            [(3, (), "'a' appears here again, first in line 1")],
        ),
        ("a: &x 1\nb: *x\n", {"a": "1", "b": None}, [(1, ("b",), "anchors and aliases")]),
        ("a: &x\n  b: *x\n", {"a": {"b": None}}, [(1, ("a", "b"), "anchors and aliases")]),
        ("? {a: &x 1}\n: [2]\nb: 3\n", {"b": "3"}, [(1, (), "a key must be a plain word")]),
        (
            "a: !!set {b}\nc: !mine 1\n",
            {"a": {"b": None}, "c": "1"},
            [(1, ("a",), "!mine"), (2, ("c",), "!mine")],
        ),
        ("a: !!null 1\nb: ! null\nc: !!str null\n", {"a": None, "b": None, "c": "null"}, []),
    ],
)
def test_what_is_not_taken_is_told_with_its_line_and_place(text, data, slips):
    found = read_yaml(text)
    assert found.data == data
    assert [slip[:2] for slip in found.slips] == [slip[:2] for slip in slips]
    for (*_, told), (*_, expected) in zip(found.slips, slips, strict=True):
        assert expected in told or "is not allowed; remove it" in told


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a: *x\n", "found undefined alias 'x'"),
        ("? [*x]\n: 1\n", "found undefined alias 'x'"),
        ("a: &x 1\nb: &x 2\n", "found duplicate anchor 'x'; first occurrence"),
        ("a: 1\n--- \nb: 2\n", "but found another document"),
        ("[" * 101 + "]" * 101, "more than 100 levels deep"),
        ("? " + "[" * 101 + "]" * 101 + "\n: 1\n", "more than 100 levels deep"),
    ],
)
def test_what_the_library_refuses_is_refused(text, told):
    with pytest.raises(yaml.YAMLError, match=told):
        read_yaml(text)


@pytest.mark.parametrize("text", ["", "# nothing\n", "~", "---\n...\n"])
def test_nothing_is_none(text):
    assert read_yaml(text).data is None
