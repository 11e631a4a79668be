"""Confirmation of a model on a new record at a known input."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, rms
from bench.calibration.result import CalibrationError
from bench.diagnosis.confirm import Confirmation, EffectNow, Model, Word
from bench.diagnosis.gap import BY_CHANCE
from bench.diagnosis.record_diagnosis import diagnose_record
from bench.diagnosis.record_model import Course, Courses, Whitening, course_of, make_courses, make_record
from bench.diagnosis.record_search import RecordWork, values_of
from bench.model.effects import AppliedEffect
from bench.readings.table import Readings


def confirm_record(readings: Readings, effects: Sequence[AppliedEffect]) -> Confirmation:
    """Compare a new record with a model's effects at their values, and diagnose the rest.

    Root mean squares are in V. Raises `CalibrationError` if the record cannot be evaluated, or could show none of
    the effects.
    """
    record = make_record(readings)
    known = np.sum([record.added(applied) for applied in effects], axis=0)
    work = RecordWork(record, make_courses(record), Whitening.of(record))
    left = RecordWork(record, Courses(()), work.whitening, record.deviation_v - known)
    noises = work.noises_beside([course for one in effects if (course := _course(work, one)) is not None])
    freedom = len(work.parts) * (len(record) - record.trend.shape[1])
    sizes = []
    for one in (work, left):
        chi2 = sum(one.fitted(k, [], noises[k])[2] for k in one.parts)
        plain = one.deviation_v - record.trend @ np.linalg.lstsq(record.trend, one.deviation_v, rcond=None)[0]
        expected = np.sqrt(np.mean([noise.variance * (1.0 + noise.ratio) for noise in noises]))
        sizes.append(Model(chi2 / freedom, rms(plain), float(expected)))
    now = tuple(_now(left, effects))
    if all(one.verdict is None for one in now):
        raise CalibrationError(f"{readings.source}: this record could show none of the model's effects")
    p_after = float(special.chdtrc(freedom, sizes[1].reduced * freedom))
    before, after = sizes
    return Confirmation(before, after, p_after, now, diagnose_record(readings, known), "V")


def _course(work: RecordWork, applied: AppliedEffect) -> Course | None:
    """Return the course of an effect in its shape, or None if the record does not show it."""
    values = applied.complete_values()
    shape = {p.name: float(values[p.name]) for p in applied.effect.parameters if p.is_shape}
    return course_of(work.record, applied.effect, shape)


def _now(left: RecordWork, effects: Sequence[AppliedEffect]) -> Iterator[EffectNow]:
    """Yield each effect as the record alone gives it, the others at the model's values."""
    record = left.record
    for applied in effects:
        course = _course(left, applied)
        read = {"", *(CHANNELS[channel] for channel in record.channels)}
        found = tuple(v for v in values_of(applied) if v.u is not None and v.channel in read)
        if course is None or not found:
            yield EffectNow(applied, None, 1.0, 1.0, found, found)
            continue
        own = RecordWork(record, Courses(()), left.whitening, left.deviation_v + record.added(applied))
        size, u = own.sizes_of(course)
        here = course.applied(size, u, record.channels)
        here = AppliedEffect(here.effect, here.values, applied.channels, u=here.u)
        now = tuple(v for v in values_of(here) if v.u is not None and v.channel in read)
        p_none = _chance([value.value for value in now], [value.u or 0.0 for value in now])
        pairs = list(zip(now, found, strict=True))
        p_same = _chance(
            [a.value - b.value for a, b in pairs], [float(np.hypot(a.u or 0.0, b.u or 0.0)) for a, b in pairs]
        )
        yield EffectNow(applied, _word(p_same, p_none), p_same, p_none, found, now)


def _word(p_same: float, p_none: float) -> Word:
    if p_none >= BY_CHANCE:
        return "gone"
    return "confirmed" if p_same >= BY_CHANCE else "changed"


def _chance(values: Sequence[float], u: Sequence[float]) -> float:
    size: Floats = np.array(values) / np.array(u)
    return float(special.chdtrc(len(size), float(size @ size)))
