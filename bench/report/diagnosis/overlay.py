"""Measured and simulated signals in one figure: as they are, and magnified as what the model given does not say."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bench.analysis.diagnosis.show import Shown
from bench.base.arrays import CHANNELS, Floats, Mask
from bench.base.numbers import scale_for
from bench.report.plots import GREY, dodged_deg, legend_of, mounts_of, residual_points, svg_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK: Final = "#222222"


def most_telling(shown: Shown) -> list[int]:
    """Return the mountings by their numbers, those first in which what was found changes the simulation most."""
    before, last = shown.before.calibration, shown.last.calibration
    missing = before.residuals - last.residuals
    sizes = [float(np.mean(missing[rows] ** 2)) for _, rows in mounts_of(before)]
    return sorted(range(len(sizes)), key=lambda mount: -sizes[mount])


def overlay_of_mount(shown: Shown, mount: int) -> str:
    """Signals against head angle in one mounting, a row for each channel: measured points over the simulated bench.

    On the left the signals, on the right both less what the model as it was given simulates: what is missing from
    it, and how the bench simulated with what was found has it.
    """
    before, last = shown.before.calibration, shown.last.calibration
    label, rows = mounts_of(before)[mount]
    signal = before.fitted.signal
    simulated, missing = signal - last.residuals, before.residuals - last.residuals
    volts = scale_for(float(np.max(np.abs(signal))), before.unit)
    scale = scale_for(float(np.max(np.abs(before.residuals))), before.unit)
    angle = dodged_deg(before)
    fine = np.linspace(-8.0, 368.0, 189)
    whose = "as it was given" if shown.after is None else "with what was found"

    def draw(figure: Figure) -> None:
        grid: Any = figure.subplots(3, 2, sharex=True, squeeze=False)
        for i, channel in enumerate(CHANNELS):
            left: Axes = grid[i, 0]
            left.plot(
                fine, _wave(angle[rows], simulated[rows, i], fine) / volts.size, color=INK, linewidth=1.0,
                label=f"simulated bench, {whose}",
            )  # fmt: skip
            left.plot(
                angle[rows], signal[rows, i] / volts.size, "o", color="#0072B2", markersize=4, alpha=0.8,
                label="measured",
            )  # fmt: skip
            left.set_ylabel(f"channel {channel} / {volts.unit}")
            right: Axes = grid[i, 1]
            right.axhline(
                0.0, color=GREY, linewidth=0.7, linestyle=(0, (4, 3)), label="simulated as it was given"
            )
            residual_points(right, before, rows, i, angle, scale, f"overlay-{mount}")
            if shown.after is not None:
                right.plot(
                    angle[rows], missing[rows, i] / scale.size, "_", color=INK, markersize=11,
                    markeredgewidth=1.8, label=f"simulated bench, {whose}",
                )  # fmt: skip
                _joined(
                    right,
                    np.degrees(before.fitted.angle_rad),
                    missing[:, i] / scale.size,
                    rows,
                    before.fitted.pass_number,
                )
            right.set_ylabel(scale.unit)
        grid[0, 0].set_title(f"installation {label}")
        grid[0, 1].set_title("less the bench simulated as it was given")
        for axes in grid[2]:
            axes.set_xticks(range(0, 361, 90))
            axes.set_xlim(-12.0, 372.0)
            axes.set_xlabel("head angle / °")
        figure.legend(*legend_of(grid.flat), loc="outside upper center", ncols=3)

    alt = (
        f"Measured and simulated signals of channels x, y, z in installation {label} against head angle, and both "
        f"less the bench simulated as it was given"
    )
    return svg_figure(f"diagnosis-overlay-{mount}", (7.6, 5.6), draw, alt)


def _wave(angle_deg: Floats, values: Floats, at_deg: Floats) -> Floats:
    """Return the wave through simulated signals: a constant, once a turn, and what few angles give beyond."""

    def columns(degrees: Floats) -> Floats:
        phi = np.radians(degrees)
        return np.column_stack([np.ones_like(phi), np.cos(phi), np.sin(phi)])

    return np.asarray(columns(at_deg) @ np.linalg.lstsq(columns(angle_deg), values, rcond=None)[0])


def _joined(axes: Axes, angle_deg: Floats, values: Floats, rows: Mask, passes: Any) -> None:
    """Join what is simulated of one pass, in the order of the angle."""
    for number in np.unique(passes[rows]):
        mine = np.flatnonzero(rows & (passes == number))
        ordered = mine[np.argsort(angle_deg[mine])]
        axes.plot(angle_deg[ordered], values[ordered], color=INK, linewidth=0.7, alpha=0.6)
