"""Cells of a CSV file: numbers read strictly, text written so that no spreadsheet computes it."""

from __future__ import annotations

import math
import re
from typing import Final

from bench.base.numbers import read_number
from bench.base.visible import shortened, visible

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


OVERLOAD: Final = 9.0e37
"""What a meter shows that is overloaded is larger, V (34401A User's Guide, chapter 3)."""

ABSOLUTE_ZERO_C: Final = -273.15
HOTTEST_C: Final = 200.0
"""No chamber of a bench is hotter; room temperature in kelvin is."""

MOST: Final = 1_000_000
"""No run has more passes, points, series or samples; what is larger stood in another column."""


class BadCell(ValueError):
    """One cell that cannot be read: which column, what was expected."""

    def __init__(self, column: str, problem: str) -> None:
        super().__init__(problem)
        self.column = column


def number(
    text: dict[str, str],
    column: str,
    expected: str,
    *,
    optional: bool = False,
    least: float = -math.inf,
    most: float = math.inf,
    hint: str = "",
) -> float:
    """Return the number in a column, from `least` to `most`; an empty cell is NaN where it is `optional`.

    Raises `BadCell`, with a `hint` where the number lies beyond.
    """
    cell = text.get(column, "")
    if cell == "" and optional:
        return math.nan
    try:
        value = read_number(cell)
    except ValueError:
        raise BadCell(column, f"expected {expected}, got {_quoted(cell)}") from None
    if abs(value) >= OVERLOAD and math.isfinite(value):
        raise BadCell(
            column,
            f"the voltmeter was overloaded ({shortened(cell)}); measure this point again on a higher range",
        )
    if not math.isfinite(value):
        raise BadCell(column, f"expected {expected}, got {_quoted(cell)}")
    if not least <= value <= most:
        raise BadCell(column, f"expected {expected}, got {_quoted(cell)}{hint}")
    return value


def temperature(text: dict[str, str], column: str) -> float:
    """Return a temperature, °C, NaN of an empty cell. Raises `BadCell` for one that no bench has."""
    expected = f"a temperature in °C from {ABSOLUTE_ZERO_C:g} to {HOTTEST_C:g}"
    return number(
        text, column, expected, optional=True, least=ABSOLUTE_ZERO_C, most=HOTTEST_C,
        hint="; is it in kelvin or °F?",
    )  # fmt: skip


def integer(text: dict[str, str], column: str, *, default: int | None = None) -> float:
    """Return a whole number of 1 or more, of an empty cell the default. Raises `BadCell`."""
    if default is not None and text.get(column, "") == "":
        return float(default)
    expected = "a whole number, 1 or more"
    value = number(text, column, expected, most=MOST, hint="; is it of another column?")
    if not value >= 1 or value != int(value):
        raise BadCell(column, f"expected {expected}, got {_quoted(text[column])}")
    return value


def angle(text: dict[str, str], column: str, *, optional: bool) -> float:
    """Return an angle in degrees, at most two turns. Raises `BadCell`."""
    value = number(text, column, "an angle in degrees", optional=optional)
    if abs(value) > 720:
        raise BadCell(
            column, f"expected an angle in degrees between -720 and 720, got {_quoted(text[column])}"
        )
    return value


def direction(text: dict[str, str]) -> float:
    """Return +1 or -1, of an empty cell 0. Raises `BadCell`."""
    value = number(text, "direction", "+1 (rising), -1 (falling) or nothing", optional=True)
    if math.isnan(value):
        return 0.0
    if value not in {1.0, -1.0}:
        raise BadCell(
            "direction", f"expected +1 (rising), -1 (falling) or nothing, got {_quoted(text['direction'])}"
        )
    return value


def _quoted(cell: str) -> str:
    return repr(shortened(cell))
