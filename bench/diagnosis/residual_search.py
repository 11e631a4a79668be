"""The sparse search for an unnamed residual model, alone and beside named effects."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Mask
from bench.diagnosis.candidates import Candidates
from bench.diagnosis.evidence import Data, Search, Whitened
from bench.diagnosis.gap import SURE, determined, folds_of, restrict, thirds_of
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.naming import LESS_PLAUSIBLE, Found, Naming, Scored
from bench.diagnosis.noise_grid import make_noise_grid
from bench.diagnosis.posterior import NoiseSize, posterior, predicted_error
from bench.diagnosis.residual_dictionary import make_dictionary
from bench.diagnosis.shapes import with_other_shapes
from bench.diagnosis.threshold import Threshold
from bench.model.effects import AppliedEffect

MOST_TERMS: Final = 5
MOST_ALIKE: Final = 4
"""Families listed of those that explain a term as well."""


@dataclass(frozen=True)
class Setting:
    """What a search needs beside the columns: the size of the noise to begin with, its ratios, the threshold."""

    sigma: float
    setting_rad: float
    ratios: tuple[float, ...]
    limit: Threshold


@dataclass(frozen=True)
class FormFold:
    """Readings held out: error (n,) and chi-square as the model was given and with the terms found without them.

    It is `counted` where the other readings could have shown the terms at all.
    """

    label: str
    before: tuple[Floats, float]
    after: tuple[Floats, float]
    counted: bool

    @property
    def count(self) -> int:
        """How many rows."""
        return len(self.before[0])


@dataclass(frozen=True)
class Form:
    """What was found in all readings, beside the first `given` columns; `sizes` of each term's columns."""

    given: int
    found: list[Found]
    sizes: list[Floats]


def search(whitened: Whitened, data: Data, given: int, limit: Threshold) -> list[Found]:
    """Find the terms beside the first `given` columns, which the model has by now."""
    found: list[Found] = []
    while len(found) < MOST_TERMS:
        scored = Scored.beside(whitened, data, _known(given, found))
        if scored.total < limit.value:
            break
        found = _looked_at_again(whitened, data, given, [*found, scored.best()])
    return _needed(whitened, data, given, found, limit)


def _known(given: int, found: list[Found], but: int | None = None) -> list[int]:
    return [*range(given), *(c for i, f in enumerate(found) if i != but for c in f.variant.columns)]


def _looked_at_again(whitened: Whitened, data: Data, given: int, found: list[Found]) -> list[Found]:
    """Look at each earlier term again beside all others: it may have stood in for something else."""
    for i in range(len(found) - 1):
        best = Scored.beside(whitened, data, _known(given, found, but=i)).best()
        if best.variant != found[i].variant:
            found = [*found[:i], best, *found[i + 1 :]]
    return found


def _needed(whitened: Whitened, data: Data, given: int, found: list[Found], limit: Threshold) -> list[Found]:
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


def alike(whitened: Whitened, data: Data, given: int, found: list[Found], which: int) -> tuple[str, ...]:
    """Return the families that explain nearly as much in the place of a term, the more plausible first."""
    evidence = Scored.beside(whitened, data, _known(given, found, but=which)).evidence
    mine = found[which].variant.family
    near = [f for f, value in evidence.items() if f != mine and evidence[mine] - value < LESS_PLAUSIBLE]
    return tuple(sorted(near, key=lambda family: -evidence[family])[:MOST_ALIKE])


def whitened_columns(linear: LinearSystem, candidates: Candidates, setting: Setting) -> Whitened:
    """Whiten the columns of a dictionary in the noise as it is known by now."""
    grid = make_noise_grid(linear, setting.sigma, setting.setting_rad, setting.ratios)
    return Whitened.of(grid, candidates, few_known=True)


def held_out(
    linear: LinearSystem,
    candidates: Candidates,
    found: Form,
    noise: NoiseSize,
    setting: Setting,
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
    found: Form,
    noise: NoiseSize,
    setting: Setting,
    parts: Iterator[tuple[str, Mask]],
) -> list[FormFold]:
    able = [(label, held) for label, held in parts if determined(linear, ~held)]
    return [_fold(linear, candidates, found, noise, setting, *fold) for fold in able]


def _fold(
    linear: LinearSystem,
    candidates: Candidates,
    form: Form,
    noise: NoiseSize,
    setting: Setting,
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


def _could_show(whitened: Whitened, form: Form, noise: NoiseSize, limit: Threshold) -> bool:
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
