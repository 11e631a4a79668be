"""Find where readings and model disagree, name what is missing, and measure how far naming it closes the gap."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from scipy import special

from bench.analysis.diagnosis.aliases import looking_like, order_of
from bench.analysis.diagnosis.assumed import assumed
from bench.analysis.diagnosis.candidates import (
    FREE_BY_ANGLE,
    FREE_BY_PASS,
    Candidates,
    Variant,
    make_candidates,
)
from bench.analysis.diagnosis.common_volts import common_volts
from bench.analysis.diagnosis.evidence import Data, Search, Whitened
from bench.analysis.diagnosis.holdout import measure_gap, near_ratios
from bench.analysis.diagnosis.known_bench import NOTHING_KNOWN, KnownBench
from bench.analysis.diagnosis.known_together import known_together
from bench.analysis.diagnosis.linear import make_linear
from bench.analysis.diagnosis.naming import Naming, name
from bench.analysis.diagnosis.noise_grid import RATIOS, make_noise_grid
from bench.analysis.diagnosis.posterior import Posterior, fit_found, noise_size
from bench.analysis.diagnosis.registration import register
from bench.analysis.diagnosis.repeats import noise_of_repeats
from bench.analysis.diagnosis.result import UNNAMED_WORDS, Diagnosis, EffectValue, NamedEffect, Verdict
from bench.analysis.diagnosis.threshold import Threshold, ThresholdCache
from bench.analysis.diagnosis.visibility import detectable, hidden
from bench.analysis.diagnosis.where import find_places
from bench.analysis.mistakes.search import find_mistakes
from bench.base.arrays import CHANNELS, Floats
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

    `stand_u` holds standard uncertainties by the names in `STAND_ANGLES` and of the "setting_error", rad;
    `nominal_scale_factors` (3,) with sign come from the data sheet of the block (unit/g) and tell swapped or
    reversed channels. `there` is what is known of meters and head: effects of what is not there are no candidates.
    The record is never changed: a mistake is corrected in a copy. Raises
    `CalibrationError` where the readings do not determine the coefficients.
    """
    stand = {key: value for key, value in stand_u.items() if key != "setting_error"}
    setting_rad = stand_u.get("setting_error", 0.0)
    mistakes = find_mistakes(readings, model, stand_u, nominal_scale_factors)
    linear = make_linear(mistakes.corrected, model, stand)
    repeats = noise_of_repeats(linear, readings.resolution)
    grid = make_noise_grid(linear, repeats.sigma, setting_rad)
    absent = there.absent(mistakes.corrected)
    candidates = make_candidates(linear, repeats.sigma, absent)
    whitened = Whitened.of(grid, candidates)
    limit = (cache or ThresholdCache(None)).threshold(linear, whitened, setting_rad)
    registered = register(linear, limit)

    data = whitened.reduce(linear.response[:, None])
    naming = name(whitened, data, limit)
    noise = noise_size(whitened, data, naming.columns)
    fitted = fit_found(linear, candidates, naming, noise)
    p_left = _p_left(whitened, data, naming)
    ratio = RATIOS.index(near_ratios(linear, noise)[1])
    sizes = detectable(whitened, limit, ratio)
    unseen = hidden(whitened, limit, ratio, sizes)
    elsewhere = {applied.effect.name for applied in model.effects} | absent.keys()
    measured_rad = linear.moved.angle_rad
    effects = _effects(candidates, naming, fitted, limit, measured_rad)
    if p_left < UNEXPLAINED and not any(not e.in_catalogue for e in effects):
        effects = (*effects, _unexplained(p_left))
    return Diagnosis(
        verdict=_verdict(bool(mistakes.mistakes), effects),
        of_copy=_verdict(False, effects),
        where=find_places(linear, grid, ratio, repeats.sigma, 3 * repeats.freedom),
        mistakes=mistakes,
        effects=effects,
        hidden={family: parts for family, parts in unseen.items() if family not in elsewhere},
        absent=absent,
        unseen_per_turn=looking_like(measured_rad, 0),
        detectable={family: size for family, size in sizes.items() if family not in absent},
        gap=measure_gap(linear, candidates, grid, naming, noise, limit, setting_rad),
        registered=registered,
        linear=linear,
        candidates=candidates,
        naming=naming,
        fitted=fitted,
        noise=noise,
        p_left=p_left,
        notes=(*readings.notes, *assumed(linear), *common_volts(naming, fitted, linear)),
    )


def _verdict(mistaken: bool, effects: tuple[NamedEffect, ...]) -> Verdict:
    if mistaken:
        return "mistake"
    if any(not e.in_catalogue for e in effects):
        return "unknown"
    if any(e.cannot_tell_from for e in effects):
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
    return float(special.fdtrc(taken, freedom, lack / (of_repeats[ratio] / freedom)))


def _rank(search: Search, whitened: Whitened, ratio: int, columns: tuple[int, ...]) -> int:
    gram = whitened.gram[ratio][np.ix_(columns, columns)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    return int(np.linalg.matrix_rank(gram * np.outer(scale, scale), tol=1e-6, hermitian=True))


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
            p_all_looks=max(p, limit.p(found.total)),
            rho=found.size,
            words=_in_words(variant),
        )
        if variant.named:
            value, covariance = fitted.amplitudes[mine], fitted.amplitude_covariance[mine, mine]
            applied = _applied(candidates, effect, variant, value, np.sqrt(np.diag(covariance)))
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


def _applied(
    candidates: Candidates, found: NamedEffect, variant: Variant, value: Floats, u: Floats
) -> tuple[AppliedEffect, ...]:
    """Return the effect with the estimated values in SI, once for each set of mountings with its own values."""
    kinds = [candidates.kinds[column] for column in variant.columns]
    applied = []
    for mounts in dict.fromkeys(kind.mounts for kind in kinds):
        values: dict[str, Floats] = {name: np.asarray(size) for name, size in variant.shape}
        sizes: dict[str, Floats] = {}
        for place, (column, kind) in enumerate(zip(variant.columns, kinds, strict=True)):
            if kind.mounts != mounts:
                continue
            at = () if kind.channel is None else kind.channel
            for numbers, number in ((values, value[place]), (sizes, u[place])):
                numbers.setdefault(kind.parameter, np.zeros(() if kind.channel is None else 3))
                numbers[kind.parameter][at] = number * candidates.scale[column]
        applied.append(AppliedEffect(CATALOGUE[variant.family], values, found.channels, sizes, mounts))
    return tuple(applied)


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
