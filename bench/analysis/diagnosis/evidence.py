"""Bayesian evidence of every candidate, with priors on physical size, the noise unknown.

For a variant with whitened columns A, prior b ~ N(0, s^2) of each in units of its plausible size, and
residual r of nu numbers with unknown variance (Jeffreys prior), the evidence is
-1/2 ln|I + s^2 A^T A| - nu/2 ln(r^T r - r^T A (A^T A + 1/s^2)^-1 A^T r). It is averaged over a few s (a
plausible size is a guess: a heavy tail lets the data overrule it) and over the ratio of the two noise sizes.
Everything needed of data is r^T r and A^T r, so that many data sets are scored at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.analysis.diagnosis.candidates import Candidates, Variant
from bench.analysis.diagnosis.noise_grid import NoiseGrid
from bench.base.arrays import Floats, Ints
from bench.base.progress import tracked

SIZES: Final = (1.0, 4.0, 20.0)
LOG_SIZE_WEIGHTS: Final = tuple(float(np.log(w)) for w in (0.6, 0.28, 0.12))
"""Prior: so many plausible sizes large, with such a probability."""

KNOWN_SIZE: Final = 20.0
"""Prior size of an effect that the model has by now, in plausible sizes: the data decide."""

EXCLUDED: Final = -1e9
"""ln of the evidence of a variant that the model has in part already."""

CHUNK: Final = 200
"""Data sets scored at once."""


@dataclass(frozen=True)
class Data:
    """What is needed of data sets: r^T r (ratios, sets) and A^T r (ratios, P, sets)."""

    square: Floats
    along: Floats

    def part(self, of: slice) -> Data:
        """Return some of the sets."""
        return Data(self.square[:, of], self.along[:, :, of])

    @property
    def sets(self) -> int:
        """How many data sets."""
        return int(self.square.shape[1])


@dataclass(frozen=True)
class Whitened:
    """The candidates' columns in units of the noise, by their Gram matrix (ratios, P, P)."""

    grid: NoiseGrid
    candidates: Candidates
    gram: Floats

    @classmethod
    def of(cls, grid: NoiseGrid, candidates: Candidates) -> Whitened:
        """Whiten the columns of all candidates."""
        many = candidates.columns.shape[1]
        gram = np.empty((len(grid.white), many, many))
        for ratio, white in enumerate(grid.white):
            columns = white @ (candidates.columns / grid.sigma)
            gram[ratio] = columns.T @ columns
        return cls(grid, candidates, gram)

    def reduce(self, response: Floats) -> Data:
        """Return what is needed of responses (N, sets)."""
        sets, size = response.shape[1], self.grid.sigma
        square = np.empty((len(self.grid.white), sets))
        along = np.empty((len(self.grid.white), self.candidates.columns.shape[1], sets))
        for start in range(0, sets, CHUNK):
            part = slice(start, start + CHUNK)
            for ratio, white in enumerate(self.grid.white):
                weighed = white.weigh(response[:, part] / size)
                square[ratio, part] = np.einsum("ns,ns->s", response[:, part] / size, weighed)
                along[ratio, :, part] = self.candidates.columns.T @ (weighed / size)
        return Data(square, along)


@dataclass(frozen=True)
class Group:
    """Variants with equally many columns; eigenvectors (ratios, variants, p, p), eigenvalues (…, p)."""

    members: Ints
    columns: Ints
    vectors: Floats
    values: Floats


@dataclass(frozen=True)
class Search:
    """All variants beside a model that has the `known` columns already.

    `gain` (ratios, known, P) fits the known columns (within a wide prior), `inner` (ratios, known, known) is
    their Gram matrix with that prior.
    """

    whitened: Whitened
    known: tuple[int, ...]
    gain: Floats
    inner: Floats
    log_det: Floats
    groups: tuple[Group, ...]

    @classmethod
    def beside(cls, whitened: Whitened, known: Sequence[int]) -> Search:
        """Project the known columns out of all others."""
        gram = whitened.gram
        h = list(known)
        inner = gram[:, h][:, :, h] + np.eye(len(h)) / KNOWN_SIZE**2
        gain = np.zeros((len(gram), 0, gram.shape[2]))
        if h:
            gain = np.asarray(np.linalg.solve(inner, gram[:, h]), dtype=np.float64)
        log_det = -0.5 * np.linalg.slogdet(inner * KNOWN_SIZE**2)[1] if h else np.zeros(len(gram))
        groups = _groups(gram, gain, h, whitened.candidates.variants)
        return cls(whitened, tuple(h), gain, inner, log_det, groups)

    def cross(self, ratio: int, rows: Sequence[int]) -> Floats:
        """Return the Gram matrix of the columns `rows` with all others, the known ones projected out."""
        gram = self.whitened.gram[ratio]
        of_rows: Floats = gram[list(rows)]
        if self.known:
            of_rows = of_rows - of_rows[:, list(self.known)] @ self.gain[ratio]
        return of_rows

    def left_over(self, data: Data) -> Data:
        """Return the data with the known columns fitted."""
        if not self.known:
            return data
        at_known = data.along[:, list(self.known)]
        fitted = np.swapaxes(self.gain, 1, 2) @ at_known
        explained = np.einsum("ghs,ghs->gs", at_known, np.linalg.solve(self.inner, at_known))
        return Data(data.square - explained, data.along - fitted)

    def score(self, data: Data) -> Scores:
        """Return the evidence of each variant and of the model as it is."""
        left = self.left_over(data)
        begun = tracked(range(0, left.sets, CHUNK), "what chance alone would show")
        parts = [self._score(left.part(slice(i, i + CHUNK))) for i in begun]
        return Scores(
            np.concatenate([p.variants for p in parts], axis=1),
            np.concatenate([p.ratio for p in parts], axis=1),
        )

    def _score(self, left: Data) -> Scores:
        grid = self.whitened.grid
        base = (grid.log_prior + grid.log_det + self.log_det)[:, None]
        of_null = base + grid.log_likelihood(left.square)
        null = _log_sum(of_null)
        out = np.full((len(self.whitened.candidates.variants), left.sets), EXCLUDED)
        for group in self.groups:
            along = left.along[:, group.columns]
            squares = (np.swapaxes(group.vectors, 2, 3) @ along) ** 2
            of_size = []
            for size, log_weight in zip(SIZES, LOG_SIZE_WEIGHTS, strict=True):
                weight = 1.0 / (group.values + 1.0 / size**2)
                explained = np.einsum("gvks,gvk->gvs", squares, weight)
                rest = np.maximum(left.square[:, None] - explained, 1e-12 * left.square[:, None])
                cost = 0.5 * np.sum(np.log1p(size**2 * group.values), axis=2)
                of_size.append(log_weight - cost[:, :, None] + grid.log_likelihood(rest))
            total = _log_sum(np.stack(of_size))
            out[group.members] = _log_sum(base[:, None] + total)
        return Scores(out - null, np.exp(of_null - null))


@dataclass(frozen=True)
class Scores:
    """ln of the evidence of each variant over that of the model as it is (variants, sets).

    `ratio` (ratios, sets) is the probability of each noise ratio in the latter.
    """

    variants: Floats
    ratio: Floats

    def families(self, candidates: Candidates) -> Floats:
        """Return ln of the mean evidence of each family (families, sets): the price of its many forms."""
        ordered = self.variants[candidates.by_family]
        starts = candidates.family_starts
        counts = np.diff([*starts, len(ordered)])
        largest = np.maximum.reduceat(ordered, starts, axis=0)
        parts = np.exp(ordered - np.repeat(largest, counts, axis=0))
        mean: Floats = largest + np.log(np.add.reduceat(parts, starts, axis=0) / counts[:, None])
        return mean


def _log_sum(logarithms: Floats) -> Floats:
    """Return ln of the sum of exponentials along the first axis, none of which is infinite."""
    largest = logarithms.max(axis=0)
    total: Floats = largest + np.log(np.sum(np.exp(logarithms - largest), axis=0))
    return total


def _groups(gram: Floats, gain: Floats, known: list[int], variants: Sequence[Variant]) -> tuple[Group, ...]:
    by_size: dict[int, list[int]] = {}
    for number, variant in enumerate(variants):
        if not set(known).intersection(variant.columns):
            by_size.setdefault(len(variant.columns), []).append(number)
    groups = []
    for size, members in by_size.items():
        columns = np.array([variants[m].columns for m in members])
        blocks = gram[:, columns[:, :, None], columns[:, None, :]]
        if known:
            at_known = gram[:, columns][:, :, :, known]
            blocks = blocks - at_known @ np.moveaxis(gain[:, :, columns], 1, 2)
        if size == 1:
            values, vectors = blocks[:, :, 0], np.ones_like(blocks)
        else:
            values, vectors = np.linalg.eigh(blocks)
        groups.append(Group(np.array(members), columns, vectors, np.maximum(values, 0.0)))
    return tuple(groups)
