"""The result of `bench diagnose` for free positions alone, as JSON, as text and as a page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from pydantic import Field
from rich.console import Console

from bench.base.arrays import CHANNELS, Floats, rms
from bench.base.computing import quiet
from bench.base.numbers import aligned, concise, quantity, rounded, scale_for, typeset
from bench.base.result_model import Real, ResultModel
from bench.diagnosis.free_records import OUTLIER, FreeDiagnosis
from bench.diagnosis.gap import Gap
from bench.diagnosis.result import NamedEffect, Verdict
from bench.model.effects import CATALOGUE
from bench.model.geometry import COEFFICIENTS
from bench.results import diagnosis_words as words
from bench.results.diagnosis_page import INK, STATES, drawn, gap_bars
from bench.results.diagnosis_parts import FoundPart, GapPart, OddsPart, VerdictOfCopy, gap_part
from bench.results.diagnosis_words import NO_FILES, Files
from bench.results.parts import BenchPart, CorrectionPart
from bench.results.plots import BLUE, GREY, PASS_COLOURS, PASS_FILLS, VERMILION, legend_of, svg_figure
from bench.results.repeats import BetweenRecordsPart, between_part, repeats_between
from bench.results.tables import Row, page, symbol

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class FreeFoundPart(FoundPart):
    """An effect that was found, or an outlying position."""

    odds: list[OddsPart] = Field(
        default=[], description="the names that may stand in this place, the most probable first"
    )


class FreePlace(ResultModel):
    """A record of a sensor in which |a| differs from 1 g."""

    channel: str
    installation: str
    pattern: str
    size: float = Field(description="root mean square of |a| - 1 g")
    unit: Literal["g"]
    p: float = Field(description="all records counted")


class FreeNoise(ResultModel):
    """The scatter of a position's |a| that remains with the effects found."""

    reading: float
    unit: Literal["g"]
    stated: Real = Field(description="what the samples imply")
    dof: int


class FreeCopyPart(ResultModel):
    """The copy of the readings without the outlying positions."""

    readings: Path | None = Field(description="the readings file of the copy; null where it was not written")
    files: list[Path] = Field(description="those of all records of which positions stand apart")
    used: int = Field(description="readings in the copy")
    verdict: VerdictOfCopy = Field(description="what the search on the copy came to")
    rests_on: list[str] = Field(description="the mistakes that are put right in it")


class FreeDiagnoseResult(ResultModel):
    """A diagnosis of readings that are free positions alone.

    For several sources, the output of `bench diagnose --json` is a list of these; a source that could not be
    evaluated has a `source-failed` object in its place.
    """

    verdict: Verdict
    where: list[FreePlace] = Field(description="records and sensors in which |a| is off, the largest first")
    effects: list[FreeFoundPart]
    next_measurement: None
    hidden: list[str] = Field(description="effects that free positions could never show")
    gap: GapPart = Field(
        description="reduced chi-square of positions held out, every fifth in turn; rms in g"
    )
    model: Path | None = Field(
        description="path of the model file that was written; of several sensors with values of their own the "
        "first's"
    )
    noise: FreeNoise
    between_records: BetweenRecordsPart | None = Field(
        description="how zeros go between records, each fitted by itself; null for one record"
    )
    sensors: int
    records: int
    threshold: float = Field(description="ln odds above which something is found")
    notes: list[str]
    source: str
    models: list[Path] = Field(description="paths of all model files that were written, a sensor each")
    report: Path | None = Field(description="path of the page")
    corrected: FreeCopyPart | None = Field(
        description="what is left without the positions that stand apart, on which all else rests; null where "
        "there is none"
    )
    bench: BenchPart | None
    corrections: list[CorrectionPart] = Field(
        description="the certificates of the instruments, and what was done by them; without any an empty list"
    )
    simulated: bool
    skipped_rows: list[str]


def free_result(
    found: FreeDiagnosis,
    files: Files = NO_FILES,
    bench: BenchPart | None = None,
    corrections: Sequence[CorrectionPart] = (),
    *,
    simulated: bool = False,
    skipped_rows: Sequence[str] = (),
) -> FreeDiagnoseResult:
    """Return the result of a diagnosis; `files` are the files that were written."""
    return FreeDiagnoseResult.from_object(
        found,
        where=[FreePlace.model_validate(place) for place in found.where],
        effects=[*map(_outlier, found.apart), *map(FreeFoundPart.model_validate, found.found)],
        next_measurement=None,
        hidden=hidden(),
        gap=gap_part(found.gap),
        model=files.model,
        noise=FreeNoise(
            reading=found.noise.reading, unit="g", stated=found.stated_g, dof=found.noise.freedom
        ),
        between_records=None if found.between is None else between_part(found.between),
        sensors=found.rows.sensors,
        models=list(files.models),
        report=files.report,
        corrected=FreeCopyPart(
            readings=files.copy,
            files=list(files.copies),
            used=len(found.rows),
            verdict=found.of_rest,
            rests_on=list(found.apart),
        )
        if found.apart
        else None,
        bench=bench,
        corrections=list(corrections),
        simulated=simulated,
        skipped_rows=list(skipped_rows),
    )


def hidden() -> list[str]:
    """Return the effects that free positions can never show: all except those of the block."""
    return [name for name, effect in CATALOGUE.items() if effect.subsystem.value != "block"]


def _outlier(text: str) -> FreeFoundPart:
    return FreeFoundPart(
        name=OUTLIER, channels=[], cannot_tell_from=[], parameters={}, p=None, p_all_looks=None, words=text
    )


# --- text -------------------------------------------------------------------------------------------

NOTHING: Final = "the positions agree with nine coefficients of each sensor within their scatter"
LISTED: Final = 2
"""Largest number of readings files that are all named; if there are more, only the first and the last are."""


def lead(found: FreeDiagnosis) -> str:
    """Return the verdict in a few words."""
    tied = any(one.cannot_tell_from for one in found.found)
    return words.LEAD[found.verdict] if found.verdict != "confounded" or tied else words.UNCONFIRMED


def readings_named(found: FreeDiagnosis) -> str:
    """Return a short name of the diagnosed readings: "a + b", or "a … z (5 readings files)"."""
    parts = found.source.split(" + ")
    return found.source if len(parts) <= LISTED else f"{parts[0]} … {parts[-1]} ({len(parts)} readings files)"


def title_of(one: NamedEffect) -> str:
    """Return the name of an effect with its channels, and the effects tied with it."""
    of = f" of {', '.join(one.channels)}" if one.channels else ""
    return " or ".join([one.name + of, *one.cannot_tell_from])


def what_in_words(found: FreeDiagnosis) -> str:
    """Return the findings as a sentence without a full stop."""
    rest = "; ".join(title_of(one) if one.in_catalogue else one.words for one in found.found) or NOTHING
    if not found.apart:
        return rest
    count = len(found.apart)
    return f"{OUTLIER}: {count} position{'s' * (count > 1)} stand{'s' * (count == 1)} apart; without: {rest}"


def gap_told(found: FreeDiagnosis) -> str:
    """Return how far the gap closes, or why it does not confirm the findings; "" if nothing was found."""
    if found.of_rest == "confounded" and found.gap.reason:
        return found.gap.reason
    return words.gap_in_words(found.gap)


def parameter_lines(one: NamedEffect) -> list[str]:
    """Return a line for each parameter: "K2 of y = 1980 ± 40 µg/g² (u)", of a sensor by itself with its number."""
    lines = [
        words.parameter_in_words(value, f" of {value.installations}" if value.installations else "")
        for value in one.parameters
        if value.u is not None
    ]
    shapes = [words.parameter_in_words(value, "") for value in one.parameters if value.u is None]
    return [*lines, *dict.fromkeys(shapes)]


def what_to_do(found: FreeDiagnosis, files: Files) -> Iterator[str]:
    """Yield a sentence on each step that should follow the diagnosis, with the command to type."""
    several = found.records * found.rows.sensors > 1
    if found.apart:
        yield "Measure the positions that stand apart again, at rest" + (
            f"; until then the corrected copy is {', '.join(map(str, files.copies))}" if files.copies else ""
        )
    for number, model in enumerate(files.models, start=1):
        of = f" of sensor {number}" if len(files.models) > 1 else ""
        source = "each record" if several else found.source
        yield f"Use the model{of}: bench calibrate {source} --model {model}"
        yield f"Test it with new readings{of}: bench confirm NEW --model {model}"
    if found.between is not None and (line := found.between.in_bench_file()):
        yield f"{repeats_between(found.between)}. Put it into the bench file, and calibrations hold it in u: {line}"
    names = {one.name for one in found.found}
    if "zeros_by_run" in names or "scale_by_run" in names:
        yield (
            "Calibrate each record by itself (bench calibrate RECORD), and write down what differs between "
            "records: when it was switched on, its temperature, who moved it"
        )
    elif found.of_rest == "unknown":
        yield "Measure the same again: what returns belongs to the sensor; see below in which record it acts"
    elif found.of_rest == "confounded":
        yield "Measure again, more positions all round, and diagnose both: bench diagnose … --together"
    elif found.verdict == "agrees":
        yield f"Nothing; the coefficients stand: bench calibrate {'each record' if several else found.source}"


def why_no_model(found: FreeDiagnosis) -> str:
    """Return the reason why no model file was written, to follow "no model file is written"."""
    if found.gap.shrinks is False:
        return "because the gap in the positions held out does not shrink: it would not be a better model"
    return "because the positions cannot decide between effects; --accept-first takes the first"


def print_free(found: FreeDiagnosis, files: Files, out: Console) -> None:
    """Print the findings in free positions in the order of the search, and the files that were written."""
    rows, gap = found.rows, found.gap
    out.print(
        f"{len(rows)} free positions, {rows.sensors} sensor{'s' * (rows.sensors > 1)}, {found.records} "
        f"record{'s' * (found.records > 1)}: |a| = 1 g is all that is known of them"
    )
    for note in found.notes:
        if not quiet.get():
            out.print(f"note: {note}")
    for text in found.apart:
        out.print(f"Mistake: outlier: {text}", style="bold")
    for place in found.where:
        out.print(f"  {place.pattern}: |a| is off by {quantity(place.size, 'g')} (rms)")
    for one in found.found:
        out.print(f"Found: {title_of(one)}", style="bold")
        out.print(typeset(f"  {one.words}"))
        for line in parameter_lines(one):
            out.print(f"  {line}")
        out.print(typeset(f"  {words.p_in_words(one.p_all_looks)} with all looks counted, rho {one.rho:.1f}"))
    if found.between is not None:
        told = repeats_between(found.between)
        out.print(typeset(f"Zeros: {told}"))
        if line := found.between.in_bench_file():
            out.print(f"  for u of calibrations, put into the bench file: {line}")
    _print_gap(gap, out)
    for file in files.copies:
        out.print(f"corrected copy of the readings: {file}")
    for file in files.models:
        out.print(f"model: {file}")
    if files.report is not None:
        out.print(f"report: {files.report}")
    if found.of_rest == "confounded" and not files.models:
        out.print(f"no model file is written {why_no_model(found)}")
    told = gap_told(found)
    text = what_in_words(found) + (f"; {told}" if told else "")
    out.print(typeset(f"{readings_named(found)}: {lead(found).upper()}: {text}"), style="bold")


def _print_gap(gap: Gap, out: Console) -> None:
    if gap.folds:
        out.print(
            f"Gap on positions held out: reduced chi-square {gap.before:.2f} before, {gap.after:.2f} after "
            f"(noise alone: 1); |a| is off by {quantity(gap.before_rms, 'g')} before, "
            f"{quantity(gap.after_rms, 'g')} after"
        )
    else:
        out.print("Gap: not measured, as no position can be held out; measure more of them, all round")
    if gap.reason:
        out.print(f"  not confirmed: {gap.reason}")


def evidence_in_words(found: FreeDiagnosis) -> dict[str, str]:
    """Return the evidence for the findings, by title, for the model file."""
    gap = found.gap
    told = {"found in": readings_named(found)}
    if found.apart:
        told["rests on"] = "; ".join(found.apart)
    for one in found.found:
        told[title_of(one)] = f"p {one.p_all_looks:.2g} with all looks, rho {one.rho:.1f}"
    told["gap"] = gap.reason or (
        f"reduced chi-square of positions held out {gap.before:.3f} before, {gap.after:.3f} after, "
        f"1 expected; root mean square of |a| - 1 g {1e6 * gap.before_rms:.3g} ug before, "
        f"{1e6 * gap.after_rms:.3g} ug after"
    )
    return told | {"threshold": f"ln odds {found.threshold:.3f}"}


# --- page and figures -----------------------------------------------------------------------------

MARKS: Final = "osD^vP*X"
BARS: Final = 0.8
"""Fraction of a record's width that its bars fill."""


def overlay(found: FreeDiagnosis, sensor: int) -> str:
    """Return a plot of the signals of a sensor in order of measurement: measured over simulated, a row per channel.

    The orientations are unknown. Each position is simulated in the direction that its signals give, so that only
    errors of the modulus show. The right column has both minus the simulation with the given model, magnified.
    """
    rows = found.rows
    mine = rows.sensor == sensor
    signal = rows.tables[sensor].signal
    per_g = rows.direction[mine] @ rows.block[sensor].K.T
    given, last = (per_g * fit.left[mine][:, None] for fit in (found.before, found.after))
    size = scale_for(float(np.max(np.abs(signal))), rows.tables[sensor].unit)
    scale = scale_for(float(np.max(np.abs(given))), rows.tables[sensor].unit)
    number = np.arange(1, len(signal) + 1)
    whose = "with what was found" if found.found else "as it was given"

    def draw(figure: Figure) -> None:
        grid: Any = figure.subplots(3, 2, sharex=True, squeeze=False)
        for i, channel in enumerate(CHANNELS):
            left: Axes = grid[i, 0]
            left.plot(
                number, (signal - last)[:, i] / size.size, "_", color=INK, markersize=9, markeredgewidth=1.4,
                label=f"simulated, {whose}",
            )  # fmt: skip
            left.plot(
                number, signal[:, i] / size.size, "o", color=BLUE, markersize=3.5, alpha=0.8, label="measured"
            )
            left.set_ylabel(f"channel {channel} / {size.unit}")
            right: Axes = grid[i, 1]
            right.axhline(
                0.0, color=GREY, linewidth=0.7, linestyle=(0, (4, 3)), label="simulated as it was given"
            )
            right.plot(number, given[:, i] / scale.size, "o", color=BLUE, markersize=3.5, alpha=0.8)
            if found.found:
                right.plot(
                    number,
                    (given - last)[:, i] / scale.size,
                    "_",
                    color=INK,
                    markersize=9,
                    markeredgewidth=1.4,
                )
            right.set_ylabel(scale.unit)
        _mark_records(grid.flat, rows.record[mine])
        grid[0, 0].set_title(f"sensor {sensor + 1}" if rows.sensors > 1 else "signals")
        grid[0, 1].set_title("less the sensor simulated as it was given")
        for axes in grid[2]:
            axes.set_xlabel("position, in the order of measurement")
        figure.legend(*legend_of(grid.flat), loc="outside upper center", ncols=3)

    alt = (
        f"Measured and simulated signals of channels x, y, z of sensor {sensor + 1} at {len(signal)} positions, "
        "and both less the sensor simulated as it was given"
    )
    return svg_figure(f"free-overlay-{sensor}", (7.6, 5.6), draw, alt)


def _mark_records(all_axes: Any, record: Floats) -> None:
    """Draw a line at each beginning of a new record."""
    edges = np.flatnonzero(np.diff(record)) + 1.5
    for axes in all_axes:
        for edge in edges:
            axes.axvline(edge, color=GREY, linewidth=0.8, linestyle=(0, (4, 3)))


def modulus_in_time(found: FreeDiagnosis) -> str:
    """Return a plot of |a| - 1 g against the time since the start of the record, before and after."""
    rows = found.rows
    fits = [("as it was given", found.before), ("with what was found", found.after)][: 1 + bool(found.found)]
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
                    label="two standard deviations of the noise",
                )  # fmt: skip
            for record in np.unique(rows.record):
                for sensor in range(rows.sensors):
                    mine = (rows.record == record) & (rows.sensor == sensor)
                    axes.plot(
                        time_s[mine] / 60.0, fit.left[mine] / scale.size, MARKS[sensor % len(MARKS)],
                        color=PASS_COLOURS[record % len(PASS_COLOURS)],
                        fillstyle=PASS_FILLS[record // len(PASS_COLOURS) % len(PASS_FILLS)], markersize=3.5,
                        label=_which(found, sensor, int(record)),
                    )  # fmt: skip
            axes.set_title(title)
            axes.set_xlabel("time in the record / min")
        grid[0, 0].set_ylabel(f"|a| − 1 g / {scale.unit}")
        figure.legend(*_few(grid), loc="outside upper center", ncols=5)

    alt = "The modulus of the specific force less 1 g against the time in its record, before and after"
    return svg_figure("free-time", (7.6, 3.4), draw, alt)


def _which(found: FreeDiagnosis, sensor: int, record: int) -> str:
    """Return the legend label of a record; that of further sensors begins with "_" and is hidden."""
    return f"record {record + 1}" if sensor == 0 or found.rows.sensors == 1 else f"_sensor {sensor + 1}"


def _few(grid: Any) -> tuple[list[Any], list[str]]:
    handles, labels = legend_of(grid.flat)
    shown = [(h, label) for h, label in zip(handles, labels, strict=True) if not label.startswith("_")]
    return [h for h, _ in shown], [label for _, label in shown]


def modulus_by_record(found: FreeDiagnosis) -> str:
    """Return a bar chart of the root mean square of |a| - 1 g in each record, for each sensor, before and after."""
    rows = found.rows
    records = np.unique(rows.record)
    scale = scale_for(float(np.max(np.abs(found.before.left))), "g")
    width = BARS / rows.sensors

    def draw(figure: Figure) -> None:
        axes: Axes = figure.subplots()
        for sensor in range(rows.sensors):
            at = np.arange(len(records)) + (sensor - (rows.sensors - 1) / 2) * width
            for fit, colour, part, what in (
                (found.before, VERMILION, 1.0, "as it was given"),
                (found.after, BLUE, 0.55, "with what was found"),
            ):
                if fit is found.before or found.found:
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
            label="noise alone",
        )
        axes.set_xticks(np.arange(len(records)), [f"record {r + 1}" for r in records])
        axes.grid(visible=False, axis="x")
        axes.set_ylabel(f"|a| − 1 g, rms / {scale.unit}")
        figure.legend(*legend_of(iter([axes])), loc="outside upper center", ncols=3)

    alt = f"Root mean square of the modulus less 1 g in {len(records)} records of {rows.sensors} sensors"
    return svg_figure("free-records", (6.4, 3.0), draw, alt)


MOST_DRAWN: Final = 8
"""Largest number of sensors whose signals are drawn."""


def render_free(
    found: FreeDiagnosis,
    files: Files,
    title: str,
    provenance: Mapping[str, str],
    *,
    simulated: bool,
) -> str:
    """Return the HTML page; the same content always gives the same text."""
    signals = [drawn(overlay(found, s)) for s in range(min(found.rows.sensors, MOST_DRAWN))]
    return page(
        "free_diagnosis.html.j2",
        title=title,
        found=found,
        simulated=simulated,
        source=readings_named(found),
        provenance=provenance,
        state=STATES.get(found.verdict, "failed"),
        lead=lead(found),
        what=what_in_words(found),
        gap=gap_told(found),
        to_do=list(what_to_do(found, files)),
        words=words,
        quantity=quantity,
        effects=[(title_of(one), one, parameter_lines(one)) for one in found.found],
        overlays=signals,
        in_time=drawn(modulus_in_time(found)),
        by_record=drawn(modulus_by_record(found)) if found.records > 1 else None,
        gap_bars=drawn(gap_bars(found.gap)) if found.found and found.gap.folds else None,
        held_out=[
            Row(
                fold.label,
                (
                    ", ".join(fold.gains) or "nothing",
                    f"{fold.before.reduced:.2f}",
                    f"{fold.after.reduced:.2f}",
                ),
            )
            for fold in found.gap.folds
        ],
        places=[
            Row(p.pattern, (quantity(p.size, "g"), typeset(words.p_in_column(p.p)))) for p in found.where
        ],
        coefficients=list(_coefficients(found)),
        zeros=list(_zeros(found)),
        models=files.models,
        hidden=[CATALOGUE[name] for name in hidden()],
    )


def _coefficients(found: FreeDiagnosis) -> Iterator[tuple[int, list[Row]]]:
    """Yield the index of each sensor and rows of its coefficients before and after, without the fixed ones."""
    unit = found.rows.tables[0].unit
    for sensor in range(found.rows.sensors):
        pairs = [
            (fit.block[sensor].vector.tolist(), fit.u[sensor].tolist()) for fit in (found.before, found.after)
        ]
        (old, u_old), (new, u_new) = pairs
        shown = [i for i in range(len(old)) if u_old[i] > 0.0]
        before = aligned([concise(old[i], u_old[i]) for i in shown])
        after = aligned([concise(new[i], u_new[i]) for i in shown])
        scale = scale_for(max(abs(new[i] - old[i]) for i in shown), unit)
        rows = []
        for i, was, now in zip(shown, before, after, strict=True):
            change = rounded((new[i] - old[i]) / scale.size, max(u_old[i], u_new[i]) / scale.size, sign=True)
            printed = scale.unit if COEFFICIENTS[i].startswith("U0") else scale.per_g
            rows.append(Row(symbol(COEFFICIENTS[i]), (was, now, change, printed)))
        yield sensor, rows


def _zeros(found: FreeDiagnosis) -> Iterator[Row]:
    """Yield a row with the zeros of each sensor in each record, fitted by itself, in mg with u."""
    between = found.between
    if between is None:
        return
    for sensor in range(found.rows.sensors):
        for record in range(between.zero.shape[1]):
            values = 1e3 * between.zero[sensor, record]
            u = 1e3 * between.u[sensor, record]
            cells = tuple(
                concise(float(values[i]), float(u[i])) if np.isfinite(values[i]) else "not determined"
                for i in range(len(CHANNELS))
            )
            yield Row(f"sensor {sensor + 1}, record {record + 1}", cells)
