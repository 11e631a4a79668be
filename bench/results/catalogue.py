"""The results of `bench catalogue`: sync, queries, units, due dates; as JSON, as text, and a unit as a page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from pydantic import Field
from rich.console import Console
from rich.text import Text

from bench.base.arrays import Floats
from bench.base.languages import HEADING, local_number, message, translated
from bench.base.numbers import fixed, places, scale_for, two_digits, uncertainty
from bench.base.result_model import ResultModel
from bench.base.tables import print_notes, table
from bench.calibration.conformity import COVERAGE_FACTOR
from bench.history.drift import Due
from bench.model.geometry import COEFFICIENTS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ON_SCREEN: Final = 40
"""Largest number of rows that a terminal shows; files have all rows."""

_COLUMNS_ON_SCREEN: Final = {
    "runs": ("name", "created", "unit", "bench", "state", "verdict", "diagnosis", "problem"),
    "coefficients": ("name", "created", "unit", "bench", "Kxx", "Kyy", "Kzz", "U0x", "U0y", "U0z"),
}
"""Columns that a terminal shows, by type of row; all columns for types that are not listed here."""

Row = dict[str, bool | int | float | str | None]
"""A row by column; null where nothing was recorded, times in UTC (ISO 8601)."""


class FolderProblem(ResultModel):
    """A folder with a problem found by the sync."""

    path: str = Field(description="the folder")
    reason: str = Field(description="why the folder is not in the catalogue, or what is wrong with its run")


class SyncResult(ResultModel):
    """The result of synchronising the catalogue with the run folders."""

    catalogue: str = Field(description="file of the catalogue, or its URL without the password")
    added: int = Field(description="number of new runs")
    changed: int = Field(description="number of runs whose files changed and were read again")
    unchanged: int = Field(description="number of folders that did not change")
    moved: int = Field(description="number of runs that are in another folder than before")
    vanished: int = Field(description="number of runs whose folder no longer exists")
    problems: list[FolderProblem]

    def print_on(self, out: Console) -> None:
        """Print the problems and the counts."""
        for one in self.problems:
            out.print(f"{one.path}: {one.reason}")
        bad = f", {len(self.problems)} with a problem" if self.problems else ""
        out.print(
            f"{self.catalogue}: {self.added} new, {self.changed} changed, {self.moved} moved, {self.unchanged} as "
            f"they were, {self.vanished} gone{bad}",
            style="bold",
        )


class AskResult(ResultModel):
    """The answer to a catalogue query, as rows."""

    query: list[str] = Field(description="the words of the question")
    of: Literal[
        "runs", "coefficients", "units", "benches", "operators", "instruments", "certificates", "issued", "folders"
    ] = Field(description="kind of thing that each row describes")  # fmt: skip
    count: int = Field(description="number of rows")
    rows: list[Row] = Field(description="rows as values by column; null if not recorded; times in UTC")

    def print_on(self, out: Console) -> None:
        """Print the first rows, with as many columns as the terminal has room for."""
        if self.rows:
            names = [name for name in _COLUMNS_ON_SCREEN.get(self.of, self.rows[0]) if name in self.rows[0]]
            shown = table(*(name.replace("_", " ") for name in names))
            for row in self.rows[:ON_SCREEN]:
                shown.add_row(*(_shown(name, _cell(row[name])) for name in names))
            out.print(shown)
        out.print(f"{self.count} {self.of}{_not_shown(self.count, '--csv')}", style="bold")


class DuePart(ResultModel):
    """The date on which a unit is due for calibration, and the reason."""

    due: str = Field(description="date on which the next calibration is due")
    basis: Literal["drift", "interval"]
    """`drift`, or `interval` if the history is too short to determine the drift"""
    why: str = Field(description="reason for the date, a sentence")
    last: str = Field(description="date of the last calibration")
    calibrations: int = Field(description="number of calibrations from which the date was found")
    limit_g: float = Field(description="permitted error, local g, for 1 g in any direction")
    error_at_last_g: float | None
    """expected expanded error (k = 2) at the last calibration, g; null if the date follows from the interval
    """
    error_when_due_g: float | None
    """expected expanded error (k = 2) on the due date, g; null if the date follows from the interval"""
    simulated: bool = Field(description="whether the calibrations are of simulated runs")


class UnitDue(DuePart):
    """A unit, the date on which it is due for calibration, and the reason."""

    unit: str = Field(description="type and serial number")


class InstrumentDue(ResultModel):
    """An instrument whose latest certificate has expired or will soon."""

    instrument: str = Field(description="maker, model and serial number")
    certificate: str = Field(description="number of the certificate")
    valid_until: str = Field(description="last day on which the certificate is valid")


class DueResult(ResultModel):
    """The dates on which units are due for calibration, earliest first."""

    query: list[str] = Field(description="the words of the question")
    units: list[UnitDue]
    not_known: dict[str, str] = Field(description="units without a known due date, with the reason")
    instruments: list[InstrumentDue] = Field([])
    """instruments whose certificate expired, expires within 30 days, or expires before the requested date"""

    def print_on(self, out: Console) -> None:
        """Print the units that are due first, and why other units have no date."""
        shown = table("due", "unit", "by", ">calibrations", "last", "")
        for one in self.units[:ON_SCREEN]:
            simulated = translated("simulated", HEADING) if one.simulated else ""
            basis = translated(one.basis, HEADING)
            shown.add_row(one.due, Text(one.unit), basis, str(one.calibrations), one.last, simulated)
        if self.units:
            out.print(shown)
        count = len(self.units)
        counted = message(f"{count} unit{'' if count == 1 else 's'} due")
        out.print(f"{counted}{_not_shown(count, '--json')}", style="bold")
        print_notes(out, [f"{name}: {why}" for name, why in self.not_known.items()])
        print_notes(
            out,
            [
                message(
                    f"{one.instrument}: certificate {one.certificate} ends on {one.valid_until}; have it calibrated"
                )
                for one in self.instruments
            ],
        )


class CoefficientThen(ResultModel):
    """A coefficient from one calibration of a unit."""

    value: float = Field(description="coefficient in unit/g; a bias in unit")
    u: float = Field(description="standard uncertainty")
    U: float = Field(description="expanded uncertainty, k = 2")


class UnitCalibration(ResultModel):
    """One calibration of a unit."""

    path: str = Field(description="run folder")
    created: str = Field(description="time at which the run began, UTC")
    bench: str | None = Field(description="name of the bench in its bench file")
    unit: str = Field(description="unit of the signals")
    g_m_s2: float = Field(description="local gravity of the last calibration, to which all refer, m/s²")
    coefficients: dict[str, CoefficientThen]


class UnitResult(ResultModel):
    """The calibrations, runs and due date of one unit in the catalogue."""

    unit: str = Field(description="type and serial number")
    simulated: bool
    """true if the compared calibrations are of simulated runs, which is so only if the unit has no others"""
    due: DuePart | None = Field(description="when the next calibration is due; null if no date is known")
    why_not_due: str = Field(description="why no date is known; empty if one is known")
    calibrations: list[UnitCalibration] = Field(description="compared calibrations, oldest first")
    runs: list[Row] = Field(description="all runs of the unit, as `bench catalogue ask` lists them")
    notes: list[str]

    def print_on(self, out: Console) -> None:
        """Print the latest coefficients with their changes, and the due date."""
        made = message(f"{len(self.runs)} runs, {len(self.calibrations)} calibrations compared")
        out.print(f"{self.unit}: {made}{', SIMULATED' if self.simulated else ''}", style="bold")
        if self.calibrations:
            last = self.calibrations[-1]
            out.print(
                f"U = K a + U0, K per local g of the last calibration, {last.g_m_s2:.6g} m/s², U in {last.unit}"
            )
            shown = table(
                "coefficient", ">last", ">U (k=2)", ">since the one before", ">since the first", "unit"
            )
            for row in coefficient_rows(self.calibrations):
                shown.add_row(*row)
            out.print(shown)
        print_notes(out, self.notes)
        due = self.due
        told = message(f"due on {due.due}: {due.why}") if due else message(f"no date due: {self.why_not_due}")
        out.print(told, style="bold")


def due_part(found: Due) -> DuePart:
    """Return the part of the result on the due date of a unit."""
    return DuePart.from_object(
        found,
        due=str(found.date.astype("datetime64[D]")),
        last=str(found.last.astype("datetime64[D]")),
        calibrations=found.count,
        error_at_last_g=found.now_g,
        error_when_due_g=found.predicted_g,
    )


def _not_shown(count: int, option: str) -> str:
    more = count - ON_SCREEN
    return "; " + message(f"{more} more are not shown: {option} FILE has all") if more > 0 else ""


def _shown(column: str, cell: str) -> str | Text:
    """Return a cell for the terminal: a state or verdict in the current language, a name as it is."""
    if column == "verdict":
        return translated(cell, "statement")
    return translated(cell) if column in ("state", "problem") else Text(local_number(cell))


def _cell(value: object) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str) and value.endswith("+00:00") and value[4:5] == "-":  # a time in UTC
        return value[:16].replace("T", " ")
    return f"{value:.6g}" if isinstance(value, float) else str(value)


# --- a unit: page and figure --------------------------------------------------------------------------

INCHES: Final = (7.4, 7.6)
_RUN_COLUMNS: Final = (
    "created", "name", "bench", "procedure", "operator", "state", "verdict", "diagnosis", "problem",
)  # fmt: skip


def unit_page(result: UnitResult) -> str:
    """Return the HTML page of a unit; the same result always gives the same text."""
    from bench.results.tables import page

    calibrations = result.calibrations
    return page(
        "unit.html.j2",
        history=result,
        figure=unit_figure(calibrations, inline=True) if calibrations else None,
        two_digits=two_digits,
        rows=coefficient_rows(calibrations),
        headings=[column.replace("_", " ") for column in _RUN_COLUMNS],
        runs=[[_cell(run[column]) for column in _RUN_COLUMNS] for run in reversed(result.runs)],
    )


def unit_figure(calibrations: Sequence[UnitCalibration], *, inline: bool = False) -> str:
    """Return an SVG plot of each coefficient minus its last value, with U (k = 2); `inline`: for a page."""
    from bench.results.plots import BLUE, GREY, svg_figure, svg_file, symbol

    dates = np.array([one.created[:19] for one in calibrations], dtype="datetime64[s]")
    values, sizes = _arrays(calibrations)
    change, bars = values - values[-1], COVERAGE_FACTOR * sizes
    unit = calibrations[-1].unit

    def draw(figure: Figure) -> None:
        grid = figure.subplots(4, 3, sharex=True)
        for j, name in enumerate(COEFFICIENTS):
            axes = grid.flat[j]
            scale = scale_for(float(np.max(np.abs(change[:, j]) + bars[:, j])), unit)
            axes.axhline(0.0, color=GREY, linewidth=0.7)
            axes.errorbar(
                dates.astype(object), change[:, j] / scale.size, bars[:, j] / scale.size,
                fmt="o", color=BLUE, capsize=2.0, markersize=3.0, elinewidth=0.8,
            )  # fmt: skip
            axes.set_title(f"{symbol(name)} / {scale.unit if name.startswith('U0') else scale.per_g}")
            ends = [dates[0], dates[-1]] if dates[-1] > dates[0] else [dates[0]]
            axes.set_xticks([end.astype(object) for end in ends], [str(end)[:10] for end in ends])

    if not inline:
        return svg_file("unit", INCHES, draw)
    words = f"Each of the twelve coefficients in {len(calibrations)} calibrations, less its last value"
    return svg_figure("unit", INCHES, draw, words)


def coefficient_rows(calibrations: Sequence[UnitCalibration]) -> list[tuple[str, ...]]:
    """Return a row for each coefficient: name, last value, U, changes since the previous and the first, unit."""
    if not calibrations:
        return []
    values, sizes = _arrays(calibrations)
    rows = []
    for j, name in enumerate(COEFFICIENTS):
        last, expanded = float(values[-1, j]), float(COVERAGE_FACTOR * sizes[-1, j])
        digits = places(expanded) if expanded > 0 else 6
        since = [values[-1, j] - values[k, j] for k in ((-2, 0) if len(values) > 1 else ())]
        changes = [fixed(float(change), digits, sign=True) for change in since] or ["–", "–"]
        unit = calibrations[-1].unit + ("" if name.startswith("U0") else "/g")
        rows.append((name, fixed(last, digits), uncertainty(expanded), *changes, unit))
    return rows


def _arrays(calibrations: Sequence[UnitCalibration]) -> tuple[Floats, Floats]:
    """Return the values and the standard uncertainties of the coefficients, each (n, 12)."""
    values, sizes = (
        np.array([[getattr(one.coefficients[name], what) for name in COEFFICIENTS] for one in calibrations])
        for what in ("value", "u")
    )
    return values, sizes
