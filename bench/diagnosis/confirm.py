"""Confirmation of a model by new readings, which are fitted with and without the effects of the model.

The effects keep the values that the model gives them. Coefficients, and stand angles with their prior u, are
estimated from the new readings twice: with the effects and without. The residuals of both fits are compared
with the noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress
from typing import Literal

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, rms
from bench.calibration import CalibrationError
from bench.calibration.design import EffectUnknown, make_problem
from bench.diagnosis.evidence import KNOWN_SIZE, ThresholdCache
from bench.diagnosis.free_positions import diagnose_free
from bench.diagnosis.free_records import FreeDiagnosis, make_system
from bench.diagnosis.gap import part_closed
from bench.diagnosis.levels import BY_CHANCE, MOSTLY, OFTEN
from bench.diagnosis.linear import LinearSystem, make_linear
from bench.diagnosis.pipeline import diagnose
from bench.diagnosis.posterior import NoiseSize, posterior, whiten_rows
from bench.diagnosis.record_diagnosis import RecordDiagnosis, diagnose_record
from bench.diagnosis.record_model import MOVE, courses_of, forms_of, make_record, shape_of
from bench.diagnosis.record_search import RecordWork
from bench.diagnosis.result import Diagnosis, EffectValue
from bench.diagnosis.search import in_the_noise_of
from bench.model import AppliedEffect, ForwardModel
from bench.model.effects.base import InPart, Parameter
from bench.readings.table import Readings

Word = Literal["confirmed", "changed", "gone"]


@dataclass(frozen=True)
class Model:
    """One fit: its reduced chi-square, and the root mean square of its residuals.

    `expected_rms_g` is the root mean square that noise alone would give. Both root mean squares are in g, or in V
    for records at a known input (`Confirmation.unit`).
    """

    reduced: float
    rms_g: float
    expected_rms_g: float


@dataclass(frozen=True)
class EffectNow:
    """One effect of the model, compared with the new readings.

    `verdict` is None if these readings could not have shown the effect. `p_same` is the p-value of the hypothesis
    that the values are unchanged, `p_none` that of the hypothesis that the effect is absent. `found` are the values
    in the model, `now` the values from the new readings alone.
    """

    applied: AppliedEffect
    verdict: Word | None
    p_same: float
    p_none: float
    found: tuple[EffectValue, ...]
    now: tuple[EffectValue, ...]


@dataclass(frozen=True)
class Confirmation:
    """The result of a confirmation: fits of new readings, `before` without the effects, `after` with them.

    `p_after` is the p-value of the chi-square with the effects; `effects` has the verdict on each.
    `diagnosis` is the diagnosis of the new readings with the model. Root mean squares are in `unit`.
    """

    before: Model
    after: Model
    p_after: float
    effects: tuple[EffectNow, ...]
    diagnosis: Diagnosis | FreeDiagnosis | RecordDiagnosis
    unit: str = "g"

    @property
    def closed(self) -> float | None:
        """The fraction of the excess of reduced chi-square over 1 that effects remove; None without an excess."""
        return part_closed(self.before.reduced, self.after.reduced)

    @property
    def verdict(self) -> Word:
        """The verdict on the model; effects that these readings could not show do not count.

        "gone": no effect is present. "confirmed": all are unchanged; they remove at least the fraction
        `MOSTLY` of the excess of chi-square, or chance explains the rest. Otherwise "changed".
        """
        words = {effect.verdict for effect in self.effects} - {None}
        if words == {"gone"}:
            return "gone"
        enough = self.closed is None or self.closed >= MOSTLY or self.p_after >= BY_CHANCE
        return "confirmed" if words == {"confirmed"} and enough else "changed"


def confirm(
    readings: Readings,
    model: ForwardModel,
    stand_u: Mapping[str, float],
    nominal_scale_factors: Floats | None = None,
    cache: ThresholdCache | None = None,
) -> Confirmation:
    """Compare new readings with the effects of a model, and diagnose these readings for further effects.

    The arguments are those of `diagnose`. Raises `CalibrationError` if the readings do not determine the
    coefficients, or could not show any of the effects.
    """
    diagnosis = diagnose(readings, model, stand_u, nominal_scale_factors, cache)
    corrected = diagnosis.mistakes.corrected
    as_found = partial(in_the_noise_of, diagnosis.linear)
    without = as_found(make_linear(corrected, replace(model, effects=()), stand_u))
    return compared(diagnosis, without, as_found(make_linear(corrected, model, stand_u)))


def confirm_free(tables: Sequence[Readings], model: ForwardModel) -> Confirmation:
    """Compare free positions with the effects of a model, and diagnose these positions for further effects.

    Raises `CalibrationError` if the positions do not determine the coefficients, or could show no effect.
    """
    diagnosis = diagnose_free(tables, None, model)
    return compared(diagnosis, make_system(replace(diagnosis.rows, effects=())), diagnosis.linear)


def confirm_record(readings: Readings, effects: Sequence[AppliedEffect]) -> Confirmation:
    """Compare a record at a known input with the effects of a model, and diagnose it for further effects.

    Root mean squares are in V. Amplitudes from the record alone are averages over the shapes and starting
    states that it allows, and u includes the variation between these. The time of a jump and the rail of a
    supply stay as the model states them. Raises `CalibrationError` if the record cannot be evaluated, or
    could show none of the effects.
    """
    record = make_record(readings)
    forms = [(one.effect, shape_of(one.effect, one.complete_values())) for one in effects]
    work = RecordWork.of(record, courses_of(record, forms))
    left = work.without(effects)
    there = {(course.family, course.shape): course for course in work.candidates.variants}
    courses = [there.get((effect.name, shape)) for effect, shape in forms]
    noises = work.noises([course for course in courses if course is not None])
    expected = float(np.sqrt(np.mean([noise.variance * (1.0 + noise.ratio) for noise in noises])))
    chi2 = [sum(one.fitted(k, [], noises[k])[2] for k in one.parts) for one in (work, left)]
    freedom = [len(one.parts) * one.freedom for one in (work, left)]
    before, after = (
        Model(of_fit / count, rms(one.beside_trend), expected)
        for of_fit, count, one in zip(chi2, freedom, (work, left), strict=True)
    )
    model = ForwardModel({}, tuple(effects))
    unknowns = [
        one
        for one in make_problem(model, record.conditions, {}).effects
        if one.channel is None or one.channel in record.channels
    ]
    of = EstimatedEffects.unchanged(model, unknowns)
    for number, course in enumerate(courses):
        mine = [i for i, one in enumerate(unknowns) if one.effect == number]
        if course is not None and mine:
            # estimate each effect from this record alone, with the others at the model's values
            alone = work.without([*effects[:number], *effects[number + 1 :]])
            tried = [] if course.family == MOVE else forms_of(record, *forms[number])
            free = replace(alone, candidates=courses_of(record, tried))
            near = free.nearest(course.family, course.shape) if len(tried) > 1 else None
            size, spread = (
                alone.sizes([course]) if near is None else free.sizes([near], 0, free.forms([near], 0))
            )
            at = [0 if (c := unknowns[i].channel) is None else record.channels.index(c) for i in mine]
            of.change[mine], of.covariance[np.ix_(mine, mine)] = (
                size[at] - of.found[mine],
                spread[np.ix_(at, at)],
            )
    p_after = float(special.chdtrc(freedom[1], chi2[1]))
    return Confirmation(
        before, after, p_after, judged(model, unknowns, of), diagnose_record(readings, effects), "V"
    )


def compared(
    diagnosis: Diagnosis | FreeDiagnosis, without: LinearSystem, having: LinearSystem
) -> Confirmation:
    """Return the comparison of two linear systems of the same readings.

    `without` lacks the effects of the model, `having` has them. `diagnosis` is the diagnosis of the readings.
    Raises `CalibrationError` if the readings could not show any of the effects.
    """
    noise = diagnosis.noise
    after, chi2 = _left(having, noise)
    before, _ = _left(without, noise)
    freedom = len(having) - having.fixed.shape[1]
    return Confirmation(
        before=before,
        after=after,
        p_after=float(special.fdtrc(freedom, noise.freedom, chi2 / freedom)),
        effects=_now(having, diagnosis),
        diagnosis=diagnosis,
    )


def _left(linear: LinearSystem, noise: NoiseSize) -> tuple[Model, float]:
    """Return the quality and the chi-square of a fit with the effects at their values and stated u."""
    stated = [unknown.stated for unknown in linear.problem.effects]
    keep = np.ones(linear.random.shape[1], dtype=bool)
    keep[linear.own] = stated
    known = replace(linear, random=linear.random[:, keep])
    chi2 = _chi2(known, noise)
    keep[linear.own] = False
    fixed = replace(linear, random=linear.random[:, keep])
    nothing = np.zeros((len(linear), 0))
    fitted = posterior(fixed, nothing, noise)
    design = np.concatenate([fixed.fixed, fixed.random], axis=1)
    of_g = (linear.setting >= 0) | (linear.rows.channel > 2)
    error = (linear.response - design @ fitted.mean)[of_g] * linear.g_per_signal[of_g]
    variance = (noise.reading * linear.relative) ** 2 + (noise.setting_rad * linear.slope) ** 2
    variance -= np.einsum("ni,ij,nj->n", design, fitted.covariance, design)
    expected = np.sqrt(np.maximum(variance, 0.0))[of_g] * linear.g_per_signal[of_g]
    return Model(chi2 / (len(linear) - linear.fixed.shape[1]), rms(error), rms(expected)), chi2


def _chi2(linear: LinearSystem, noise: NoiseSize) -> float:
    """Return the chi-square of a fit: squares of the residuals of readings and priors."""
    nothing = np.zeros((len(linear), 0))
    fitted = posterior(linear, nothing, noise)
    white = whiten_rows(linear, noise, (linear.response - linear.design(nothing) @ fitted.mean)[:, None])
    return float(np.sum(white**2) + np.sum(fitted.mean[linear.fixed.shape[1] :] ** 2))


def _now(linear: LinearSystem, diagnosis: Diagnosis | FreeDiagnosis) -> tuple[EffectNow, ...]:
    """Estimate the effects from these readings alone, and compare them with the model.

    An `InPart` effect keeps its value in the model, because these readings determine it no better. Raises
    `CalibrationError` if the readings could show none of the effects.
    """
    model = linear.model
    whole = [not isinstance(model.effects[one.effect].effect, InPart) for one in linear.problem.effects]
    unknowns = list(compress(linear.problem.effects, whole))
    places = np.arange(linear.own.start, linear.own.stop)[np.array(whole, dtype=bool)]
    of = EstimatedEffects.unchanged(model, unknowns)
    own = linear.random[:, places] * (of.plausible / [unknown.prior_u for unknown in unknowns])
    free = replace(linear, random=np.delete(linear.random, places, axis=1))
    change, covariance = _estimated(free, own, of.found, diagnosis)
    return judged(model, unknowns, replace(of, change=change, covariance=covariance))


@dataclass(frozen=True)
class EstimatedEffects:
    """The m parameters of a model's effects, and how they change in the new readings.

    `plausible` (m,) are plausible sizes in SI; the other members are multiples of these. `found` (m,) and `u`
    (m,) are values and uncertainties in the model. `change` (m,) is the new estimate minus `found`;
    `covariance` (m, m) is the covariance of the new estimates alone, without `u`.
    """

    plausible: Floats
    found: Floats
    u: Floats
    change: Floats
    covariance: Floats

    @classmethod
    def unchanged(cls, model: ForwardModel, unknowns: Sequence[EffectUnknown]) -> EstimatedEffects:
        """Return the values in the model, a change of 0, and a wide prior (`KNOWN_SIZE`) as covariance."""
        plausible = np.array([parameter_of(model, unknown).plausible for unknown in unknowns])
        found = np.array([unknown.prior_mean for unknown in unknowns]) / plausible
        u = np.array([unknown.prior_u if unknown.stated else 0.0 for unknown in unknowns]) / plausible
        return cls(plausible, found, u, np.zeros(len(found)), KNOWN_SIZE**2 * np.eye(len(found)))


def judged(
    model: ForwardModel, unknowns: Sequence[EffectUnknown], of: EstimatedEffects
) -> tuple[EffectNow, ...]:
    """Return the verdict on each effect of a model; `InPart` effects are skipped, as they have none.

    `unknowns` describe the m entries of `of`. Raises `CalibrationError` if the readings could show no effect.
    """
    known = np.sqrt(np.diag(of.covariance))
    effects, seen = [], []
    for number, applied in enumerate(model.effects):
        if isinstance(applied.effect, InPart):
            continue
        mine = [i for i, unknown in enumerate(unknowns) if unknown.effect == number]
        alike = [
            i
            for i, unknown in enumerate(unknowns)
            if model.effects[unknown.effect].effect.name == applied.effect.name
        ]
        size, least, p_same, p_none = _shown(of, mine)
        if size < least and len(alike) > len(mine):
            size, least, p_same, p_none = _shown(of, alike, apart=False)
        then, now = (
            tuple(
                _value(model, unknowns[i], sizes[i] * of.plausible[i], of_u[i] * of.plausible[i])
                for i in mine
            )
            for sizes, of_u in ((of.found, of.u), (of.found + of.change, known))
        )
        word = _word(p_same, p_none) if size >= least else None
        effects.append(EffectNow(applied, word, p_same, p_none, then, now))
        where = f" in {', '.join(applied.installations)}" if applied.installations else ""
        seen.append(
            f"{applied.effect.name}: {size:.1f} where {least:.1f} would show"
            if np.isfinite(least)
            else f"{applied.effect.name}{where}: they determine none of its values"
        )
    if not any(effect.verdict for effect in effects):
        raise CalibrationError(
            "these readings cannot confirm the model: its effects are too small for their noise "
            f"({'; '.join(seen)}, in units of noise); measure with the procedure in which they were found, or "
            "more passes"
        )
    return tuple(effects)


def _shown(
    estimated: EstimatedEffects, places: Sequence[int], *, apart: bool = True
) -> tuple[float, float, float, float]:
    """Return amplitude in the model, least amplitude that would show, `p_same` and `p_none`.

    The amplitudes are in units of noise. The parameters with the indices `places` are judged in the
    directions (eigenvectors of their covariance) that the readings determine. If `apart` is false, values of
    several mountings are judged together. The model does not state their correlations; therefore its u in a
    direction counts as at most that of the readings.
    """
    use = np.array(places, dtype=np.int64)
    variance, turned = np.linalg.eigh(estimated.covariance[np.ix_(use, use)])
    told = variance < (MOSTLY * KNOWN_SIZE) ** 2
    directions, own = turned[:, told], np.diag(variance[told])
    of_model = directions.T @ (estimated.u[use, None] ** 2 * directions)
    if not apart:
        of_model = np.diag(np.minimum(np.diag(of_model), variance[told]))
    found, change = directions.T @ estimated.found[use], directions.T @ estimated.change[use]
    if not len(found):
        return 0.0, float("inf"), 1.0, 1.0
    # an effect of this size is missed at the level `OFTEN`
    least = float(np.sqrt(special.chdtri(len(found), BY_CHANCE)) - special.ndtri(OFTEN))
    same, none = square(change, own + of_model), square(found + change, own)
    p_same, p_none = special.chdtrc(len(found), [same, none]).tolist()
    return float(np.sqrt(square(found, own))), least, p_same, p_none


def _estimated(
    linear: LinearSystem, own: Floats, found: Floats, diagnosis: Diagnosis | FreeDiagnosis
) -> tuple[Floats, Floats]:
    """Return the change from the values `found` (m,), in plausible sizes, and its covariance.

    Further effects found are estimated as well, except one that could take up most of the model's effects.
    """
    count, columns = len(found), own
    fitted = posterior(linear, columns, diagnosis.noise)
    for one in diagnosis.naming.found:
        more = np.column_stack([columns, diagnosis.candidates.columns[:, list(one.variant.columns)]])
        again = posterior(linear, more, diagnosis.noise)
        seen, beside = (square(found, fit.amplitude_covariance[:count, :count]) for fit in (fitted, again))
        if beside >= MOSTLY * seen:
            columns, fitted = more, again
    return fitted.amplitudes[:count], fitted.amplitude_covariance[:count, :count]


def _word(p_same: float, p_none: float) -> Word:
    if p_none >= BY_CHANCE:
        return "gone"
    return "confirmed" if p_same >= BY_CHANCE else "changed"


def square(part: Floats, covariance: Floats) -> float:
    """Return the chi-square of estimates `part` (m,) with their `covariance` (m, m); 0 if m is 0."""
    return float(part @ np.linalg.solve(covariance, part)) if len(part) else 0.0


def parameter_of(model: ForwardModel, unknown: EffectUnknown) -> Parameter:
    """Return the description, in the catalogue, of the parameter that `unknown` estimates."""
    effect = model.effects[unknown.effect].effect
    return next(p for p in effect.parameters if p.name == unknown.parameter)


def _value(model: ForwardModel, unknown: EffectUnknown, value: float, u: float) -> EffectValue:
    parameter = parameter_of(model, unknown)
    channel = "" if unknown.channel is None else CHANNELS[unknown.channel]
    mounts = "+".join(model.effects[unknown.effect].installations)
    scale = parameter.si_per_unit
    return EffectValue(
        parameter.name, channel, mounts, float(value / scale), float(u / scale), parameter.unit
    )
