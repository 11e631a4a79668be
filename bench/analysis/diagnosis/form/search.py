"""The sparse search: one term after the other, by the evidence and the threshold that names are given by."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.analysis.diagnosis.candidates import Candidates
from bench.analysis.diagnosis.evidence import Data, Search, Whitened
from bench.analysis.diagnosis.holdout import SURE, determined, folds_of, restrict, thirds_of
from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.naming import LESS_PLAUSIBLE, Found, Scored
from bench.analysis.diagnosis.noise_grid import make_noise_grid
from bench.analysis.diagnosis.posterior import NoiseSize, posterior, predicted_error
from bench.analysis.diagnosis.threshold import Threshold
from bench.base.arrays import Floats, Mask

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
