"""The page of a unit: its coefficients over time with their u, its runs, when it is due."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from markupsafe import Markup

from bench.base.arrays import Floats
from bench.base.numbers import fixed, places, scale_for, two_digits
from bench.calibration.conformity import COVERAGE_FACTOR
from bench.model.geometry import COEFFICIENTS
from bench.results.plots import BLUE, GREY, svg_figure, svg_file, symbol
from bench.results.template import page

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INCHES: Final = (7.4, 7.6)
_RUN_COLUMNS: Final = (
    "created",
    "name",
    "bench",
    "procedure",
    "operator",
    "state",
    "verdict",
    "diagnosis",
    "problem",
)


def render_unit(history: Mapping[str, Any]) -> str:
    """Return the page of a unit, from what `bench catalogue unit --json` has; the same gives the same text."""
    calibrations = history["calibrations"]
    return page(
        "unit.html.j2",
        history=history,
        figure=Markup(unit_figure(calibrations)) if calibrations else None,  # noqa: S704 - our own drawing
        expected=_expected(history["due"]),
        rows=coefficient_rows(calibrations),
        headings=[column.replace("_", " ") for column in _RUN_COLUMNS],
        runs=[[_cell(run[column]) for column in _RUN_COLUMNS] for run in reversed(history["runs"])],
    )


def _expected(due: Mapping[str, Any] | None) -> list[str]:
    """Return the errors expected at the last calibration and when due, in millionths of g, to two digits."""
    sizes = [due[name] for name in ("error_at_last_g", "error_when_due_g")] if due else []
    return ["–" if size is None else two_digits(size * 1e6) for size in sizes]


def unit_figure(calibrations: Sequence[Mapping[str, Any]]) -> str:
    """Return an SVG element: each coefficient less its last value over time, with bars of k = 2."""
    words = f"Each of the twelve coefficients in {len(calibrations)} calibrations, less its last value"
    return svg_figure("unit", INCHES, _drawing(calibrations), words)


def unit_file(calibrations: Sequence[Mapping[str, Any]]) -> str:
    """Return the same as an SVG file that stands alone."""
    return svg_file("unit", INCHES, _drawing(calibrations))


def _drawing(calibrations: Sequence[Mapping[str, Any]]) -> Callable[[Figure], None]:
    dates = np.array([one["created"][:19] for one in calibrations], dtype="datetime64[s]")
    values, sizes = _arrays(calibrations)
    change, bars = values - values[-1], COVERAGE_FACTOR * sizes
    unit = calibrations[-1]["unit"]

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

    return draw


def coefficient_rows(calibrations: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Return for each coefficient its last value, its U, the change since the one before and since the first."""
    if not calibrations:
        return []
    values, sizes = _arrays(calibrations)
    rows = []
    for j, name in enumerate(COEFFICIENTS):
        digits = places(float(COVERAGE_FACTOR * sizes[-1, j])) if sizes[-1, j] > 0 else 6
        since = [values[-1, j] - values[k, j] for k in ((-2, 0) if len(values) > 1 else ())]
        changes = [fixed(float(change), digits, sign=True) for change in since] or ["–", "–"]
        unit = calibrations[-1]["unit"] + ("" if name.startswith("U0") else "/g")
        last, expanded = float(values[-1, j]), float(COVERAGE_FACTOR * sizes[-1, j])
        rows.append((name, fixed(last, digits), fixed(expanded, digits), *changes, unit))
    return rows


def _arrays(calibrations: Sequence[Mapping[str, Any]]) -> tuple[Floats, Floats]:
    """Return values and standard uncertainties, (n, 12) each."""
    found = [
        [[one["coefficients"][name][what] for name in COEFFICIENTS] for one in calibrations]
        for what in ("value", "u")
    ]
    return np.array(found[0]), np.array(found[1])


def _cell(value: Any) -> str:
    return "–" if value is None else str(value)[:16].replace("T", " ") if _is_time(value) else str(value)


def _is_time(value: Any) -> bool:
    return isinstance(value, str) and value.endswith("+00:00") and value[4:5] == "-"
