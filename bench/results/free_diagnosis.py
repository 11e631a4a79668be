"""The result of `bench diagnose` for readings in unknown orientations (free positions): JSON, text, page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from pydantic import Field
from rich.console import Console

from bench.base.arrays import rms
from bench.base.languages import message, translated
from bench.base.numbers import concise, quantity, scale_for, typeset
from bench.base.result_model import Real, ResultModel
from bench.base.tables import print_notes
from bench.base.text import as_typed
from bench.diagnosis.free_records import OUTLIER, FreeDiagnosis
from bench.diagnosis.show import CoefficientChange
from bench.model.effects import CATALOGUE
from bench.model.geometry import COEFFICIENTS
from bench.results import diagnosis_page as pages
from bench.results import diagnosis_words as words
from bench.results.diagnosis import print_effect, print_files, print_gap, print_verdict
from bench.results.diagnosis_parts import (
    AloneResult,
    BetweenRecordsPart,
    CopyPart,
    FoundPart,
    between_part,
    gap_part,
    repeats_between,
)
from bench.results.diagnosis_words import NO_FILES, Files
from bench.results.plots import BLUE, GREY, PASS_COLOURS, PASS_FILLS, VERMILION, legend_of, svg_figure
from bench.results.tables import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class FreeNoise(ResultModel):
    """The scatter of |a| at a position after the effects found are removed."""

    reading: float
    unit: Literal["g"]
    stated: Real = Field(description="noise that the scatter of the samples implies")
    dof: int


class FreeCopyPart(CopyPart):
    """The copy of the readings without the outlying positions."""

    files: list[Path] = Field(description="readings files of all records that have outlying positions")


class FreeDiagnoseResult(AloneResult):
    """A diagnosis of readings that are all free positions.

    For several sources, the output of `bench diagnose --json` is a list of these; a source that could not be
    evaluated has a `source-failed` object in its place.
    """

    effects: list[FoundPart]
    noise: FreeNoise
    between_records: BetweenRecordsPart | None
    """variation of the zeros between records, each fitted separately; null for one record"""
    sensors: int
    records: int
    models: list[Path] = Field(description="paths of the model files, one for each sensor")
    corrected: FreeCopyPart | None
    """readings without the outlying positions, from which all other members follow; null if there are none"""


def result_of(found: FreeDiagnosis, files: Files = NO_FILES, **made_from: Any) -> FreeDiagnoseResult:
    """Return the result of a diagnosis; `files` are the files that were written."""
    copy = FreeCopyPart(
        readings=files.copy, files=list(files.copies), used=len(found.rows), verdict=found.of_copy,
        rests_on=list(found.apart),
    )  # fmt: skip
    return FreeDiagnoseResult.made(
        found,
        files,
        made_from,
        effects=[*map(_outlier, found.apart), *found.effects],
        gap=gap_part(found.gap),
        noise=FreeNoise(
            reading=found.noise.reading, unit="g", stated=found.stated_g, dof=found.noise.freedom
        ),
        between_records=None if found.between is None else between_part(found.between),
        sensors=found.rows.sensors,
        models=list(files.models),
        corrected=copy if found.apart else None,
    )


def _outlier(text: str) -> FoundPart:
    return FoundPart(
        name=OUTLIER, channels=[], cannot_tell_from=[], parameters={}, p=None, p_all_looks=None, words=text
    )


# --- text -------------------------------------------------------------------------------------------

NOTHING: Final = message("nine coefficients of each sensor explain the positions within their scatter")


def what_in_words(found: FreeDiagnosis) -> str:
    """Return the findings as a sentence without a full stop."""
    rest = words.found_in_words(found, NOTHING)
    if not found.apart:
        return rest
    count = len(found.apart)
    return message(
        f"{OUTLIER}: {count} outlying position{'' if count == 1 else 's'}; in the other positions: {rest}"
    )


def apart_in_words(text: str) -> str:
    """Return a sentence on an outlying position in the current language, its place part by part."""
    place, _, said = text.partition(": ")
    return f"{', '.join(map(translated, place.split(', ')))}: {translated(said)}"


def what_to_do(found: FreeDiagnosis, files: Files) -> Iterator[str]:
    """Yield a sentence on each step that should follow the diagnosis, with the command to type."""
    several = found.records * found.rows.sensors > 1
    source = message("each record") if several else as_typed(found.source)
    if found.apart:
        again = message("Measure the outlying positions again, at rest")
        copies = ", ".join(map(str, files.copies))
        copy = message(f"until then the corrected copy is {copies}") if copies else ""
        yield "; ".join(filter(None, [again, copy]))
    for number, model in enumerate(files.models, start=1):
        of = message(f" of sensor {number}") if len(files.models) > 1 else ""
        yield message(f"Use the model{of}: bench calibrate {source} --model {as_typed(model)}")
        yield message(f"Test it with new readings{of}: bench confirm NEW --model {as_typed(model)}")
    if found.between is not None and (line := found.between.in_bench_file()):
        yield message(
            f"{repeats_between(found.between)}. Add this line to the bench file, so that u of calibrations "
            f"includes it: {line}"
        )
    names = {one.name for one in found.effects}
    if "zeros_by_run" in names or "scale_by_run" in names:
        yield message(
            "Calibrate each record separately (bench calibrate RECORD), and note what differs between records: "
            "time since switch-on, temperature, operator"
        )
    elif found.of_copy == "unknown":
        yield message(
            "Repeat the measurement: an effect that returns belongs to the sensor; see below where it acts"
        )
    elif found.of_copy == "confounded":
        yield message(
            "Measure more positions in all directions, and diagnose both runs: bench diagnose … --together"
        )
    elif found.verdict == "agrees":
        yield message(f"Nothing; use the coefficients: bench calibrate {source}")


def print_found(found: FreeDiagnosis, files: Files, out: Console) -> None:
    """Print the findings in free positions in the order of the search, and the files that were written."""
    rows = found.rows
    out.print(
        message(
            f"{len(rows)} free positions, {rows.sensors} sensor{'s' if rows.sensors > 1 else ''}, {found.records} "
            f"record{'s' if found.records > 1 else ''}: only |a| = 1 g is known of them"
        )
    )
    print_notes(out, found.notes)
    for text in found.apart:
        out.print(message(f"Mistake: {OUTLIER}: {apart_in_words(text)}"), style="bold")
    for place in found.where:
        out.print(message(f"  {place.pattern}: |a| is off by {quantity(place.size, 'g')} (rms)"))
    for one in found.effects:
        print_effect(one, (), out)
    if found.between is not None:
        out.print(typeset(message(f"Zeros: {repeats_between(found.between)}")))
        if line := found.between.in_bench_file():
            out.print(message(f"  for u of calibrations, add to the bench file: {line}"))
    if found.effects:
        print_gap(found.gap, out)
    print_files(found, files, out)
    source, gap = words.readings_named(found.source), words.gap_of_verdict(found)
    print_verdict(source, found, what_in_words(found), [gap], out)


def evidence_in_words(found: FreeDiagnosis) -> dict[str, str]:
    """Return the evidence for the findings, by title, for the model file."""
    gap = found.gap
    told = gap.reason or (
        f"reduced chi-square of held-out positions {gap.before:.3f} before, {gap.after:.3f} after, "
        f"1 expected; root mean square of |a| - 1 g {1e6 * gap.before_rms:.3g} ug before, "
        f"{1e6 * gap.after_rms:.3g} ug after"
    )
    mended = {"rests on": "; ".join(found.apart)} if found.apart else {}
    return mended | words.evidence_of(found, told)


# --- page and figures -----------------------------------------------------------------------------

MARKS: Final = "osD^vP*X"


def overlay_of_sensor(found: FreeDiagnosis, sensor: int) -> str:
    """Return a plot of a sensor's measured and simulated signals in order of measurement, a row per channel.

    Orientations are unknown. Each position is therefore simulated in the direction that its signals indicate,
    and the plot shows only errors of the modulus.
    """
    rows = found.rows
    mine = rows.sensor == sensor
    signal = rows.tables[sensor].signal
    per_g = rows.direction[mine] @ rows.block[sensor].K.T
    given, last = (per_g * fit.left[mine][:, None] for fit in (found.before, found.after))
    size = scale_for(float(np.max(np.abs(signal))), rows.tables[sensor].unit)
    scale = scale_for(float(np.max(np.abs(given))), rows.tables[sensor].unit)
    number = np.arange(1, len(signal) + 1)

    def draw(i: int, left: Axes, right: Axes, whose: str) -> None:
        left.plot(number, (signal - last)[:, i] / size.size, "_", **pages.BARS, label=whose)
        left.plot(number, signal[:, i] / size.size, "o", **pages.MEASURED)
        right.plot(number, given[:, i] / scale.size, "o", **pages.MEASURED)
        if found.effects:
            right.plot(number, (given - last)[:, i] / scale.size, "_", **pages.BARS, label=whose)
        for edge in np.flatnonzero(np.diff(rows.record[mine])) + 1.5:  # where a new record begins
            for axes in (left, right):
                axes.axvline(edge, color=GREY, linewidth=0.8, linestyle=(0, (4, 3)))

    return pages.overlay(
        f"free-overlay-{sensor}", message(f"sensor {sensor + 1}"), (size, scale), draw,
        message("position, in the order of measurement"), found=bool(found.effects),
    )  # fmt: skip


def modulus_in_time(found: FreeDiagnosis) -> str:
    """Return a plot of |a| - 1 g against the time in a record, without and with the effects found."""
    rows = found.rows
    fits = [(message("given model"), found.before), (message("with the effects found"), found.after)]
    fits = fits[: 1 + bool(found.effects)]
    scale = scale_for(float(np.max(np.abs(found.before.left))), "g")
    time_s = np.concatenate([table.conditions().elapsed_s for table in rows.tables])
    for record in np.unique(rows.record):
        time_s[rows.record == record] -= time_s[rows.record == record].min()

    def draw(figure: Figure) -> None:
        grid: Any = figure.subplots(1, len(fits), sharex=True, squeeze=False)
        for axes, (title, fit) in zip(grid[0], fits, strict=True):
            axes.axhline(0.0, color=GREY, linewidth=0.7)
            for number in (2.0, -2.0):
                axes.axhline(
                    number * found.noise.reading / scale.size, color=GREY, linestyle=(0, (6, 3)), linewidth=0.9,
                    label=message("two standard deviations of the noise"),
                )  # fmt: skip
            for record in np.unique(rows.record):
                for sensor in range(rows.sensors):
                    mine = (rows.record == record) & (rows.sensor == sensor)
                    axes.plot(
                        time_s[mine] / 60.0, fit.left[mine] / scale.size, MARKS[sensor % len(MARKS)],
                        color=PASS_COLOURS[record % len(PASS_COLOURS)],
                        fillstyle=PASS_FILLS[record // len(PASS_COLOURS) % len(PASS_FILLS)], markersize=3.5,
                        label=message(f"record {record + 1}") if sensor == 0 else None,
                    )  # fmt: skip
            axes.set_title(title)
            axes.set_xlabel(message("time in the record / min"))
        grid[0, 0].set_ylabel(f"|a| − 1 g / {scale.unit}")
        figure.legend(*legend_of(grid.flat), loc="outside upper center", ncols=5)

    alt = message(
        "The modulus of the specific force minus 1 g against the time in its record, before and after"
    )
    return svg_figure("free-time", (7.6, 3.4), draw, alt)


def modulus_by_record(found: FreeDiagnosis) -> str:
    """Return a bar chart of the rms of |a| - 1 g by record and sensor, without and with the effects found."""
    rows = found.rows
    records = np.unique(rows.record)
    scale = scale_for(float(np.max(np.abs(found.before.left))), "g")
    width = 0.8 / rows.sensors  # of the room of a record

    def draw(figure: Figure) -> None:
        axes: Axes = figure.subplots()
        for sensor in range(rows.sensors):
            at = np.arange(len(records)) + (sensor - (rows.sensors - 1) / 2) * width
            for fit, colour, part, what in (
                (found.before, VERMILION, 1.0, message("given model")),
                (found.after, BLUE, 0.55, message("with the effects found")),
            ):
                if fit is found.before or found.effects:
                    sizes = [rms(fit.left[(rows.record == r) & (rows.sensor == sensor)]) for r in records]
                    axes.bar(
                        at, np.array(sizes) / scale.size, width=0.9 * part * width, color=colour,
                        label=what,
                    )  # fmt: skip
        axes.axhline(
            found.noise.reading / scale.size,
            color=GREY,
            linestyle=(0, (6, 3)),
            linewidth=1.1,
            label=message("noise alone"),
        )
        axes.set_xticks(np.arange(len(records)), [message(f"record {r + 1}") for r in records])
        axes.grid(visible=False, axis="x")
        axes.set_ylabel(message(f"|a| − 1 g, rms / {scale.unit}"))
        figure.legend(*legend_of(iter([axes])), loc="outside upper center", ncols=3)

    alt = message(
        f"Root mean square of the modulus minus 1 g in {len(records)} records of {rows.sensors} sensors"
    )
    return svg_figure("free-records", (6.4, 3.0), draw, alt)


def render(
    found: FreeDiagnosis, files: Files, title: str, provenance: Mapping[str, str], *, simulated: bool
) -> str:
    """Return the HTML page; the same content always gives the same text."""
    shown = range(found.rows.sensors)[: pages.MOST_DRAWN]
    gap = words.gap_of_verdict(found)
    return pages.render_alone(
        "free_diagnosis.html.j2",
        found,
        provenance,
        title=title,
        simulated=simulated,
        what=what_in_words(found),
        told=[gap] if gap else [],
        to_do=list(what_to_do(found, files)),
        overlays=[overlay_of_sensor(found, sensor) for sensor in shown],
        in_time=modulus_in_time(found),
        by_record=modulus_by_record(found) if found.records > 1 else None,
        gap_bars=pages.gap_bars(found.gap) if found.effects and found.gap.folds else None,
        places=[Row(p.pattern, quantity(p.size, "g"), typeset(words.p_in_column(p.p))) for p in found.where],
        coefficients=[
            (sensor, pages.coefficient_rows(_coefficients(found, sensor), found.rows.tables[0].unit))
            for sensor in range(found.rows.sensors)
        ],
        apart=list(map(apart_in_words, found.apart)),
        zeros=list(_zeros(found)),
        models=files.models,
        hidden=[CATALOGUE[name] for name in found.hidden],
    )


def _coefficients(found: FreeDiagnosis, sensor: int) -> dict[str, CoefficientChange]:
    fits = (found.before, found.after)
    each = np.stack([column for fit in fits for column in (fit.block[sensor].vector, fit.u[sensor])], axis=1)
    rows = zip(COEFFICIENTS, each.tolist(), strict=True)
    return {name: CoefficientChange(*row) for name, row in rows if row[1] > 0.0}


def _zeros(found: FreeDiagnosis) -> Iterator[Row]:
    """Yield a row for each record and sensor: the zeros with u in mg, if each record is fitted alone."""
    between = found.between
    if between is None:
        return
    for sensor, (zeros, of_u) in enumerate(zip(between.zero, between.u, strict=True)):
        for record, (values, u) in enumerate(zip(1e3 * zeros, 1e3 * of_u, strict=True)):
            cells = tuple(
                concise(value, of_value) if np.isfinite(value) else message("not determined")
                for value, of_value in zip(values.tolist(), u.tolist(), strict=True)
            )
            yield Row(message(f"sensor {sensor + 1}, record {record + 1}"), *cells)
