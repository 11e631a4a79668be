"""A model of units measured over years on several benches: scatter, benches, drift rates and random walks.

value = level of the unit + bench effect + rate of the unit x time + random walk + scatter + error of stated u, all
normal and independent. Only contrasts within units count. The variances maximise the restricted likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy import optimize, special

from bench.base.arrays import Floats, Ints
from bench.stats.reml import ONE_SIDED, Profile, profile_of

BENCH, SCATTER, RATE, WALK = 0, 1, 2, 3
STEADY: Final = (BENCH, SCATTER)
SHOWN_P: Final = 0.05
"""P-value below which a drift of units counts as significant; only then is it separated from the scatter."""
LONGEST: Final = (128, 64, 32, 16)
"""Candidates for the largest number of runs used per unit; the first within `MOST_WORK` is used."""
MOST_WORK: Final = 5e7
"""Largest sum, over units, of the cubed number of runs; a likelihood then takes about a tenth of a second."""
LEAST_PART: Final = 1e-6
"""A variance below this part of its scale counts as zero."""


@dataclass(frozen=True)
class SameLength:
    """The m units with n runs each, which have r = n - 1 contrasts.

    `rows` (m, n) are the rows of the units' runs in the table, in order of time. `contrast` (r, n) is the contrast
    matrix. `time` (m, r) are the contrasts of the times; `walk` (m, r, r) is the covariance of the contrasts of a
    random walk of unit variance in a year; `bench` (m, r, B) are the contrasts of the bench indicators.
    """

    rows: Ints
    contrast: Floats
    time: Floats
    walk: Floats
    bench: Floats


@dataclass(frozen=True)
class Histories:
    """The design of contrasts within units, in groups `alike` of units with equal numbers of runs.

    `runs` (U,) are the numbers of runs of each unit, `benches` is the number of benches. At most `longest` runs
    of a unit are used.
    """

    alike: tuple[SameLength, ...]
    runs: Ints
    benches: int
    longest: int

    @property
    def dof(self) -> int:
        """Total number of contrasts."""
        return sum(len(one.rows) * len(one.contrast) for one in self.alike)


def histories(unit: Ints, bench: Ints, years: Floats) -> Histories:
    """Return the design for n runs: unit and bench numbers (n,), from 0; times `years` (n,) of any origin."""
    order = np.lexsort((years, unit))
    runs = np.bincount(unit)
    start = np.cumsum(runs) - runs
    light = [size for size in LONGEST if np.sum(np.minimum(runs, size).astype(float) ** 3) <= MOST_WORK]
    longest = light[0] if light else LONGEST[-1]
    benches = int(bench.max()) + 1
    found = []
    for many in np.unique(runs[runs > 1]):
        kept = np.unique(np.linspace(0, many - 1, min(many, longest)).round().astype(np.int64))
        rows = order[start[runs == many][:, None] + kept]
        n = len(kept)
        contrast = np.linalg.qr(np.eye(n) - 1.0 / n)[0][:, : n - 1].T
        time = years[rows] - years[rows][:, :1]
        walked = np.minimum(time[:, :, None], time[:, None, :])
        found.append(
            SameLength(
                rows, contrast, time @ contrast.T, contrast @ walked @ contrast.T,
                contrast @ np.eye(benches)[bench[rows]],
            )
        )  # fmt: skip
    return Histories(tuple(found), runs, benches, longest)


@dataclass(frozen=True)
class HistoryLikelihood:
    """The restricted log likelihood, up to a constant, at variances (4,) of benches, scatter, rates and walks.

    `slope` (4,) is its gradient, `information` (4, 4) the average information.
    """

    variances: Floats
    likelihood: float
    slope: Floats
    information: Floats


Weighed = tuple[SameLength, Floats, Floats, Floats]
"""For units of equal length: units, contrasts X of values and benches, inverse covariance W of X, and W X."""


@dataclass(frozen=True)
class Within:
    """The values `y` (n,) of one coefficient, their stated variances (n,), and the design of contrasts."""

    of: Histories
    y: Floats
    variance: Floats

    @cached_property
    def _data(self) -> list[tuple[SameLength, Floats, Floats]]:
        """For each number of runs: units, contrasts (m, r, 1 + B) of values and benches, and covariance (m, r, r).

        The covariance is the stated covariance of the contrasts of values.
        """
        y = self.y - np.median(self.y)
        return [
            (
                one,
                np.concatenate([(y[one.rows] @ one.contrast.T)[..., None], one.bench], axis=2),
                np.einsum(
                    "rn,mn,sn->mrs", one.contrast, self.variance[one.rows], one.contrast, optimize=True
                ),
            )
            for one in self.of.alike
        ]

    @cached_property
    def scales(self) -> Floats:
        """Start values (4,) of the variances of benches, scatter, rates and walks."""
        dof = self.of.dof
        square = sum(float(np.sum(seen[..., 0] ** 2)) for _, seen, _ in self._data) / dof
        square = max(square, float(np.median(self.variance)))
        time = sum(float(np.sum(one.time**2)) for one, _, _ in self._data) / dof
        walk = sum(float(np.einsum("mrr->", one.walk)) for one, _, _ in self._data) / dof
        return np.array([square, square, square / max(time, 1e-12), square / max(walk, 1e-12)])

    def at(self, variances: Floats) -> HistoryLikelihood:
        """Return the likelihood, its gradient and the information at variances (4,)."""
        likelihood, kept, G, h, X = self._solved(variances)
        return HistoryLikelihood(variances, likelihood, *_gradient_and_information(kept, G, h, X))

    def likelihood(self, variances: Floats) -> float:
        """Return the restricted log likelihood at variances (4,), up to a constant."""
        return self._solved(variances)[0]

    def _solved(self, variances: Floats) -> tuple[float, list[Weighed], Floats, Floats, Floats]:
        bench, scatter, rate, walk = variances
        size = self.of.benches
        sums, logs = np.zeros((size + 1, size + 1)), 0.0
        kept = []
        for one, seen, stated in self._data:
            r = len(one.contrast)
            V = (
                stated
                + scatter * np.eye(r)
                + walk * one.walk
                + rate * one.time[:, :, None] * one.time[:, None, :]
            )
            weight = np.linalg.inv(V)
            logs += float(np.sum(np.linalg.slogdet(V)[1]))
            weighed = weight @ seen
            sums += _summed_products(seen, weighed)
            kept.append((one, seen, weight, weighed))
        G, h = sums[1:, 1:], sums[1:, 0]
        A = np.eye(size) + bench * G
        X = bench * np.linalg.inv(A)
        likelihood = -0.5 * (logs + float(np.linalg.slogdet(A)[1]) + float(sums[0, 0]) - float(h @ X @ h))
        return likelihood, kept, G, h, X

    def fit(self, kept: Sequence[int], scatter: float = 0.0) -> HistoryLikelihood:
        """Return the maximum of the likelihood over the variances whose indices are in `kept`.

        The variance of the scatter, if not in `kept`, has the value `scatter`. All other variances are zero.
        """
        scale = self.scales
        places = list(kept)

        def full(parts: Floats) -> Floats:
            variances = np.array([0.0, scatter, 0.0, 0.0])
            variances[places] = scale[places] * parts
            return variances

        def cost(parts: Floats) -> tuple[float, Floats]:
            point = self.at(full(parts))
            return -point.likelihood, -point.slope[places] * scale[places]

        found = optimize.minimize(
            cost, np.full(len(places), 0.25), jac=True, method="L-BFGS-B", bounds=[(0.0, None)] * len(places),
            options={"ftol": 1e-9, "gtol": 1e-3},
        )  # fmt: skip
        return self.at(full(np.where(found.x < LEAST_PART, 0.0, found.x)))

    def profile(self, best: HistoryLikelihood, which: int, free: Sequence[int]) -> Profile:
        """Return the profile over the square root of variance `which`, from the maximum `best`.

        `free` are the indices of the variances that were estimated.
        """
        return profile_of(
            self.likelihood, best.variances, best.information, which, free, float(np.sqrt(self.scales[which]))
        )


def _summed_products(a: Floats, b: Floats) -> Floats:
    """Return the sums over units and contrasts of the products of `a` (m, r, i) and `b` (m, r, j), (i, j)."""
    return np.asarray(a.reshape(-1, a.shape[2]).T @ b.reshape(-1, b.shape[2]))


def _gradient_and_information(
    kept: Sequence[Weighed], G: Floats, h: Floats, X: Floats
) -> tuple[Floats, Floats]:
    """Return gradient (4,) and average information (4, 4) by the variances, from the results of `_solved`."""
    size = len(h)
    traces, squares = np.zeros(4), np.zeros(4)
    inner, across = np.zeros((4, 4)), np.zeros((4, size))
    traces[BENCH] = float(np.trace(G - G @ X @ G))
    left = h - G @ (X @ h)
    squares[BENCH] = float(left @ left)
    for one, seen, weight, weighed in kept:
        z = weighed[..., 1:]
        p = weighed[..., 0] - z @ (X @ h)
        walked = (one.walk @ p[..., None])[..., 0]
        along = np.sum(one.time * p, axis=1)
        moved = np.stack([seen[..., 1:] @ left, p, one.time * along[:, None], walked], axis=-1)
        squares[1:] += np.sum(p**2), np.sum(along**2), np.sum(p * walked)
        rates = (one.time[:, None, :] @ z)[:, 0, :]
        traces[SCATTER] += np.einsum("mrr->", weight) - np.sum(X * _summed_products(z, z))
        traces[RATE] += np.sum(one.time * (weight @ one.time[..., None])[..., 0])
        traces[RATE] -= np.sum(X * (rates.T @ rates))
        traces[WALK] += np.sum(weight * one.walk)
        traces[WALK] -= np.sum(X * _summed_products(z, one.walk @ z))
        weighed_moves = weight @ moved
        inner += _summed_products(moved, weighed_moves)
        across += _summed_products(moved, z)
    return 0.5 * (squares - traces), 0.5 * (inner - across @ X @ across.T)


@dataclass(frozen=True)
class CalibrationSpread:
    """The scatter of a laboratory's calibrations without the units' own drift, as standard deviations.

    `scatter` is the scatter in excess of the stated u: the root mean square of its possible values, weighted by
    their likelihood. It is therefore larger for few calibrations. `scatter_least` and `scatter_most` are its 90 %
    limits. `bench` is the maximum-likelihood standard deviation between benches, `bench_most` its upper 95 %
    limit; both are NaN for a single bench. `rate` (per year) and `walk` (over a year) are the standard
    deviations of the units' drifts, zero unless significant. `p` is the p-value of the hypothesis that units
    do not drift.
    """

    scatter: float
    scatter_least: float
    scatter_most: float
    bench: float
    bench_most: float
    rate: float
    walk: float
    p: float

    @property
    def shown(self) -> bool:
        """Whether the drift of the units is significant."""
        return self.p < SHOWN_P


def spread_of(within: Within, *, several: bool, drifts: bool = True) -> CalibrationSpread:
    """Return the scatter without the drift of units and, for `several` benches, the spread between benches.

    A rate or walk that is not significant counts as scatter. Without `drifts`, as for units with too few runs,
    any drift counts as scatter.
    """
    first = STEADY if several else (SCATTER,)
    steady = within.fit(first)
    moving = within.fit((*first, RATE, WALK)) if drifts else steady
    gained = _gained(moving, steady)
    # two variances at their bound zero: mixture of chi-square with 0, 1, 2 degrees of freedom (1/4, 1/2, 1/4)
    p = 0.5 * float(special.chdtrc(1, gained)) + 0.25 * float(special.chdtrc(2, gained)) if gained else 1.0
    chosen, free = (moving, (*first, RATE, WALK)) if p < SHOWN_P else (steady, first)
    for kept in (RATE, WALK) if p < SHOWN_P else ():
        simpler = within.fit((*first, kept))
        if 0.5 * special.chdtrc(1, _gained(moving, simpler)) >= SHOWN_P:
            chosen, free = simpler, (*first, kept)
            break
    spread = within.profile(chosen, SCATTER, free)
    mean = spread.mean()
    bench_most = within.profile(chosen, BENCH, free).most() if several else float("nan")
    sizes = np.sqrt(chosen.variances)
    return CalibrationSpread(
        mean, _least(within, moving, first, mean), spread.most(), float(sizes[BENCH]) if several else float("nan"),
        bench_most, float(sizes[RATE]), float(sizes[WALK]), p,
    )  # fmt: skip


def _gained(more: HistoryLikelihood, fewer: HistoryLikelihood) -> float:
    return 2.0 * max(0.0, more.likelihood - fewer.likelihood)


def _least(within: Within, moving: HistoryLikelihood, first: Sequence[int], mean: float) -> float:
    """Return the lower 95 % limit of scatter by profile likelihood, at most `mean`; 0 if insignificant."""
    others = [j for j in (*first, RATE, WALK) if j != SCATTER]
    end = float(np.sqrt(moving.variances[SCATTER]))

    def lacking(size: float) -> float:
        return moving.likelihood - within.fit(others, scatter=size**2).likelihood - ONE_SIDED

    if end <= 0.0 or lacking(0.0) <= 0.0:
        return 0.0
    return min(mean, float(optimize.brentq(lacking, 0.0, end, xtol=0.02 * end)))
