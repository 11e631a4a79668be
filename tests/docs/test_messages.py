"""The messages on the page of troubles are those of the program: each stands in its code as it is quoted."""

from __future__ import annotations

import ast
import re
from functools import cache
from itertools import pairwise

import pytest

from tests.support.pages import DOCS, ELLIPSIS, ROOT

PAGE = DOCS / "troubleshooting.md"
QUOTED = [
    line[1:-1] for line, after in pairwise(PAGE.read_text(encoding="utf-8").splitlines())
    if line.startswith("`") and after.startswith(": ")
]  # fmt: skip


@cache
def words_of(path):
    """The words of a file of the code: one that lacks a word of a quotation need not be parsed for it."""
    return set(re.findall(r"[A-Za-z]{3,}", path.read_text(encoding="utf-8")))


@cache
def texts_of(path):
    """The texts of a file, an ellipsis for what is filled in; what is joined with plus stands together."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.append(node.value)
        elif isinstance(node, ast.JoinedStr):
            parts = (part.value if isinstance(part, ast.Constant) else ELLIPSIS for part in node.values)
            found.append("".join(parts))
    return found


def is_of_the_program(quoted):
    words = set(re.findall(r"[A-Za-z]{3,}", quoted))
    paths = (path for top in ("bench", "drivers", "sim") for path in (ROOT / top).rglob("*.py"))
    likely = (path for path in paths if words <= words_of(path))
    return any(pattern(quoted).search(text) for path in likely for text in texts_of(path))


def pattern(quoted):
    """What a text must hold: the words of a quotation; where it has an ellipsis anything may stand."""
    words = [re.escape(piece.strip()) for piece in quoted.split(ELLIPSIS) if piece.strip(" ';,()")]
    return re.compile(".*?".join(words), re.DOTALL)


@pytest.mark.parametrize("quoted", QUOTED)
def test_a_message_on_the_page_is_one_of_the_program(quoted):
    assert len(re.sub(r"\W", "", quoted)) >= 6, "too little of it to be looked for"
    assert is_of_the_program(quoted), quoted


def test_the_page_quotes_many_and_the_check_can_fail():
    assert len(QUOTED) >= 45
    assert not is_of_the_program("the voltmeter is out of sorts")
