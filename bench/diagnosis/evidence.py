"""Bayesian evidence of every candidate, with priors on physical size and unknown noise.

A variant has the whitened columns A, each for a parameter of plausible size, with amplitudes b ~ N(0, s^2). The
residual r has nu degrees of freedom and an unknown variance (Jeffreys prior). Then the logarithm of the evidence is
-1/2 ln|I + s^2 A^T A| - nu/2 ln(r^T r - r^T A (A^T A + 1/s^2)^-1 A^T r). It is averaged over a few s, because a
plausible size is a guess, and over the noise ratios. The evidence depends on the data only by r^T r and A^T r.
Therefore many data sets can be scored at once.

Chance alone exceeds the threshold of the evidence with the probability `FALSE_ALARMS`. The threshold comes
from the same search in readings simulated without a missing effect.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.special import logsumexp

from bench.base.arrays import Floats, Ints
from bench.base.computing import tracked
from bench.base.files import write_whole
from bench.diagnosis.candidates import EQUAL, KIND_PRIOR, Candidates
from bench.diagnosis.levels import CHUNK, FARTHEST, OFTEN
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.noise_grid import RATIOS, ColumnProducts, NoiseGrid
from bench.model import CATALOGUE
from bench.model.effects import FormulaEffect

SIZES: Final = (1.0, 4.0, 20.0, 80.0)
"""Prior standard deviations of an effect, in plausible sizes: plausible, a few times larger, far larger, extreme.

Without the widest, the tail of the prior would decide between aliases that need different sizes.
"""
LOG_SIZE_WEIGHTS: Final = tuple(float(np.log(w)) for w in (0.6, 0.28, 0.1, 0.02))
"""ln of the prior probability of each of `SIZES`: larger effects are rarer."""
LOG_SIZE_WEIGHTS_OF_METER: Final = tuple(float(np.log(w)) for w in (0.61, 0.28, 0.1099, 1e-4))
"""The same for effects of the voltmeters, which are calibrated to some ppm, so that none is extreme."""

KNOWN_SIZE: Final = SIZES[-2]
"""Prior size, in plausible sizes, of an effect already in the model: so wide that data decide."""
BEYOND_BELIEF: Final = FARTHEST * KNOWN_SIZE
"""Largest credible size of an effect, in plausible sizes.

An effect that would have to be larger is no alias; an effect that shows only beyond this size is hidden.
"""


@dataclass(frozen=True)
class Data:
    """Scalar products of data sets r, whitened residuals of N rows, at each noise ratio.

    `square` (ratios, sets) is r^T r; `along` (ratios, P, sets) is A^T r for the P whitened columns A.
    """

    square: Floats
    along: Floats

    def part(self, of: slice) -> Data:
        """Return the products of only the data sets in the slice `of`."""
        return Data(self.square[:, of], self.along[:, :, of])


@dataclass(frozen=True)
class Whitened:
    """The candidates at each ratio of a noise `grid`, by the scalar `products` of their whitened columns.

    `kept` is a cache of scores, `searches` one of searches by their known columns.
    """

    grid: NoiseGrid
    candidates: Candidates
    products: ColumnProducts
    kept: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)
    searches: dict[tuple[int, ...], Search] = field(default_factory=dict, compare=False, repr=False)

    @classmethod
    def of(cls, grid: NoiseGrid, candidates: Candidates) -> Whitened:
        """Return the candidates with the scalar products of their whitened columns."""
        return cls(grid, candidates, grid.products(candidates.columns))

    def forget(self) -> None:
        """Clear the caches, which refer to this object and would keep its memory in use."""
        self.kept.clear()
        self.searches.clear()

    def among(self, ratio: int, columns: Sequence[int]) -> Floats:
        """Return the Gram matrix (k, k) of the k `columns` at the noise ratio with the index `ratio`."""
        at = slice(ratio, ratio + 1)
        return np.asarray(self.products.among(np.array(columns, dtype=np.int64), at)[0])

    @cached_property
    def log_weights(self) -> Floats:
        """ln of the prior probability of each of `SIZES` for each variant, (sizes, variants)."""
        of_meter, others = (np.array(one)[:, None] for one in (LOG_SIZE_WEIGHTS_OF_METER, LOG_SIZE_WEIGHTS))
        return np.where(self.candidates.of_meter, of_meter, others)

    @cached_property
    def blocks(self) -> tuple[tuple[Ints, Ints, Floats], ...]:
        """Groups of variants with p columns: indices (v,), columns (v, p), Gram matrices (ratios, v, p, p)."""
        groups = []
        for members, columns in self.candidates.by_size:
            # at most some thousand columns at once, or those of many runs would take much memory
            parts = np.array_split(columns, 1 + columns.size // CHUNK**2)
            grams = np.concatenate([self.products.among(part) for part in parts], axis=1)
            groups.append((members, columns, grams))
        return tuple(groups)

    def reduce(self, response: Floats) -> Data:
        """Return the products of the columns with the residuals `response` (N, sets), in the unit of the signal."""
        sets, sigma, white = response.shape[1], self.grid.sigma, self.grid.white
        square = np.empty((len(white), sets))
        along = np.empty((len(white), self.candidates.columns.shape[1], sets))
        for start in range(0, sets, CHUNK):
            part = slice(start, start + CHUNK)
            residual = response[:, part] / sigma
            weighed = np.stack([one.weigh(residual) for one in white], axis=1)
            square[:, part] = np.einsum("ns,nrs->rs", residual, weighed)
            whole = self.candidates.columns.T @ (weighed / sigma).reshape(len(residual), -1)
            along[:, :, part] = np.swapaxes(whole.reshape(-1, *weighed.shape[1:]), 0, 1)
        return Data(square, along)


@dataclass(frozen=True)
class Group:
    """The variants with p columns, from whose Gram matrices the known columns are projected out.

    `vectors` (ratios, v, p, p) and `values` (ratios, v, p) are the eigenvectors and eigenvalues of these matrices.
    `members` (v,) and `columns` (v, p) are indices of variants and columns.
    """

    members: Ints
    columns: Ints
    vectors: Floats
    values: Floats

    def squares(self, left: Data) -> Floats:
        """Return the squared projections of the data on the eigenvectors, shape (ratios, variants, p, sets)."""
        along = left.along[:, self.columns]
        return np.asarray(
            (along if self.columns.shape[1] == 1 else np.swapaxes(self.vectors, 2, 3) @ along) ** 2
        )


@dataclass(frozen=True)
class Search:
    """A search over all variants for what is missing in a model that contains the columns `known`.

    `inverse` (ratios, k, k) is the inverse Cholesky factor of the Gram matrix of the k known columns with
    their prior (`KNOWN_SIZE`); `half` (ratios, k, P) is `inverse` times their scalar products with all P
    columns. `log_det` (ratios,) is the part of ln of the evidence that depends only on the known columns.
    """

    whitened: Whitened
    known: tuple[int, ...]
    inverse: Floats
    half: Floats
    log_det: Floats

    @classmethod
    def beside(cls, whitened: Whitened, known: Sequence[int]) -> Search:
        """Return the search for effects that a model with the columns `known` (indices) lacks."""
        key = tuple(sorted(known))
        search = whitened.searches[key] = whitened.searches.get(key) or cls._beside(whitened, key)
        return search

    @classmethod
    def _beside(cls, whitened: Whitened, known: tuple[int, ...]) -> Search:
        h = np.array(known, dtype=np.int64)
        across = whitened.products.across(h)
        inverse = np.linalg.inv(np.linalg.cholesky(across[:, :, h] + np.eye(len(h)) / KNOWN_SIZE**2))
        log_det = np.sum(np.log(np.diagonal(inverse, axis1=1, axis2=2) / KNOWN_SIZE), axis=1)
        return cls(whitened, known, inverse, inverse @ across, log_det)

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """The variants that contain none of the known columns, grouped by their number of columns."""
        taken = np.zeros(self.whitened.candidates.columns.shape[1], dtype=bool)
        taken[list(self.known)] = True
        for equal, own in self.whitened.candidates.equal if self.known else ():
            taken[list(equal)] |= taken[list(own)].any()
        groups = []
        for members, columns, blocks in self.whitened.blocks:
            free = ~taken[columns].any(axis=1)
            if free.any():
                groups.append(self._group(members[free], columns[free], blocks[:, free]))
        return tuple(groups)

    def _group(self, members: Ints, columns: Ints, blocks: Floats) -> Group:
        if self.half.shape[1]:
            seen = np.moveaxis(self.half[:, :, columns], 1, 2)
            blocks = blocks - np.swapaxes(seen, 2, 3) @ seen
        values, vectors = _eigen(blocks)
        return Group(members, columns, vectors, np.maximum(values, 0.0))

    def between(self, ratio: int, columns: Sequence[int]) -> Floats:
        """Return the Gram matrix (k, k) of the `columns` at a noise ratio, the known columns projected out."""
        seen = self.half[ratio][:, list(columns)]
        return np.asarray(self.whitened.among(ratio, columns) - seen.T @ seen)

    def along(self, ratio: int, columns: Sequence[int], sizes: Floats) -> Floats:
        """Return the scalar products (P,) of all columns with the sum of `columns` times their `sizes` (k,).

        `columns` are indices. The known columns are projected out; `ratio` is the index of the noise ratio.
        """
        chosen = np.array(columns, dtype=np.int64)
        across = sizes @ self.whitened.products.across(chosen, slice(ratio, ratio + 1))[0]
        return np.asarray(across - (self.half[ratio][:, chosen] @ sizes) @ self.half[ratio])

    def left_over(self, data: Data) -> Data:
        """Return the scalar products of the data sets after the known columns are fitted and subtracted."""
        if not self.known:
            return data
        fitted = self.inverse @ data.along[:, list(self.known)]
        return Data(
            data.square - np.sum(fitted**2, axis=1), data.along - np.swapaxes(self.half, 1, 2) @ fitted
        )

    def log_evidence(self, data: Data) -> float:
        """Return ln of the evidence for the first data set, with the noise and the noise ratio integrated out."""
        square, grid = self.left_over(data).square[:, 0], self.whitened.grid
        return float(logsumexp(grid.log_prior + grid.log_det + self.log_det + grid.log_likelihood(square)))

    def score(self, data: Data) -> Scores:
        """Return ln of the Bayes factor of adding each variant to the model, for each data set."""
        left = self.left_over(data)
        begun = tracked(range(0, left.square.shape[1], CHUNK), "what chance alone would show")
        parts = [self._score(left.part(slice(i, i + CHUNK))) for i in begun]
        return Scores(
            np.concatenate([p.variants for p in parts], axis=1),
            np.concatenate([p.ratio for p in parts], axis=1),
        )

    def _score(self, left: Data) -> Scores:
        grid = self.whitened.grid
        base, log_weights = grid.log_prior + grid.log_det + self.log_det, self.whitened.log_weights
        of_null = base[:, None] + grid.log_likelihood(left.square)
        null = _log_sum(of_null.copy())
        # a variant with a column that the model already has
        out = np.full(
            (len(self.whitened.candidates.variants), left.square.shape[1]), np.finfo(np.float64).min
        )
        for group in self.groups:
            squares = group.squares(left)
            # in place: a new array for each step would take as long as the logarithms
            logs = np.empty((len(SIZES), *squares.shape[:2], squares.shape[3]))
            for rest, size, log_weight in zip(logs, SIZES, log_weights[:, group.members], strict=True):
                weight = 1.0 / (group.values + 1.0 / size**2)
                np.matmul(weight[:, :, None], squares, out=rest[:, :, None])
                np.subtract(left.square[:, None], rest, out=rest)
                np.maximum(rest, 1e-12 * left.square[:, None], out=rest)
                grid.log_likelihood(rest, out=rest)
                cost = 0.5 * np.sum(np.log1p(size**2 * group.values), axis=2)
                np.add(rest, (base[:, None] + log_weight - cost)[:, :, None], out=rest)
            out[group.members] = _log_sum(logs.reshape(-1, *logs.shape[2:]))
        return Scores(out - null, np.exp(of_null - null))


@dataclass(frozen=True)
class Scores:
    """The scores of all variants in each data set.

    `variants` (variants, sets) is ln of the Bayes factor; `ratio` (ratios, sets) the probability of each
    ratio.
    """

    variants: Floats
    ratio: Floats

    def families(self, candidates: Candidates) -> Floats:
        """Return ln of the Bayes factor of each family, a mean over forms, shape (families, sets)."""
        ordered = self.variants[candidates.by_family]
        starts = candidates.family_starts
        counts = np.diff([*starts, len(ordered)])
        largest = np.maximum.reduceat(ordered, starts, axis=0)
        share = candidates.share[candidates.by_family, None]
        parts = share * np.exp(ordered - np.repeat(largest, counts, axis=0))
        mean: Floats = largest + np.log(np.add.reduceat(parts, starts, axis=0))
        return mean


def _eigen(matrices: Floats) -> tuple[Floats, Floats]:
    """Return eigenvalues (…, p), ascending, and eigenvectors (…, p, p) of symmetric matrices (…, p, p).

    For p = 2 they follow from the angle of the larger principal axis, as `eigh` is slow for many small matrices.
    """
    size = matrices.shape[-1]
    if size == 1:
        return matrices[..., 0], np.ones_like(matrices)
    if size > 2:
        return np.linalg.eigh(matrices)
    first, across, second = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]
    mean, half = (first + second) / 2.0, (first - second) / 2.0
    radius, angle = np.hypot(half, across), np.arctan2(across, half) / 2.0
    turn = np.array([[-np.sin(angle), np.cos(angle)], [np.cos(angle), np.sin(angle)]])
    return np.stack([mean - radius, mean + radius], axis=-1), np.moveaxis(turn, (0, 1), (-1, -2))


def _log_sum(logarithms: Floats) -> Floats:
    """Return ln of the sum of exponentials of finite numbers along the first axis; the numbers are overwritten."""
    largest = logarithms.max(axis=0)
    logarithms -= largest
    total: Floats = largest + np.log(np.exp(logarithms, out=logarithms).sum(axis=0))
    return total


# --- the threshold --------------------------------------------------------------------------------


NULLS: Final = 1000
"""Number of simulated data sets for a threshold: the fraction `OFTEN`, 50, determines the tail to 14 %."""
SEED: Final = 20260
FALSE_ALARMS: Final = 0.006
"""Probability of a false alarm: the search finds an effect although the model is complete.

It is below `BY_CHANCE`, as the choice of the noise adds a few alarms.
"""


@dataclass(frozen=True)
class Threshold:
    """The threshold `value` of the evidence for a missing effect; chance exceeds it with `probability`.

    The evidence is ln of the odds that an effect is missing. If none is, it exceeds `start` plus x with probability
    `p_start` exp(-x / `decay`). This tail was fitted to `nulls` simulated data sets.
    """

    value: float
    probability: float
    start: float
    p_start: float
    decay: float
    nulls: int

    def at(self, probability: float) -> Threshold:
        """Return the threshold that chance exceeds with another `probability`."""
        value = self.start + self.decay * float(np.log(self.p_start / probability))
        return replace(self, value=value, probability=probability)

    def p(self, evidence: float) -> float:
        """Return the p-value of this `evidence`, over all candidates; 1 if it is not above `start`."""
        if evidence <= self.start:
            return 1.0
        return min(float(self.p_start * np.exp(-(evidence - self.start) / self.decay)), 1.0)


def total_evidence(scores: Scores, whitened: Whitened) -> Floats:
    """Return ln of the odds that any effect is missing, shape (sets,): a sum over families with their priors."""
    families = scores.families(whitened.candidates) + whitened.candidates.log_prior[:, None]
    return np.asarray(logsumexp(families, axis=0), dtype=np.float64)


def null_responses(linear: LinearSystem, sigma: float, ratios: Floats, rng: np.random.Generator) -> Floats:
    """Return residuals (N, sets), unit of the signal, simulated without a missing effect.

    `sigma` is the noise of a reading in this unit; `ratios` (sets,) is the noise ratio of each data set.
    """
    sets = len(ratios)
    setting = rng.standard_normal((linear.settings, sets)) * ratios / linear.typical_slope
    response = rng.standard_normal((len(linear), sets)) * linear.relative[:, None]
    response += np.where(linear.setting >= 0, linear.slope, 0.0)[:, None] * setting[linear.setting]
    response *= sigma
    if linear.random.shape[1]:
        response += linear.random @ rng.standard_normal((linear.random.shape[1], sets))
    return response


def make_threshold(linear: LinearSystem, whitened: Whitened, nulls: int = NULLS) -> Threshold:
    """Return the evidence threshold for a missing effect, from simulated data sets without a missing effect.

    `nulls` is the number of data sets; the noise ratio of each is drawn from its prior.
    """
    rng = np.random.default_rng(SEED)
    grid = whitened.grid
    ratios = rng.choice(np.array(RATIOS), nulls, p=np.exp(grid.log_prior))
    search = Search.beside(whitened, ())
    data = whitened.reduce(null_responses(linear, grid.sigma, ratios, rng))
    return fit_tail(total_evidence(search.score(data), whitened))


def fit_tail(evidence: Floats) -> Threshold:
    """Return the threshold that the `evidence` (sets,) exceeds with probability `FALSE_ALARMS`.

    The evidence is of data sets simulated without a missing effect. An exponential is fitted to the fraction
    `OFTEN` with the largest evidence; its quantile has a smaller variance than the empirical quantile.
    """
    ordered = np.sort(evidence)
    many = max(int(OFTEN * len(ordered)), 10)
    start = float(ordered[-many - 1])
    decay = float(np.mean(ordered[-many:] - start))
    p_start = many / len(ordered)
    return Threshold(start, p_start, start, p_start, decay, len(ordered)).at(FALSE_ALARMS)


@dataclass(frozen=True)
class ThresholdCache:
    """A cache of simulated thresholds: a small JSON file for each design in `folder` (None: no cache).

    The name of a file is a hash of all that its threshold depends on. These are angles (rounded to 1 arcmin), times
    (10 s), temperatures (0.01 K), directions, mountings, passes, stand, block, noise (10 %), catalogue and priors.
    """

    folder: Path | None

    def threshold(self, linear: LinearSystem, whitened: Whitened, setting_rad: float) -> Threshold:
        """Return the threshold from the cache, or simulate and store it.

        `setting_rad` is the setting error of the bench file. A cache that cannot be written is ignored.
        """
        if self.folder is None:
            return make_threshold(linear, whitened)
        file = self.folder / f"{_key(linear, whitened, setting_rad)}.json"
        try:
            return Threshold(**json.loads(file.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError, KeyError, RecursionError):
            made = make_threshold(linear, whitened)
        with suppress(OSError):  # the cache saves time and nothing else
            self.folder.mkdir(parents=True, exist_ok=True)
            write_whole(file, json.dumps(asdict(made)))
        return made


def _key(linear: LinearSystem, whitened: Whitened, setting_rad: float) -> str:
    readings = linear.readings
    scale = np.abs(np.diag(linear.block.K)).mean()
    parts: list[object] = [
        readings.unit,
        readings.installation.tolist(),
        readings.series.tolist(),
        readings.pass_number.tolist(),
        readings.point.tolist(),
        readings.direction.tolist(),
        np.round(np.degrees(readings.angle_rad) * 60).tolist(),
        np.round(readings.time_s / 10).tolist(),
        np.round(readings.temperature_c, 2).tolist(),
        {name: cells.tolist() for name, cells in readings.extra.items() if name in DESIGN_COLUMNS},
        np.round(linear.conditions.above_nominal_v, 2).tolist(),
        {k: np.round(v.block_from_platform, 2).tolist() for k, v in linear.model.installations.items()},
        [(a.effect.name, a.channels, a.installations, sorted(a.values)) for a in linear.model.effects],
        np.round(linear.block.K / scale, 2).tolist(),
        np.round(linear.block.U0 / scale, 2).tolist(),
        round(float(np.log(scale)) * 50),
        round(float(np.log(whitened.grid.sigma / scale)) * 10),
        round(setting_rad * 1e9),
        np.round(np.linalg.norm(linear.random, axis=0) / scale, 6).tolist(),
        repr([(name, effect.parameters) for name, effect in CATALOGUE.items()]),
        whitened.candidates.families,
        (NULLS, SEED, FALSE_ALARMS, KIND_PRIOR, OFTEN, SIZES, RATIOS, 0.1),
        (LOG_SIZE_WEIGHTS, LOG_SIZE_WEIGHTS_OF_METER, EQUAL),
        [0, 0, 0],  # sizes of channels: the files of a version that distinguished them stay valid
    ]
    if readings.run.any():
        parts += [readings.run.tolist(), None if readings.block is None else readings.block.tolist()]
    parts += formulas()
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


DESIGN_COLUMNS: Final = ("scan_order", "reference_v", "range_v", "mounting_number")


def formulas() -> list[str]:
    """Return name, stage and formula of each effect defined by a formula, on which a threshold depends."""
    return [
        f"{effect.name}, {effect.stage} {effect.adds_to}: {effect.expression}"
        for effect in CATALOGUE.values()
        if isinstance(effect, FormulaEffect)
    ]
