"""The page of a control chart: one HTML file that needs nothing but itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from markupsafe import Markup

from bench.base.arrays import Floats
from bench.base.numbers import MINUS, fixed, probability, scale_for, two_digits
from bench.model.geometry import COEFFICIENTS
from bench.results.control_chart import CheckBlockChart
from bench.results.plots import BLUE, GREY, VERMILION, svg_figure, symbol
from bench.results.template import page

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


MOST_SHOWN: Final = 60
"""So many of the last runs are drawn and listed."""
BASIS_IN_WORDS: Final = {
    "stated": "stated u, believed as it stands",
    "scaled": "stated u, times one factor for all coefficients that the baseline shows",
    "scatter": "the scatter of the baseline alone (Hotelling's T²)",
}


def render_chart(found: CheckBlockChart) -> str:
    """Return the page; the same chart gives the same text."""
    chart = found.chart
    last = chart.verdicts[-1] if chart.verdicts else None
    look = "none" if last is None else "passed" if last.accepted else "failed"
    word = {"none": "No verdict yet", "passed": "✓ In control", "failed": "✗ Out of control"}[look]
    figures = []
    if last is not None:
        figures = [
            Markup(svg_figure("joint", (7.4, 5.6), _Joint(found).draw, "T², EWMA and s of every run")),  # noqa: S704 - our own drawing
            Markup(svg_figure("single", (7.4, 8.2), _Single(found).draw, "every coefficient by run")),  # noqa: S704 - our own drawing
        ]
    return page(
        "control_chart.html.j2",
        found=found,
        chart=chart,
        look=look,
        word=word,
        last=last,
        basis=BASIS_IN_WORDS[chart.design.basis],
        factor=f"{float(np.sqrt(chart.centre.scale)):.2f}",
        figures=figures,
        runs=_runs(found),
        coefficients=_coefficients(found),
        components=_components(found),
        drift=_drift(found),
        singles=(f"{chart.limit_single:.2f}", f"{chart.limit_single_ewma:.2f}"),
        limits=(f"{chart.limit_t2:.1f}", f"{chart.limit_ewma:.1f}"),
    )


class _Joint:
    """Three panels over one another: T² of each run, T² of the EWMA, the short-term standard deviation."""

    def __init__(self, found: CheckBlockChart) -> None:
        self._chart, self._unit = found.chart, found.unit

    def draw(self, figure: Figure) -> None:
        chart = self._chart
        shown = slice(-MOST_SHOWN, None)
        panels = figure.subplots(3 if chart.short is not None else 2, sharex=True, squeeze=False)[:, 0]
        along = np.arange(1.0, len(chart.later) + 1)[shown]
        _panel(panels[0], along, chart.shewhart.t2[shown], np.full(len(along), chart.limit_t2))
        panels[0].set_ylabel("T² of the run")
        _panel(panels[1], along, chart.ewma.t2[shown], np.full(len(along), chart.limit_ewma))
        panels[1].set_ylabel(f"T² of the EWMA (λ = {chart.design.smoothing:g})")
        if chart.short is not None:
            scale = scale_for(chart.short.pooled, self._unit)
            limits = chart.short.limits(chart.design.alpha)[shown] / scale.size
            _panel(panels[2], along, chart.short.s[shown] / scale.size, limits)
            panels[2].axhline(chart.short.pooled / scale.size, color=GREY, linewidth=0.7)
            panels[2].set_ylabel(f"s of a reading / {scale.unit}")
        _name_runs(panels[-1], chart, along)


class _Single:
    """A panel for each coefficient: deviation from the centre with limits, and the EWMA with its own."""

    def __init__(self, found: CheckBlockChart) -> None:
        self._chart, self._unit = found.chart, found.unit

    def draw(self, figure: Figure) -> None:
        chart = self._chart
        shown = slice(-MOST_SHOWN, None)
        along = np.arange(1.0, len(chart.later) + 1)[shown]
        largest = max(float(np.max(chart.shewhart.u)), 1e-30) * chart.limit_single
        scale = scale_for(largest, self._unit)
        grid = figure.subplots(4, 3, sharex=True)
        for k, name in enumerate(COEFFICIENTS):
            axes = grid.flat[k]
            _coefficient(axes, chart, k, along, shown, scale.size)
            axes.set_title(symbol(name))
            axes.xaxis.get_major_locator().set_params(integer=True)
        figure.supylabel(f"off the centre / {scale.per_g}, biases: {scale.unit}", fontsize=8)
        figure.supxlabel("run after the baseline", fontsize=8)


def _coefficient(axes: Axes, chart: Any, k: int, along: Floats, shown: slice, size: float) -> None:
    own, smoothed = chart.shewhart, chart.ewma
    limit = chart.limit_single * own.u[shown, k] / size
    value = own.deviation[shown, k] / size
    axes.axhline(0.0, color=GREY, linewidth=0.7)
    _level(axes, along, limit, color=VERMILION, linewidth=0.8)
    _level(axes, along, -limit, color=VERMILION, linewidth=0.8)
    near = chart.limit_single_ewma * smoothed.u[shown, k] / size
    _level(axes, along, near, color=GREY, linewidth=0.8, linestyle="--")
    _level(axes, along, -near, color=GREY, linewidth=0.8, linestyle="--")
    axes.plot(along, smoothed.deviation[shown, k] / size, color=GREY, linewidth=1.2)
    beyond = np.abs(own.z[shown, k]) > chart.limit_single
    axes.plot(along[~beyond], value[~beyond], "o", color=BLUE, markersize=3)
    axes.plot(along[beyond], value[beyond], "X", color=VERMILION, markersize=5)


def _panel(axes: Axes, along: Floats, values: Floats, limits: Floats) -> None:
    beyond = values > limits
    axes.plot(along, values, color=GREY, linewidth=0.7)
    axes.plot(along[~beyond], values[~beyond], "o", color=BLUE, markersize=4)
    axes.plot(along[beyond], values[beyond], "X", color=VERMILION, markersize=6)
    _level(axes, along, limits, color=VERMILION, linewidth=1.0)
    axes.set_ylim(bottom=0.0)


def _level(axes: Axes, along: Floats, level: Floats, **style: Any) -> None:
    """Draw a limit half a run to either side of each, so that a single run has one to be seen, too."""
    axes.plot(np.column_stack((along - 0.5, along + 0.5)).ravel(), np.repeat(level, 2), **style)


def _name_runs(axes: Axes, chart: Any, along: Floats) -> None:
    """Name runs by the day they were begun, as many as there is room for."""
    every = max(1, len(along) // 8)
    ticks = along[::-1][::every][::-1]
    days = {f"{run.when:%Y-%m-%d}" for run in chart.later}
    text = "%m-%d %H:%M" if len(days) < len(chart.later) else "%Y-%m-%d"
    axes.set_xticks(ticks, [f"{chart.later[int(k) - 1].when:{text}}" for k in ticks], fontsize=7)


def _runs(found: CheckBlockChart) -> list[dict[str, Any]]:
    chart = found.chart
    rows = []
    for row in list(range(len(chart.later)))[-MOST_SHOWN:][::-1]:
        verdict, short = chart.verdicts[row], chart.short
        ewma = float(chart.ewma.t2[row])
        cells = [
            f"{verdict.when:%Y-%m-%d %H:%M}",
            f"{chart.shewhart.t2[row]:.1f}",
            "–" if np.isnan(ewma) else f"{ewma:.1f}",
            "–" if short is None else f"{np.sqrt(short.f[row]):.2f}",
            "in control" if verdict.accepted else "; ".join(verdict.reasons),
        ]
        rows.append({"head": verdict.run, "cells": cells, "bad": not verdict.accepted})
    return rows


def _coefficients(found: CheckBlockChart) -> list[dict[str, Any]]:
    chart = found.chart
    if not chart.verdicts:
        return []
    rows = []
    for k, name in enumerate(COEFFICIENTS):
        u, deviation = float(chart.shewhart.u[-1, k]), float(chart.shewhart.deviation[-1, k])
        scale = scale_for(u, found.unit)
        unit = scale.unit if name.startswith("U0") else scale.per_g
        ewma = float(chart.ewma.z[-1, k])
        z = float(chart.shewhart.z[-1, k])
        cells = [
            f"{fixed(deviation / scale.size, 1)} {unit}",
            f"{u / scale.size:.1f} {unit}",
            f"{z:+.1f}".replace("-", MINUS),
            "–" if np.isnan(ewma) else f"{ewma:+.1f}".replace("-", MINUS),
        ]
        beyond = abs(z) > chart.limit_single or abs(ewma) > chart.limit_single_ewma
        rows.append({"head": Markup(_html(name)), "cells": cells, "bad": beyond})  # noqa: S704 - our own names
    return rows


def _components(found: CheckBlockChart) -> list[dict[str, Any]]:
    parts = found.chart.components
    if parts is None:
        return []
    rows = []
    for k, name in enumerate(COEFFICIENTS):
        scale = scale_for(float(parts.stated[k]), found.unit)
        columns = (parts.noise, parts.stated, parts.scatter, parts.between, parts.between_most)
        unit = scale.unit if name.startswith("U0") else scale.per_g
        sizes = ["0" if column[k] == 0.0 else two_digits(float(column[k]) / scale.size) for column in columns]
        cells = [*(f"{size} {unit}" for size in sizes), f"{parts.f[k]:.2f}", probability(float(parts.p[k]))]
        bad = bool(parts.more_than_stated[k] < 0.01)
        rows.append({"head": Markup(_html(name)), "cells": cells, "bad": bad})  # noqa: S704 - our own names
    return rows


def _drift(found: CheckBlockChart) -> list[dict[str, Any]]:
    drift = found.chart.drift
    if drift is None:
        return []
    rows = []
    for k, name in enumerate(COEFFICIENTS):
        scale = scale_for(float(drift.u[k]), found.unit)
        unit = scale.unit if name.startswith("U0") else scale.per_g
        cells = [
            f"{fixed(float(drift.per_year[k]) / scale.size, 1)} {unit}",
            f"{float(drift.u[k]) / scale.size:.1f} {unit}",
            probability(float(drift.p[k])),
        ]
        rows.append({"head": Markup(_html(name)), "cells": cells, "bad": bool(drift.p[k] < 0.01)})  # noqa: S704 - our own names
    return rows


def _html(name: str) -> str:
    return f"{name[0]}<sub>{name[1:]}</sub>"
