"""Whether something without a name is as plausible as what was named: left over by it, or in its place.

What resembles an effect of the catalogue is given its name and leaves a little. So the dictionary competes
with the names: each of its forms in the place of one name, and of all of them where there are several, by the same
evidence; and what the names leave, the shapes that they may have in part taken off, must not speak for a form.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from bench.analysis.diagnosis.candidates import Candidates
from bench.analysis.diagnosis.evidence import Data, Search, Whitened
from bench.analysis.diagnosis.form.dictionary import make_dictionary
from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.naming import Naming, Scored
from bench.analysis.diagnosis.noise_grid import make_noise_grid
from bench.analysis.diagnosis.shapes import with_other_shapes
from bench.base.arrays import Floats
from bench.model import AppliedEffect

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
