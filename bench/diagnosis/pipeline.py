"""The diagnosis as a whole: find where readings and model disagree, name what is missing, measure the gap."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.base.languages import message
from bench.base.text import LISTED, LISTED_IN_SENTENCE
from bench.calibration.design import FIXED
from bench.calibration.result import CalibrationError, DeviatingReadings
from bench.config.bench_file.file import BenchFile
from bench.diagnosis.candidates import Candidates, Variant, is_form, with_terms
from bench.diagnosis.evidence import Threshold, ThresholdCache, Whitened
from bench.diagnosis.gap import Gap, measure_gap, near_ratios
from bench.diagnosis.known_bench import NOTHING_KNOWN, KnownBench
from bench.diagnosis.levels import BY_CHANCE, MOSTLY
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.mistakes.search import Mistake, MistakesLeaveTooLittle
from bench.diagnosis.multi_run_system import find_mistakes_in_each, with_blocks
from bench.diagnosis.naming import (
    FamilyOdds,
    FoundEffect,
    Naming,
    Scored,
    find,
    name,
    named_again,
    same_signature,
)
from bench.diagnosis.next_measurement import Proposal, propose
from bench.diagnosis.noise_grid import RATIOS, digit_of
from bench.diagnosis.noise_kinds import NoiseFinding, noise_findings, noise_kinds
from bench.diagnosis.posterior import (
    NoiseSize,
    Posterior,
    applied_of,
    beside,
    channels_of,
    common_volts,
    fit_found,
    known_together,
    left_open,
    noise_size,
    posterior,
    sizes_alone,
    starting_states,
    with_other_shapes,
)
from bench.diagnosis.residual_dictionary import WITH_CHANNELS
from bench.diagnosis.result import (
    UNNAMED_FORM,
    UNNAMED_WORDS,
    Diagnosis,
    EffectValue,
    FreeForm,
    NamedEffect,
    UnexplainedScatter,
    Verdict,
    assumed,
    at_reference,
    describe,
    register,
)
from bench.diagnosis.search import Prepared, SearchTask, find_effects
from bench.diagnosis.show import ModelComparison, contradicted, show
from bench.diagnosis.visibility import (
    FarReading,
    detectable,
    far_readings,
    find_places,
    hidden,
    looking_like,
    order_of,
    smallest,
)
from bench.model import CATALOGUE, AppliedEffect, ForwardModel
from bench.model.geometry import COEFFICIENTS
from bench.readings.table import Readings


def diagnose(
    readings: Readings,
    model: ForwardModel,
    stand_u: Mapping[str, float],
    nominal_scale_factors: Floats | None = None,
    cache: ThresholdCache | None = None,
    there: KnownBench = NOTHING_KNOWN,
) -> Diagnosis:
    """Return the diagnosis of a table of readings against a model, after mistakes are corrected in a copy.

    `stand_u` has the standard uncertainties of the angles (`STAND_ANGLES`) and the "setting_error", rad, and of the
    "voltmeter_error", V. `nominal_scale_factors` (3,), or (blocks, 3), are those of the data sheet with signs, unit
    of the signal per g. Without them, channels exchanged or reversed in the whole run cannot be found. Effects that
    the bench, `there`, excludes are not searched. Raises `CalibrationError` if the readings do not determine the
    coefficients, `MistakesLeaveTooLittle` if only the corrected copy does not.
    """
    mistakes = find_mistakes_in_each(readings, model, stand_u, nominal_scale_factors)
    digit = digit_of(mistakes.corrected if mistakes.scales_the_run else readings)
    try:
        mistakes = replace(mistakes, corrected=with_blocks(mistakes.corrected, model))
        absent = there.absent(mistakes.corrected)
        task = SearchTask(model, stand_u, digit, cache or ThresholdCache(None), absent)
        prepared, naming = find_effects(task, mistakes.corrected)
    except CalibrationError as error:
        if not mistakes.mistakes:
            raise
        raise MistakesLeaveTooLittle(mistakes, str(error)) from error
    estimated, weak = _confirmed(prepared, naming)
    linear, whitened, noise, naming = prepared.linear, prepared.whitened, estimated.noise, estimated.naming
    kinds = tuple(noise_kinds(linear, noise, digit, prepared.chosen))
    stated = mistakes.corrected, stand_u, linear.typical_slope, digit
    findings = noise_findings(noise, *stated, linear.by_run, _slow(linear), linear.by_channel)
    effects, far = _with_far(prepared, estimated)
    ratio, repeats = RATIOS.index(near_ratios(linear, noise)[1]), prepared.repeats
    sizes = detectable(whitened, prepared.limit, ratio)
    unseen = hidden(whitened, prepared.limit, ratio, sizes)
    elsewhere = {applied.effect.name for applied in model.effects} | absent.keys()
    return Diagnosis(
        of_copy=verdict_of(effects, findings, estimated.gap),
        form=_form(prepared, estimated),
        far=far,
        where=find_places(linear, whitened.grid, ratio, repeats.sigma, 3 * repeats.freedom),
        mistakes=mistakes,
        effects=effects,
        hidden={family: parts for family, parts in unseen.items() if family not in elsewhere},
        absent=absent,
        unseen_per_turn=looking_like(linear.moved.angle_rad, 0),
        detectable={family: size for family, size in sizes.items() if family not in absent},
        smallest=smallest(whitened, prepared.limit, ratio),
        gap=estimated.gap,
        registered=register(linear, prepared.limit),
        linear=linear,
        candidates=prepared.candidates,
        naming=naming,
        fitted=estimated.fitted,
        in_part=estimated.in_part,
        left_open=estimated.left_open,
        noise=noise,
        p_left=UnexplainedScatter.of(noise, repeats).p,
        whitened=whitened,
        data=prepared.data,
        findings=findings,
        noise_kinds=kinds,
        notes=(
            *mistakes.corrected.notes,
            *(finding.words for finding in findings),
            *(kind.words for kind in kinds),
            *(
                message(
                    f"left out of the model: {one.variant.family} (ln odds {one.total:.1f}), because held-out "
                    "readings do not confirm it; more passes may"
                )
                for one in weak
            ),
            *assumed(linear),
            *at_reference(e.applied[0].effect for e in effects if e.applied),
            *common_volts(naming, estimated.sized, linear),
            *same_signature(naming),
        ),
    )


def _confirmed(prepared: Prepared, naming: Naming) -> tuple[_Estimated, list[FoundEffect]]:
    """Return the joint estimate without weak effects that held-out readings do not confirm, and these effects.

    They are left out only if a stronger effect was found. An effect far beyond the threshold needs no confirmation.
    """
    estimated = _estimated(prepared, naming)
    if estimated.gap.shrinks is not False or len(naming.found) < 2:
        return estimated, []
    strongest = max(naming.found, key=lambda one: one.size)
    weak = [
        one
        for one in naming.found
        if one is not strongest
        and one.variant.family in estimated.gap.unconfirmed
        and one.total < prepared.limit.value - np.log(BY_CHANCE)
    ]
    if weak:
        others = [one for one in naming.found if one not in weak]
        left_out = {one.variant.family for one in weak}
        naming = named_again(
            prepared.whitened, prepared.data, prepared.limit, others, lambda family: family not in left_out
        )
        estimated = _estimated(prepared, naming)
    return estimated, weak


def _with_far(
    prepared: Prepared, estimated: _Estimated
) -> tuple[tuple[NamedEffect, ...], tuple[FarReading, ...]]:
    """Return the effects and the far readings, which only effects confirmed by held-out readings may explain."""
    effects, linear = estimated.effects, prepared.linear
    columns = prepared.candidates.columns[:, list(estimated.naming.columns)]
    far = far_readings(linear, columns, estimated.noise)
    if any(one.p < BY_CHANCE for one in far) and all(e.in_catalogue for e in effects):
        words = "; ".join(one.words for one in far[:LISTED_IN_SENTENCE])
        effects = (*effects, NamedEffect.unnamed("single_reading", far[0].p, words))
    if estimated.gap.shrinks is False:
        far = far_readings(linear, columns[:, :0], estimated.noise)
    return effects, far


@dataclass(frozen=True)
class _Estimated:
    """The joint estimate of coefficients and named effects, with the `noise` about them.

    `sized` are the estimates with the shapes found, `fitted` those with parts of other shapes, too. `in_part`
    are these parts and the starting states; `left_open` has what a model file states of them. `gap` is the
    prediction of held-out readings.
    """

    naming: Naming
    effects: tuple[NamedEffect, ...]
    noise: NoiseSize
    sized: Posterior
    fitted: Posterior
    in_part: tuple[AppliedEffect, ...]
    left_open: tuple[AppliedEffect, ...]
    gap: Gap


def _estimated(prepared: Prepared, naming: Naming) -> _Estimated:
    linear, candidates, whitened, data = (
        prepared.linear, prepared.candidates, prepared.whitened, prepared.data,
    )  # fmt: skip
    noise = noise_size(whitened, data, naming.columns)
    sized = fit_found(linear, candidates, naming, noise)
    others = beside(candidates, naming, sized, channels_of(whitened, data, naming))
    parts = tuple(applied for of_find in others for applied in of_find)
    fitted = fit_found(with_other_shapes(linear, parts), candidates, naming, noise)
    effects = effects_of(candidates, naming, sized, prepared.limit, linear)
    kept = left_open(linear, candidates, naming, others, fitted, noise)
    starts = starting_states(linear, candidates, naming, sized, kept)
    gap = measure_gap(linear, whitened, naming, noise, prepared.limit, prepared.setting_rad)
    in_part = (*starts, *sizes_alone(linear, parts, 1 + len(kept) + len(starts)))
    return _Estimated(naming, effects, noise, sized, fitted, in_part, (*kept, *starts), gap)


def _form(prepared: Prepared, estimated: _Estimated) -> FreeForm | None:
    """Return the terms for unnamed effects, or for effects tied with a term; None if names suffice."""
    linear, whitened, data = prepared.linear, prepared.whitened, prepared.data
    candidates, naming = whitened.candidates, estimated.naming
    named = [one for one in naming.found if one.variant.named]
    patterns = [one for one in naming.found if not one.variant.named and one.variant.term is None]
    tied = [one for one in named if any(is_form(candidates, f) for f in one.ties)]
    if len(named) == len(naming.found) and not tied:
        return None
    if not patterns and not tied:
        return describe(linear, candidates, naming, estimated.noise, estimated.gap, prepared.repeats)
    if linear.readings.run.any() and patterns:
        whitened = Whitened.of(whitened.grid, with_terms(candidates, linear))
        data = whitened.reduce(linear.response[:, None])
        candidates = whitened.candidates
    among = partial(is_form, candidates)
    begun = [one for one in named if one not in tied]
    found = name(whitened, data, prepared.limit, begun=begun, among=among)
    search = partial(find, begun=begun, among=among)
    noise = noise_size(whitened, data, found.columns)
    form_gap = measure_gap(linear, whitened, found, noise, prepared.limit, prepared.setting_rad, search)
    instead = () if patterns else tuple(one.variant.family for one in tied)
    return describe(linear, candidates, found, noise, form_gap, prepared.repeats, instead)


def verdict_of(effects: Sequence[NamedEffect], findings: Sequence[NoiseFinding | str], gap: Gap) -> Verdict:
    """Return the verdict on readings without mistakes: the first of these that applies.

    "unknown": there are `findings` (noise larger than stated, or readings far off), or an effect is not in
    the catalogue. "confounded": the readings do not exclude others in place of an effect, or held-out
    readings do not confirm the effects. "named": effects were found. "agrees": nothing was found.
    """
    if findings or any(not e.in_catalogue for e in effects):
        return "unknown"
    if any(e.cannot_tell_from for e in effects) or (effects and not gap.shrinks):
        return "confounded"
    return "named" if effects else "agrees"


def effects_of(
    candidates: Candidates,
    naming: Naming,
    fitted: Posterior,
    limit: Threshold,
    linear: LinearSystem | None = None,
) -> tuple[NamedEffect, ...]:
    """Return the effects found with the estimates `fitted`; p-values use the threshold `limit`.

    Aliases of periods per turn, and channels of unnamed effects, are stated only if `linear` is given.
    """
    effects = []
    for found, mine in naming.sizes():
        variant = found.variant
        rho, p = fitted.significance(mine)
        effect = NamedEffect(
            name=name_of(candidates, variant.family),
            channels=tuple(CHANNELS[c] for c in variant.channels),
            installations=variant.mounts,
            cannot_tell_from=_tie_names(candidates, found),
            odds=_odds(candidates, found),
            plainer_than=found.plainer_than,
            parameters=(),
            p=p,
            p_all_looks=max(p, limit.p(found.total)),
            rho=rho,
            words=_in_words(variant, _mostly_in(linear, candidates, variant, fitted.amplitudes[mine])),
        )
        if variant.named:
            value, covariance = fitted.amplitudes[mine], fitted.amplitude_covariance[mine, mine]
            either = (effect.name, *effect.cannot_tell_from) if effect.cannot_tell_from else ()
            applied = applied_of(candidates, variant, value, np.sqrt(np.diag(covariance)), either)
            together = known_together(candidates, variant, value, covariance)
            order = order_of(applied[0])
            effect = replace(
                effect,
                parameters=tuple(values_of(applied)),
                applied=applied,
                together=together,
                aliases=()
                if order is None or linear is None
                else looking_like(linear.moved.angle_rad, order),
            )
        effects.append(effect)
    return tuple(effects)


def name_of(candidates: Candidates, family: str) -> str:
    """Return the name of a family as results show it: `UNNAMED_FORM` if it has a formula, else its own."""
    return UNNAMED_FORM if is_form(candidates, family) else family


def _tie_names(candidates: Candidates, found: FoundEffect) -> tuple[str, ...]:
    names = dict.fromkeys(name_of(candidates, family) for family in found.ties)
    names.pop(name_of(candidates, found.variant.family), None)
    return tuple(names)


def _odds(candidates: Candidates, found: FoundEffect) -> tuple[FamilyOdds, ...]:
    """Return the odds of the names for an effect; all unnamed forms count as one, below 1 % only ties count."""
    whole: dict[str, float] = {}
    for one in found.odds:
        called = name_of(candidates, one.name)
        whole[called] = whole.get(called, 0.0) + one.probability
    tied = _tie_names(candidates, found)
    ranked = sorted(whole.items(), key=lambda item: -item[1])
    return tuple(FamilyOdds(called, p) for called, p in ranked if p >= BY_CHANCE or called in tied)


def _mostly_in(
    linear: LinearSystem | None, candidates: Candidates, variant: Variant, amplitudes: Floats
) -> str:
    """Return in words the channel with most of the square of an effect's signature; "" if there is none."""
    if linear is None:
        return ""
    square = (candidates.columns[:, list(variant.sizes)] @ amplitudes) ** 2
    of_channel = [float(square[linear.rows.channel == c].sum()) for c in range(len(CHANNELS))]
    most = int(np.argmax(of_channel))
    return message(f"mostly in channel {CHANNELS[most]}") if of_channel[most] > MOSTLY * square.sum() else ""


def _in_words(variant: Variant, mostly_in: str) -> str:
    if variant.named:
        return CATALOGUE[variant.family].sentence
    if variant.term is None:
        words, place = UNNAMED_WORDS[variant.family], variant.where
        mostly_in = f"channel {CHANNELS[variant.channels[0]]}" if len(variant.channels) == 1 else mostly_in
    else:
        words, place = f"{UNNAMED_WORDS[UNNAMED_FORM]}: {variant.family}", variant.term.where
        if variant.term.stage in WITH_CHANNELS:
            words += f" of {', '.join(CHANNELS[c] for c in variant.channels)}"
            mostly_in = ""
    where = "; ".join(filter(None, (place, mostly_in)))
    return f"{words} ({where})" if where else words


def values_of(applied: tuple[AppliedEffect, ...]) -> Iterator[EffectValue]:
    """Yield each parameter of an effect with its u, in units of the catalogue, by mounting if there are several."""
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


# --- a diagnosis with all that follows ------------------------------------------------------------


@dataclass(frozen=True)
class Rival:
    """A family that may be present in place of an effect found.

    `evidence` is ln of its Bayes factor; it is `tied` if the readings do not exclude it. `shift` (12 ×
    blocks,) is the change of each coefficient, in units of its u, if it replaces the effect in the model.
    """

    family: str
    evidence: float
    tied: bool
    shift: Floats

    @property
    def largest_shift(self) -> tuple[str, float]:
        """The name of the coefficient that this family changes most, and the change in units of its u."""
        worst = int(np.argmax(np.abs(self.shift)))
        return COEFFICIENTS[worst % FIXED], float(self.shift[worst])


def rivals(diagnosis: Diagnosis) -> tuple[tuple[Rival, ...], ...]:
    """Return the `LISTED` best families for each effect, its own family, its ties and those that include it."""
    naming, candidates = diagnosis.naming, diagnosis.candidates
    if not naming.found:
        return ()
    found = _coefficients(diagnosis, naming.columns)
    u = np.sqrt(np.diag(diagnosis.fitted.covariance))[: diagnosis.linear.fixed.shape[1]]
    rankings = []
    for one in naming.found:
        scored, others = _beside(diagnosis, one)
        ranked = sorted(scored.evidence, key=lambda family: -scored.evidence[family])
        alike = {one.variant.family, *one.ties, *one.plainer_than}
        ranked = [f for f in ranked if f == one.variant.family or not is_form(candidates, f)]
        rows = []
        for family in (f for i, f in enumerate(ranked) if i < LISTED or f in alike):
            variant = one.variant if family == one.variant.family else scored.likeliest(family)
            shift = (_coefficients(diagnosis, [*others, *variant.columns]) - found) / u
            rows.append(
                Rival(name_of(candidates, family), scored.evidence[family], family in one.ties, shift)
            )
        rankings.append(tuple(rows))
    return tuple(rankings)


def shifts_by_ties(diagnosis: Diagnosis) -> Floats:
    """Return the shifts (k, 12 per block) of the coefficients if a tied family replaces an effect found.

    The readings do not exclude this family; each shift is multiplied by the root of its probability. Unnamed
    effects count only if all of them are terms of the dictionary, and these can join the model.
    """
    form, naming = diagnosis.form, diagnosis.naming
    same = all(one.variant.named or one.variant.term for one in naming.found)
    described = form is not None and bool(form.applied) and not form.instead_of and same
    found = _coefficients(diagnosis, naming.columns)
    shifts = [np.zeros((0, len(found)))]
    for one in naming.found:
        scored, others = _beside(diagnosis, one)
        for variant, probability in scored.in_place_of(one) if one.variant.named or described else ():
            shift = _coefficients(diagnosis, [*others, *variant.columns]) - found
            shifts.append(np.sqrt(probability) * shift[None])
    return np.concatenate(shifts)


def _beside(diagnosis: Diagnosis, one: FoundEffect) -> tuple[Scored, list[int]]:
    """Return the scores with all other effects found in the model, and the columns of these effects."""
    others = [i for f in diagnosis.naming.found if f is not one for i in f.variant.columns]
    return Scored.beside(diagnosis.whitened, diagnosis.data, others), others


def _coefficients(diagnosis: Diagnosis, columns: Sequence[int]) -> Floats:
    """Return the changes of the coefficients from `linear.block` with these columns in the model.

    All columns have the same wide prior, so that a difference of two results is not due to priors.
    """
    linear = diagnosis.linear
    fitted = posterior(linear, diagnosis.candidates.columns[:, list(columns)], diagnosis.noise)
    return fitted.mean[: linear.fixed.shape[1]]


@dataclass(frozen=True)
class FullDiagnosis:
    """The result of the command `bench diagnose` for one set of readings.

    `ranking` has the families that may be in place of each effect. `skipped_rows` are rows that could not be
    read. `shown` has the simulations of the first block; if there are several, `blocks` has those of all.
    """

    source: str
    simulated: bool
    skipped_rows: tuple[str, ...]
    diagnosis: Diagnosis
    shown: ModelComparison
    ranking: tuple[tuple[Rival, ...], ...]
    next_measurement: Proposal | None
    blocks: tuple[ModelComparison, ...] = ()

    def rivals_of(self, effect: int) -> tuple[Rival, ...]:
        """Return the families in place of the effect with this index; empty if there is no ranking for it."""
        return self.ranking[effect] if effect < len(self.ranking) else ()


@dataclass(frozen=True)
class MistakesAlone:
    """A diagnosis that ends with the mistakes, because the corrected readings do not determine the coefficients.

    `corrected` are the readings with the mistakes corrected; `reason` says what is missing.
    """

    source: str
    simulated: bool
    mistakes: tuple[Mistake, ...]
    corrected: Readings
    reason: str


UNEXPLAINED: Final = message(
    "no mistake or effect that 'bench diagnose' knows explains them; correct these rows in the readings file (of a "
    "run, that of 'bench export --csv') or delete them, and diagnose the file"
)
"""What to do about readings that spoil the fit of a diagnosis, too."""


def diagnose_fully(
    readings: Readings,
    model: ForwardModel,
    bench: BenchFile,
    g_m_s2: float,
    cache: ThresholdCache,
    *,
    source: str,
    simulated: bool,
    known: Sequence[Mistake] = (),
    stated: bool = True,
    nominal: Floats | None = None,
) -> FullDiagnosis:
    """Diagnose the readings of a bench, simulate them, rank the rivals, and propose the next measurement.

    `g_m_s2` is local gravity, m/s². `source` names the readings; `simulated` says whether instruments were
    simulated. Mistakes in `known` are already corrected. If `stated` is False, the readings may be from another
    bench, and this bench excludes no effects. `nominal` (blocks, 3) replaces the scale factors of the bench file.
    Raises the errors of `diagnose`.
    """
    stand_u = {name: spread.u for name, spread in bench.stand_distributions().items()}
    sheet = np.array(bench.unit_under_test.scale_factors.values) if nominal is None else nominal
    sheet_of_unit = sheet if readings.unit == "V" else None
    there = KnownBench.of(bench) if stated else NOTHING_KNOWN
    diagnosis = diagnose(readings, model, stand_u, sheet_of_unit, cache, there)
    if known:
        mistakes = replace(diagnosis.mistakes, mistakes=(*known, *diagnosis.mistakes.mistakes))
        diagnosis = replace(diagnosis, mistakes=mistakes)
    model = diagnosis.linear.model
    try:
        blocks = tuple(_shown(diagnosis, model, stand_u, g_m_s2))
    except DeviatingReadings as error:
        reason = DeviatingReadings(error.args[0], UNEXPLAINED)
        if not diagnosis.mistakes.mistakes:
            raise reason from error
        raise MistakesLeaveTooLittle(diagnosis.mistakes, str(reason)) from error
    shown = blocks[0]
    told = [*filter(None, [there.not_judged(readings)]), *contradicted(model.effects, shown.before.effects)]
    return FullDiagnosis(
        source=source,
        simulated=simulated,
        skipped_rows=readings.skipped,
        diagnosis=replace(diagnosis, notes=(*diagnosis.notes, *told)),
        shown=shown,
        ranking=rivals(diagnosis),
        # a proposal is for one block; with several, the block to measure again is unknown
        next_measurement=propose(diagnosis, bench) if len(blocks) == 1 else None,
        blocks=blocks if len(blocks) > 1 else (),
    )


def _shown(
    diagnosis: Diagnosis, model: ForwardModel, stand_u: Mapping[str, float], g_m_s2: float
) -> Iterator[ModelComparison]:
    readings, by_ties = diagnosis.mistakes.corrected, shifts_by_ties(diagnosis)
    if readings.block is None:
        slow = _slow(diagnosis.linear)
        yield show(readings, model, diagnosis.applied, stand_u, g_m_s2, diagnosis.in_part, slow, by_ties)
        return
    numbers = np.unique(readings.block)
    for number, own_ties in zip(numbers, np.split(by_ties, len(numbers), axis=1), strict=True):
        own = readings.select(readings.block == number)
        mounts = {str(mount) for mount in own.conditions().mounts}
        applied = [a for a in diagnosis.applied if not a.installations or mounts & set(a.installations)]
        yield show(own, model, tuple(applied), stand_u, g_m_s2, by_ties=own_ties)


def _slow(linear: LinearSystem) -> Floats | None:
    """Return the signals (n, 3, k) of the slow noise found, for one standard deviation of each of k components."""
    if not (linear.slow_channels or linear.slow_reference):
        return None
    rows, own = linear.rows, linear.setting >= 0
    signals = np.zeros((len(linear.readings), 3, linear.of_noise))
    of_noise = linear.random[own, linear.random.shape[1] - linear.of_noise :]
    signals[rows.reading[own], rows.channel[own]] = of_noise
    return signals
