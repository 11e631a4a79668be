"""The result of `bench calibrate` and `bench report` for a record at a known input: JSON, text and page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, Literal

from pydantic import Field
from rich.console import Console

from bench.base.arrays import rms
from bench.base.languages import message
from bench.base.numbers import concise, quantity, typeset
from bench.base.result_model import ResultModel
from bench.base.tables import print_notes
from bench.calibration.result import COVERAGE_FACTOR
from bench.diagnosis.record_calibration import ChannelCalibration, Estimate, RecordCalibration
from bench.history.stability import Stability
from bench.results.parts import BenchPart, Corrections, ReadingsPart
from bench.results.record_diagnosis import course_figure
from bench.results.repeats import RepeatsPart, repeats_part, repeats_told
from bench.results.stability import allan_figure, averaging_lines
from bench.results.tables import page

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


# --- text -------------------------------------------------------------------------------------------


def headline(found: RecordCalibration) -> str:
    """Return a line with the duration of the record, its voltage, and the meaning of the values."""
    record = found.record
    return message(
        f"record at a known input: {len(record)} means over {record.time_h[-1]:.1f} h at {found.level_v:.6g} V, "
        "U = gain × reference + offset; ± is U, k = 2"
    )


def channel_lines(found: RecordCalibration) -> Iterator[str]:
    """Yield a line on each channel."""
    for one in found.channels:
        told = []
        if one.gain is not None:
            told.append(
                message(f"gain = {concise(one.gain.value, one.gain.u)} (U = {2e6 * one.gain.u:.2g} ppm)")
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
    return f"{concise(value, u).partition('(')[0]} ± {u:.2g}"


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
    told = [*channel_lines(found), *found.not_observable]
    return [*told, *filter(None, [repeats_line(found)]), NO_VERDICT]


def print_record_calibration(
    source: str, found: RecordCalibration, notes: Sequence[str], out: Console
) -> None:
    """Print gain, offset and drift of each channel with U."""
    out.print(typeset(f"{source}: {headline(found)}"), style="bold")
    for line in lines_of(found):
        out.print(typeset(line))
    print_notes(out, notes)


# --- page ---------------------------------------------------------------------------------------------


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
