"""The Allan deviation of the three signals as a figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from bench.analysis.stability.allan import AllanCurve
from bench.analysis.stability.noise_terms import NoiseTerms
from bench.base.arrays import CHANNELS
from bench.base.numbers import scale_for
from bench.report.plots import BLUE, GREEN, GREY, VERMILION, svg_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
