"""The residual model: the sparse search for terms, their sizes and predictions, unexplained variance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.diagnosis.candidates import Candidates
from bench.diagnosis.evidence import Data, Search, Threshold, Whitened
from bench.diagnosis.gap import SURE, determined, folds_of, restrict, thirds_of
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.naming import LESS_PLAUSIBLE, FoundEffect, Naming, Scored
from bench.diagnosis.noise_grid import Repeats, make_noise_grid
from bench.diagnosis.posterior import (
    NoiseSize,
    Posterior,
    noise_size,
    posterior,
    predicted_error,
    whiten_rows,
    with_other_shapes,
)
from bench.diagnosis.residual_dictionary import Dictionary, make_dictionary
from bench.model.effects import AppliedEffect
from bench.model.effects.formula import FormulaEffect

MOST_TERMS: Final = 5
MOST_ALIKE: Final = 4
"""Families listed of those that explain a term as well."""


@dataclass(frozen=True)
class SearchSettings:
    """What a search needs beside the columns: the size of the noise to begin with, its ratios, the threshold."""

    sigma: float
    setting_rad: float
    ratios: tuple[float, ...]
    limit: Threshold


@dataclass(frozen=True)
class FormFold:
    """A fold of held-out readings: error (n,) and chi-square without and with terms found in the rest.

    It is `counted` where the other readings could have shown the terms at all.
    """

    label: str
    before: tuple[Floats, float]
    after: tuple[Floats, float]
    counted: bool

    @property
    def count(self) -> int:
        """The number of rows held out."""
        return len(self.before[0])


@dataclass(frozen=True)
class ResidualForm:
    """The terms found in all readings beside the first `given` columns, with the `sizes` of their columns."""

    given: int
    found: list[FoundEffect]
    sizes: list[Floats]


def search(whitened: Whitened, data: Data, given: int, limit: Threshold) -> list[FoundEffect]:
    """Find the terms beside the first `given` columns, which the model has by now."""
    found: list[FoundEffect] = []
    while len(found) < MOST_TERMS:
        scored = Scored.beside(whitened, data, _known(given, found))
        if scored.total < limit.value:
            break
        found = _looked_at_again(whitened, data, given, [*found, scored.best()])
    return _needed(whitened, data, given, found, limit)


def _known(given: int, found: list[FoundEffect], but: int | None = None) -> list[int]:
    return [*range(given), *(c for i, f in enumerate(found) if i != but for c in f.variant.columns)]


def _looked_at_again(
    whitened: Whitened, data: Data, given: int, found: list[FoundEffect]
) -> list[FoundEffect]:
    """Look at each earlier term again beside all others: it may have stood in for something else."""
    for i in range(len(found) - 1):
        best = Scored.beside(whitened, data, _known(given, found, but=i)).best()
        if best.variant != found[i].variant:
            found = [*found[:i], best, *found[i + 1 :]]
    return found


def _needed(
    whitened: Whitened, data: Data, given: int, found: list[FoundEffect], limit: Threshold
) -> list[FoundEffect]:
    """Leave out the terms that are not worth their place beside the others; the weakest first."""
    while len(found) > 1:
        odds = [
            Scored.beside(whitened, data, _known(given, found, but=i)).evidence[f.variant.family]
            for i, f in enumerate(found)
        ]
        weakest = int(np.argmin(odds))
        if odds[weakest] >= limit.value:
            break
        found = [*found[:weakest], *found[weakest + 1 :]]
    return found


def alike(
    whitened: Whitened, data: Data, given: int, found: list[FoundEffect], which: int
) -> tuple[str, ...]:
    """Return the families that explain nearly as much in the place of a term, the more plausible first."""
    evidence = Scored.beside(whitened, data, _known(given, found, but=which)).evidence
    mine = found[which].variant.family
    near = [f for f, value in evidence.items() if f != mine and evidence[mine] - value < LESS_PLAUSIBLE]
    return tuple(sorted(near, key=lambda family: -evidence[family])[:MOST_ALIKE])


def whitened_columns(linear: LinearSystem, candidates: Candidates, setting: SearchSettings) -> Whitened:
    """Whiten the columns of a dictionary in the noise as it is known by now."""
    grid = make_noise_grid(linear, setting.sigma, setting.setting_rad, setting.ratios)
    return Whitened.of(grid, candidates, few_known=True)


def held_out(
    linear: LinearSystem,
    candidates: Candidates,
    found: ResidualForm,
    noise: NoiseSize,
    setting: SearchSettings,
    *,
    once: bool,
) -> list[FormFold]:
    """Search again without each part of the readings in turn, and predict it.

    Parts are passes and the verification points; every third setting where something happens `once`, or where no
    other part can be counted.
    """
    folds = [] if once else _folds(linear, candidates, found, noise, setting, folds_of(linear))
    if not any(fold.counted for fold in folds):
        folds += _folds(linear, candidates, found, noise, setting, thirds_of(linear))
    return folds


def _folds(
    linear: LinearSystem,
    candidates: Candidates,
    found: ResidualForm,
    noise: NoiseSize,
    setting: SearchSettings,
    parts: Iterator[tuple[str, Mask]],
) -> list[FormFold]:
    able = [(label, held) for label, held in parts if determined(linear, ~held)]
    return [_fold(linear, candidates, found, noise, setting, *fold) for fold in able]


def _fold(
    linear: LinearSystem,
    candidates: Candidates,
    form: ResidualForm,
    noise: NoiseSize,
    setting: SearchSettings,
    label: str,
    held: Mask,
) -> FormFold:
    train = ~held
    part = restrict(linear, train)
    kept = Candidates(candidates.columns[train], candidates.kinds, candidates.scale, candidates.variants)
    whitened = whitened_columns(part, kept, setting)
    found = search(whitened, whitened.reduce(part.response[:, None]), form.given, setting.limit)

    def error(columns: list[int]) -> tuple[Floats, float]:
        effects = candidates.columns[:, columns]
        return predicted_error(linear, effects, noise, posterior(linear, effects, noise, train), held)

    counted = _could_show(whitened, form, noise, setting.limit)
    return FormFold(label, error([]), error(_known(form.given, found)), counted)


def _could_show(whitened: Whitened, form: ResidualForm, noise: NoiseSize, limit: Threshold) -> bool:
    """Whether these readings would show each term at its size: from the design, not from their values."""
    half = np.sqrt(2.0 * max(limit.value + np.log(len(whitened.candidates.families)), 1.0))
    for i, (one, size) in enumerate(zip(form.found, form.sizes, strict=True)):
        mine = list(one.variant.columns)
        beside = Search.beside(whitened, _known(form.given, form.found, but=i))
        gram = beside.between(whitened.ratios // 2, mine)
        seen = float(size @ gram @ size) * (whitened.grid.sigma / noise.reading) ** 2
        if np.sqrt(max(seen, 0.0)) < half + SURE:
            return False
    return True


UNNAMED_FORM: Final = "unnamed_form"
"""What stands in `cannot_tell_from` of an effect that a form without a name describes as well."""
SAME: Final = 0.999
"""A form of whose square this part lies in an effect's own is the effect itself, written as a formula."""
UNHEARD: Final = float(np.log(10.0))
"""Prior ln odds for the catalogue: what nobody has named is a tenth as plausible. Settled beforehand."""
RANK: Final = 1e-9


def unnamed_in_place(
    linear: LinearSystem,
    whitened: Whitened,
    data: Data,
    naming: Naming,
    in_part: tuple[AppliedEffect, ...],
    setting_rad: float,
) -> tuple[int, ...]:
    """Return the numbers of the finds in whose place, or beside which, a form is as plausible.

    `whitened` and `data` are those in which they were found, `in_part` what they may have of other shapes,
    `setting_rad` the setting error that the bench file states.
    """
    every = tuple(range(len(naming.found)))
    dictionary = make_dictionary(linear, whitened.candidates.columns[:, list(naming.columns)]).candidates
    shaped = with_other_shapes(linear, in_part)
    grid = replace(make_noise_grid(shaped, whitened.grid.sigma, setting_rad), known=whitened.grid.known)
    beside = Whitened.of(grid, dictionary)
    data_beside = beside.reduce(shaped.response[:, None])
    if Scored.beside(beside, data_beside, range(len(naming.columns))).total > UNHEARD:
        return every
    forms = Whitened.of(whitened.grid, dictionary)
    seen = forms.reduce(linear.response[:, None])
    count = range(len(naming.columns))
    gained = max(_log_evidence(beside, data_beside, count) - _log_evidence(forms, seen, count), 0.0)
    places = list(naming.parts())
    suspects: set[int] = set()
    for group in _groups(len(every)):
        others = [c for i, (_, mine) in enumerate(places) if i not in group for c in _numbers(mine)]
        scored = Scored.beside(forms, seen, others)
        own = [c for i in group for c in _own_columns(whitened.candidates, places[i][0].variant.family)]
        chosen = _not_the_same(forms, scored, own)
        odds = _log_sum(chosen) - np.log(len(dictionary.families))
        if odds > _odds_of_names(whitened, data, naming, group) + gained + UNHEARD:
            suspects.update(group)
    return tuple(sorted(suspects))


def _groups(count: int) -> Iterator[tuple[int, ...]]:
    """Yield the finds that something else may stand for: each alone, and all of several."""
    yield from ((i,) for i in range(count))
    if count > 1:
        yield tuple(range(count))


def _numbers(place: slice) -> range:
    return range(place.start, place.stop)


def _own_columns(candidates: Candidates, family: str) -> Iterator[Floats]:
    """Yield the columns (N, m) of a family, for each of its shapes."""
    variants = [candidates.variants[v] for v in candidates.of_family(family)]
    for shape in dict.fromkeys(variant.shape for variant in variants):
        numbers = {c for variant in variants if variant.shape == shape for c in variant.columns}
        yield candidates.columns[:, sorted(numbers)]


def _not_the_same(forms: Whitened, scored: Scored, own: list[Floats]) -> list[float]:
    """Return the evidence of the families of forms, without forms that are one of the effects.

    `own` are the columns of each effect in each of its shapes. The mean over a family's forms is taken as if
    those left out had none.
    """
    candidates, white = forms.candidates, forms.grid.white[scored.ratio]
    columns = white @ candidates.columns
    length2 = np.sum(columns**2, axis=0)
    same = np.zeros(len(length2), dtype=bool)
    for of_effect in own:
        u, size, _ = np.linalg.svd(white @ of_effect, full_matrices=False)
        basis = u[:, size > RANK * size[0]]
        same |= np.sum((basis.T @ columns) ** 2, axis=0) >= SAME * length2
    evidence = []
    for family in candidates.families:
        members = candidates.of_family(family)
        left = [m for m in members if not all(same[c] for c in candidates.variants[m].columns)]
        if left:
            evidence.append(_log_sum(scored.scores.variants[left, 0]) - np.log(len(members)))
    return evidence


def _odds_of_names(whitened: Whitened, data: Data, naming: Naming, group: tuple[int, ...]) -> float:
    """Return ln of the odds of the named effects of a group together, one after the other, beside the others."""
    known = [c for i, one in enumerate(naming.found) if i not in group for c in one.variant.columns]
    total = 0.0
    for i in group:
        variant = naming.found[i].variant
        scored = Scored.beside(whitened, data, known)
        total += scored.evidence[variant.family] - np.log(len(whitened.candidates.families))
        known += variant.columns
    return total


def _log_evidence(whitened: Whitened, data: Data, known: Sequence[int]) -> float:
    """Return ln of the evidence of a model with the known columns, its noise integrated over."""
    search = Search.beside(whitened, known)
    grid = whitened.grid
    square = search.left_over(data).square[:, 0]
    return _log_sum(grid.log_prior + grid.log_det + search.log_det + grid.log_likelihood(square))


def _log_sum(logarithms: Floats | list[float]) -> float:
    return float(np.logaddexp.reduce(logarithms)) if len(logarithms) else -np.inf


# --- the residual model: terms with sizes, their predictions, unexplained variance and scatter ----


BY_CHANCE: Final = 0.05
"""What chance gives so often is stated as an upper limit and as no value; the limit holds in all but as many."""
OF_SETTING: Final = 2
"""Numbers by which a repeat of a setting tells of the noise: across the turn of the head."""


@dataclass(frozen=True)
class UnexplainedScatter:
    """Scatter beyond that of the repeats (1 σ, unit of the signal), its u, the 95 % limit, the chance of it.

    `u` and `upper` are infinite where there are no readings beside the repeats to tell.
    """

    value: float
    u: float
    upper: float
    p: float

    @classmethod
    def of(cls, noise: NoiseSize, repeats: Repeats) -> UnexplainedScatter:
        """Compare the noise beside all that was found with that of the repeats, which is a part of it (F test)."""
        of_repeats = OF_SETTING * repeats.freedom
        beyond = noise.freedom - of_repeats
        all2, repeats2 = noise.reading**2, repeats.sigma**2
        value = float(np.sqrt(max(all2 - repeats2, 0.0)))
        if beyond <= 0:
            return cls(value, np.inf, np.inf, 1.0)
        lack = max(noise.freedom * all2 - of_repeats * repeats2, 0.0) / beyond / repeats2
        # scatter that chance made small is no proof of less than the repeats can tell
        largest = max(lack, 1.0) / float(special.fdtri(beyond, of_repeats, BY_CHANCE))
        upper = float(np.sqrt(max(largest - 1.0, 0.0) * repeats2 * beyond / noise.freedom))
        variance = 2 * all2**2 / noise.freedom + 2 * repeats2**2 * (1 / of_repeats - 2 / noise.freedom)
        u = float(np.sqrt(variance)) / (2 * value) if value > 0.0 else float(np.sqrt(np.sqrt(variance)))
        return cls(value, u, max(upper, value), float(special.fdtrc(beyond, of_repeats, lack)))

    @property
    def there(self) -> bool:
        """Whether it is more than chance."""
        return self.p < BY_CHANCE


SIGNIFICANT: Final = 1e-3
"""Chance of so much scatter somewhere, all places counted, below which it is said."""
LEAST_ROWS: Final = 4
LARGER: Final = 1.5
"""By how much the scatter must be larger than elsewhere to be worth a word."""


@dataclass(frozen=True)
class LocalScatter:
    """Where readings scatter more: standard deviations there and elsewhere, unit of the signal."""

    channel: str
    where: str
    sd: float
    elsewhere: float
    p: float

    @property
    def words(self) -> str:
        """The place in words."""
        return f"channel {self.channel}, {self.where}"


def larger_scatter(linear: LinearSystem, left: Floats) -> LocalScatter | None:
    """Return the place whose residuals `left` (N,) scatter most beyond the others, None where none does."""
    places = list(_places(linear))
    best: LocalScatter | None = None
    oriented = linear.setting >= 0
    for channel, where, rows in places:
        others = oriented & ~rows
        inside, outside = int(rows.sum()), int(others.sum())
        if inside < LEAST_ROWS or outside < LEAST_ROWS:
            continue
        sd, elsewhere = (float(np.sqrt(np.mean(left[of] ** 2))) for of in (rows, others))
        if sd <= LARGER * elsewhere:
            continue
        p = float(special.fdtrc(inside, outside, (sd / elsewhere) ** 2)) * len(places)
        if p < SIGNIFICANT and (best is None or p < best.p):
            best = LocalScatter(channel, where, sd, elsewhere, p)
    return best


def _places(linear: LinearSystem) -> Iterator[tuple[str, str, Mask]]:
    rows, readings = linear.rows, linear.readings
    oriented = linear.setting >= 0
    label = readings.installation[rows.reading]
    series = readings.series[rows.reading]
    mounts = np.array([i if s == 1 else f"{i}/{s}" for s, i in zip(series, label, strict=True)])
    passes = readings.pass_number[rows.reading]
    for c, channel in enumerate(CHANNELS):
        own = oriented & (rows.channel == c)
        yield channel, "everywhere", own
        for mount in dict.fromkeys(mounts[own].tolist()):
            here = own & (mounts == mount)
            yield channel, f"installation {mount}", here
            for number in dict.fromkeys(passes[here].tolist()):
                yield channel, f"installation {mount}, pass {number}", here & (passes == number)


UNNAMED: Final = "unnamed_"
"""Prefix of the name of an unnamed effect."""
LEAST_CLOSED: Final = 0.5
"""A form goes into a model file where it closes so much of the gap on readings held out; settled beforehand."""


@dataclass(frozen=True)
class FormTerm:
    """A term with its sizes and their u; `could_also_be` are families that describe it as well.

    `p` is for this term alone, `rho` its size in units of noise.
    """

    applied: AppliedEffect
    family: str
    could_also_be: tuple[str, ...]
    rho: float
    p: float

    @property
    def effect(self) -> FormulaEffect:
        """The term as an effect."""
        assert isinstance(self.applied.effect, FormulaEffect)  # noqa: S101 - made so
        return self.applied.effect

    def sizes(self) -> list[tuple[str, str, float, float, str]]:
        """Return parameter, channel ("" for all), value, u and unit of each size, in that unit."""
        told = []
        for p in self.effect.parameters:
            if p.is_shape:
                continue
            value, u = self.applied.values[p.name], self.applied.u[p.name]
            for channel in self.applied.channels if p.per_channel else ("",):
                at = CHANNELS.index(channel) if channel else ()
                told.append(
                    (p.name, channel, float(value[at] / p.si_per_unit), float(u[at] / p.si_per_unit), p.unit)
                )
        return told


@dataclass(frozen=True)
class FreeForm:
    """A description of unnamed effects by terms of the dictionary.

    `folds` hold readings out and search without them; `dark` is what the readings scatter beyond their repeats
    with the terms: it has no form, and is an uncertainty. `scatter` says where it is larger.
    `instead_of` are the named effects in whose place the terms stand: one or the other is there.
    """

    terms: tuple[FormTerm, ...]
    folds: tuple[FormFold, ...]
    dark: UnexplainedScatter
    scatter: LocalScatter | None
    unit: str
    instead_of: tuple[str, ...] = ()

    @property
    def counted(self) -> tuple[FormFold, ...]:
        """The parts held out without which the rest could have shown the terms."""
        return tuple(fold for fold in self.folds if fold.counted)

    @property
    def before(self) -> float:
        """Reduced chi-square of the readings held out that count, without the terms."""
        return self._reduced([fold.before[1] for fold in self.counted])

    @property
    def after(self) -> float:
        """Reduced chi-square of the counted held-out readings with the terms found without them."""
        return self._reduced([fold.after[1] for fold in self.counted])

    @property
    def closed(self) -> float | None:
        """Part of the gap that the terms close on readings held out; None where there is no gap to close."""
        return (self.before - self.after) / (self.before - 1.0) if self.before > 1.0 else None

    @property
    def predicts(self) -> bool:
        """Whether the terms predict readings that they have not seen well enough for a model file."""
        return bool(self.terms) and self.closed is not None and self.closed >= LEAST_CLOSED

    @property
    def applied(self) -> tuple[AppliedEffect, ...]:
        """The terms with their values, for the model: none where names stand there or they do not predict."""
        return tuple(term.applied for term in self.terms) if self.predicts and not self.instead_of else ()

    def _reduced(self, chi2: Sequence[float]) -> float:
        return sum(chi2) / max(sum(fold.count for fold in self.counted), 1)


def describe(linear: LinearSystem, given: Floats, repeats: Repeats, setting: SearchSettings) -> FreeForm:
    """Describe what has no name beside what has one: the columns `given` (N, m), one prior size each."""
    dictionary = make_dictionary(linear, given)
    count = given.shape[1]
    whitened = whitened_columns(linear, dictionary.candidates, setting)
    data = whitened.reduce(linear.response[:, None])
    found = search(whitened, data, count, setting.limit)
    columns = [*range(count), *(c for f in found for c in f.variant.columns)]
    noise = noise_size(whitened, data, tuple(columns))
    fitted = posterior(linear, dictionary.candidates.columns[:, columns], noise)
    others = [alike(whitened, data, count, found, i) for i in range(len(found))]
    once = any(dictionary.of(f.variant).once for f in found)
    form = FreeForm(
        terms=_terms(linear, dictionary, found, others, fitted, count),
        folds=tuple(
            held_out(linear, dictionary.candidates, _of(found, fitted, count), noise, setting, once=once)
            if found
            else ()
        ),
        dark=UnexplainedScatter.of(noise, repeats),
        scatter=None,
        unit=linear.readings.unit,
    )
    # terms that predict nothing follow the noise that is to be described
    believed = tuple(columns if form.predicts else columns[:count])
    noise = noise_size(whitened, data, believed)
    return replace(
        form,
        dark=UnexplainedScatter.of(noise, repeats),
        scatter=larger_scatter(linear, _left(linear, dictionary.candidates.columns[:, believed], noise)),
    )


def _of(found: list[FoundEffect], fitted: Posterior, given: int) -> ResidualForm:
    """Return the terms with the sizes of their columns."""
    ends = np.cumsum([len(f.variant.columns) for f in found])
    return ResidualForm(given, found, np.split(fitted.amplitudes[given:], ends[:-1]))


def _left(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> Floats:
    """Return what is left of the readings, the setting error taken out, unit of the signal, shape (N,)."""
    fitted = posterior(linear, effects, noise)
    left = linear.response - np.concatenate([linear.fixed, linear.random, effects], axis=1) @ fitted.mean
    return noise.reading * whiten_rows(linear, noise, left[:, None], np.ones(len(linear), dtype=bool))[:, 0]


def _terms(
    linear: LinearSystem,
    dictionary: Dictionary,
    found: Sequence[FoundEffect],
    others: Sequence[tuple[str, ...]],
    fitted: Posterior,
    given: int,
) -> tuple[FormTerm, ...]:
    taken = {applied.effect.name for applied in linear.model.effects}
    names = (name for name in (f"{UNNAMED}{k}" for k in range(1, 1000)) if name not in taken)
    u = np.sqrt(np.diag(fitted.amplitude_covariance))
    terms = []
    start = given
    for one, also, name in zip(found, others, names, strict=False):
        stop = start + len(one.variant.columns)
        applied = _applied(dictionary, one, name, fitted.amplitudes[start:stop], u[start:stop])
        p = float(special.chdtrc(stop - start, one.size**2))
        terms.append(FormTerm(applied, one.variant.family, also, one.size, p))
        start = stop
    return tuple(terms)


def _applied(dictionary: Dictionary, one: FoundEffect, name: str, value: Floats, u: Floats) -> AppliedEffect:
    candidates: Candidates = dictionary.candidates
    kinds = [candidates.kinds[column] for column in one.variant.columns]
    per_channel = kinds[0].channel is not None
    effect = dictionary.of(one.variant).effect(name, per_channel=per_channel)
    values: dict[str, Floats] = {p.name: np.asarray(p.default) for p in effect.parameters if p.is_shape}
    sizes: dict[str, Floats] = {}
    for place, (column, kind) in enumerate(zip(one.variant.columns, kinds, strict=True)):
        at = () if kind.channel is None else kind.channel
        for numbers, number in ((values, value[place]), (sizes, u[place])):
            numbers.setdefault(kind.parameter, np.zeros(() if kind.channel is None else 3))
            numbers[kind.parameter][at] = number * candidates.scale[column]
    channels = tuple(CHANNELS[c] for c in one.variant.channels)
    return AppliedEffect(effect, values, channels, sizes)
