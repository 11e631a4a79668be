"""Each row of the table of events names tests that there are."""

from __future__ import annotations

import ast
import re

import pytest

from tests.support.pages import DOCS, ROOT

TEXT = (DOCS / "when-something-happens.md").read_text(encoding="utf-8")
LINES = [line.strip("| ").split(" | ") for line in TEXT.splitlines() if line.startswith("| ")]
EVENTS = [[cell.strip() for cell in row] for row in LINES if row[0].strip() != "event"]
WANTED = (
    "chamber lost", "head lost", "voltmeter lost", "power cut", "closed terminal", "Ctrl-C once", "Ctrl-C again",
    "suspended", "civil time", "full disk", "second program", "chamber that does not move", "moves away",
    "outside its limits", "stalls",
)  # fmt: skip


def names_in(path):
    return {
        node.name for node in ast.parse((ROOT / path).read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef)
    }  # fmt: skip


@pytest.mark.parametrize("row", EVENTS, ids=[row[0] for row in EVENTS])
def test_a_row_is_whole_and_its_tests_are_there(row):
    assert len(row) == 5
    assert all(row)
    named = re.findall(r"`(tests/\S+\.py)::(\w+)`", row[4])
    assert named, row
    assert [f"{path}::{name}" for path, name in named if name not in names_in(path)] == []


def test_the_events_that_matter_are_in_the_table():
    assert [words for words in WANTED if not any(words in row[0] for row in EVENTS)] == []
