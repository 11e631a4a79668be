"""The messages on the page of troubles are those of the program: each stands in its code as it is quoted."""

from __future__ import annotations

import ast
import re
from itertools import pairwise

import pytest

from tests.support.pages import DOCS, ELLIPSIS, ROOT

PAGE = DOCS / "troubleshooting.md"
QUOTED = [
    line[1:-1] for line, after in pairwise(PAGE.read_text(encoding="utf-8").splitlines())
    if line.startswith("`") and after.startswith(": ")
]  # fmt: skip


def literals():
    """Every text of the code, an ellipsis for what is filled in; what is joined with plus stands together."""
    for top in ("bench", "drivers", "sim"):
        for path in (ROOT / top).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    yield node.value
                elif isinstance(node, ast.JoinedStr):
                    yield "".join(
                        part.value if isinstance(part, ast.Constant) else ELLIPSIS for part in node.values
                    )


@pytest.fixture(scope="module")
def texts():
    return set(literals())


def pattern(quoted):
    """What a text must hold: the words of a quotation; where it has an ellipsis anything may stand."""
    words = [re.escape(piece.strip()) for piece in quoted.split(ELLIPSIS) if piece.strip(" ';,()")]
    return re.compile(".*?".join(words), re.DOTALL)


@pytest.mark.parametrize("quoted", QUOTED)
def test_a_message_on_the_page_is_one_of_the_program(quoted, texts):
    assert len(re.sub(r"\W", "", quoted)) >= 6, "too little of it to be looked for"
    assert any(pattern(quoted).search(text) for text in texts), quoted


def test_the_page_quotes_many_and_the_check_can_fail(texts):
    assert len(QUOTED) >= 45
    assert not any(pattern("the voltmeter is out of sorts").search(text) for text in texts)
