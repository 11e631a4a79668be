"""Results for a record at a known input, as JSON, as text and as a page.

They are the diagnosis (`bench diagnose`) and the calibration of the meters (`bench calibrate`, `bench report`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, Literal

from pydantic import Field
from rich.console import Console

from bench.base.arrays import Floats, rms
from bench.base.languages import message
from bench.base.numbers import concise, quantity, scale_for, typeset, uncertainty
from bench.base.result_model import ResultModel
from bench.base.tables import print_notes
from bench.base.text import LISTED_IN_SENTENCE
from bench.calibration.result import COVERAGE_FACTOR
from bench.diagnosis.gap import Gap
from bench.diagnosis.record_calibration import ChannelCalibration, Estimate, RecordCalibration
from bench.diagnosis.record_diagnosis import RecordDiagnosis, Rival
from bench.diagnosis.record_model import Record
from bench.history.stability import Stability
from bench.results import diagnosis_words as words
from bench.results.diagnosis import print_effect, print_files, print_verdict
from bench.results.diagnosis_page import render_alone
from bench.results.diagnosis_parts import (
    AloneResult,
    EffectPart,
    GapPart,
    RepeatsPart,
    gap_part,
    repeats_part,
    repeats_told,
)
from bench.results.diagnosis_words import NO_FILES, Files
from bench.results.parts import BenchPart, Corrections, ReadingsPart
from bench.results.plots import BLUE, VERMILION, legend_of, svg_figure
from bench.results.stability import allan_figure, averaging_lines
from bench.results.tables import page

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class ChannelPart(ResultModel):
    """Zero and drift of a channel, estimated together with the effects found, and the residuals of the channel."""

    channel: str
    zero_v: float = Field(
        description="zero at the middle of the record, V: mean of signal minus reference; that at 0 V if the "
        "reference has several levels"
    )
    u_zero_v: float
    drift_v_h: float = Field(description="drift, V/h")
    u_drift_v_h: float
    before_rms_v: float = Field(description="rms of the residuals without the effects, V")
    after_rms_v: float = Field(description="rms of the residuals with the effects, V")


class RecordNoisePart(ResultModel):
    """The noise of the mean of a channel's readings."""

    white_v: float
    slow_v: float
    means: int = Field(description="number of means into which the readings were averaged")


class RecordDiagnoseResult(AloneResult):
    """A diagnosis of a record in which voltmeters read a known reference voltage (rows R alone)."""

    effects: list[EffectPart]
    rivals: list[Rival]
    """comparison of the shapes that an effect of the meter's temperature can have"""
    channels: list[ChannelPart]
    noise: RecordNoisePart
    far: list[str] = Field(description="means with unexplained jumps of 6 u or more")


def result_of(found: RecordDiagnosis, files: Files = NO_FILES, **made_from: Any) -> RecordDiagnoseResult:
    """Return the result of a diagnosis; `files` are the files that were written."""
    return RecordDiagnoseResult.made(
        found,
        files,
        made_from,
        gap=_gap_part(found.gap),
        channels=[
            ChannelPart.from_object(fit, before_rms_v=rms(fit.before_v), after_rms_v=rms(fit.residual_v))
            for fit in found.fits
        ],
        noise=RecordNoisePart(white_v=found.white_v, slow_v=found.slow_v, means=len(found.record)),
    )


def _gap_part(gap: Gap) -> GapPart:
    """Return the part on the gap; members in µg are null, because a record has no scale factor."""
    in_g = dict.fromkeys(("before_rms_ug", "after_rms_ug"))
    part = gap_part(gap)
    held_out = [fold.model_copy(update=in_g) for fold in part.held_out]
    return part.model_copy(update={**in_g, "expected_rms_ug": None, "reason": None, "held_out": held_out})


# --- text -------------------------------------------------------------------------------------------


def _trend_in_words(record: Record) -> str:
    """Return what each channel equals without effects; a gain is fitted if the reference has several levels."""
    return message(f"{'gain × ' if record.several_levels else 'the '}reference plus a zero and a drift")


def what_in_words(found: RecordDiagnosis) -> str:
    """Return the findings as a sentence without a full stop."""
    nothing = message(f"within the noise each channel equals {_trend_in_words(found.record)}")
    return "; ".join([words.found_in_words(found, nothing), *found.far[:LISTED_IN_SENTENCE]])


def gap_told(found: RecordDiagnosis) -> str:
    """Return the misfit of held-out parts of the record without and with effects; "" without such parts."""
    gap = found.gap
    if not gap.folds:
        return ""
    return message(
        f"held-out excursions: residuals {quantity(gap.before_rms, 'V')} before, "
        f"{quantity(gap.after_rms, 'V')} after (rms); "
        f"reduced chi-square {gap.before:.2f} before, {gap.after:.2f} after (noise alone: 1)"
    )


def rivals_told(found: RecordDiagnosis) -> str:
    """Return which response to the meter's temperature best predicts held-out parts; "" if not compared."""
    if not found.rivals:
        return ""
    ordered = sorted(found.rivals, key=lambda one: one.chi2)
    listed = ", ".join(f"{one.what} {quantity(one.held_out_rms_v, 'V')}" for one in ordered)
    return message(f"{ordered[0].what} predicts held-out excursions best; residuals: {listed} (rms)")


def channel_lines(found: RecordDiagnosis) -> Iterator[str]:
    """Yield a line on each channel: zero, drift, and the residuals without and with the effects found."""
    for fit in found.fits:
        zero, drift = (
            concise(1e6 * value, 1e6 * u)
            for value, u in ((fit.zero_v, fit.u_zero_v), (fit.drift_v_h, fit.u_drift_v_h))
        )
        yield message(
            f"{fit.channel}: zero {zero} µV, drift {drift} µV/h; "
            f"residuals {quantity(rms(fit.before_v), 'V')} before, "
            f"{quantity(rms(fit.residual_v), 'V')} after (rms)"
        )


def print_found(found: RecordDiagnosis, files: Files, out: Console) -> None:
    """Print the diagnosis of a record, and the files that were written; the verdict comes last."""
    record = found.record
    out.print(
        message(
            f"record at a known input: {len(record)} means over {record.time_h[-1]:.1f} h, "
            f"channel{'s' if len(record.channels) > 1 else ''} {', '.join(fit.channel for fit in found.fits)}"
        )
    )
    print_notes(out, found.notes)
    for one in found.effects:
        print_effect(one, (), out)
    for line in (*channel_lines(found), rivals_told(found), gap_told(found)):
        if line:
            out.print(typeset(line[0].upper() + line[1:] if line[1] != ":" else line))
    print_files(found, files, out)
    print_verdict(found.source, found, what_in_words(found), [], out)


def what_to_do(found: RecordDiagnosis, files: Files) -> Iterator[str]:
    """Yield a sentence on each step that should follow, with the command to type."""
    for one in found.effects:
        if one.applied and one.cannot_tell_from:
            yield message(f"To separate {words.alike_in_words([one])}: {one.applied[0].effect.shown_by}")
    for model in files.models:
        yield message(f"Test it with a new record: bench confirm NEW --model {model}")
    if found.verdict == "unknown":
        yield message("Record again, and note possible causes with their times")


def evidence_in_words(found: RecordDiagnosis) -> dict[str, str]:
    """Return the evidence for the findings, by title, for the model file."""
    return words.evidence_of(found, gap_told(found))


# --- page ---------------------------------------------------------------------------------------------


def course_figure(time_h: Floats, courses: Sequence[tuple[str, Floats, Floats]]) -> str:
    """Return a plot of the residuals of signal minus reference against `time_h` (n,), in h.

    `courses` has for each channel its name, and its residuals (n,) in V without and with the effects found.
    """
    scale = scale_for(max(float(abs(before).max()) for _, before, _ in courses), "V")

    def draw(figure: Figure) -> None:
        rows = figure.subplots(len(courses), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (channel, before, after) in zip(rows, courses, strict=True):
            for course, colour, label in (
                (before, VERMILION, message("without the effects")),
                (after, BLUE, message("with the effects found")),
            ):  # fmt: skip
                axes.plot(time_h, course / scale.size, color=colour, linewidth=1.0, label=label)
            axes.set_ylabel(message(f"{channel} − reference / {scale.unit}"))
        rows[-1].set_xlabel(message("time / h"))
        figure.legend(*legend_of(iter(rows)), loc="outside upper center", ncols=2)

    alt = message(
        f"Signal minus reference of {len(courses)} channels over {time_h[-1]:.1f} h, without and with the effects"
    )
    return svg_figure("record-course", (6.4, 1.2 + 1.8 * len(courses)), draw, alt)


def render(
    found: RecordDiagnosis, files: Files, title: str, provenance: Mapping[str, str], *, simulated: bool
) -> str:
    """Return the HTML page; the same content always gives the same text."""
    course = course_figure(
        found.record.time_h, [(fit.channel, fit.before_v, fit.residual_v) for fit in found.fits]
    )
    return render_alone(
        "record.html.j2",
        found,
        provenance,
        title=title,
        intro=message(
            f"A record at a known input: each channel equals {_trend_in_words(found.record)}, plus effects."
        ),
        simulated=simulated,
        what=what_in_words(found),
        told=[line for line in (gap_told(found), rivals_told(found)) if line],
        to_do=list(what_to_do(found, files)),
        figures=[
            (
                course,
                message("Signal minus reference: residuals without the effects, and with the effects found."),
            )
        ],
        listed=list(channel_lines(found)),
    )


# --- the calibration of meters ---------------------------------------------------------------------------


NO_VERDICT: Final = message(
    "verdicts of |a| do not apply to a record at a known input, which has no acceleration; compare gain and offset "
    "with the specification of the meter"
)


class ValuePart(ResultModel):
    """A value with its uncertainty."""

    value: float
    u: float = Field(description="combined u of readings, reference and given effects")
    U: float = Field(description="expanded uncertainty k u")
    k: float
    u_readings: float = Field(description="part of u from the readings, including slow noise")


class RecordChannelPart(ResultModel):
    """Gain, offset, drift and noise of a channel, and the residuals of their fit."""

    gain: ValuePart | None = Field(description="gain, V/V; null if the reference stays at 0 V")
    offset_v: ValuePart | None = Field(description="offset, V; null if the reference has a single level")
    covariance_v: float = Field(description="covariance of gain and offset, V")
    drift_v_h: ValuePart
    """drift of the offset, V/h; gain and offset apply to the middle of the record"""
    white_v: float = Field(description="white noise of a mean of the record, standard deviation, V")
    slow_v: float = Field(description="slow noise of a mean of the record, root mean square, V")
    residual_rms_v: float


class RecordCalibrateResult(ResultModel):
    """The calibration of voltmeters that read a known reference voltage: U = gain × reference + offset."""

    estimator: Literal["gls"]
    unit: Literal["V"]
    channels: dict[str, RecordChannelPart]
    level_v: float = Field(description="mean of the reference voltage, V")
    not_observable: list[str]
    does_not_apply: list[str] = Field(description="members that only results of a block have")
    repeats: RepeatsPart | None
    """parts of the record, each calibrated separately; null if the record is too short"""
    means: int = Field(description="number of means into which the readings were averaged")
    readings: ReadingsPart
    model: str
    source: str
    bench: BenchPart
    made_at: str | None
    simulated: bool
    corrections: Corrections
    notes: list[str]
    skipped_rows: list[str]


def record_calibrate_result(
    found: RecordCalibration, model: str, skipped_rows: Sequence[str], made_from: Mapping[str, Any]
) -> RecordCalibrateResult:
    """Return the result; `made_from` has source, bench, made_at, simulated and corrections."""
    names = ("source", "bench", "made_at", "simulated", "corrections")
    return RecordCalibrateResult(
        estimator="gls", unit="V", level_v=found.level_v, not_observable=list(found.not_observable), model=model,
        channels={one.channel: _channel(one) for one in found.channels},
        does_not_apply=[NO_VERDICT],
        repeats=None if found.repeats is None else repeats_part(found.repeats),
        means=len(found.record),
        readings=ReadingsPart(used=int(found.record.used.sum()), skipped=len(skipped_rows)),
        notes=list(found.notes), skipped_rows=list(skipped_rows),
        **{name: made_from[name] for name in names},
    )  # fmt: skip


def _channel(one: ChannelCalibration) -> RecordChannelPart:
    return RecordChannelPart.from_object(
        one, gain=_value(one.gain), offset_v=_value(one.offset_v), drift_v_h=_value(one.drift_v_h),
        residual_rms_v=rms(one.residual_v),
    )  # fmt: skip


def _value(of: Estimate | None) -> ValuePart | None:
    if of is None:
        return None
    return ValuePart.from_object(of, U=COVERAGE_FACTOR * of.u, k=COVERAGE_FACTOR)


def headline(found: RecordCalibration) -> str:
    """Return a line with the duration of the record, its voltage, and the meaning of the values."""
    record = found.record
    return message(
        f"record at a known input: {len(record)} means over {record.time_h[-1]:.1f} h at {found.level_v:.6g} V, "
        "U = gain × reference + offset; ± is U, k = 2"
    )


def calibrated_lines(found: RecordCalibration) -> Iterator[str]:
    """Yield a line on each channel."""
    for one in found.channels:
        told = []
        if one.gain is not None:
            told.append(
                message(
                    f"gain = {concise(one.gain.value, one.gain.u)} (U = {uncertainty(2e6 * one.gain.u)} ppm)"
                )
            )
        if one.offset_v is not None:
            told.append(message(f"offset = {_micro(one.offset_v)} µV"))
        told += [
            message(f"drift = {_micro(one.drift_v_h)} µV/h"),
            message(f"residuals {quantity(rms(one.residual_v), 'V')} (rms)"),
        ]
        yield message(f"channel {one.channel}: {', '.join(told)}")


def _micro(of: Estimate) -> str:
    value, u = 1e6 * of.value, 1e6 * COVERAGE_FACTOR * of.u
    return f"{concise(value, u).partition('(')[0]} ± {uncertainty(u)}"


def repeats_line(found: RecordCalibration) -> str:
    """Return a sentence on how values from parts of the record scatter; "" if the record is too short."""
    if found.repeats is None:
        return ""
    term = found.repeats.term
    shown = [
        (one.channel, unit)
        for one in found.channels
        for value, unit in ((one.gain, "V/V"), (one.offset_v, "V"))
        if value is not None
    ]
    sizes = []
    for (channel, unit), size in zip(shown, term.size.tolist(), strict=True) if term else ():
        told = f"{1e6 * size:.2g} ppm" if unit == "V/V" else quantity(size, "V")
        sizes.append(f"{channel} × {size:.2g}" if term and term.name == "scale" else f"{channel} {told}")
    return repeats_told(found.repeats, message("within the record"), sizes)


def lines_of(found: RecordCalibration) -> list[str]:
    """Return lines on each channel, what is not determined, the scatter of repeats, and why there is no verdict."""
    told = [*calibrated_lines(found), *found.not_observable]
    return [*told, *filter(None, [repeats_line(found)]), NO_VERDICT]


def print_record_calibration(
    source: str, found: RecordCalibration, notes: Sequence[str], out: Console
) -> None:
    """Print gain, offset and drift of each channel with U."""
    out.print(typeset(f"{source}: {headline(found)}"), style="bold")
    for line in lines_of(found):
        out.print(typeset(line))
    print_notes(out, notes)


def render_record_calibration(
    found: RecordCalibration,
    noise: Stability | str,
    title: str,
    provenance: Mapping[str, str],
    notes: Sequence[str],
    *,
    simulated: bool,
) -> str:
    """Return the HTML report; `noise` is the stability of the residuals, or a sentence on why it is missing."""
    fits = [
        (one.channel, found.known_v[:, i] + one.residual_v, one.residual_v)
        for i, one in enumerate(found.channels)
    ]
    figures = [
        (
            course_figure(found.record.time_h, fits),
            message("Errors of the meters, and the residuals of gain, offset and drift."),
        )
    ]
    if isinstance(noise, Stability):
        notes = list(dict.fromkeys([*notes, *noise.record.notes]))
        figures.append(
            (
                allan_figure(noise, inline=True),
                message("Allan deviation and spectrum of the residuals, the drift included."),
            )
        )
    return page(
        "record.html.j2",
        title=title,
        intro=message("A record at a known input: U = gain × reference + offset + drift for each channel."),
        simulated=simulated,
        source=provenance["source"],
        state="none",
        lead=headline(found),
        what="",
        told=lines_of(found),
        to_do=[],
        figures=figures,
        listed=[noise] if isinstance(noise, str) else averaging_lines(noise),
        effects=[],
        held_out=[],
        notes=notes,
        provenance=provenance,
        ending="report",
    )
