"""The page of a diagnosis with its figures: one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.base.languages import message, translated
from bench.base.numbers import (
    MINUS,
    Scale,
    aligned,
    concise,
    fixed,
    quantity,
    rounded,
    scale_for,
    two_digits,
    typeset,
)
from bench.calibration.result import Calibration
from bench.diagnosis import Diagnosis
from bench.diagnosis.gap import UNDETERMINED, Gap
from bench.diagnosis.pipeline import FullDiagnosis, Rival
from bench.diagnosis.show import SEED, CoefficientChange, ModelComparison, ModulusPoint
from bench.diagnosis.visibility import ResidualPattern
from bench.model import CATALOGUE, Effect
from bench.results import diagnosis_words as words
from bench.results import plots
from bench.results.diagnosis_words import Files
from bench.results.form_words import form_in_words
from bench.results.tables import Row, page, symbol

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bench.diagnosis.free_records import FreeDiagnosis
    from bench.diagnosis.record_diagnosis import RecordDiagnosis

INK: Final = "#222222"
DRAWN: Final = 4
"""Number of mountings whose residuals are visible at once; those of further mountings are collapsed."""

MOST_DRAWN: Final = 12
"""Up to this number of mountings all are drawn; of more, only `DRAWN`."""

STATES: Final = {"agrees": "passed", "named": "none", "confounded": "none"}
"""The style of the verdict box for each verdict; any other verdict has the style of a failure."""


def render_diagnosis(
    full: FullDiagnosis, files: Files, title: str, limit_g: float, provenance: Mapping[str, str]
) -> str:
    """Return the HTML page; the same content always gives the same text. `limit_g` is the limit of |Δg|, g."""
    diagnosis, shown = full.diagnosis, full.shown
    return page(
        "diagnosis.html.j2",
        title=title,
        full=full,
        files=files,
        diagnosis=diagnosis,
        shown=shown,
        provenance=provenance,
        seed=SEED,
        state=STATES.get(diagnosis.verdict, "failed"),
        words=words,
        quantity=quantity,
        overlays=_overlays(shown),
        places=[_place(place) for place in diagnosis.where],
        ranking_bars=ranking_bars,
        held_out=held_out_rows(diagnosis.gap),
        gap_bars=gap_bars(diagnosis.gap) if diagnosis.effects and diagnosis.gap.folds else None,
        coefficient_rows=partial(coefficient_rows, unit=shown.before.calibration.unit),
        tests=_tests(shown),
        residuals=_residuals(shown),
        in_time=in_time(shown),
        modulus=modulus_at_points(shown, limit_g) if shown.before.points else None,
        form=list(form_in_words(diagnosis)),
        apart=_apart(diagnosis),
        catalogue=CATALOGUE,
        smallest=[
            Row(name, translated(size).replace(" ", "\N{NO-BREAK SPACE}"), CATALOGUE[name].sentence)
            for name, size in words.smallest_found(diagnosis)
        ],
        setting=f"{two_digits(diagnosis.noise.setting_arcsec)}″",
    )


def render_alone(
    template: str,
    found: FreeDiagnosis | RecordDiagnosis,
    provenance: Mapping[str, str],
    **content: Any,
) -> str:
    """Return the HTML page for free positions or a record; `content` holds further variables of the `template`."""
    lines = [(words.effect_title(one), one, list(words.parameters_in_words(one))) for one in found.effects]
    return page(
        template,
        found=found,
        provenance=provenance,
        source=words.readings_named(found.source),
        state=STATES.get(found.verdict, "failed"),
        lead=words.lead(found),
        words=words,
        quantity=quantity,
        effects=lines,
        held_out=held_out_rows(found.gap),
        notes=found.notes,
        ending="diagnosis",
        **content,
    )


def _place(place: ResidualPattern) -> Row:
    where = message("verification points") if place.channel == "modulus" else place.channel
    installation = message("whole run") if place.installation == "all" else place.installation
    size = quantity(place.size, place.unit)
    return Row(where, installation, place.pattern, size, typeset(words.p_in_column(place.p)))


def held_out_rows(gap: Gap) -> list[Row]:
    """Return a row for each set of held-out readings: effects named from the rest, misfit before and after.

    "Before" and "after" mean without and with these effects. Sets that could not be held out have no numbers.
    """
    rows = [
        Row(
            fold.label,
            ", ".join(map(translated, fold.gains)) or "nothing",
            f"{fold.before.reduced:.2f}",
            f"{fold.after.reduced:.2f}",
        )
        for fold in gap.folds
    ]
    left_out = (message(f"not held out: {UNDETERMINED}"), "", "")
    return rows + [Row(label, *left_out) for label in gap.undetermined]


def coefficient_rows(changes: Mapping[str, CoefficientChange], unit: str) -> list[Row]:
    """Return a row for each coefficient: value before and after, change with its unit, and change divided by u."""
    before = aligned([concise(one.before, one.u_before) for one in changes.values()])
    after = aligned([concise(one.after, one.u_after) for one in changes.values()])
    scale = scale_for(max(abs(one.after - one.before) for one in changes.values()), unit)
    rows = []
    for (name, one), was, now in zip(changes.items(), before, after, strict=True):
        change, u = one.after - one.before, max(one.u_after, one.u_before)
        difference = rounded(change / scale.size, u / scale.size, sign=True)
        printed = scale.unit if name.startswith("U0") else scale.per_g
        in_u = fixed(one.in_u, 1, sign=True) if one.u_before > 0 else ""
        rows.append(Row(symbol(name), was, now, difference, printed, in_u))
    return rows


def _tests(shown: ModelComparison) -> list[Row]:
    rows = []
    unit = shown.before.calibration.unit
    for name, one in (
        (message("given model"), shown.before),
        (message("with the effects found"), shown.after),
    ):
        if one is not None and one.tested:
            simulated = quantity(one.repeated.lack_of_fit.rms, unit)
            chi2, p = (
                message(f"{one.test.chi2:.1f} for {one.test.dof}"),
                typeset(words.p_in_column(one.test.p, 2)),
            )
            rows.append(Row(name, chi2, p, quantity(one.test.rms, unit), simulated))
    return rows


def _drawn_of(shown: ModelComparison) -> int:
    """Return the number of mountings for which figures are drawn; each takes about a second."""
    count = len(plots.mounts_of(shown.before.calibration))
    return count if count <= MOST_DRAWN else DRAWN


def _overlays(shown: ModelComparison) -> tuple[list[str], list[str]]:
    """Return two lists of overlays of measured and simulated signals: the clearest one, and the others."""
    figures = [overlay_of_mount(shown, i) for i in most_telling(shown)[: _drawn_of(shown)]]
    return figures[:1], figures[1:]


def _residuals(shown: ModelComparison) -> tuple[list[str], list[str]]:
    """Return the residual figures: a list of those always visible, and a list of the collapsed ones."""
    mounts = plots.mounts_of(shown.before.calibration)[: _drawn_of(shown)]
    figures = [residuals_of_mount(shown, i) for i in range(len(mounts))]
    return figures[:DRAWN], figures[DRAWN:]


def _apart(diagnosis: Diagnosis) -> list[Effect]:
    """Return the catalogue entries of all tied effects; each states the measurement that would separate it."""
    names = dict.fromkeys(
        name
        for effect in diagnosis.effects
        if effect.cannot_tell_from
        for name in (effect.name, *effect.cannot_tell_from)
    )
    return [CATALOGUE[name] for name in names if name in CATALOGUE]


# --- figures --------------------------------------------------------------------------------------


def columns_of(shown: ModelComparison) -> list[tuple[str, Calibration]]:
    """Return title and calibration of each column: given model, model with any effects found, simulation."""
    after = [] if shown.after is None else [(message("after"), shown.after.calibration)]
    return [
        (message("before") if after else message("readings"), shown.before.calibration),
        *after,
        (message(f"simulated bench, seed {SEED}"), shown.last.repeated),
    ]


def common_scale(shown: ModelComparison) -> Scale:
    """Return the prefix of the unit that all figures of residuals share."""
    largest = max(float(np.max(np.abs(c.residuals))) for _, c in columns_of(shown))
    return scale_for(largest, shown.before.calibration.unit)


def residuals_of_mount(shown: ModelComparison, mount: int) -> str:
    """Return a plot of residuals against head angle in one mounting: a row per channel, a column per model."""
    columns = [(title, c, [plots.mounts_of(c)[mount][1]]) for title, c in columns_of(shown)]
    name = str(plots.mounts_of(shown.before.calibration)[mount][0])
    titles = ", ".join(translated(title) for title, _, _ in columns)
    alt = message(f"Residuals of channels x, y, z in installation {name} against head angle: {titles}")
    return plots.residuals_against_angle(
        f"diagnosis-mount-{mount}", (7.6, 5.4), columns, common_scale(shown), alt
    )


def in_time(shown: ModelComparison) -> str:
    """Return a plot of residuals without and with the effects, against time or, if unknown, in order."""
    columns = [
        (title, c, [rows for _, rows in plots.mounts_of(c)])
        for title, c in columns_of(shown)[: 1 if shown.after is None else 2]
    ]
    return plots.residuals_in_time("diagnosis-time", (7.6, 5.0), columns, common_scale(shown))


def gap_bars(gap: Gap) -> str:
    """Return a bar chart of reduced chi-square without and with the effects, for each set of held-out readings."""
    folds = gap.folds
    names = [translated(fold.label.replace(" and ", "\nand ")) for fold in folds]
    places = np.arange(len(folds), dtype=float)

    def draw(figure: Figure) -> None:
        axes: Axes = figure.subplots()
        before, after = [f.before.reduced for f in folds], [f.after.reduced for f in folds]
        for key, heights, shift, colour in (
            ("before", before, -0.19, plots.VERMILION), ("after", after, 0.19, plots.BLUE),
        ):  # fmt: skip
            axes.bar(places + shift, heights, width=0.36, color=colour, linewidth=0.8, label=key)
        axes.axhline(
            1.0, color=plots.GREY, linestyle=(0, (6, 3)), linewidth=1.1, label=message("noise alone")
        )
        axes.set_xticks(places, names)
        axes.grid(visible=False, axis="x")
        axes.set_ylabel(message("reduced χ² of held-out readings"))
        axes.set_xlim(-0.6, len(folds) - 0.4)
        figure.legend(loc="outside upper center", ncols=5)

    alt = message(
        f"Reduced chi-square of held-out readings before and after, {len(folds)} folds; noise alone gives 1"
    )
    return plots.svg_figure("diagnosis-gap", (6.4, 3.0), draw, alt)


def ranking_bars(rows: Sequence[Rival], named: str, number: int) -> str:
    """Return a bar chart of ln odds of `named` and its rivals; a bracket joins effects that fit as well."""
    ordered = sorted(rows, key=lambda rival: rival.evidence)
    places = np.arange(len(ordered), dtype=float)
    alike = [i for i, rival in enumerate(ordered) if rival.family == named or rival.tied]

    def draw(figure: Figure) -> None:
        axes: Axes = figure.subplots()
        for kind, colour, text in (
            ("named", plots.BLUE, message("found")), ("tied", plots.ORANGE, message("tied with it")),
            ("less", "#B9C4CE", message("less plausible")),
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
        if len(alike) > 1 and max(alike) - min(alike) < len(alike):  # no other family lies between them
            reach = max(ordered[i].evidence for i in alike)
            at = reach + 0.03 * max(abs(reach), 1.0)
            axes.plot([at, at], [min(alike) - 0.35, max(alike) + 0.35], color="#222222", linewidth=1.2)
            axes.annotate(
                message("tie"), (at, float(np.mean([min(alike), max(alike)]))), xytext=(4, 0),
                textcoords="offset points", va="center",
            )  # fmt: skip
        axes.axvline(0.0, color=plots.GREY, linewidth=0.7)
        axes.set_yticks(places, [rival.family for rival in ordered], parse_math=False)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel(message("ln odds that the effect is present"))
        axes.margins(x=0.12)
        figure.legend(loc="outside upper center", ncols=3)

    listed = ", ".join(
        f"{rival.family} {rival.evidence:.1f}".replace("-", MINUS) for rival in reversed(ordered)
    )
    alt = message(f"Evidence of {named} and of its rivals: {listed}")
    return plots.svg_figure(f"diagnosis-ranking-{number}", (6.4, 1.1 + 0.24 * len(ordered)), draw, alt)


def _kind(rival: Rival, named: str) -> str:
    return "named" if rival.family == named else "tied" if rival.tied else "less"


def modulus_at_points(shown: ModelComparison, limit_g: float) -> str:
    """Return a plot of Δg ± 2 u at the verification points, without and with the effects found (paper, Fig. 6)."""
    scale = scale_for(limit_g, "g")
    limit = limit_g / scale.size
    parts: list[tuple[str, Sequence[ModulusPoint], str, str]] = [("Δg", shown.before.points, "o", plots.BLUE)]
    if shown.after is not None:
        parts = [
            ("before", shown.before.points, "s", plots.VERMILION),
            ("after", shown.after.points, "o", plots.BLUE),
        ]
    count = len(shown.before.points)

    def draw(figure: Figure) -> None:
        axes: Axes = figure.subplots()
        plots.mark_limit(axes, limit, scale)
        for i, (name, points, marker, colour) in enumerate(parts):
            axes.errorbar(
                np.arange(count) + 0.24 * (i - (len(parts) - 1) / 2),
                [p.delta_g / scale.size for p in points], [2.0 * p.u / scale.size for p in points],
                fmt=marker, color=colour, markersize=5, capsize=3, linewidth=1.1, label=name,
            )  # fmt: skip
        axes.set_xticks(range(count), plots.point_labels(shown.before.points))
        axes.set_xlim(-0.6, count - 0.4)
        axes.margins(y=0.15)
        figure.legend(loc="outside upper center", ncols=2)

    alt = message(f"Δg at {count} verification points before and after, limit ±{limit:g} {scale.unit}")
    return plots.svg_figure("diagnosis-modulus", (6.4, 3.0), draw, alt)


def most_telling(shown: ModelComparison) -> list[int]:
    """Return the indices of the mountings, first the one where the effects found change the signals most."""
    before, last = shown.before.calibration, shown.last.calibration
    missing = before.residuals - last.residuals
    sizes = [float(np.mean(missing[rows] ** 2)) for _, rows in plots.mounts_of(before)]
    return sorted(range(len(sizes)), key=lambda mount: -sizes[mount])


def overlay_of_mount(shown: ModelComparison, mount: int) -> str:
    """Return a plot of measured and simulated signals against head angle in one mounting, a row per channel."""
    before, last = shown.before.calibration, shown.last.calibration
    label, rows = plots.mounts_of(before)[mount]
    signal = before.fitted.signal
    simulated, missing = signal - last.residuals, before.residuals - last.residuals
    volts = scale_for(float(np.max(np.abs(signal))), before.unit)
    scale = scale_for(float(np.max(np.abs(before.residuals))), before.unit)
    angle, degrees = plots.dodged_deg(before), np.degrees(before.fitted.angle_rad)
    fine = np.linspace(-8.0, 368.0, 189)

    def draw(i: int, left: Axes, right: Axes, whose: str) -> None:
        wave = _wave(angle[rows], simulated[rows, i], fine) / volts.size
        left.plot(fine, wave, color=INK, linewidth=1.0, label=whose)
        left.plot(angle[rows], signal[rows, i] / volts.size, "o", **MEASURED)
        plots.residual_points(right, before, rows, i, angle, scale, f"overlay-{mount}")
        if shown.after is not None:
            right.plot(angle[rows], missing[rows, i] / scale.size, "_", **BARS, label=whose)
            _joined(right, degrees, missing[:, i] / scale.size, rows, before.fitted.pass_number)
        right.set_xticks(range(0, 361, 90))
        right.set_xlim(-12.0, 372.0)

    return overlay(
        f"diagnosis-overlay-{mount}", message(f"installation {label}"), (volts, scale), draw,
        message("head angle / °"), found=shown.after is not None,
    )  # fmt: skip


MEASURED: Final[dict[str, Any]] = {"color": plots.BLUE, "markersize": 4, "alpha": 0.8, "label": "measured"}
BARS: Final[dict[str, Any]] = {"color": INK, "markersize": 10, "markeredgewidth": 1.6}
"""Style of the points of measured signals, and of the bars of simulated ones."""


def overlay(
    name: str,
    place: str,
    scales: tuple[Scale, Scale],
    draw_channel: Callable[[int, Axes, Axes, str], None],
    along: str,
    *,
    found: bool,
) -> str:
    """Return a plot of measured and simulated signals, a row per channel; `place` is in its title.

    The left column shows the signals. The right column shows them minus the simulation by the given model: what
    this model lacks, and how much of it the effects found explain. `draw_channel` draws one channel into a left
    and a right axes; `along` is the label of the horizontal axis.
    """
    whose = (
        message("simulated with the effects found") if found else message("simulated with the given model")
    )

    def draw(figure: Figure) -> None:
        grid: Any = figure.subplots(3, 2, sharex=True, squeeze=False)
        given = message("simulated with the given model")
        for i, (channel, (left, right)) in enumerate(zip(CHANNELS, grid, strict=True)):
            right.axhline(0.0, color=plots.GREY, linewidth=0.7, linestyle=(0, (4, 3)), label=given)
            draw_channel(i, left, right, whose)
            left.set_ylabel(f"channel {channel} / {scales[0].unit}")
            right.set_ylabel(scales[1].unit)
        grid[0, 0].set_title(place)
        grid[0, 1].set_title(message("minus the given model"))
        for axes in grid[2]:
            axes.set_xlabel(along)
        figure.legend(*plots.legend_of(grid.flat), loc="outside upper center", ncols=3)

    alt = message(
        f"Measured and simulated signals of channels x, y, z, {place}, and both minus the signals simulated with "
        "the given model"
    )
    return plots.svg_figure(name, (7.6, 5.6), draw, alt)


def _wave(angle_deg: Floats, values: Floats, at_deg: Floats) -> Floats:
    """Fit a constant, sine and cosine of the angle to `values` at `angle_deg`; return the fit at `at_deg`."""

    def columns(degrees: Floats) -> Floats:
        phi = np.radians(degrees)
        return np.column_stack([np.ones_like(phi), np.cos(phi), np.sin(phi)])

    return np.asarray(columns(at_deg) @ np.linalg.lstsq(columns(angle_deg), values, rcond=None)[0])


def _joined(axes: Axes, angle_deg: Floats, values: Floats, rows: Mask, passes: Any) -> None:
    for number in np.unique(passes[rows]):
        mine = np.flatnonzero(rows & (passes == number))
        ordered = mine[np.argsort(angle_deg[mine])]
        axes.plot(angle_deg[ordered], values[ordered], color=INK, linewidth=0.7, alpha=0.6)
