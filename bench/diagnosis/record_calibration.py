"""The calibration of each channel of a record at a known input: gain, offset and drift, with u.

The model is U = gain × reference + offset + drift × t. The noise is white plus slow noise, as in the
diagnosis of records. Estimates are averaged over the kinds and variances of noise, weighted by their posterior
probability, so that u includes what slow noise may hide.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Ints, u_of
from bench.base.languages import message
from bench.calibration.budget.coefficients import unknown_courses
from bench.calibration.budget.error_source import ErrorSource
from bench.calibration.result import CalibrationError
from bench.diagnosis.levels import FOLDS
from bench.diagnosis.record_model import (
    LEAST,
    ZERO_V,
    Record,
    courses_of,
    fading_record,
    forms_of,
    make_record,
    shape_of,
    start_of,
    without_noise,
)
from bench.diagnosis.record_noise import Noise, NoiseTrials
from bench.diagnosis.record_search import Forms, RecordWork
from bench.model.conditions import Conditions
from bench.model.effects import AppliedEffect
from bench.readings.columns import numbers
from bench.readings.table import REFERENCE, REFERENCE_SD_V, REFERENCE_V, Readings
from bench.stats.repeats import Repeats, compare_repeats

METER_GAIN: Final = "voltmeter_gain"
"""The kind of the sources that `meter_gain_sources` yields."""


@dataclass(frozen=True)
class Estimate:
    """A value with its standard uncertainty `u`; `u_readings` is the part of u from the noise of the readings."""

    value: float
    u: float
    u_readings: float


@dataclass(frozen=True)
class ChannelCalibration:
    """The calibration of one channel: gain (V/V), offset (V) and drift (V/h).

    If the reference has one level, `gain` or `offset_v` is None. `covariance_v` is the covariance of gain and
    offset, V. `white_v` and `slow_v` are the standard deviations of the white and the slow noise of one mean,
    V; `residual_v` (n,) are the residuals, V.
    """

    channel: str
    gain: Estimate | None
    offset_v: Estimate | None
    covariance_v: float
    drift_v_h: Estimate
    white_v: float
    slow_v: float
    residual_v: Floats


@dataclass(frozen=True)
class RecordCalibration:
    """The calibration of all c channels of a record of n means; `level_v` is the mean of the reference, V.

    `known_v` (n, c) are the voltages of the given effects, V, which are already subtracted. `not_observable`
    says what the record does not determine. `repeats` compares calibrations of parts of the record, None if
    these cannot be calibrated.
    """

    record: Record
    channels: tuple[ChannelCalibration, ...]
    level_v: float
    known_v: Floats
    not_observable: tuple[str, ...]
    notes: tuple[str, ...]
    repeats: Repeats | None = None

    def residual_of(self, readings: Readings) -> Floats:
        """Return the signals minus gain × reference, offset and effects, V, (m, c); the drift is not subtracted."""
        at, record = readings.time_s, self.record
        reference_v = numbers(readings.extra[REFERENCE_V])
        left = []
        for number, (i, one) in enumerate(zip(record.channels, self.channels, strict=True)):
            gain = 1.0 if one.gain is None else one.gain.value
            offset_v = 0.0 if one.offset_v is None else one.offset_v.value
            known_v = np.interp(at, record.conditions.time_s, self.known_v[:, number])
            left.append(readings.signal[:, i] - gain * reference_v - offset_v - known_v)
        return np.column_stack(left)


def calibrate_record(
    readings: Readings, effects: Sequence[AppliedEffect] = (), hidden: Sequence[ErrorSource] = ()
) -> RecordCalibration:
    """Calibrate meters from readings at a known input, after known effects are subtracted.

    Effects with a stated u keep their values; the others were found in these readings and are estimated again. u
    includes the uncertainty of shapes and of the state in which a lag begins, the slow noise, and the scatter of
    the reference (`reference_sd_v`). If the record lacks a temperature, u includes the `hidden` sources that depend
    on it (`unread_sources`). If the reference only changes linearly with time, u includes errors of the gain
    (`meter_gain_sources`). Raises `CalibrationError` if the readings cannot be evaluated, or if such a reference
    has no source for a gain.
    """
    record = make_record(readings)
    hidden = _acting(record, hidden)
    known = record.added_by(effects)
    left = record.less(known)
    scatter, note = _scatter(readings, record)
    errors = [np.repeat(scatter[:, None], len(record.channels), axis=1)]
    of_one_u = [(one.effect, {**one.complete_values(), **one.u}, one.channels) for one in effects if one.u]
    errors += [record.added(AppliedEffect(*one)) for one in of_one_u]
    errors += [_one_start(record, one) for one in effects if one.u and "lag" in one.complete_values()]
    errors += [error for one in hidden for error in _of_hidden(record, one)]
    level = float(record.reference_v.mean())
    return RecordCalibration(
        record=record,
        channels=_channels(left, np.stack(errors), _refitted(left, [e for e in effects if not e.u])),
        level_v=level,
        known_v=known,
        not_observable=() if record.several_levels else tuple(_hidden(record, level)),
        notes=(
            *record.notes,
            *note,
            *_shapes_kept(record, effects),
            *(f"u includes {one.name}: {one.origin}" for one in hidden),
        ),
        repeats=_parts(left),
    )


@dataclass(frozen=True)
class _Refitted:
    """An effect to estimate again: its voltages and those of its starting state (`start_of`), V, (n, c) each.

    `forms` are its possible shapes, None if the shape is known.
    """

    added_v: Floats
    start: Floats
    forms: Forms | None


def _refitted(left: Record, effects: Sequence[AppliedEffect]) -> list[_Refitted]:
    """Return `effects` as effects to estimate again; `left` is the record minus these effects."""
    if not effects:
        return []
    record = left.less(-left.added_by(effects))
    given = [(one.effect, shape_of(one.effect, one.complete_values())) for one in effects]
    tried = [forms_of(record, *one) for one in given]
    every = {(effect.name, shape): (effect, shape) for one in tried for effect, shape in one}
    work = RecordWork.of(record, courses_of(record, every.values()))
    courses = [work.nearest(effect.name, shape) for effect, shape in given]
    known = list(dict.fromkeys(filter(None, courses)))
    of_effects = [
        work.forms(known, known.index(near)) if near and len(forms) > 1 else None
        for near, forms in zip(courses, tried, strict=True)
    ]
    starts = [start_of(record, *one) for one in given]
    return [_Refitted(*one) for one in zip(map(left.added, effects), starts, of_effects, strict=True)]


def _shapes_kept(record: Record, effects: Sequence[AppliedEffect]) -> Iterator[str]:
    """Yield a sentence for each effect that keeps its values, if other shapes of it are possible."""
    for one in effects:
        shape = shape_of(one.effect, one.complete_values())
        if one.u and shape and len(forms_of(record, one.effect, shape)) > 1:
            yield message(
                f"{one.effect.name} keeps {one.shapes_text()} of the model; u leaves out the uncertainty of "
                "this shape, which no model file states"
            )


def _parts(record: Record) -> Repeats | None:
    """Return the comparison of equal parts of a record; None if it is short or a part lacks level or noise."""
    if len(record) < FOLDS * LEAST or record.ramp:
        return None
    parts = [_part(record, rows) for rows in np.array_split(np.arange(len(record)), FOLDS)]
    if any(part.several_levels != record.several_levels or any(without_noise(part)) for part in parts):
        return None
    each = [_channels(part, np.zeros((0, *part.deviation_v.shape)), []) for part in parts]
    shown = [[one for c in channels for one in (c.gain, c.offset_v) if one] for channels in each]
    value = np.array([[one.value for one in part] for part in shown])
    return compare_repeats(value[None], np.array([[one.u_readings for one in part] for part in shown])[None])


def _part(record: Record, rows: Ints) -> Record:
    nowhere = np.full(len(rows), np.nan)
    conditions = Conditions.of([REFERENCE] * len(rows), nowhere, time_s=record.conditions.time_s[rows])
    return replace(
        record, deviation_v=record.deviation_v[rows], reference_v=record.reference_v[rows],
        scale=record.scale[rows], conditions=conditions,
    )  # fmt: skip


def _channels(record: Record, errors: Floats, again: Sequence[_Refitted]) -> tuple[ChannelCalibration, ...]:
    """Return the calibration of each channel with effects to estimate `again`.

    `errors` (e, n, c) has the voltages of one u of each of e common errors.
    """
    trials, level = NoiseTrials.of(record), float(record.reference_v.mean())
    found = []
    for number, channel in enumerate(record.channels):
        effects = [one for one in again if np.any(one.added_v[:, number])]
        columns = [one.added_v[:, number] for one in effects]
        design = np.column_stack([record.trend, *columns]) / record.scale[:, None]
        first = design.shape[1]
        design = np.column_stack([design, *(one.start for one in effects)])
        targets = (
            np.column_stack([record.deviation_v[:, number], *errors[:, :, number]]) / record.scale[:, None]
        )
        mean, spread, noise = trials.averaged(design, targets)
        left = (targets[:, 0] - design @ mean[:, 0]) * record.scale
        count = record.trend.shape[1]
        for place, one in enumerate(effects):
            if one.forms is not None:
                mine = [count + place, first + place]
                others, held = np.delete(design, mine, axis=1), design[:, mine]
                beside = np.column_stack([others, targets[:, 0] + held[:, 0]])
                of_form = one.forms.variance_beside(noise, beside, held)
                spread[:count, :count] += of_form[:count, :count]
        found.append(
            _channel(record, CHANNELS[channel], level, mean[:count], spread[:count, :count], noise, left)
        )
    return tuple(found)


def _channel(
    record: Record, channel: str, level: float, mean: Floats, spread: Floats, noise: Noise, left: Floats
) -> ChannelCalibration:
    """Return gain, offset and drift of a `channel` from the estimates `mean` (p, 1 + e) of the trend.

    The rows are deviation, slope and, for several levels, gain - 1. The first column has the estimates, of
    covariance `spread`; the others are their changes by one u of an error.
    """
    several = len(mean) > 2
    has_gain = several or (abs(level) >= ZERO_V and not record.ramp)
    turn = record.zero_and_drift
    if several:
        turn = np.vstack([[0.0, 0.0, 1.0], turn])
    elif has_gain:
        turn[0] /= level
    value, own, of_errors = turn @ mean[:, 0], turn @ spread @ turn.T, turn @ mean[:, 1:]
    whole = own + of_errors @ of_errors.T
    made = [Estimate(*map(float, one)) for one in zip(value, u_of(whole), u_of(own), strict=True)]
    gain = replace(made[0], value=1.0 + made[0].value) if has_gain else None
    return ChannelCalibration(
        channel=channel,
        gain=gain,
        offset_v=made[1] if several else None if has_gain else made[0],
        covariance_v=float(whole[0, 1]) if several else 0.0,
        drift_v_h=made[-1],
        white_v=noise.white,
        slow_v=noise.white * noise.ratio**0.5,
        residual_v=left,
    )


def _scatter(readings: Readings, record: Record) -> tuple[Floats, tuple[str, ...]]:
    """Return the scatter (n,) of reference meters, V, as one common error; if unrecorded, 0 and a note."""
    cells = readings.extra.get(REFERENCE_SD_V)
    known = np.zeros(0) if cells is None else np.isfinite(numbers(cells))
    if cells is None or not known.any():
        return np.zeros(len(record)), (
            message(
                f"{REFERENCE_V} counts as exact, as {REFERENCE_SD_V} is missing; u holds no error of the reference"
            ),
        )
    sd = np.interp(record.conditions.time_s, readings.time_s[known], numbers(cells)[known])
    return sd, ()


def _one_start(record: Record, applied: AppliedEffect) -> Floats:
    """Return the voltages (n, c), V, of one standard deviation of the unknown starting state of a known effect."""
    values = applied.complete_values()
    at_once = AppliedEffect(applied.effect, {**values, "lag": np.zeros(())}, applied.channels)
    return fading_record(record, float(values["lag"])).added(at_once)


def _acting(record: Record, hidden: Sequence[ErrorSource]) -> tuple[ErrorSource, ...]:
    """Return the sources that act on a record. Raises the `CalibrationError` of `calibrate_record`."""
    of_gain = [one for one in hidden if one.kind == METER_GAIN] if record.ramp else []
    covered = {channel for one in of_gain for channel in one.channels}
    if record.ramp and not covered.issuperset(CHANNELS[channel] for channel in record.channels):
        raise CalibrationError(
            f"{record.source}: the reference changes linearly with time, and no u of the gain is given; step the "
            "reference up and down"
        )
    unread = (
        () if record.conditions.meter_c is not None else (one for one in hidden if one.kind != METER_GAIN)
    )
    return (*unread, *of_gain)


def _of_hidden(record: Record, source: ErrorSource) -> Iterator[Floats]:
    """Yield independent voltages (n, c), V, that a source of `_acting` adds, each of one u."""
    if source.kind == METER_GAIN:
        yield source.u * record.reference_v[:, None] * source.on_channels[list(record.channels)]
        return
    factors, names = source.factors or {}, [CHANNELS[channel] for channel in record.channels]
    gain, offset = (np.array([factors[f"{of} {name}"] for name in names]) for of in ("gain", "offset"))
    per_kelvin = record.reference_v[:, None] * gain + offset
    for course in unknown_courses(record.conditions.elapsed_s, source.correlation_s).T:
        yield source.u * course[:, None] * per_kelvin


def _hidden(record: Record, level: float) -> Iterator[str]:
    if record.ramp:
        yield message(
            "gain: the reference changes linearly with time, so that an error of the gain looks like a drift; "
            "the gain counts as 1, and u includes its error; step the reference up and down to determine it"
        )
        return
    if abs(level) < ZERO_V:
        yield message(f"gain: the reference stays at {level:.3g} V; record a second level to determine it")
        return
    yield message(
        f"offset: the reference stays at {level:.6g} V, where 1 µV of offset is {1e-6 / abs(level):.2g} of "
        "gain; the offset counts as 0; record a short circuit or a second level to determine it"
    )
