"""Text in the cells of a CSV file: what a spreadsheet would compute, or a terminal obey, goes out as text alone."""

from __future__ import annotations

import re
from typing import Final

from bench.base.visible import visible

_NUMBER: Final = re.compile(r" *[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)? *")
_FORMULA: Final = re.compile(r"'*(?:\s*[=+\-@＝＋－＠]|[\t\r\n])")
_ESCAPE: Final = re.compile(r"\\(?:x([0-9a-f]{2})|u([0-9a-f]{4})|U([0-9a-f]{8}))")
_OF_ESCAPES: Final = re.compile(r"\\(?:\\|x[0-9a-f]{2}|u[0-9a-f]{4}|U[0-9a-f]{8})")


def as_cell(text: str) -> str:
    r"""Return a text as a cell that any spreadsheet and terminal keeps as text; a number stays as it is.

    One that begins like a formula (`=`, `+`, `-`, `@`, tab, line end) gets an apostrophe in front. Control
    characters become escapes (`\x1b`), backslashes beside them two.
    """
    safe = visible(text)
    if safe != text or _shows_escape(text):
        safe = visible(text.replace("\\", "\\\\"))
    return f"'{safe}" if _FORMULA.match(safe) and not _NUMBER.fullmatch(safe) else safe


def of_cell(cell: str) -> str:
    """Return the text of which `as_cell` makes the cell; a cell that it never makes comes back as it is."""
    safe = cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell
    if not _shows_escape(safe) or "\\" in _OF_ESCAPES.sub("", safe):
        return safe
    return _OF_ESCAPES.sub(lambda found: "\\" if found[0] == r"\\" else _character(found[0]), safe)


def _shows_escape(text: str) -> bool:
    """Whether something in the text reads like an escape of a character that is not visible."""
    return any(visible(character := _character(found[0])) != character for found in _ESCAPE.finditer(text))


def _character(escape: str) -> str:
    code = int(escape[2:], 16)
    return chr(code) if code < 0x110000 else escape
