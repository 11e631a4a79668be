"""The coefficients of several calibrations over time as a figure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bench.analysis.calibration.conformity import COVERAGE_FACTOR
from bench.analysis.history.comparison import Comparison
from bench.base.numbers import scale_for
from bench.model.block import COEFFICIENTS
from bench.report.plots import BLUE, GREY, VERMILION, svg_file, symbol

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
