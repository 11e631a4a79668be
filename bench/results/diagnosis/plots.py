"""Figures of a diagnosis: before, after, simulated bench, measured over simulated signals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.base.numbers import MINUS, Scale, scale_for
from bench.calibration.result import Calibration
from bench.diagnosis.full import Rival
from bench.diagnosis.gap import Gap
from bench.diagnosis.show import SEED, ModulusPoint, Shown
from bench.results.plots import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    VERMILION,
    dodged_deg,
    legend_of,
    mark_changes,
    mounts_of,
    residual_points,
    sd_of_reading,
    svg_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


MANY: Final = 3
"""From so many mountings on there is room for their labels alone."""


def columns_of(shown: Shown) -> list[tuple[str, Calibration]]:
    """Return what is drawn side by side: before, after, a simulated run; nothing after where nothing was named."""
    after = [] if shown.after is None else [("after", shown.after.calibration)]
    return [
        ("before" if after else "readings", shown.before.calibration),
        *after,
        (f"simulated bench, seed {SEED}", shown.last.repeated),
    ]


def common_scale(shown: Shown) -> Scale:
    """Return the scale on which all residuals are drawn."""
    largest = max(float(np.max(np.abs(c.residuals))) for _, c in columns_of(shown))
    return scale_for(largest, shown.before.calibration.unit)


def residuals_of_mount(shown: Shown, mount: int) -> str:
    """Residuals against head angle in one mounting: a row for each channel, before and after side by side.

    The stand's angles are at their estimates. The band is two standard deviations of a single reading.
    """
    columns, scale = columns_of(shown), common_scale(shown)
    name = str(mounts_of(columns[0][1])[mount][0])

    def draw(figure: Figure) -> None:
        grid: Any = figure.subplots(3, len(columns), sharex=True, sharey=True, squeeze=False)
        fine = np.linspace(-8.0, 368.0, 189)
        for column, (title, calibration) in enumerate(columns):
            _, rows = mounts_of(calibration)[mount]
            band = 2.0 * sd_of_reading(calibration, rows, np.radians(fine)) / scale.size
            grid[0, column].set_title(title)
            for i, channel in enumerate(CHANNELS):
                axes: Axes = grid[i, column]
                axes.fill_between(fine, -band[:, i], band[:, i], color="#B9C4CE", alpha=0.45, linewidth=0)
                axes.axhline(0.0, color=GREY, linewidth=0.7)
                residual_points(
                    axes, calibration, rows, i, dodged_deg(calibration), scale, f"readings-{column}"
                )
                axes.set_xticks(range(0, 361, 90))
                axes.set_xlim(-12.0, 372.0)
                if column == 0:
                    axes.set_ylabel(f"channel {channel} / {scale.unit}")
            grid[2, column].set_xlabel("head angle / °")
        figure.legend(*legend_of(grid.flat), loc="outside upper center", ncols=6)

    titles = ", ".join(title for title, _ in columns)
    alt = f"Residuals of channels x, y, z in installation {name} against head angle: {titles}"
    return svg_figure(f"diagnosis-mount-{mount}", (7.6, 5.4), draw, alt)


def residuals_in_time(shown: Shown) -> str:
    """Residuals against time (in the order of measurement where there is none), before and after side by side."""
    columns, scale = columns_of(shown)[: 1 if shown.after is None else 2], common_scale(shown)
    time_s = columns[0][1].fitted.time_s
    timed = bool(np.all(np.isfinite(time_s)))
    along = time_s / 3600.0 if timed else np.arange(1.0, len(time_s) + 1.0)

    def draw(figure: Figure) -> None:
        grid: Any = figure.subplots(3, len(columns), sharex=True, sharey=True, squeeze=False)
        for column, (title, calibration) in enumerate(columns):
            for i, channel in enumerate(CHANNELS):
                axes: Axes = grid[i, column]
                axes.axhline(0.0, color=GREY, linewidth=0.7)
                for _, rows in mounts_of(calibration):
                    residual_points(axes, calibration, rows, i, along, scale, f"readings-{column}")
                if column == 0:
                    axes.set_ylabel(f"channel {channel} / {scale.unit}")
            word = "installation " if len(mounts_of(calibration)) < MANY else ""
            mark_changes(grid[:, column], calibration, along, word)
            grid[0, column].set_title(title, pad=16)
            grid[2, column].set_xlabel("time / h" if timed else "reading, in order")
        figure.legend(*legend_of(grid.flat), loc="outside upper center", ncols=6)

    alt = "Residuals of channels x, y, z against time, before and after"
    return svg_figure("diagnosis-time", (7.6, 5.0), draw, alt)


def gap_bars(gap: Gap) -> str:
    """Reduced chi-square of what was held out, each fold by itself, before and after; 1 is noise alone."""
    folds = gap.folds
    names = [fold.label.replace(" and ", "\nand ") for fold in folds]
    places = np.arange(len(folds), dtype=float)

    def draw(figure: Figure) -> None:
        axes: Axes = figure.subplots()
        before, after = [f.before.reduced for f in folds], [f.after.reduced for f in folds]
        for key, heights, shift, colour in (
            ("before", before, -0.19, VERMILION), ("after", after, 0.19, BLUE),
        ):  # fmt: skip
            for counted in (True, False):
                chosen = [i for i, fold in enumerate(folds) if fold.counted is counted]
                if chosen:
                    axes.bar(
                        places[chosen] + shift, [heights[i] for i in chosen], width=0.36,
                        color=colour if counted else "white", edgecolor=colour,
                        hatch="" if counted else "////", linewidth=0.8,
                        label=key if counted else f"{key}, not counted",
                    )  # fmt: skip
        axes.axhline(1.0, color=GREY, linestyle=(0, (6, 3)), linewidth=1.1, label="noise alone")
        axes.set_xticks(places, names)
        axes.grid(visible=False, axis="x")
        axes.set_ylabel("reduced χ² of readings held out")
        axes.set_xlim(-0.6, len(folds) - 0.4)
        figure.legend(loc="outside upper center", ncols=5)

    alt = f"Reduced chi-square of readings held out before and after, {len(folds)} folds; noise alone gives 1"
    return svg_figure("diagnosis-gap", (6.4, 3.0), draw, alt)


def ranking(rows: Sequence[Rival], named: str, number: int) -> str:
    """Ln odds of the most plausible families; those that the data cannot tell apart in one bracket."""
    ordered = sorted(rows, key=lambda rival: rival.evidence)
    places = np.arange(len(ordered), dtype=float)
    alike = [i for i, rival in enumerate(ordered) if rival.family == named or rival.tied]

    def draw(figure: Figure) -> None:
        axes: Axes = figure.subplots()
        for kind, colour, text in (
            ("named", BLUE, "found"), ("tied", ORANGE, "not told apart from it"),
            ("less", "#B9C4CE", "less plausible"),
        ):  # fmt: skip
            chosen = [i for i, rival in enumerate(ordered) if _kind(rival, named) == kind]
            if chosen:
                axes.barh(
                    places[chosen],
                    [ordered[i].evidence for i in chosen],
                    color=colour,
                    label=text,
                    height=0.7,
                )
        if len(alike) > 1 and max(alike) - min(alike) < len(alike):  # no other one between them
            reach = max(ordered[i].evidence for i in alike)
            at = reach + 0.03 * max(abs(reach), 1.0)
            axes.plot([at, at], [min(alike) - 0.35, max(alike) + 0.35], color="#222222", linewidth=1.2)
            axes.annotate(
                "tie", (at, float(np.mean([min(alike), max(alike)]))), xytext=(4, 0),
                textcoords="offset points", va="center",
            )  # fmt: skip
        axes.axvline(0.0, color=GREY, linewidth=0.7)
        axes.set_yticks(places, [rival.family for rival in ordered], parse_math=False)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("ln of the odds that it is there")
        axes.margins(x=0.12)
        figure.legend(loc="outside upper center", ncols=3)

    alt = f"Evidence of {named} and of its rivals: " + ", ".join(
        f"{rival.family} {rival.evidence:.1f}".replace("-", MINUS) for rival in reversed(ordered)
    )
    return svg_figure(f"diagnosis-ranking-{number}", (6.4, 1.1 + 0.24 * len(ordered)), draw, alt)


def _kind(rival: Rival, named: str) -> str:
    return "named" if rival.family == named else "tied" if rival.tied else "less"


def modulus(shown: Shown, limit_g: float) -> str:
    """Δg at the verification points before and after, bars of k = 2, between the limits (paper, Fig. 6)."""
    scale = scale_for(limit_g, "g")
    limit = limit_g / scale.size
    parts: list[tuple[str, Sequence[ModulusPoint], str, str]] = [("Δg", shown.before.points, "o", BLUE)]
    if shown.after is not None:
        parts = [("before", shown.before.points, "s", VERMILION), ("after", shown.after.points, "o", BLUE)]
    count = len(shown.before.points)

    def draw(figure: Figure) -> None:
        axes: Axes = figure.subplots()
        axes.axhspan(-limit, limit, color=GREEN, alpha=0.07, linewidth=0)
        axes.axhline(0.0, color=GREY, linewidth=0.7)
        for sign in (1.0, -1.0):
            axes.axhline(sign * limit, color=VERMILION, linestyle=(0, (6, 3)), linewidth=1.1)
        for i, (name, points, marker, colour) in enumerate(parts):
            axes.errorbar(
                np.arange(count) + 0.24 * (i - (len(parts) - 1) / 2),
                [p.delta_g / scale.size for p in points], [2.0 * p.u / scale.size for p in points],
                fmt=marker, color=colour, markersize=5, capsize=3, linewidth=1.1, label=name,
            )  # fmt: skip
        several = len({p.pass_number for p in shown.before.points}) > 1
        axes.set_xticks(
            range(count),
            [
                f"{p.angle_deg:.0f}°" + (f"\npass {p.pass_number}" if several else "")
                for p in shown.before.points
            ],
        )
        axes.set_xlim(-0.6, count - 0.4)
        axes.grid(visible=False, axis="x")
        axes.annotate(
            f"limit ±{limit:g} {scale.unit}", (1.0, limit), xycoords=("axes fraction", "data"),
            xytext=(-4, 3), textcoords="offset points", ha="right", color="#A34700",
        )  # fmt: skip
        axes.set_xlabel("verification point: head angle")
        axes.set_ylabel(f"Δg / {scale.unit}")
        axes.margins(y=0.15)
        figure.legend(loc="outside upper center", ncols=2)

    alt = f"Δg at {count} verification points before and after, limit ±{limit:g} {scale.unit}"
    return svg_figure("diagnosis-modulus", (6.4, 3.0), draw, alt)


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
