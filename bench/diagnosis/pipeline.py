"""Find where readings and model disagree, name what is missing, and measure how far naming it closes the gap."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats
from bench.diagnosis.candidates import (
    FREE_BY_ANGLE,
    FREE_BY_PASS,
    NOTHING_KNOWN,
    Candidates,
    KnownBench,
    Variant,
)
from bench.diagnosis.evidence import Data, Search, Whitened
from bench.diagnosis.gap import Gap, measure_gap, near_ratios
from bench.diagnosis.multi_run_system import find_mistakes_in_each, with_blocks
from bench.diagnosis.naming import Naming, same_signature
from bench.diagnosis.noise_grid import RATIOS
from bench.diagnosis.noise_kinds import NoiseFinding, noise_findings, noise_kinds
from bench.diagnosis.one_run import look_at_runs
from bench.diagnosis.posterior import (
    Posterior,
    applied_of,
    common_volts,
    fit_found,
    known_together,
    noise_size,
)
from bench.diagnosis.repeats import digit_of
from bench.diagnosis.residual_model import describe
from bench.diagnosis.residual_search import UNNAMED_FORM, Setting, unnamed_in_place
from bench.diagnosis.result import (
    UNNAMED_WORDS,
    Diagnosis,
    EffectValue,
    NamedEffect,
    Verdict,
    assumed,
    at_reference,
    register,
)
from bench.diagnosis.shapes import beside, channels_of, left_open, with_other_shapes
from bench.diagnosis.single_run_search import look
from bench.diagnosis.threshold import Threshold, ThresholdCache
from bench.diagnosis.visibility import detectable, hidden, smallest
from bench.diagnosis.where import find_places, looking_like, order_of
from bench.model import CATALOGUE, AppliedEffect, ForwardModel
from bench.readings.table import Readings

UNEXPLAINED: Final = 1e-3
"""Chance that the repeats alone explain what the named effects leave, below which something is left over."""


def diagnose(
    readings: Readings,
    model: ForwardModel,
    stand_u: Mapping[str, float],
    nominal_scale_factors: Floats | None = None,
    cache: ThresholdCache | None = None,
    there: KnownBench = NOTHING_KNOWN,
) -> Diagnosis:
    """Diagnose one table of readings against a model.

    `stand_u` holds standard uncertainties by the names in `STAND_ANGLES` and of the "setting_error", rad, and of
    the "voltmeter_error", V;
    `nominal_scale_factors` (3,), or (blocks, 3) of several, with sign come from the data sheet (unit/g) and tell
    swapped or reversed channels. `there` is what is known of meters and head: effects of what is not there are no
    candidates. The record is never changed: a mistake is corrected in a copy. Raises
    `CalibrationError` where the readings do not determine the coefficients.
    """
    stand = {key: value for key, value in stand_u.items() if key != "setting_error"}
    setting_rad = stand_u.get("setting_error", 0.0)
    readings = with_blocks(readings, model)
    mistakes = find_mistakes_in_each(readings, model, stand_u, nominal_scale_factors)
    absent = there.absent(mistakes.corrected)
    find = look_at_runs if mistakes.corrected.run.any() else look
    digit = digit_of(readings)
    looked, naming = find(
        mistakes.corrected, model, stand, setting_rad, cache or ThresholdCache(None), digit, absent
    )
    linear, candidates, whitened, data = looked.linear, looked.candidates, looked.whitened, looked.data
    repeats, grid, limit = looked.repeats, looked.whitened.grid, looked.limit
    registered = register(linear, limit)
    noise = noise_size(whitened, data, naming.columns)
    sized = fit_found(linear, candidates, naming, noise)
    others = beside(candidates, naming, sized, channels_of(whitened, data, naming))
    in_part = tuple(applied for of_find in others for applied in of_find)
    fitted = fit_found(with_other_shapes(linear, in_part), candidates, naming, noise)
    p_left = _p_left(whitened, data, naming)
    ratio = RATIOS.index(near_ratios(linear, noise)[1])
    sizes = detectable(whitened, limit, ratio)
    unseen = hidden(whitened, limit, ratio, sizes)
    elsewhere = {applied.effect.name for applied in model.effects} | absent.keys()
    measured_rad = linear.moved.angle_rad
    effects = _effects(candidates, naming, sized, limit, measured_rad)
    if p_left < UNEXPLAINED and not any(not e.in_catalogue for e in effects):
        effects = (*effects, _unexplained(p_left))
    gap = measure_gap(linear, whitened, naming, noise, limit, setting_rad)
    described = tuple(noise_kinds(linear, noise, looked.weighed, digit, looked.slow))
    findings = noise_findings(noise, readings, stand_u, linear.typical_slope, digit, linear.by_run)
    of_copy = _verdict(False, effects, findings, gap)
    instead: tuple[int, ...] = ()
    # with several blocks no form competes with a name: each of the ratios would take the products of all forms
    if of_copy == "named" and linear.readings.block is None:
        instead = unnamed_in_place(linear, whitened, data, naming, in_part, setting_rad)
        effects = tuple(_tied_with_form(e) if i in instead else e for i, e in enumerate(effects))
        of_copy = _verdict(False, effects, findings, gap)
    form = None
    if of_copy == "unknown" or instead:
        given = [
            column
            for i, f in enumerate(naming.found)
            if f.variant.named and i not in instead
            for column in f.variant.columns
        ]
        about = Setting(repeats.sigma, setting_rad, near_ratios(linear, noise), limit)
        form = describe(linear, candidates.columns[:, given], repeats, about)
        form = replace(form, instead_of=tuple(effects[i].name for i in instead))
    return Diagnosis(
        verdict=_verdict(bool(mistakes.mistakes), effects, findings, gap),
        of_copy=of_copy,
        form=form,
        where=find_places(linear, grid, ratio, repeats.sigma, 3 * repeats.freedom),
        mistakes=mistakes,
        effects=effects,
        hidden={family: parts for family, parts in unseen.items() if family not in elsewhere},
        absent=absent,
        unseen_per_turn=looking_like(measured_rad, 0),
        detectable={family: size for family, size in sizes.items() if family not in absent},
        smallest=smallest(whitened, limit, ratio),
        gap=gap,
        registered=registered,
        linear=linear,
        candidates=candidates,
        naming=naming,
        fitted=fitted,
        in_part=in_part,
        left_open=left_open(linear, candidates, naming, others, fitted, noise),
        noise=noise,
        p_left=p_left,
        whitened=whitened,
        data=data,
        findings=findings,
        weighed=looked.weighed,
        noise_kinds=described,
        notes=(
            *readings.notes,
            *(finding.words for finding in findings),
            *(kind.words for kind in described),
            *assumed(linear),
            *at_reference(e.applied[0].effect for e in effects if e.applied),
            *common_volts(naming, sized, linear),
            *same_signature(naming),
        ),
    )


def _verdict(
    mistaken: bool, effects: tuple[NamedEffect, ...], findings: tuple[NoiseFinding, ...], gap: Gap
) -> Verdict:
    """Return the first that applies; what readings held out do not confirm is named no better than a tie."""
    if mistaken:
        return "mistake"
    if findings or any(not e.in_catalogue for e in effects):
        return "unknown"
    if any(e.cannot_tell_from for e in effects) or (effects and not gap.shrinks):
        return "confounded"
    return "named" if effects else "agrees"


def _p_left(whitened: Whitened, data: Data, naming: Naming) -> float:
    """Return the probability of what is left beside the scatter of repeats (F test of the lack of fit)."""
    generic = {
        i
        for v in whitened.candidates.variants
        if v.family in {FREE_BY_ANGLE, FREE_BY_PASS}
        for i in v.columns
    }
    known = naming.columns
    loose = (*known, *sorted(generic - set(known)))
    model_search, loose_search = Search.beside(whitened, known), Search.beside(whitened, loose)
    grid = whitened.grid
    weight = grid.log_prior + grid.log_det
    of_model, of_repeats = (
        model_search.left_over(data).square[:, 0],
        loose_search.left_over(data).square[:, 0],
    )
    ratio = int(np.argmax(weight + grid.log_likelihood(of_model)))
    taken = _rank(loose_search, whitened, ratio, loose) - len(known)
    freedom = grid.freedom - len(known) - taken
    if taken <= 0 or freedom <= 0:
        return 1.0
    lack = max(of_model[ratio] - of_repeats[ratio], 0.0) / taken
    if grid.known:  # readings that are rounded alike repeat themselves: their scatter tells nothing
        return float(special.chdtrc(taken, lack * taken))
    return float(special.fdtrc(taken, freedom, lack / (of_repeats[ratio] / freedom)))


def _rank(search: Search, whitened: Whitened, ratio: int, columns: tuple[int, ...]) -> int:
    gram = whitened.among(ratio, columns)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    return int(np.linalg.matrix_rank(gram * np.outer(scale, scale), tol=1e-6, hermitian=True))


def _tied_with_form(effect: NamedEffect) -> NamedEffect:
    return replace(effect, cannot_tell_from=(*effect.cannot_tell_from, UNNAMED_FORM))


def _unexplained(p: float) -> NamedEffect:
    return NamedEffect("lack_of_fit", (), (), (), (), (), p, p, None, UNNAMED_WORDS["lack_of_fit"])


def _effects(
    candidates: Candidates, naming: Naming, fitted: Posterior, limit: Threshold, angle_rad: Floats
) -> tuple[NamedEffect, ...]:
    """Return what was found with its values; `angle_rad` are the angles measured."""
    effects = []
    for found, mine in naming.parts():
        variant = found.variant
        p = float(special.chdtrc(len(variant.columns), found.size**2))
        effect = NamedEffect(
            name=variant.family,
            channels=tuple(CHANNELS[c] for c in variant.channels),
            installations=variant.mounts,
            cannot_tell_from=found.ties,
            plainer_than=found.plainer_than,
            parameters=(),
            p=p,
            p_all_looks=max(p, limit.p(found.total, found.of_slip)),
            rho=found.size,
            words=_in_words(variant),
        )
        if variant.named:
            value, covariance = fitted.amplitudes[mine], fitted.amplitude_covariance[mine, mine]
            applied = applied_of(candidates, variant, value, np.sqrt(np.diag(covariance)))
            together = known_together(candidates, variant, value, covariance)
            order = order_of(applied[0])
            effect = replace(
                effect,
                parameters=tuple(_values(applied)),
                applied=applied,
                together=together,
                aliases=() if order is None else looking_like(angle_rad, order),
            )
        effects.append(effect)
    return tuple(effects)


def _in_words(variant: Variant) -> str:
    if variant.named:
        return CATALOGUE[variant.family].sentence
    return UNNAMED_WORDS[variant.family] + (f" ({variant.where})" if variant.where else "")


def _values(applied: tuple[AppliedEffect, ...]) -> Iterator[EffectValue]:
    """Yield parameters with u in the units of the catalogue; with their mountings where there are several sets."""
    for one in applied:
        mounts = "+".join(one.installations) if len(applied) > 1 else ""
        for p in one.effect.parameters:
            if p.name not in one.values:
                continue
            value = np.asarray(one.values[p.name]) / p.si_per_unit
            u = np.asarray(one.u.get(p.name, np.zeros_like(value))) / p.si_per_unit
            for channel in one.channels if p.per_channel and not p.is_shape else ("",):
                at = CHANNELS.index(channel) if channel else ()
                known = None if p.is_shape else float(u[at])
                yield EffectValue(p.name, channel, mounts, float(value[at]), known, p.unit)
