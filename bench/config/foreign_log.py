"""Conversion of other programs' logs to readings files, by a mapping of their columns, units and time format.

Such a mapping is a YAML file:

    log_columns: 1
    time_format: "%Y-%m-%d %H:%M:%S"
    columns:
      time_s: timestamp
      reference_v: {columns: [k1, k2, k3], unit: V}     # their mean; their scatter goes into reference_sd_v
      ux_v: {columns: dut, unit: uV}
      meter_temperature_c: bath
    constants: {installation: R}
"""

from __future__ import annotations

import csv
import io
import math
import re
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, Field

from bench.base.arrays import HOUR, MINUTE
from bench.base.numbers import read_number
from bench.base.text import shortened
from bench.base.units import plain_unit, unit_of
from bench.base.yaml_files import FileModel, Place
from bench.readings.csv import LISTED_AT_ONCE, ReadingsError
from bench.readings.table import REFERENCE_SD_V, REFERENCE_V, SCAN_ORDER, TEMPERATURE_SOURCE, UNITS

SUFFIXES: Final[Mapping[str, str]] = {"_v": "V", "_s": "s", "_a": "A"}
"""The SI unit of a readings file's column, by its suffix; of other columns, only temperatures are converted."""
SCATTER: Final[Mapping[str, str]] = {REFERENCE_V: REFERENCE_SD_V} | {
    f"u{axis}_{unit}": f"u{axis}_sd_{unit}" for axis in "xyz" for unit in UNITS
}
"""The name of the column of scatter, for each column of a readings file that has one."""
TIME: Final = "time_s"
INSTALLATION: Final = "installation"
TEXTS: Final = (INSTALLATION, SCAN_ORDER, TEMPERATURE_SOURCE)
"""The columns of a readings file whose cells are texts; a label of an installation such as 1.0 becomes 1."""
TEMPERATURES: Final[Mapping[str, tuple[float, float]]] = {
    "degC": (1.0, 0.0), "K": (1.0, -273.15), "degF": (5.0 / 9.0, -160.0 / 9.0),
}  # fmt: skip
"""For each unit of temperature in a log, the factor and then the summand of its conversion to °C."""
MOST_PREVIEWED: Final = 5


def _column(value: Any) -> Any:
    """Return the long form of a column that is written as a name or a list of names."""
    if isinstance(value, str | list):
        return {"columns": value}
    return value


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


class LogColumn(FileModel):
    """Columns of a log; their mean becomes one column of the readings file.

    With a `time_format`, the cells of the columns for `time_s`, such as date and time of day, are joined by a
    blank instead. For a signal and for `reference_v`, the standard deviation of several columns becomes a
    further column (`ux_sd_v`, `reference_sd_v`). `unit` is the unit in the log. `add`, in the unit of the
    readings file, is added to the mean. The label 1.0 of an installation is read as 1.
    """

    columns: Annotated[tuple[str, ...], BeforeValidator(_listed)]
    unit: str | None = None
    add: float = 0.0


class LogColumns(FileModel):
    """A mapping from the columns of a log to those of a readings file.

    `time_format` is a format for `strptime`, or `iso`. Lines that begin with `comment` are skipped. `constants`
    maps columns of the readings file to cells that are the same in every row.
    """

    log_columns: Literal["1"]
    separator: str = ","
    decimal: Literal[".", ","] = "."
    comment: str = "#"
    time_format: str | None = None
    columns: dict[str, Annotated[LogColumn, BeforeValidator(_column)]]
    constants: dict[str, str] = Field(default={})

    @classmethod
    def cross_checks(cls, data: Any) -> Iterable[tuple[Place, str]]:
        """Yield place and sentence for each wrong unit, column listed twice, and text from several columns."""
        columns = data.get("columns") if isinstance(data, dict) else None
        for name, value in columns.items() if isinstance(columns, dict) else ():
            unit = value.get("unit") if isinstance(value, dict) else None
            listed = value.get("columns") if isinstance(value, dict) else value
            if name in TEXTS:
                several = isinstance(listed, list) and len(listed) != 1
                if several or (isinstance(value, dict) and {"unit", "add"} & set(value)):
                    yield ("columns", name), f"{name} is a text; name one column, without 'unit' and 'add'"
                continue
            for one in _repeated(listed) if isinstance(listed, list) else ():
                yield ("columns", name), f"the mean has the column {shortened(str(one))} twice; list it once"
            if isinstance(unit, str):
                try:
                    _factor(name, unit)
                except ValueError as problem:
                    yield ("columns", name, "unit"), str(problem)


def _repeated(names: Sequence[Any]) -> list[Any]:
    return [name for k, name in enumerate(names) if names.index(name) < k]


def _factor(name: str, unit: str | None) -> float:
    """Return the factor from the log's `unit` to the unit of column `name`. Raises `ValueError` if none."""
    wanted = next((si for end, si in SUFFIXES.items() if name.endswith(end)), None)
    if unit is None:
        return 1.0
    if name.endswith("_c"):
        if plain_unit(unit) not in TEMPERATURES:
            raise ValueError(f"the unit {unit} of {name} is no unit of temperature; state degC, K or degF")
        return TEMPERATURES[plain_unit(unit)][0]
    size, dimension = unit_of(plain_unit(unit))
    if wanted is None or dimension != unit_of(wanted)[1]:
        raise ValueError(
            f"the unit {unit} of {name} cannot be converted to {wanted or '1'}; state another unit"
        )
    return size


def _summand(name: str, unit: str | None) -> float:
    """Return the summand that completes the conversion of a temperature to °C; 0 for other quantities.

    The temperature is first multiplied by the factor of `unit`.
    """
    return TEMPERATURES[plain_unit(unit)][1] if unit is not None and name.endswith("_c") else 0.0


@dataclass(frozen=True)
class ConvertedLog:
    """A log converted to a readings file: its text, the number of rows, and the rows left out, with the reason.

    A row has the same line number in both files, so that a message about one of them also fits the other.
    """

    text: str
    rows: int
    skipped: tuple[str, ...]

    def preview(self) -> str:
        """Return the header and the first rows."""
        return "\n".join([line for line in self.text.splitlines() if line][: 1 + MOST_PREVIEWED])


def convert_log(
    path: Path, content: bytes, mapping: LogColumns, *, skip_bad_rows: bool = False
) -> ConvertedLog:
    """Return a log converted to a readings file; times count from the first row of the log.

    Raises `ReadingsError` for an unreadable log, for columns that the log lacks, for a local time that goes
    back as if a clock was put back, and for every bad row (the first 20, then how many more). A row is bad if
    a cell is no number or time, or if it has too few or too many cells. With `skip_bad_rows`, bad rows are
    left out, unless all rows are bad.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ReadingsError(f"{path}: not a UTF-8 text file; save it as UTF-8") from error
    separator = {"tab": "\t", "\\t": "\t"}.get(mapping.separator, mapping.separator)
    if len(separator) != 1:
        raise ReadingsError(
            f"{path}: the mapping's separator {separator!r} is not one character; state one there, or 'tab'"
        )
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.startswith(mapping.comment)
    ]
    rows = list(
        csv.reader(io.StringIO("\n".join(line for _, line in lines), newline=""), delimiter=separator)
    )
    if not rows:
        raise ReadingsError(
            f"{path}: the log has no line besides comments; give a log with a header and rows"
        )
    if len(rows) != len(lines):
        raise ReadingsError(
            f"{path}: a cell in quotes runs over the end of its line; remove the line break, or close the quote"
        )
    header = [cell.strip() for cell in rows[0]]
    _require(path, header, mapping)
    if len(rows) == 1:
        raise ReadingsError(f"{path}: the log has a header but no row; give a log with rows")
    reader = _Rows(header, mapping)
    made, bad = [], []
    for (number, _), cells in zip(lines[1:], rows[1:], strict=True):
        try:
            made.append((number, reader.row(cells)))
        except _HourRepeatedError as problem:
            raise ReadingsError(f"{path}, line {number}, {problem}") from None
        except ValueError as problem:
            bad.append(f"{path}, line {number}, {problem}")
    if bad and not (skip_bad_rows and made):
        more = [f"… and {len(bad) - LISTED_AT_ONCE} more bad rows"] if len(bad) > LISTED_AT_ONCE else []
        remedy = (
            "no row is left; mend the rows or the mapping"
            if not made
            else "mend the rows, or add --skip-bad-rows"
        )
        told = [*bad[:LISTED_AT_ONCE], *more, f"nothing was imported; {remedy}"]
        raise ReadingsError("\n".join(told))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\r\n")
    writer.writerow(reader.names)
    last = 1
    for number, row in made:
        out.write("\r\n" * (number - last - 1))
        writer.writerow(row)
        last = number
    return ConvertedLog(out.getvalue(), len(made), tuple(bad))


def _require(path: Path, header: Sequence[str], mapping: LogColumns) -> None:
    """Raise `ReadingsError` unless the header has each column that is mapped exactly once."""
    wanted = [name for column in mapping.columns.values() for name in column.columns]
    missing = [name for name in dict.fromkeys(wanted) if name not in header]
    if missing:
        raise ReadingsError(
            f"{path}, line 1: the log lacks the columns {', '.join(missing)} that the mapping names; correct the "
            f"mapping (the log has {', '.join(header)})"
        )
    for name in wanted:
        if len(at := [str(k) for k, one in enumerate(header, start=1) if one == name]) > 1:
            raise ReadingsError(
                f"{path}, line 1: columns {' and '.join(at)} have the same name {name}; give each a name of its own"
            )


def _text(name: str, cell: str) -> str:
    """Return a cell of a column of `TEXTS`; a label such as 1.0 becomes 1."""
    return re.sub(r"^(\d+)[.,]0*$", r"\1", cell) if name == INSTALLATION else cell


class _HourRepeatedError(Exception):
    """Local time goes back as if a clock was put back: all times after it may be an hour too early."""


class _Rows:
    def __init__(self, header: Sequence[str], mapping: LogColumns) -> None:
        self.mapping = mapping
        self._header = header
        self._at = {
            name: [header.index(c) for c in column.columns] for name, column in mapping.columns.items()
        }
        self._scatter = {
            name: sd for name, at in self._at.items() if len(at) > 1 and (sd := SCATTER.get(name))
        }
        self._factor = {name: _factor(name, column.unit) for name, column in mapping.columns.items()}
        self._add = {
            name: column.add + _summand(name, column.unit) for name, column in mapping.columns.items()
        }
        self._began: float | None = None
        self._latest = -math.inf
        self.names = [*mapping.constants, *mapping.columns, *self._scatter.values()]

    def row(self, cells: Sequence[str]) -> list[str]:
        """Return the cells of one row. Raises `ValueError` that names the first wrong cell."""
        if len(cells) != len(self._header):
            raise ValueError(f"expected {len(self._header)} cells as in the header, got {len(cells)}")
        values, scatter = [], []
        for name, column in self.mapping.columns.items():
            if name in TEXTS:
                values.append(_text(name, cells[self._at[name][0]].strip()))
                continue
            if name == TIME and self.mapping.time_format is not None:
                joined = " ".join(cells[k].strip() for k in self._at[name])
                numbers = [self._since_begin(" and ".join(column.columns), joined)]
            else:
                numbers = [self._number(name, self._header[k], cells[k].strip()) for k in self._at[name]]
            mean = statistics.fmean(numbers) + self._add[name]
            values.append("" if math.isnan(mean) else repr(mean))
            if name in self._scatter:
                scatter.append("" if math.isnan(mean) else repr(statistics.stdev(numbers)))
        return [*self.mapping.constants.values(), *values, *scatter]

    def _number(self, name: str, column: str, cell: str) -> float:
        if not cell and name != TIME:
            return math.nan
        if self.mapping.decimal == "," and "." in cell:
            raise ValueError(
                f"column {column}: the point in {shortened(cell)!r} may separate thousands; "
                "remove it, or state decimal: '.'"
            )
        text = cell.replace(",", ".") if self.mapping.decimal == "," else cell
        try:
            value = read_number(text) * self._factor[name]
        except ValueError:
            raise ValueError(f"column {column}: expected a number, got {shortened(cell)!r}") from None
        if name == TIME:
            self._began = value if self._began is None else self._began
            return value - self._began
        return value

    def _since_begin(self, column: str, cell: str) -> float:
        form = self.mapping.time_format or ""
        try:
            at = datetime.fromisoformat(cell) if form == "iso" else datetime.strptime(cell, form)
        except ValueError:
            raise ValueError(f"column {column}: expected a time as {form}, got {shortened(cell)!r}") from None
        seconds = (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()
        back, self._latest = self._latest - seconds, seconds
        if at.tzinfo is None and HOUR / 2 <= back <= HOUR:
            raise _HourRepeatedError(
                f"column {column}: the time goes back by {back / MINUTE:.0f} min; if the clock was put back, write "
                "times with their UTC offset (%z), otherwise sort the rows"
            )
        self._began = seconds if self._began is None else self._began
        return seconds - self._began
