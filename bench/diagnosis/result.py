"""The result of a diagnosis, the description of unnamed effects, and the settings registered before scoring."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import count
from typing import Final, Literal

import numpy as np
from scipy import special

from bench.base.arrays import Floats
from bench.base.languages import message
from bench.base.text import LISTED_IN_SENTENCE
from bench.config.model_file import UNNAMED
from bench.diagnosis import candidates, evidence, gap, naming, noise_grid
from bench.diagnosis.candidates import Candidates, in_volts
from bench.diagnosis.evidence import Data, Whitened
from bench.diagnosis.gap import Gap, folds_of, thirds_of
from bench.diagnosis.levels import BY_CHANCE, HARDLY_EVER, MOSTLY, OFTEN
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.mistakes.search import MistakeSearch
from bench.diagnosis.naming import FamilyOdds, Naming
from bench.diagnosis.noise_grid import Repeats
from bench.diagnosis.noise_kinds import LocalScatter, NoiseFinding, NoiseKind, larger_scatter, residuals
from bench.diagnosis.posterior import KnownTogether, NoiseSize, Posterior, applied_of, posterior
from bench.diagnosis.visibility import FarReading, ResidualPattern, Smallest
from bench.model.conditions import REFERENCE_C, REMOUNT_S, SETTING_S
from bench.model.effects import CATALOGUE, AppliedEffect, Effect
from bench.model.effects.formula import FormulaEffect, names_in


@dataclass(frozen=True)
class Registration:
    """The settings of a diagnosis that are fixed before the readings are scored, with their hash.

    `sha256` is a hash of all settings, of the catalogue, and of the weights of `sizes`. The sets of readings
    `held_out_else` are held out if the sets `held_out` cannot be. `pair_margin` is always None.
    """

    sha256: str
    unnamed: tuple[str, ...]
    sizes: tuple[float, ...]
    noise_ratios: tuple[float, ...]
    noise_ratio_spread: float
    threshold: float
    false_alarms: float
    tie_leak: float
    alone_from: float
    tie_holds: float
    tie_absurd: float
    prior_of_kinds: tuple[float, ...]
    most_effects: int
    hidden_beyond: float
    significance_where: float
    gap_least_fall: float
    gap_least_closed: float
    gap_by_chance: float
    held_out: tuple[str, ...]
    held_out_else: tuple[str, ...]
    pair_margin: float | None = None


def register(linear: LinearSystem, limit: evidence.Threshold) -> Registration:
    """Return the settings of the diagnosis of these readings, with their hash; `limit` is the threshold."""
    settled = Registration(
        sha256="",
        unnamed=candidates.UNNAMED,
        sizes=evidence.SIZES,
        noise_ratios=noise_grid.RATIOS,
        noise_ratio_spread=noise_grid.RATIO_SPREAD,
        threshold=round(limit.value, 9),
        false_alarms=limit.probability,
        tie_leak=naming.ALIAS,
        alone_from=1.0 - OFTEN,
        tie_holds=1.0 - BY_CHANCE,
        tie_absurd=evidence.BEYOND_BELIEF,
        prior_of_kinds=candidates.KIND_PRIOR,
        most_effects=naming.MOST_EFFECTS,
        hidden_beyond=evidence.BEYOND_BELIEF,
        significance_where=BY_CHANCE,
        gap_least_fall=gap.LEAST_FALL,
        gap_least_closed=MOSTLY,
        gap_by_chance=BY_CHANCE,
        held_out=tuple(label for label, _ in folds_of(linear)),
        held_out_else=tuple(label for label, _ in thirds_of(linear)),
    )
    hashed = asdict(settled) | {
        "catalogue": {name: [asdict(p) for p in effect.parameters] for name, effect in CATALOGUE.items()},
        "size_weights": [round(w, 12) for w in evidence.LOG_SIZE_WEIGHTS],
        "size_weights_of_meter": [round(w, 12) for w in evidence.LOG_SIZE_WEIGHTS_OF_METER],
        "equal": candidates.EQUAL,
    }
    if evidence.formulas():
        hashed["formulas"] = evidence.formulas()
    hashed["form"] = [MOSTLY, HARDLY_EVER]
    del hashed["sha256"]
    text = json.dumps(hashed, sort_keys=True)
    return replace(settled, sha256=hashlib.sha256(text.encode()).hexdigest())


Verdict = Literal["agrees", "mistake", "named", "confounded", "unknown"]

UNNAMED_WORDS: Mapping[str, str] = {
    "free_by_angle": message("something that depends on the angle of the head, the same in every pass"),
    "free_by_pass": message("something that differs from pass to pass"),
    "slow_in_time": message("something that changes slowly with time"),
    "single_reading": message("a single outlying reading"),
    "single_setting": message("the angle of a single setting"),
    "zeros_by_run": message("the zeros change from run to run; the readings do not say why"),
    "scale_by_run": message("the scale factors change from run to run; the readings do not say why"),
    "unnamed_form": message("something without a name"),
}


@dataclass(frozen=True)
class EffectValue:
    """An estimated parameter of an effect; `value` and `u` are in `unit`, the unit of the catalogue.

    `u` is None for a shape parameter chosen from a grid. `channel` is empty if the value is for all channels,
    `installations` if it is for all mountings.
    """

    parameter: str
    channel: str
    installations: str
    value: float
    u: float | None
    unit: str


@dataclass(frozen=True)
class NamedEffect:
    """An effect that was found, with its estimated parameters.

    `cannot_tell_from` are names that the readings do not exclude; `odds` are the posterior probabilities of
    all names; `plainer_than` are effects of the same subsystem that include it. `rho` is
    `Posterior.significance` of the parameters, None if not estimated. `p` is the p-value of this effect
    alone; `p_all_looks` is corrected for all effects searched. `applied` has an entry for each set of
    mountings, none outside the catalogue. `together` are sums or differences that are known far better than
    the values. `aliases` are other periods per turn that these angles do not distinguish.
    """

    name: str
    channels: tuple[str, ...]
    installations: tuple[str, ...]
    cannot_tell_from: tuple[str, ...]
    plainer_than: tuple[str, ...]
    parameters: tuple[EffectValue, ...]
    p: float
    p_all_looks: float
    rho: float | None
    words: str
    applied: tuple[AppliedEffect, ...] = ()
    together: tuple[KnownTogether, ...] = ()
    aliases: tuple[int, ...] = ()
    odds: tuple[FamilyOdds, ...] = ()

    @classmethod
    def unnamed(cls, name: str, p: float, words: str, odds: tuple[FamilyOdds, ...] = ()) -> NamedEffect:
        """Return a found pattern that is no effect of the catalogue and has no parameters.

        `name` is a key of `UNNAMED_WORDS`; `words` describe the pattern.
        """
        return cls(name, (), (), (), (), (), p, p, None, words, odds=odds)

    @property
    def in_catalogue(self) -> bool:
        """Whether the effect has a name in the catalogue."""
        return self.name in CATALOGUE

    @property
    def probability(self) -> float | None:
        """The posterior probability that the name is right; None if no odds were computed."""
        return next((one.probability for one in self.odds if one.name == self.name), None)

    @property
    def shape_held(self) -> bool:
        """Whether the u of the parameters assumes that the shape found is the true shape."""
        return any(one.u is None for one in self.parameters)


@dataclass(frozen=True)
class Findings:
    """The findings common to the diagnoses of oriented readings, of free positions and of a record.

    `of_copy` is the verdict on the readings with mistakes corrected; `where` are patterns of residuals;
    `gap` says how well held-out readings are predicted.
    """

    of_copy: Verdict
    effects: tuple[NamedEffect, ...]
    where: tuple[ResidualPattern, ...]
    gap: Gap
    notes: tuple[str, ...]

    @property
    def mistaken(self) -> bool:
        """Whether the readings have mistakes that were corrected in a copy."""
        return False

    @property
    def verdict(self) -> Verdict:
        """The verdict: "mistake" if there are mistakes, otherwise `of_copy`."""
        return "mistake" if self.mistaken else self.of_copy

    @property
    def applied(self) -> tuple[AppliedEffect, ...]:
        """The effects of the catalogue that were found, with the values with which they can join the model."""
        return tuple(applied for effect in self.effects for applied in effect.applied)


@dataclass(frozen=True)
class Diagnosis(Findings):
    """The complete result of the diagnosis of one set of readings.

    `far` are readings far from the model. `p_left` is the p-value of the noise about the model with all
    effects found against that of repeats (lack of fit). `hidden` maps effects to the parts that these
    readings could not show (empty: all). `absent` maps effects to the reason why this bench cannot have them.
    `unseen_per_turn` are periods per turn of head errors that do not change the readings. `detectable` is the
    amplitude, in plausible sizes, at which half of all runs find each effect; `smallest` is the joint
    amplitude of several parameters.

    `in_part` are parts that the effects may have in other shapes; the u of the coefficients includes them.
    `left_open` are the parts for a model file. `findings` state where noise is larger than stated;
    `noise_kinds`, where it departs from normal noise of one standard deviation. `form` describes unnamed
    effects. Plots and reports use `whitened`, `data`, `linear`, `candidates`, `naming`, `fitted` and `noise`.
    """

    far: tuple[FarReading, ...]
    mistakes: MistakeSearch
    hidden: Mapping[str, tuple[str, ...]]
    absent: Mapping[str, str]
    unseen_per_turn: tuple[int, ...]
    detectable: Mapping[str, float]
    smallest: Mapping[str, tuple[Smallest, ...]]
    registered: Registration
    linear: LinearSystem
    candidates: Candidates
    naming: Naming
    fitted: Posterior
    in_part: tuple[AppliedEffect, ...]
    left_open: tuple[AppliedEffect, ...]
    noise: NoiseSize
    p_left: float
    whitened: Whitened
    data: Data
    form: FreeForm | None = None
    findings: tuple[NoiseFinding, ...] = ()
    noise_kinds: tuple[NoiseKind, ...] = ()

    @property
    def mistaken(self) -> bool:
        """Whether the readings have mistakes that were corrected in a copy."""
        return bool(self.mistakes.mistakes)

    @property
    def applied(self) -> tuple[AppliedEffect, ...]:
        """The effects found that can be added to the model: of the catalogue, and terms of unnamed effects."""
        return (*super().applied, *(() if self.form is None else self.form.applied))

    @property
    def noise_by_channel(self) -> Floats:
        """The noise of a reading in the channels x, y and z, (3,), in the unit of the signal."""
        return self.noise.reading * self.linear.by_channel


OF_TEMPERATURE = ("thermal_bias", "thermal_scale")


def at_reference(found: Iterable[Effect]) -> Iterator[str]:
    """Yield a sentence on the temperature of the coefficients, if any effect in `found` depends on temperature."""
    names = [
        one.name
        for one in found
        if one.name in OF_TEMPERATURE
        or (isinstance(one, FormulaEffect) and "temperature" in names_in(one.expression))
    ]
    if names:
        yield message(
            f"the coefficients apply at {REFERENCE_C:g} °C, the reference temperature of {' and '.join(names)}"
        )


def assumed(linear: LinearSystem) -> Iterator[str]:
    """Yield a sentence for each assumption that the diagnosis made, and for each effect not searched."""
    readings = linear.readings
    yield from (message(f"not searched: {trouble}") for trouble in CATALOGUE.troubles)
    if linear.orientation is not None and linear.orientation.contradicts:
        yield linear.orientation.in_words()
    if not np.isfinite(readings.time_s).any():
        yield (
            message(
                f"no times in the readings: {SETTING_S / 60:g} min a setting and {REMOUNT_S / 60:g} min for "
                "a remount are assumed, and all rates and time constants depend on this"
            )
        )
    if not np.isfinite(readings.temperature_c).any():
        yield message(
            f"no temperatures in the readings: {' and '.join(OF_TEMPERATURE)} cannot be searched for"
        )
    if readings.unit != "V":
        names = ", ".join(name for name, effect in CATALOGUE.items() if in_volts(effect))
        yield message(
            f"signals in {readings.unit} are not voltages: effects stated in volts are not searched for ({names})"
        )


# --- what the catalogue does not explain -------------------------------------------------------------

UNNAMED_FORM: Final = "unnamed_form"
"""Entry in an effect's `cannot_tell_from` if an unnamed form describes the readings equally well."""


@dataclass(frozen=True)
class UnexplainedScatter:
    """The standard deviation of the scatter about the model beyond that of repeats, unit of the signal.

    `value` has the uncertainty `u` and the 95 % limit `upper`; `p` is the p-value of the hypothesis that it
    is 0. If all readings are repeats, `u` and `upper` are infinite.
    """

    value: float
    u: float
    upper: float
    p: float

    @classmethod
    def of(cls, noise: NoiseSize, repeats: Repeats) -> UnexplainedScatter:
        """Return the scatter about the model with all effects, in excess of the noise of repeats (F test)."""
        # per setting, two directions of the signals are perpendicular to du/dphi
        of_repeats = 2 * repeats.freedom
        beyond = noise.freedom - of_repeats
        all2, repeats2 = noise.reading**2, repeats.sigma**2
        value = float(np.sqrt(max(all2 - repeats2, 0.0)))
        if beyond <= 0:
            return cls(value, np.inf, np.inf, 1.0)
        lack = max(noise.freedom * all2 - of_repeats * repeats2, 0.0) / beyond / repeats2
        # a ratio below 1 is chance, and must not lower the limit
        largest = max(lack, 1.0) / float(special.fdtri(beyond, of_repeats, OFTEN))
        upper = float(np.sqrt(max(largest - 1.0, 0.0) * repeats2 * beyond / noise.freedom))
        # the excess is a part of the difference of two independent mean squares
        part = beyond / noise.freedom
        variance = 2 * (part * repeats2) ** 2 * (lack**2 / beyond + 1 / of_repeats)
        u = float(np.sqrt(variance)) / (2 * value) if value > 0.0 else float(np.sqrt(np.sqrt(variance)))
        return cls(value, u, max(upper, value), float(special.fdtrc(beyond, of_repeats, lack)))

    @property
    def there(self) -> bool:
        """Whether the scatter is significant."""
        return self.p < OFTEN


@dataclass(frozen=True)
class FormTerm:
    """A term of the dictionary that was found, with its amplitudes and their u.

    `could_also_be` are terms that describe the readings equally well. `rho` is `Posterior.significance` of the
    term; its p-value `p` is not corrected for the number of terms searched.
    """

    applied: AppliedEffect
    family: str
    could_also_be: tuple[str, ...]
    rho: float
    p: float

    @property
    def effect(self) -> FormulaEffect:
        """The term as an effect that is defined by a formula."""
        assert isinstance(self.applied.effect, FormulaEffect)  # noqa: S101 - made so
        return self.applied.effect


@dataclass(frozen=True)
class FreeForm:
    """A description, by terms of the dictionary, of what the catalogue does not explain.

    `gap` compares predictions of held-out readings without and with the terms. `dark` is the scatter beyond the
    noise of repeats; `scatter` is the place where it is largest, if any. `instead_of` are named effects that
    explain the same readings: either they or the terms are present.
    """

    terms: tuple[FormTerm, ...]
    gap: Gap
    dark: UnexplainedScatter
    scatter: LocalScatter | None
    unit: str
    instead_of: tuple[str, ...] = ()

    @property
    def predicts(self) -> bool:
        """Whether the terms predict held-out readings well enough to belong in a model file."""
        return bool(self.terms) and self.gap.closed is not None and self.gap.closed >= MOSTLY

    @property
    def applied(self) -> tuple[AppliedEffect, ...]:
        """The terms to add to the model; empty if they do not predict, or named effects explain as much."""
        return tuple(term.applied for term in self.terms) if self.predicts and not self.instead_of else ()


def describe(
    linear: LinearSystem,
    candidates: Candidates,
    naming: Naming,
    noise: NoiseSize,
    gap: Gap,
    repeats: Repeats,
    instead_of: tuple[str, ...] = (),
) -> FreeForm:
    """Return the description of what the catalogue does not explain, from the terms that were found.

    `noise` and `gap` are those of the model with all effects found; `repeats` is the noise of repeats.
    """
    columns = candidates.columns[:, list(naming.columns)]
    scatter = larger_scatter(linear, residuals(linear, columns, noise))
    terms = tuple(_terms(linear, candidates, naming, posterior(linear, columns, noise)))
    dark = UnexplainedScatter.of(noise, repeats)
    return FreeForm(terms, gap, dark, scatter, linear.readings.unit, instead_of)


def _terms(
    linear: LinearSystem, candidates: Candidates, naming: Naming, fitted: Posterior
) -> Iterator[FormTerm]:
    taken = {applied.effect.name for applied in linear.model.effects}
    names = (name for name in map(f"{UNNAMED}{{}}".format, count(1)) if name not in taken)
    u = np.sqrt(np.diag(fitted.amplitude_covariance))
    for one, mine in naming.parts():
        variant = one.variant
        if variant.term is None:
            continue
        per_channel = candidates.kinds[variant.columns[0]].channel is not None
        effect = variant.term.effect(next(names), per_channel=per_channel)
        shape = tuple((p.name, p.default) for p in effect.parameters if p.is_shape)
        (applied,) = applied_of(
            candidates, variant._replace(shape=shape), fitted.amplitudes[mine], u[mine], effect=effect
        )
        rho, p = fitted.significance(mine)
        yield FormTerm(applied, variant.family, one.ties[:LISTED_IN_SENTENCE], rho, p)
