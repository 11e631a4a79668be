"""The noise of a record at a known input: white and slow noise, and scalar products for each trial noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy import linalg, special

from bench.base.arrays import Floats, Ints
from bench.diagnosis.evidence import LOG_SIZE_WEIGHTS, SIZES
from bench.diagnosis.levels import NEGLIGIBLE, OFTEN
from bench.diagnosis.record_model import Record

RATIOS: Final = (0.0, *np.geomspace(1e-2, 1e5, 11).tolist())
"""Trial ratios of the slow noise's mean variance to the white noise's variance, a factor of five apart."""
CORRELATED: Final = (0.005, 0.02, 0.06)
"""Correlation times of the exponentially correlated noises, as fractions of the length of the record.

They are a factor of about three apart; longer ones resemble flicker noise.
"""
WEIGHTS: Final = (30.0, 3.0, 600.0)
"""Prior weights of a random walk and of one of the gain, at each of `RATIOS`, and of white noise alone.

Other slow noise has 1. After a fit of zero and drift, it resembles a walk, but adds less to u. With equal weights,
82 to 87 % of the drifts under a walk are within 2 u; with these, 93 %. A drift of the gain is not fitted. Walks of
all ratios together have about half the weight of white noise.
"""


def slow_kernels(time_h: Floats) -> Iterator[Floats]:
    """Yield the covariance (n, n), of mean variance 1, of each kind of slow noise at `time_h` (n,), h.

    The kinds are a random walk, flicker noise, and noise of exponential correlation with several time constants.
    The covariance of flicker noise is an integral of exponential covariances over ln of the time constant, from the
    mean step to the length of the record.
    """
    length = float(time_h[-1])
    apart = np.abs(time_h[:, None] - time_h)
    share = np.maximum(apart / length, NEGLIGIBLE)
    flicker = special.exp1(share) - special.exp1(share * len(time_h))
    short = [np.exp(-apart / (part * length)) for part in CORRELATED]
    for kernel in (np.minimum.outer(time_h, time_h), flicker, *short):
        yield kernel / np.mean(np.diag(kernel))


@dataclass(frozen=True)
class Noise:
    """White noise of `variance`, V², plus slow noise of one kind, over n means.

    Both are noises of the signals divided by their relative white noise. `slow` (n,) and `vectors` (n, n) are
    eigenvalues and eigenvectors of the slow noise's covariance; in the signals its mean variance is `ratio` times
    `variance`.
    """

    slow: Floats
    vectors: Floats
    ratio: float
    variance: float = 1.0

    @cached_property
    def sd(self) -> Floats:
        """Standard deviation (n,) of the noise along each of the `vectors`, V."""
        return np.asarray(np.sqrt(self.variance * (1.0 + self.ratio * self.slow)))

    @property
    def covariance(self) -> Floats:
        """The covariance matrix (n, n) of the noise, V²."""
        return np.asarray((self.vectors * self.sd**2) @ self.vectors.T)

    def whiten(self, columns: Floats) -> Floats:
        """Return the columns (n, m) as numbers with independent noise of variance 1."""
        return np.asarray((self.vectors.T @ columns) / self.sd[:, None])

    def drawn(self, rng: np.random.Generator, count: int) -> Floats:
        """Return `count` samples of the noise (n, count), V.

        The factor of the covariance is the symmetric root, as the signs of eigenvectors vary between machines.
        """
        drawn = self.vectors.T @ rng.standard_normal((len(self.slow), count))
        return np.asarray(self.vectors @ (self.sd[:, None] * drawn))

    @property
    def white(self) -> float:
        """Standard deviation of the white noise, V."""
        return float(np.sqrt(self.variance))


@dataclass(frozen=True)
class NoiseTrials:
    """The trial noises of a record: kinds of slow noise, each with several ratios to the white noise.

    `slow` has the eigenvalues (n,) and eigenvectors (n, n) of each kind. `trend` (n, 2 or 3) is that of the record,
    divided by the relative noise.
    """

    slow: tuple[tuple[Floats, Floats], ...]
    trend: Floats

    @classmethod
    def of(cls, record: Record) -> NoiseTrials:
        """Return the trial noises for the times of a record; its relative noise is that of white noise alone.

        With several levels, slow noise may also be one of the gain or of the reference, in proportion to the level.
        """
        kernels = list(slow_kernels(record.time_h))
        if record.several_levels:
            level = record.reference_v / np.sqrt(np.mean(record.reference_v**2))
            kernels += [kernel * np.outer(level, level) for kernel in kernels]
        found = (linalg.eigh(kernel / np.outer(record.scale, record.scale)) for kernel in kernels)
        slow = tuple((np.maximum(variance, 0.0), vectors) for variance, vectors in found)
        return cls(slow, record.trend / record.scale[:, None])

    @property
    def log_prior(self) -> Floats:
        """ln of the prior weight of each trial noise, shape (s,), in the order of `whitened`."""
        kinds = np.ones((len(self.slow), len(RATIOS) - 1))
        walks = kinds[:: 2 + len(CORRELATED)]
        walks.T[:] = WEIGHTS[: len(walks)]
        return np.asarray(np.log(np.append(WEIGHTS[-1], kinds)))

    def whitened(self, columns: Floats) -> Iterator[tuple[Noise, Floats]]:
        """Yield each trial noise (of white variance 1), and the columns (n, m) whitened by it."""
        for number, (variance, vectors) in enumerate(self.slow):
            turned = vectors.T @ columns
            for ratio in RATIOS:
                if number == 0 or ratio > 0.0:  # without slow noise all kinds are the same
                    noise = Noise(variance, vectors, ratio)
                    yield noise, turned / noise.sd[:, None]

    def products(
        self, known: Floats, columns: Floats, targets: Floats, starts: Floats | None = None
    ) -> Products:
        """Return the scalar products of `columns` (n, h) and `targets` (n, d) for each trial noise.

        The trend and the columns `known` (n, m) are projected out; `starts` (n, h) are the starting states of the
        columns (`start_of`).
        """
        fixed, h = self.trend.shape[1] + known.shape[1], columns.shape[1]
        starts = np.zeros_like(columns) if starts is None else starts
        begun = np.flatnonzero(np.any(starts, axis=0))
        every = np.column_stack([self.trend, known, columns, starts[:, begun], targets])
        each = []
        for noise, white in self.whitened(every):
            basis, upper = np.linalg.qr(white[:, :fixed])
            rest = white[:, fixed:] - basis @ (basis.T @ white[:, fixed:])
            own, start, data = np.split(rest, [h, h + len(begun)], axis=1)
            log_det = -float(np.sum(np.log(noise.sd)) + np.sum(np.log(np.abs(np.diag(upper)))))
            squares = [np.sum(of**2, axis=0) for of in (own, start, data)]
            between = (own.T @ data, start.T @ data, np.sum(own[:, begun] * start, axis=0))
            each.append((noise, log_det, *squares, *between))
        noises, *found = zip(*each, strict=True)
        return Products(noises, len(self.trend) - fixed, begun, *map(np.array, found))

    def averaged(self, design: Floats, targets: Floats) -> tuple[Floats, Floats, Noise]:
        """Return least-squares estimates (p, d), their covariance (p, p) for the first target, and the noise.

        `design` (n, p) begins with the trend; `targets` are (n, d). Estimates are averages over the trial noises,
        weighted by their probability with the first target. The covariance includes the variation of the estimates
        between these noises. The noise is the likeliest one.
        """
        count = design.shape[1]
        beside = design[:, self.trend.shape[1] :]
        beside = beside[:, np.any(beside, axis=0)]  # an effect without a lag has no starting state
        products = self.products(beside, np.zeros((len(design), 0)), targets[:, :1])
        weight = special.softmax(products.likelihood[:, 0] + self.log_prior)
        whitened = self.whitened(np.column_stack([design, targets]))
        solutions = [solved(white[:, :count], white[:, count:]) for _, white in whitened]
        means = np.array([mean for mean, _, _ in solutions])
        spreads = [
            spread * left / products.freedom
            for (_, spread, _), left in zip(solutions, products.left[:, 0], strict=True)
        ]
        mean = np.tensordot(weight, means, axes=1)
        off = means[:, :, 0] - mean[:, 0]
        spread = np.tensordot(weight, np.array(spreads) + off[:, :, None] * off[:, None, :], axes=1)
        return mean, spread, products.noise


@dataclass(frozen=True)
class Products:
    """Scalar products of h whitened columns and d targets, for each of s trial noises.

    `square` (s, h) and `left` (s, d) are squared lengths of columns and targets, `product` (s, h, d) their
    scalar products; `log_det` (s,) is the part of ln of the restricted likelihood without data. The columns
    `begun` (b,) have starting states: `start_square` (s, b) are the squared lengths of these, `start_product`
    (s, b, d) their products with targets, `across` (s, b) with their columns.
    """

    noises: tuple[Noise, ...]
    freedom: int
    begun: Ints
    log_det: Floats
    square: Floats
    start_square: Floats
    left: Floats
    product: Floats
    start_product: Floats
    across: Floats

    @property
    def likelihood(self) -> Floats:
        """ln of the restricted likelihood of each trial noise without any of the columns, shape (s, d)."""
        return np.asarray(self.log_det[:, None] - 0.5 * self.freedom * np.log(self.left))

    @property
    def sizes(self) -> tuple[Floats, Floats, Floats]:
        """ln of restricted likelihood, amplitude, and variance (h,) of each column in the first target.

        They are averages over the trial noises of one kind of slow noise. Of the kinds that the record does
        not exclude, it is the kind with the largest u, which covers the others. The prior u of a starting
        state is the amplitude of its column, as estimated with a free starting state.
        """
        freedom, each = self.freedom - 1, []
        for number in range(len(self.noises)):
            square, product, left, _ = self._beside_states(number)
            variance = (left - product**2 / square) / self.freedom
            prior = (product / square) ** 2 + variance / square
            square, product, left, cost = self._beside_states(number, variance / prior)
            size = product / square
            left = left - size * product
            log = self.log_det[number] - cost - 0.5 * (np.log(square) + freedom * np.log(left))
            each.append((log[:, 0], size[:, 0], (left / (freedom * square))[:, 0]))
        log, size, variance = (np.array(of) for of in zip(*each, strict=True))
        slow = [id(noise.slow) for noise in self.noises]
        kinds = [np.equal(slow, one) for one in dict.fromkeys(slow)]
        of_kind = np.array([special.logsumexp(log[kind]) for kind in kinds])
        likely = np.flatnonzero(of_kind > of_kind.max() + np.log(OFTEN))
        variances = [_mean(*(of[kinds[k]].ravel() for of in (log, size, variance)))[1] for k in likely]
        kind = kinds[likely[int(np.argmax(variances))]]
        return np.asarray(special.logsumexp(log[kind], axis=0)), *_mean(log[kind], size[kind], variance[kind])

    def _beside_states(
        self, number: int, ridge: Floats | None = None
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Return `square`, `product`, `left` (h, d) with starting states fitted, and ln of their cost.

        `ridge` (h, d) is the white variance over the prior variance of the state of each column; None: free.
        """
        b, product = self.begun, self.product[number].copy()
        square, left = np.empty_like(product), np.empty_like(product)
        square[:], left[:], cost = (
            np.maximum(self.square[number], 1e-300)[:, None],
            self.left[number],
            0.0 * product,
        )
        least = NEGLIGIBLE * square[b]
        prior = least if ridge is None else ridge[b]
        state, across = self.start_square[number][:, None] + prior, self.across[number][:, None]
        square[b] = np.maximum(square[b] - across**2 / state, least)
        product[b] -= across * self.start_product[number] / state
        left[b] -= self.start_product[number] ** 2 / state
        cost[b] = 0.5 * np.log(state / prior)
        return square, product, left, cost

    @property
    def noise(self) -> Noise:
        """The trial noise that is most probable for the first target, with its variance."""
        best = int(np.argmax(self.likelihood[:, 0]))
        return replace(self.noises[best], variance=float(self.left[best, 0]) / self.freedom)

    @property
    def gain(self) -> Floats:
        """ln of the Bayes factor (h, d) of adding each column, for each target, averaged over trial noises.

        The priors of amplitudes and starting states are mixtures of normal ones, of deviations `SIZES`.
        """
        total = np.full(self.product.shape[1:], -np.inf)
        for number, log_det in enumerate(self.log_det):
            square, product, left, _ = self._beside_states(number)
            variance = np.maximum(left - product**2 / square, 1e-300) / self.freedom
            for size, weight in zip(SIZES, LOG_SIZE_WEIGHTS, strict=True):
                square, product, left, cost = self._beside_states(number, variance / size**2)
                known = square * size**2 / variance
                rest = left - product**2 / square * known / (1.0 + known)
                log = weight + log_det - cost - 0.5 * (np.log1p(known) + self.freedom * np.log(rest))
                np.logaddexp(total, log, out=total)
        return np.asarray(total - special.logsumexp(self.likelihood, axis=0))


def _mean(log: Floats, size: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Return the mean of amplitudes over the first axis, with likelihoods exp(`log`), and its variance."""
    weight = special.softmax(log, axis=0)
    mean = np.sum(weight * size, axis=0)
    return mean, np.asarray(np.sum(weight * (variance + (size - mean) ** 2), axis=0))


def solved(columns: Floats, targets: Floats) -> tuple[Floats, Floats, float]:
    """Return least-squares estimates (m, …) of `targets` by whitened columns (n, m), covariance and chi-square."""
    spread = np.asarray(np.linalg.pinv(columns.T @ columns, hermitian=True), dtype=np.float64)
    mean = spread @ columns.T @ targets
    return mean, spread, float(np.sum((targets - columns @ mean) ** 2))
