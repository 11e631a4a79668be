"""How far two explanations of the same readings lie apart, in readings that were taken or are only planned.

D = 1/2 min_g |e_i - E_j g|^2 in units of the noise: e_i is what the effect found puts into the readings, E_j
what the rival can put there; coefficients, stand angles and what else was found are free. It is the
Kullback-Leibler divergence of the two (Eriksson, Frisk, Krysander, Automatica 49 (2013) 1591); 8 is four
standard deviations.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bench.analysis.diagnosis.candidates import Candidates, Variant, plausible_columns
from bench.analysis.diagnosis.evidence import KNOWN_SIZE
from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.posterior import NoiseSize, whiten_rows
from bench.base.arrays import Floats
from bench.model import CATALOGUE, AppliedEffect
from bench.readings.table import VERIFICATION


class EffectPart(NamedTuple):
    """One number of an effect, at its plausible size: a parameter, of one channel or all, in certain mountings."""

    family: str
    parameter: str
    shape: tuple[tuple[str, float], ...]
    mounts: tuple[str, ...]
    channel: int | None


Form = tuple[EffectPart, ...]
"""A form that an effect may have: the numbers that it has then."""


def form_of(candidates: Candidates, variant: Variant) -> Form:
    """Return a variant of a candidate, so that it can be looked at in other readings."""
    kinds = [candidates.kinds[place] for place in variant.columns]
    return tuple(EffectPart(variant.family, k.parameter, variant.shape, k.mounts, k.channel) for k in kinds)


def forms_of(candidates: Candidates, family: str) -> tuple[Form, ...]:
    """Return the forms that an effect may have in the readings of these candidates."""
    return tuple(form_of(candidates, v) for v in candidates.variants if v.family == family)


def forms_everywhere(family: str, mounts: tuple[str, ...] = ()) -> tuple[Form, ...]:
    """Return the forms of an effect in every channel, of each shape, in all mountings or the given ones."""
    parameters = CATALOGUE[family].parameters
    grids = [[(p.name, value) for value in p.grid] for p in parameters if p.grid]
    return tuple(
        tuple(
            EffectPart(family, p.name, shape, mounts, channel)
            for p in parameters
            if not p.grid
            for channel in ((0, 1, 2) if p.per_channel else (None,))
        )
        for shape in itertools.product(*grids)
    )


class ReadingDesign:
    """Readings, taken or planned, in which explanations are compared.

    `noise` is the size of the noise, `others` are effects that are in the model beside what is compared, each
    known no better than the readings tell.
    """

    def __init__(self, linear: LinearSystem, noise: NoiseSize, others: Sequence[Form] = ()) -> None:
        self.linear = linear
        self._noise = noise
        self._unseen: dict[EffectPart, Floats] = {}
        self._seen: dict[EffectPart, Floats] = {}
        known = [self._column(part) * KNOWN_SIZE for form in others for part in form]
        self._make_free(known)

    def remounted(self, families: Sequence[str], before: Sequence[str]) -> None:
        """Give every mounting that is not among those `before` such effects of its own, of plausible size.

        What was wrong in one mounting says nothing of the next; what lasts goes on.
        """
        labels = [str(m) for m in self.linear.moved.mounts if m.installation != VERIFICATION]
        effects = [CATALOGUE[family] for family in families]
        of_mounts = [effect.name for effect in effects if effect.per_mount and not effect.lasts]
        new = [
            self._column(part)
            for family in of_mounts
            for label in labels
            if label not in before
            for part in forms_everywhere(family, (label,))[0]
        ]
        self._make_free([*self._known, *new])

    def _make_free(self, known: list[Floats]) -> None:
        """Project out the coefficients, and within their priors the stand's angles and the `known` columns."""
        self._known = known
        self._seen.clear()
        fixed, random = self.linear.fixed, self.linear.random
        self._priors = random.shape[1] + len(known)
        base = self._white(np.column_stack([fixed, random, *known]))
        prior = np.concatenate([np.zeros((self._priors, fixed.shape[1])), np.eye(self._priors)], axis=1)
        self._basis, _ = np.linalg.qr(np.concatenate([base, prior]))

    def _white(self, columns: Floats) -> Floats:
        return whiten_rows(self.linear, self._noise, columns, np.ones(len(self.linear), dtype=bool))

    def _left(self, columns: Floats) -> Floats:
        """Return what of columns (N, m) shows beside what is free, units of the noise."""
        white = np.concatenate([self._white(columns), np.zeros((self._priors, columns.shape[1]))])
        left: Floats = white - self._basis @ (self._basis.T @ white)
        return left

    def _column(self, part: EffectPart) -> Floats:
        if part not in self._unseen:
            effect = CATALOGUE[part.family]
            parameter = next(p for p in effect.parameters if p.name == part.parameter)
            columns = plausible_columns(self.linear, effect, parameter, part.shape, part.mounts)
            for channel, column in columns.items():
                self._unseen[part._replace(channel=channel)] = column
        return self._unseen[part]

    def seen(self, form: Form) -> Floats:
        """Return what a form leaves beside what is free, for a plausible size of each number, (m, numbers)."""
        new = [part for part in form if part not in self._seen]
        if new:
            left = self._left(np.column_stack([self._column(part) for part in new]))
            self._seen.update(zip(new, left.T, strict=True))
        return np.column_stack([self._seen[part] for part in form])

    def divergence(self, found: Sequence[AppliedEffect], rivals: Sequence[Form]) -> float:
        """Return D of an effect with the values found against the nearest form of a rival."""
        total = np.sum([self.linear.effect_column(applied) for applied in found], axis=0)
        one = self._left(total[:, None])[:, 0]
        least = float(one @ one)
        for form in rivals:
            other = self.seen(form)
            left = one - other @ np.linalg.lstsq(other, one, rcond=1e-9)[0]
            least = min(least, float(left @ left))
        return least / 2.0

    def visible(self, forms: Sequence[Form]) -> float:
        """Return how far an effect of plausible size stands out in the form that shows best (rho)."""
        return max((_largest(self.seen(form)) for form in forms), default=0.0)

    def cosine(self, one: Form, other: Form) -> float:
        """Return the cosine of the smallest angle between what two forms leave; 0 where one leaves nothing."""
        first, second = _basis(self.seen(one)), _basis(self.seen(other))
        if not (first.shape[1] and second.shape[1]):
            return 0.0
        return min(1.0, _largest(first.T @ second))


def _largest(matrix: Floats) -> float:
    """Return the largest singular value."""
    return float(np.linalg.svd(matrix, compute_uv=False)[0])


def _basis(columns: Floats) -> Floats:
    u, size, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, size > 1e-6 * max(1.0, size[0])]
