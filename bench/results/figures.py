"""Figures of comparisons, histories and Allan deviations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from bench.base.arrays import CHANNELS
from bench.base.numbers import scale_for
from bench.calibration.conformity import COVERAGE_FACTOR
from bench.history.comparison import Comparison
from bench.history.equivalence import Equivalence
from bench.model.geometry import COEFFICIENTS
from bench.results.plots import BLUE, GREEN, GREY, VERMILION, svg_file, symbol
from bench.stats.allan import AllanCurve, NoiseTerms

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def equivalence_figure(benches: Sequence[str], found: Sequence[Equivalence], signal: str) -> str:
    """Return an SVG file; benches beyond U are crosses in red, the band is the dark size of the others."""
    places = np.arange(len(benches))

    def draw(figure: Figure) -> None:
        grid = figure.subplots(4, 3, sharey=True)
        for axes, name, one in zip(grid.flat, COEFFICIENTS, found, strict=True):
            U = COVERAGE_FACTOR * one.u_degree
            scale = scale_for(float(np.max(np.abs(one.degree) + U)), signal)
            if one.dark > 0:
                axes.axvspan(-one.dark / scale.size, one.dark / scale.size, color="#DDE2E6", zorder=0)
            axes.axvline(0.0, color=GREY, linewidth=0.7)
            for beyond, marker, colour in ((one.en <= 1.0, "o", BLUE), (one.en > 1.0, "X", VERMILION)):
                axes.errorbar(
                    one.degree[beyond] / scale.size, places[beyond], xerr=U[beyond] / scale.size,
                    fmt=marker, color=colour, capsize=2.0,
                )  # fmt: skip
            unit = scale.unit if name.startswith("U0") else scale.per_g
            axes.set_title(f"{symbol(name)} / {unit}")
            axes.set_yticks(places, benches)
            axes.set_ylim(len(benches) - 0.5, -0.5)
        figure.supxlabel("degree of equivalence: bench less reference, bars k = 2", fontsize=8)

    return svg_file("equivalence", (7.4, 2.4 + 0.9 * len(benches)), draw)


def history_figure(comparison: Comparison) -> str:
    """Return an SVG file: each coefficient less its first value, with bars of k = 2; changed ones in red."""
    snapshots = [comparison.first, *(changes.later for changes in comparison.changes)]
    dates = [snapshot.when for snapshot in snapshots if snapshot.when is not None]
    dated = len(dates) == len(snapshots)
    values = np.array([snapshot.vector for snapshot in snapshots]) - comparison.first.vector
    bars = COVERAGE_FACTOR * np.sqrt([np.diag(snapshot.covariance) for snapshot in snapshots])
    changed = np.any([changes.changed for changes in comparison.changes], axis=0)
    scale = scale_for(float(np.max(np.abs(values) + bars)), comparison.first.unit)

    def draw(figure: Figure) -> None:
        grid = figure.subplots(4, 3, sharex=True)
        for j, name in enumerate(COEFFICIENTS):
            axes = grid.flat[j]
            along = dates if dated else list(range(1, len(snapshots) + 1))
            axes.axhline(0.0, color=GREY, linewidth=0.7)
            axes.errorbar(
                along, values[:, j] / scale.size, bars[:, j] / scale.size,
                fmt="X" if changed[j] else "o", color=VERMILION if changed[j] else BLUE, capsize=2.5,
            )  # fmt: skip
            axes.set_title(symbol(name) + (" changed" if changed[j] else ""))
            if dated:
                axes.set_xticks([dates[0], dates[-1]], [f"{date:%Y-%m-%d}" for date in (dates[0], dates[-1])])
            else:
                axes.set_xticks(along)
        figure.supylabel(f"less the first / {scale.per_g}, biases: {scale.unit}; bars k = 2", fontsize=8)

    return svg_file("history", (7.4, 7.4), draw)


def allan_figure(curves: Sequence[AllanCurve], terms: Sequence[NoiseTerms], unit: str, tau_s: float) -> str:
    """Return an SVG file: deviation with 95 % limits, the noise terms' sum, the averaging time chosen."""
    scale = scale_for(min(float(curve.deviation.min()) for curve in curves), unit)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        look = zip(CHANNELS, (BLUE, VERMILION, GREEN), ("o", "s", "^"), curves, terms, strict=True)
        for channel, colour, marker, curve, term in look:
            low, high = curve.limits(term.freedom)
            reach = np.stack([curve.deviation - low, high - curve.deviation]) / scale.size
            axes.errorbar(
                curve.tau_s, curve.deviation / scale.size, reach,
                fmt=marker, color=colour, capsize=2, linewidth=0.9, label=f"channel {channel}",
            )  # fmt: skip
            fine = np.geomspace(curve.tau_s[0], curve.tau_s[-1], 200)
            axes.plot(fine, term.deviation(fine) / scale.size, color=colour, linewidth=0.8, alpha=0.7)
        axes.axvline(tau_s, color=GREY, linestyle=(0, (4, 3)), linewidth=0.9)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("averaging time / s")
        axes.set_ylabel(f"Allan deviation / {scale.unit}")
        axes.set_title(f"overlapping, limits 95 %; lines: the noise terms; dashed: {tau_s:.3g} s")
        figure.legend(loc="outside upper center", ncols=3)

    return svg_file("allan", (6.4, 4.2), draw)
