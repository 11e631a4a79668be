"""Confirmation of a model on a new record at a known input."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from bench.base.arrays import rms
from bench.calibration.design import make_problem
from bench.diagnosis.confirm import Confirmation, EstimatedEffects, Model, judged
from bench.diagnosis.record_diagnosis import diagnose_record
from bench.diagnosis.record_model import courses_of, make_record, shape_of
from bench.diagnosis.record_search import RecordWork
from bench.model.effects import AppliedEffect
from bench.model.forward import ForwardModel
from bench.readings.table import Readings


def confirm_record(readings: Readings, effects: Sequence[AppliedEffect]) -> Confirmation:
    """Compare a new record at a known input with a model's effects, and diagnose it for further ones.

    The effects keep their values. Root mean squares are in V. Raises `CalibrationError` if the record cannot
    be evaluated, or could not show any of the effects.
    """
    record = make_record(readings)
    forms = [(one.effect, shape_of(one.effect, one.complete_values())) for one in effects]
    work = RecordWork.of(record, courses_of(record, forms))
    left = work.less(record.added_by(effects))
    there = {(course.family, course.shape): course for course in work.candidates.variants}
    courses = [there.get((effect.name, shape)) for effect, shape in forms]
    noises = work.noises([course for course in courses if course is not None])
    expected = float(np.sqrt(np.mean([noise.variance * (1.0 + noise.ratio) for noise in noises])))
    freedom = len(work.parts) * (len(record) - record.trend.shape[1])
    reduced = [sum(one.fitted(k, [], noises[k])[2] for k in one.parts) / freedom for one in (work, left)]
    before, after = (
        Model(of_fit, rms(one.record.beside_trend), expected)
        for of_fit, one in zip(reduced, (work, left), strict=True)
    )
    model = ForwardModel({}, tuple(effects))
    unknowns = [
        one
        for one in make_problem(model, record.conditions, {}).effects
        if one.channel is None or one.channel in record.channels
    ]
    of = EstimatedEffects.unchanged(model, unknowns)
    for number, (applied, course) in enumerate(zip(effects, courses, strict=True)):
        mine = [i for i, one in enumerate(unknowns) if one.effect == number]
        if course is not None and mine:
            # each effect as the record alone gives it, the others at the model's values
            size, u_size = left.less(-record.added(applied)).sizes([course])
            at = [0 if (c := unknowns[i].channel) is None else record.channels.index(c) for i in mine]
            of.change[mine], of.covariance[mine, mine] = size[at] - of.found[mine], u_size[at] ** 2
    p_after = float(special.chdtrc(freedom, after.reduced * freedom))
    return Confirmation(
        before, after, p_after, judged(model, unknowns, of), diagnose_record(readings, effects), "V"
    )
