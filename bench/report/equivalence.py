"""Degrees of equivalence of benches as a figure: one panel a coefficient, a bar of U (k = 2) a bench."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from bench.analysis.calibration.conformity import COVERAGE_FACTOR
from bench.analysis.intercomparison.equivalence import Equivalence
from bench.base.numbers import scale_for
from bench.model.block import COEFFICIENTS
from bench.report.plots import BLUE, GREY, VERMILION, svg_file, symbol

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
