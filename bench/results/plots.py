"""The figures of the report, each as an SVG string for the page.

Glyphs are drawn as outlines, so that a figure looks the same everywhere. Identifiers and hashes are fixed, so
that the same input gives the same text. The colours are Okabe and Ito's, which colour-blind people can tell
apart; shapes or words repeat what colours show.
"""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from html import escape
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from markupsafe import Markup

from bench.base.arrays import CHANNELS, HOUR, MINUTE, Floats, Mask
from bench.base.languages import ENGLISH, language, message, translated
from bench.base.numbers import MINUS, Scale, scale_for
from bench.base.text import APPROACH
from bench.calibration import Calibration
from bench.calibration.budget.propagation import correlation_of
from bench.calibration.verification import Verification, VerificationPoint
from bench.model.conditions import Mounting
from bench.model.geometry import COEFFICIENTS
from bench.readings.table import VERIFICATION

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bench.diagnosis.show import ModulusPoint


# matplotlib warns if it cannot create its settings folder, which does not affect a page
logging.getLogger("matplotlib").setLevel(logging.ERROR)

BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"
PURPLE, ORANGE, GREY = "#CC79A7", "#E69F00", "#5F6B76"
PASS_COLOURS: Final = (BLUE, VERMILION, GREEN, PURPLE, ORANGE)
PASS_FILLS: Final = ("full", "none", "bottom", "left", "top")
MARKERS: Final = {1: "^", -1: "v", 0: "o"}
DODGE_DEG: Final = 5.0
"""Horizontal spread (degrees) of passes at the same angle, so that no reading hides another."""

STYLE: Final[dict[str, Any]] = {
    "svg.fonttype": "path",
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.titlesize": 9,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "grid.color": "#DDE2E6",
    "grid.linewidth": 0.5,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": "#222222",
    "ytick.labelcolor": "#222222",
    "legend.frameon": False,
    "lines.markersize": 4.5,
    "lines.markeredgewidth": 0.9,
}


Columns = Sequence[tuple[str, Calibration, Sequence[Mask]]]
"""Title of a column of a figure, the calibration, and the readings of each mounting drawn in it."""


def residuals_by_angle(calibration: Calibration) -> str:
    """Return a plot of residuals against head angle: a row per channel, a column per installation."""
    columns = [
        (message(f"installation {mount}"), calibration, [rows]) for mount, rows in mounts_of(calibration)
    ]
    alt = message(
        f"Residuals of channels x, y, z against head angle, {len(columns)} installations, with the ±2σ band"
    )
    size = (max(1.2 + 3.1 * len(columns), 4.6), 6.0)
    return residuals_against_angle("residuals-angle", size, columns, residual_scale(calibration), alt)


def residuals_against_angle(
    name: str, size: tuple[float, float], columns: Columns, scale: Scale, alt: str
) -> str:
    """Return a plot of residuals against head angle, a row per channel, a column for each of `columns`.

    A band shows ±2 standard deviations of a reading; `alt` is the alternative text.
    """
    fine = np.linspace(-8.0, 368.0, 189)

    def prepare(number: int, rows: Sequence[Axes]) -> None:
        title, calibration, (mine,) = columns[number]
        band = 2.0 * sd_of_reading(calibration, mine, np.radians(fine)) / scale.size
        rows[0].set_title(title, parse_math=False)
        for i, axes in enumerate(rows):
            axes.fill_between(fine, -band[:, i], band[:, i], color="#B9C4CE", alpha=0.45, linewidth=0)
            axes.set_xticks(range(0, 361, 90 if len(columns) > 2 else 45))
            axes.set_xlim(-12.0, 372.0)

    label = message("head angle / °")
    return _residuals(name, size, columns, dodged_deg, label, prepare, scale, alt)


def residuals_in_order(calibration: Calibration) -> str:
    """Return a plot of residuals against time or, if a reading has no time, in order of measurement."""
    columns = [("", calibration, [rows for _, rows in mounts_of(calibration)])]
    return residuals_in_time("residuals-order", (7.4, 5.2), columns, residual_scale(calibration))


def residuals_in_time(name: str, size: tuple[float, float], columns: Columns, scale: Scale) -> str:
    """Return a plot as `residuals_in_order` does, with a column of panels for each of `columns`."""
    time_s = columns[0][1].fitted.time_s
    along: Floats = np.arange(1.0, len(time_s) + 1.0)
    label = message("reading, in the order of measurement")
    if np.all(np.isfinite(time_s)):
        unit, of_unit = ("h", HOUR) if np.ptp(time_s) > 2 * HOUR else ("min", MINUTE)
        along, label = time_s / of_unit, message(f"time since the start / {unit}")
    # many labels have no room for the word
    word = "installation " if sum(len(mounts) for _, _, mounts in columns) <= MOST_WITH_WORD else ""

    def prepare(number: int, rows: Sequence[Axes]) -> None:
        title, calibration, _ = columns[number]
        mark_changes(rows, calibration, along, word)
        rows[0].set_title(title, pad=16)

    alt = message(f"Residuals of channels x, y, z against {label}")
    return _residuals(name, size, columns, lambda _: along, label, prepare, scale, alt)


MOST_WITH_WORD: Final = 5
"""Largest number of mountings in a row of figures whose labels say "installation"."""


def _residuals(
    name: str,
    size: tuple[float, float],
    columns: Columns,
    along: Callable[[Calibration], Floats],
    label: str,
    prepare: Callable[[int, Sequence[Axes]], None],
    scale: Scale,
    alt: str,
) -> str:
    """Return a plot of residuals against the abscissa `along`; `prepare` draws the background of a column."""
    same = len({id(calibration) for _, calibration, _ in columns}) == 1

    def draw(figure: Figure) -> None:
        grid: Any = figure.subplots(3, len(columns), sharex=True, sharey=True, squeeze=False)
        for number, (_, calibration, mounts) in enumerate(columns):
            prepare(number, grid[:, number])
            for i, axes in enumerate(grid[:, number]):
                axes.axhline(0.0, color=GREY, linewidth=0.7)
                for rows in mounts:
                    marks = "readings" if same else f"readings-{number}"
                    residual_points(axes, calibration, rows, i, along(calibration), scale, marks)
            grid[2, number].set_xlabel(label)
        for channel, axes in zip(CHANNELS, grid[:, 0], strict=True):
            axes.set_ylabel(message(f"channel {channel} / {scale.unit}"))
        figure.legend(*legend_of(grid.flat), loc="outside upper center", ncols=6)

    return svg_figure(name, size, draw, alt)


def verification_points(verification: Verification) -> str:
    """Return a plot of Δg at the verification points, with bars of U and the limits (paper, Fig. 6)."""
    scale = scale_for(verification.limit_g, "g")
    limit = verification.limit_g / scale.size
    points = verification.points

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        mark_limit(axes, limit, scale)
        accepted = min(p.accepted_up_to for p in points) / scale.size
        if 0.0 < accepted < limit:
            for sign in (1.0, -1.0):
                axes.axhline(sign * accepted, color=GREY, linestyle=":", linewidth=1.1)
        for passed, marker, colour, name in (
            (True, "o", BLUE, message("accepted")),
            (False, "X", VERMILION, message("not accepted")),
        ):
            chosen = [(j, p) for j, p in enumerate(points) if p.passed is passed]
            if chosen:
                at = [j for j, _ in chosen]
                drawn = axes.errorbar(
                    at,
                    [p.delta_g / scale.size for _, p in chosen],
                    [p.U / scale.size for _, p in chosen],
                    fmt=marker, color=colour, markersize=6, capsize=4, linewidth=1.1, label=message(f"Δg, {name}"),
                )  # fmt: skip
                drawn.lines[0].set_gid(f"readings-{'within' if passed else 'outside'}")
        reach = max(limit, *((abs(p.delta_g) + p.U) / scale.size for p in points))
        axes.set_ylim(-1.2 * reach, 1.2 * reach)
        axes.set_xlim(-0.6, len(points) - 0.4)
        axes.set_xticks(range(len(points)), point_labels(points))
        axes.tick_params(axis="x", labelrotation=90 if len(points) > 16 else 0)
        axes.grid(visible=False, axis="x")
        figure.legend(loc="outside upper center", ncols=2)

    alt = message(f"Δg at {len(points)} verification points with bars of U, limit ±{limit:g} {scale.unit}")
    return svg_figure("verification", (6.4, 3.2), draw, alt)


def mark_limit(axes: Axes, limit: float, scale: Scale) -> None:
    """Draw lines at ±`limit` of Δg (in the unit of `scale`), and label the axes."""
    for sign in (1.0, -1.0):
        axes.axhline(sign * limit, color=VERMILION, linestyle=(0, (6, 3)), linewidth=1.1)
    axes.axhspan(-limit, limit, color=GREEN, alpha=0.07, linewidth=0)
    axes.axhline(0.0, color=GREY, linewidth=0.7)
    axes.grid(visible=False, axis="x")
    axes.annotate(
        message(f"limit ±{limit:g} {scale.unit}"), (1.0, limit), xycoords=("axes fraction", "data"),
        xytext=(-4, 3), textcoords="offset points", ha="right", color="#A34700",
    )  # fmt: skip
    axes.set_xlabel(message("verification point: head angle"))
    axes.set_ylabel(f"Δg / {scale.unit}")


def correlations(calibration: Calibration) -> str:
    """Return a plot of the correlation matrix of the twelve coefficients, lower triangle."""
    matrix = correlation_of(calibration.covariance)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        shown = np.ma.masked_where(np.triu(np.ones_like(matrix, dtype=np.bool_)), matrix)
        # pcolormesh draws vector shapes; imshow would embed a bitmap
        mesh = axes.pcolormesh(shown, cmap="RdBu_r", vmin=-1.0, vmax=1.0, edgecolors="white", linewidth=1.2)
        for i in range(12):
            for j in range(i):
                r = matrix[i, j]
                text = f"{r:.2f}".replace("-", MINUS) if abs(r) >= 0.005 else "0"
                colour = "white" if abs(r) > 0.6 else "#222222" if abs(r) >= 0.1 else "#8A939B"
                axes.text(
                    j + 0.5, i + 0.5, text, ha="center", va="center", fontsize=6.5, color=colour,
                    in_layout=False,  # it is inside the axes, so that the layout need not measure it
                )  # fmt: skip
        ticks = np.arange(12) + 0.5
        axes.set_xticks(ticks[:-1], [symbol(name) for name in COEFFICIENTS[:-1]])
        axes.set_yticks(ticks[1:], [symbol(name) for name in COEFFICIENTS[1:]])
        axes.set_xlim(0, 11)
        axes.set_ylim(12, 1)
        axes.tick_params(length=0)
        axes.grid(visible=False)
        axes.spines[:].set_visible(False)
        bar = figure.colorbar(mesh, ax=axes, shrink=0.7, pad=0.02, ticks=[-1, -0.5, 0, 0.5, 1])
        bar.solids.set_rasterized(False)  # type: ignore[union-attr]
        bar.set_label(message("correlation coefficient"))

    return svg_figure(
        "correlations", (6.2, 4.3), draw, message("Correlations between the twelve coefficients")
    )


def compared_coefficients(calibration: Calibration, compared: Calibration) -> str:
    """Return a plot of the coefficients of `compared` minus those of `calibration`, both with bars U (k = 2)."""
    difference = compared.block.vector - calibration.block.vector
    scale = scale_for(float(np.max(np.abs(difference) + 2.0 * compared.u)), calibration.unit)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.axhline(0.0, color=GREY, linewidth=0.7)
        for of, values, shift, marker, colour in (
            (calibration, 0.0 * difference, -0.14, "o", BLUE),
            (compared, difference, 0.14, "D", VERMILION),
        ):
            axes.errorbar(
                np.arange(12) + shift, values / scale.size, 2.0 * of.u / scale.size,
                fmt=marker, color=colour, markersize=4.5, capsize=2.5, linewidth=1.0, label=of.estimator,
            )  # fmt: skip
        axes.set_xticks(range(12), [symbol(name) for name in COEFFICIENTS])
        axes.set_xlim(-0.6, 11.6)
        axes.grid(visible=False, axis="x")
        axes.set_ylabel(message(f"difference / {scale.per_g}") + "\n" + message(f"(biases: {scale.unit})"))
        figure.legend(loc="outside upper center", ncols=2)

    alt = message(f"Twelve coefficients by {compared.estimator} as differences from {calibration.estimator}")
    return svg_figure("compared", (7.4, 3.2), draw, alt)


# --- data of the figures ----------------------------------------------------------------------------


def mounts_of(calibration: Calibration) -> list[tuple[Mounting, Mask]]:
    """Return each mounting of the n fitted readings, with a mask (n,) that selects its readings."""
    conditions = calibration.fitted.conditions()
    return [(mount, conditions.mount == index) for index, mount in enumerate(conditions.mounts)]


def sd_of_reading(calibration: Calibration, rows: Mask, angle_rad: Floats) -> Floats:
    """Return the standard deviation (m, 3) of a single reading at head angles (m,), in the signal's unit.

    It combines, in quadrature, the reading noise and the setting error times the slope du/dphi of the signal. The
    slope comes from a sine and a cosine of the angle, fitted to the predicted signals `rows` of one mounting.
    """
    angle = calibration.fitted.angle_rad[rows]
    predicted = calibration.fitted.signal[rows] - calibration.residuals[rows]
    columns = np.column_stack([np.sin(angle), np.cos(angle), np.ones_like(angle)])
    turn, *_ = np.linalg.lstsq(columns, predicted, rcond=None)
    slope = np.cos(angle_rad)[:, None] * turn[0] - np.sin(angle_rad)[:, None] * turn[1]
    noise = calibration.noise
    return np.asarray(np.hypot(noise.reading, noise.setting_rad * slope))


def residual_scale(calibration: Calibration) -> Scale:
    """Return the prefix of the unit that the figures of residuals and the table of readings share."""
    return scale_for(float(np.max(np.abs(calibration.residuals))), calibration.unit)


def symbol(name: str) -> str:
    """Return the name of a coefficient or of an intrinsic number for matplotlib: "Kxy" -> "$K_{xy}$"."""
    if name.startswith("theta_"):
        return rf"$\theta_{{{name[6:]}}}$"
    return f"$U_{{0{name[2:]}}}$" if name.startswith("U0") else f"${name[0]}_{{{name[1:]}}}$"


# --- drawing ----------------------------------------------------------------------------------------


def dodged_deg(calibration: Calibration) -> Floats:
    """Return the head angles (n,) in degrees, shifted a little from pass to pass so that no points overlap."""
    number = calibration.fitted.pass_number
    middle = (number.min() + number.max()) / 2.0
    spread = max(float(np.ptp(number)), 1.0) / 2.0
    return np.asarray(np.degrees(calibration.fitted.angle_rad) + DODGE_DEG * (number - middle) / spread)


def residual_points(
    axes: Axes,
    calibration: Calibration,
    rows: Mask,
    channel: int,
    along: Floats,
    scale: Scale,
    name: str = "readings",
) -> None:
    """Draw a channel's residuals in one mounting (mask `rows`) against `along` (n,); `name` makes ids unique."""
    fitted = calibration.fitted
    for number in np.unique(fitted.pass_number[rows]):
        for direction, marker in MARKERS.items():
            chosen = rows & (fitted.pass_number == number) & (fitted.direction == direction)
            if np.any(chosen):
                (line,) = axes.plot(
                    along[chosen], calibration.residuals[chosen, channel] / scale.size, marker,
                    color=PASS_COLOURS[(number - 1) % len(PASS_COLOURS)],
                    fillstyle=PASS_FILLS[(number - 1) % len(PASS_FILLS)],
                    label=message(f"pass {number} {APPROACH.get(direction, '')}").strip(),
                )  # fmt: skip
                line.set_gid(f"{name}-{CHANNELS[channel]}-{np.flatnonzero(chosen)[0]}")


def legend_of(grid: Iterator[Axes]) -> tuple[list[Any], list[str]]:
    """Return handles and labels for one legend of several axes, each label once."""
    entries = {
        label: handle
        for axes in grid
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    return list(entries.values()), list(entries)


def mark_changes(grid: Any, calibration: Calibration, along: Floats, word: str = "installation ") -> None:
    """Draw a line at each change of mounting along `along` (n,); above it, write `word` and the new mounting."""
    conditions = calibration.fitted.conditions()
    starts = [0, *(np.flatnonzero(np.diff(conditions.mount)) + 1)]
    for start in starts:
        edge = along[0] if start == 0 else (along[start - 1] + along[start]) / 2.0
        for axes in grid:
            if start:
                axes.axvline(edge, color=GREY, linewidth=0.8, linestyle=(0, (4, 3)))
        grid[0].annotate(
            f" {word}{conditions.mounts[conditions.mount[start]]}", (edge, 1.0),
            xycoords=("data", "axes fraction"), xytext=(0, 3), textcoords="offset points", parse_math=False,
        )  # fmt: skip


def point_labels(points: Sequence[VerificationPoint] | Sequence[ModulusPoint]) -> list[str]:
    """Return a label for each verification point: its angle and, if there are several, its pass and mounting."""
    passes, series = len({p.pass_number for p in points}) > 1, len({p.series for p in points}) > 1
    return [
        f"{p.angle_deg:.0f}°"
        + (f"\n{Mounting(p.series, VERIFICATION)}" if series else "")
        + ("\n" + message(f"pass {p.pass_number}") if passes else "")
        for p in points
    ]


@contextmanager
def drawn(name: str, inches: tuple[float, float], draw: Callable[[Figure], None]) -> Iterator[Figure]:
    """Draw a figure and yield it in a context with the page's style; `name` makes its identifiers reproducible."""
    # imported here because importing matplotlib takes longer than most commands
    from matplotlib import style
    from matplotlib.figure import Figure

    with style.context(["default", {**STYLE, "svg.hashsalt": name}]):
        figure = Figure(figsize=inches, layout="constrained")
        draw(figure)
        translate_texts(figure)
        yield figure


def translate_texts(figure: Figure) -> None:
    """Translate the texts of a figure into the current language, and use its decimal sign on the axes."""
    if language() == ENGLISH:
        return
    from matplotlib.text import Text
    from matplotlib.ticker import FixedFormatter, FuncFormatter, ScalarFormatter

    for text in figure.findobj(Text):
        text.set_text(by_line(text.get_text()))
    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
        formatter = axis.get_major_formatter()
        if isinstance(formatter, FixedFormatter):
            axis.set_major_formatter(FixedFormatter([by_line(str(label)) for label in formatter.seq]))
        elif type(formatter) is ScalarFormatter:
            formatter.set_useOffset(False)
            formatter.set_axis(axis)
            axis.set_major_formatter(FuncFormatter(partial(_local_label, formatter)))


def by_line(text: str) -> str:
    """Return a text translated line by line."""
    return "\n".join(map(translated, text.split("\n")))


def _local_label(formatter: Any, value: float, position: int | None = None) -> str:
    """Return the label that `formatter` gives to a tick, with the decimal sign of the language."""
    formatter.set_locs(formatter.axis.get_majorticklocs())
    return translated(str(formatter(value, position)))


def svg_file(name: str, inches: tuple[float, float], draw: Callable[[Figure], None]) -> str:
    """Draw a figure and return it as the text of a standalone SVG file."""
    return _written(name, inches, draw)


def _written(name: str, inches: tuple[float, float], draw: Callable[[Figure], None]) -> str:
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    text = io.StringIO()
    with drawn(name, inches, draw) as figure:
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        # not savefig, which draws everything twice for the same file
        FigureCanvasSVG(figure).print_svg(text, metadata=nothing)  # type: ignore[no-untyped-call]
    return text.getvalue()


def svg_figure(name: str, inches: tuple[float, float], draw: Callable[[Figure], None], alt: str) -> Markup:
    """Draw a figure and return it as an SVG element, safe for a page; `alt` is its alternative text.

    The element has unique identifiers and no metadata.
    """
    svg = svg_file(name, inches, draw)
    body = svg[svg.index("<svg") :]
    body = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>|<style.*?</style>", "", body, flags=re.DOTALL)
    body = re.sub(r'\bid="', f'id="{name}-', body)
    body = re.sub(r'(?:xlink:)?href="#', f'href="#{name}-', body).replace("url(#", f"url(#{name}-")
    box = re.search(r'viewBox="[^"]*"', body)
    if box is None:  # pragma: no cover - matplotlib always writes one
        raise ValueError(f"figure {name}: no viewBox in the SVG")
    # the width is in em, so that the lettering scales with the page's text
    alt = escape(translated(alt))
    start = f'<svg {box[0]} role="img" aria-label="{alt}" style="max-width:{inches[0] * 6.4:.1f}em">'
    whole = start + re.sub(r">\s+<", "><", body[body.index(">") + 1 :].strip())
    return Markup(whole)  # noqa: S704 - our own drawing
