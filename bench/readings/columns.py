"""Strict parsing and safe writing of cells of a readings file; the optional columns of level and supply."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, Final

import numpy as np

from bench.base.arrays import ARCSEC, HOUR, Floats, Ints, Labels
from bench.base.numbers import read_number
from bench.base.text import shortened, visible

# --- cells ------------------------------------------------------------------------------------------

_NUMBER: Final = re.compile(r" *[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)? *")
_FORMULA: Final = re.compile(r"'*(?:\s*[=+\-@＝＋－＠]|[\t\r\n])")
_ESCAPE: Final = re.compile(r"\\(?:x([0-9a-f]{2})|u([0-9a-f]{4})|U([0-9a-f]{8}))")
_OF_ESCAPES: Final = re.compile(r"\\(?:\\|x[0-9a-f]{2}|u[0-9a-f]{4}|U[0-9a-f]{8})")


def as_cell(text: str) -> str:
    r"""Return a text as a cell that no spreadsheet or terminal interprets; a number stays unchanged.

    Text that begins like a formula (`=`, `+`, `-`, `@`, tab, line end) is prefixed with an apostrophe. Control
    characters become escapes (`\x1b`); the text's own backslashes are then doubled.
    """
    safe = visible(text)
    if safe != text or _shows_escape(text):
        safe = visible(text.replace("\\", "\\\\"))
    return f"'{safe}" if _FORMULA.match(safe) and not _NUMBER.fullmatch(safe) else safe


def of_cell(cell: str) -> str:
    """Return the text of a cell, the inverse of `as_cell`.

    A cell that is no possible result of `as_cell` stays unchanged.
    """
    safe = cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell
    if not _shows_escape(safe) or "\\" in _OF_ESCAPES.sub("", safe):
        return safe
    return _OF_ESCAPES.sub(lambda found: "\\" if found[0] == r"\\" else _character(found[0]), safe)


def _shows_escape(text: str) -> bool:
    """Return whether the text contains an escape, such as `\\x1b`, of an invisible character."""
    return any(visible(character := _character(found[0])) != character for found in _ESCAPE.finditer(text))


def _character(escape: str) -> str:
    code = int(escape[2:], 16)
    return chr(code) if code < 0x110000 else escape


OVERLOAD: Final = 9.0e37
"""Readings of this size or more, V, mean an overloaded meter (34401A User's Guide, chapter 3)."""

_SIGNAL: Final = ("ux_", "uy_", "uz_")

ABSOLUTE_ZERO_C: Final = -273.15
HOTTEST_C: Final = 200.0
"""The highest valid temperature, °C: above that of any chamber, below room temperature in kelvin."""

MOST: Final = 1_000_000
"""The largest valid pass, point, series or number of samples; a larger number is in the wrong column."""


class BadCell(ValueError):
    """An invalid cell; `column` is its column, the message states the expected content."""

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
    """Return the number in a column of the row `text`; NaN for an empty `optional` cell.

    Raises `BadCell` for anything else. Its message has `expected`, or says that the meter was overloaded; for
    a number not from `least` to `most` it ends with `hint`.
    """
    cell = text.get(column, "")
    if cell == "" and optional:
        return math.nan
    try:
        value = read_number(cell)
    except ValueError:
        raise BadCell(column, f"expected {expected}, got {_quoted(cell)}") from None
    if abs(value) >= OVERLOAD and math.isfinite(value) and not column.startswith(_SIGNAL):
        raise BadCell(
            column,
            f"expected {expected}, got {_quoted(cell)}, which meters give for an overload or an open sensor; "
            f"correct this cell{' or leave it empty' if optional else ''}",
        )
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
    """Return the temperature in a column, °C, NaN for an empty cell. Raises `BadCell` if it is impossible."""
    expected = f"a temperature in °C from {ABSOLUTE_ZERO_C:g} to {HOTTEST_C:g}"
    return number(
        text, column, expected, optional=True, least=ABSOLUTE_ZERO_C, most=HOTTEST_C,
        hint="; perhaps it is in kelvin or °F; use °C",
    )  # fmt: skip


def integer(text: dict[str, str], column: str, *, default: int | None = None) -> float:
    """Return the whole number, 1 or more, in a column; `default` for an empty cell. Raises `BadCell`."""
    if default is not None and text.get(column, "") == "":
        return float(default)
    expected = "a whole number, 1 or more"
    value = number(text, column, expected, most=MOST, hint="; is it from another column?")
    if not value >= 1 or value != int(value):
        raise BadCell(column, f"expected {expected}, got {_quoted(text[column])}")
    return value


def angle(text: dict[str, str], column: str, *, optional: bool) -> float:
    """Return the angle in a column, -720 to 720 degrees, NaN for an empty `optional` cell. Raises `BadCell`."""
    value = number(text, column, "an angle in degrees", optional=optional)
    if abs(value) > 720:
        raise BadCell(
            column, f"expected an angle in degrees between -720 and 720, got {_quoted(text[column])}"
        )
    return value


def direction(text: dict[str, str]) -> float:
    """Return the direction of approach of a row: +1, -1, or 0 for an empty cell. Raises `BadCell`."""
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


# --- optional columns: the level, the supply and its rails ------------------------------------------

ANGLES: Final = ("alpha1_arcsec", "alpha2_arcsec", "u_alpha1_arcsec", "u_alpha2_arcsec")
"""The columns of the platform's tilt angles during a mounting and of their standard uncertainties."""
DRIFTS: Final = ("drift_alpha1_arcsec_h", "drift_alpha2_arcsec_h")
"""The columns of the rms rate of tilt of the platform, from repeated level readings; one value for a run."""
LEVEL_COLUMNS: Final = (*ANGLES, *DRIFTS)


def level_rad(extra: Mapping[str, Labels], rows: int) -> Floats | None:
    """Return α1, α2, u(α1), u(α2) of each row, rad, shape (rows, 4), NaN if unknown; None without level columns.

    `extra` are the text columns of a table. Raises `ValueError` for a cell that is not a number, for a row
    with only some of the four values, and for a standard uncertainty that is not above 0.
    """
    if not all(name in extra for name in ANGLES):
        return None
    columns = [
        [float(cell) if cell.strip() else math.nan for cell in extra[name].tolist()] for name in ANGLES
    ]
    found = np.array(columns, dtype=np.float64).reshape(4, rows).T * ARCSEC
    whole = np.isfinite(found).all(axis=1)
    if np.any(part := np.isfinite(found).any(axis=1) & ~whole):
        row = int(np.argmax(part)) + 1
        raise ValueError(f"row {row} states only some of {', '.join(ANGLES)}; fill in all of them, or none")
    if np.any(bad := whole & (found[:, 2:] <= 0.0).any(axis=1)):
        row = int(np.argmax(bad)) + 1
        raise ValueError(f"a u in row {row} is not above 0 ({', '.join(ANGLES[2:])}); state it above 0")
    return found


def drift_rad_s(extra: Mapping[str, Labels]) -> tuple[float, float] | None:
    """Return the rms rates of change of α1 and α2, rad/s, from text columns.

    Return None if no mounting had two level readings.
    """
    if not all(name in extra for name in DRIFTS):
        return None
    rates = [[float(cell) for cell in extra[name].tolist() if cell.strip()] for name in DRIFTS]
    if not all(rates):
        return None
    one, two = (math.sqrt(sum(r**2 for r in own) / len(own)) * ARCSEC / HOUR for own in rates)
    return one, two


def wrong_level_cell(text: Mapping[str, str]) -> tuple[str, str] | None:
    """Return the first level column with an invalid cell in a row, and a sentence on it; None for a valid row."""
    for name in LEVEL_COLUMNS:
        cell = text.get(name, "").strip()
        try:
            good = not cell or math.isfinite(read_number(cell))
        except ValueError:
            good = False
        if not good:
            return name, f"expected a number of arcsec, got {shortened(cell)!r}"
    given = [name for name in ANGLES if text.get(name, "").strip()]
    for name in ANGLES if given else ():
        if name not in given or (name.startswith("u_") and float(text[name]) <= 0.0):
            return name, f"expected a number: {', '.join(ANGLES)} must be filled in together, with u above 0"
    return None


_COLUMN: Final = re.compile(r"rail_(?P<rail>[a-z][a-z0-9_]*?)_(?P<what>nominal_v|v|a)")


def voltage_column(rail: str) -> str:
    """Return the name of the column with a rail's measured voltage, V."""
    return f"rail_{rail}_v"


def nominal_column(rail: str) -> str:
    """Return the name of the column with a rail's nominal voltage, V."""
    return f"rail_{rail}_nominal_v"


def current_column(rail: str) -> str:
    """Return the name of the column with a rail's measured current, A."""
    return f"rail_{rail}_a"


def is_of_a_rail(column: str) -> bool:
    """Return whether a column holds a rail's voltage, nominal voltage or current."""
    return _COLUMN.fullmatch(column) is not None


def rails_of(columns: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the rails whose voltage column is among `columns`, in the order of `columns`."""
    matches = [_COLUMN.fullmatch(column) for column in columns]
    return tuple(match["rail"] for match in matches if match is not None and match["what"] == "v")


def above_nominal_v(extra: Mapping[str, Labels]) -> Floats | None:
    """Return the rail voltages minus their nominal voltages, V, shape (n, rails); None without rails.

    A value is NaN if the voltage or the nominal voltage is not given.
    """
    rails = rails_of(extra)
    if not rails:
        return None
    columns = [
        numbers(extra[voltage_column(rail)])
        - (numbers(extra[nominal_column(rail)]) if nominal_column(rail) in extra else np.nan)
        for rail in rails
    ]
    return np.stack(columns, axis=1)


METER_C: Final = "meter_temperature_c"
"""The column of the temperature of the voltmeters, °C."""
ROOM_C: Final = "room_c"
"""The column of the temperature of the room, °C."""


def meter_c(extra: Mapping[str, Labels]) -> Floats | None:
    """Return the temperature of the voltmeters, °C, shape (n,), NaN where unknown.

    If it was never recorded, the temperature of the room takes its place. `extra` are the text columns of a table.
    Returns None if neither temperature is recorded.
    """
    own = next((name for name in (METER_C, ROOM_C) if any(map(str.strip, extra.get(name, ())))), None)
    return None if own is None else numbers(extra[own])


MOUNTING: Final = "mounting_number"
"""The column of the number of the mounting, if the block stayed mounted for several series."""


def mountings(extra: Mapping[str, Labels]) -> Ints | None:
    """Return the number of each row's mounting, shape (n,), 0 where unknown; None without the column."""
    return np.nan_to_num(numbers(extra[MOUNTING])).astype(np.int64) if MOUNTING in extra else None


def mounting_cells(series: Sequence[object], mounted: Sequence[object]) -> list[str]:
    """Return the cells of the column `mounting_number`, empty ones if each series is a mounting.

    `series` and `mounted` identify the series and the mounting of each reading; None is a reading without mounting.
    """
    pairs = {pair for pair in zip(series, mounted, strict=True) if pair[1] is not None}
    if len(pairs) == len({one for one, _ in pairs}) == len({one for _, one in pairs}):
        return [""] * len(mounted)
    number = {one: str(place) for place, one in enumerate(dict.fromkeys(filter(None, mounted)), start=1)}
    return ["" if one is None else number[one] for one in mounted]


SINCE_POWER_ON_S: Final = "since_power_on_s"
"""The column of the time since the block was switched on, s."""


def since_power_on_s(extra: Mapping[str, Labels]) -> Floats | None:
    """Return the time since the block was switched on, s, shape (n,), NaN where unknown; None if not recorded."""
    return numbers(extra[SINCE_POWER_ON_S]) if SINCE_POWER_ON_S in extra else None


def since_power_on_cells(read_s: Sequence[float | None], power: Sequence[tuple[float, str]]) -> list[str]:
    """Return the cells of the column `since_power_on_s` for readings at the times `read_s`, s; "" if unknown.

    `power` lists (time in s, state) from the record; the states are "on", "found on", "off" and "fault". A block
    "found on" has been on since the last "on"; without an earlier "on" the time is unknown.
    """
    cells = []
    for time_s in read_s:
        since_s = None
        for at_s, state in power:
            if time_s is None or at_s > time_s:
                break
            since_s = {"on": at_s, "found on": since_s}.get(state)
        cells.append("" if time_s is None or since_s is None else f"{time_s - since_s:.3f}")
    return cells


def numbers(cells: Labels) -> Floats:
    """Return the cells of a column as numbers, NaN for an empty cell, shape (n,)."""
    return np.array([float(cell) if cell.strip() else np.nan for cell in cells.tolist()], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Rail:
    """A supply rail of the block: measured and nominal voltage with their signs, V, and measured current, A."""

    voltage_v: float
    nominal_v: float
    current_a: float

    def to_json(self) -> dict[str, float]:
        """Return the rail as a JSON object for an event of the record."""
        return {"voltage_v": self.voltage_v, "nominal_v": self.nominal_v, "current_a": self.current_a}

    @classmethod
    def from_json(cls, name: str, row: Mapping[str, Any]) -> Rail:
        """Return the rail `name` from the JSON object of an event. Raises `KeyError`, `TypeError`, `ValueError`."""
        values = (row["voltage_v"], row["nominal_v"], row["current_a"])
        if any(type(value) not in (int, float) or not isfinite(value) for value in values):
            raise ValueError(f"rail {name}: voltage, nominal voltage or current is not a number")
        return cls(*values)


def between(before: Mapping[str, Rail], after: Mapping[str, Rail]) -> dict[str, Rail]:
    """Return the means of the measurements before and after a reading, for rails in both of them, by name."""
    return {
        name: Rail(
            (rail.voltage_v + after[name].voltage_v) / 2.0,
            rail.nominal_v,
            (rail.current_a + after[name].current_a) / 2.0,
        )
        for name, rail in before.items()
        if name in after
    }


def columns_of(taken: Sequence[Mapping[str, Rail]]) -> dict[str, list[str]]:
    """Return the text columns of the supply rails by name: measured voltage, nominal voltage and current of each.

    `taken` has the rails of each reading by name. A cell is empty where a reading lacks the rail.
    """
    columns: dict[str, list[str]] = {}
    for name in dict.fromkeys(name for rails in taken for name in rails):
        rails = [row.get(name) for row in taken]
        columns[voltage_column(name)] = ["" if rail is None else repr(rail.voltage_v) for rail in rails]
        columns[nominal_column(name)] = ["" if rail is None else f"{rail.nominal_v:g}" for rail in rails]
        columns[current_column(name)] = ["" if rail is None else repr(rail.current_a) for rail in rails]
    return columns


def ranges_in_words(extra: Mapping[str, Sequence[str]]) -> str:
    """Return the ranges of voltage and current of each rail in words; an empty string without rails.

    `extra` are the text columns of a table.
    """
    told = []
    for rail in rails_of(extra):
        spans = [_span(extra[voltage_column(rail)], "V", 1.0)]
        if current_column(rail) in extra:
            spans.append(_span(extra[current_column(rail)], "mA", 1e3))
        told.append(f"{rail} {', '.join(span for span in spans if span) or 'not measured'}")
    return "; ".join(told)


def _span(cells: Sequence[str], unit: str, scale: float) -> str:
    values = [float(cell) * scale for cell in cells if cell.strip()]
    if not values:
        return ""
    low, high = f"{min(values):.5g}", f"{max(values):.5g}"
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"
