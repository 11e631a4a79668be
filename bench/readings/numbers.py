"""Numbers in the cells of a readings file, and what is said of those that are none."""

from __future__ import annotations

import math
from typing import Final

OVERLOAD: Final = 9.0e37
"""What a meter shows that is overloaded is larger, V (34401A User's Guide, chapter 3)."""


class BadCell(ValueError):
    """One cell that cannot be read: which column, what was expected."""

    def __init__(self, column: str, problem: str) -> None:
        super().__init__(problem)
        self.column = column


def number(text: dict[str, str], column: str, expected: str, *, optional: bool = False) -> float:
    """Return the number in a column; an empty cell is NaN where it is `optional`. Raises `BadCell`."""
    cell = text.get(column, "")
    if cell == "" and optional:
        return math.nan
    try:
        if "_" in cell:
            raise ValueError
        value = float(cell)
    except ValueError:
        raise BadCell(column, f"expected {expected}, got {cell!r}") from None
    if abs(value) >= OVERLOAD and math.isfinite(value):
        raise BadCell(
            column, f"the voltmeter was overloaded ({cell}); measure this point again on a higher range"
        )
    if not math.isfinite(value):
        raise BadCell(column, f"expected {expected}, got {cell!r}")
    return value


def integer(text: dict[str, str], column: str, *, default: int | None = None) -> float:
    """Return a whole number of 1 or more, of an empty cell the default. Raises `BadCell`."""
    if default is not None and text.get(column, "") == "":
        return float(default)
    value = number(text, column, "a whole number, 1 or more")
    if value != int(value) or not 1 <= value < 2**31:
        raise BadCell(column, f"expected a whole number, 1 or more, got {text[column]!r}")
    return value


def angle(text: dict[str, str], column: str, *, optional: bool) -> float:
    """Return an angle in degrees, at most two turns. Raises `BadCell`."""
    value = number(text, column, "an angle in degrees", optional=optional)
    if abs(value) > 720:
        raise BadCell(column, f"expected an angle in degrees between -720 and 720, got {text[column]!r}")
    return value


def direction(text: dict[str, str]) -> float:
    """Return +1 or -1, of an empty cell 0. Raises `BadCell`."""
    value = number(text, "direction", "+1 (rising), -1 (falling) or nothing", optional=True)
    if math.isnan(value):
        return 0.0
    if value not in {1.0, -1.0}:
        raise BadCell(
            "direction", f"expected +1 (rising), -1 (falling) or nothing, got {text['direction']!r}"
        )
    return value
