"""Crossed random effects of units and benches on one coefficient of many calibrations.

value = mean of its group + unit effect + bench effect + excess scatter + calibration error of stated u, all
normal and independent. A group is a type of unit on a connected set of benches. The excess scatter differs
between calibrations. The "sizes" are the standard deviations of unit effects, bench effects and excess
scatter; they maximise the restricted likelihood.

There are many units and few benches. Units are eliminated one by one (Woodbury), which leaves a matrix of groups
and benches (Schur complement). So the work is proportional to the number of values.

Sources: S. R. Searle, G. Casella, C. E. McCulloch, Variance Components (1992), ch. 6 and 7 (equations, prediction);
A. R. Gilmour, R. Thompson, B. R. Cullis, Biometrics 51 (1995) 1440 (average information); R. N. Kackar, D. A.
Harville, J. Am. Stat. Assoc. 79 (1984) 853 (u of predictions with estimated sizes).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy import linalg, optimize, sparse
from scipy.sparse.csgraph import connected_components

from bench.base.arrays import Floats, Ints
from bench.stats.reml import profile_of

UNIT, BENCH, EXCESS = 0, 1, 2
LEAST_PART: Final = 1e-3
"""A size below this fraction of its scale (see `scales_of`) counts as zero."""
TRIED: Final = 0.1
"""A size below this fraction of its scale is set to zero, unless the likelihood falls by that."""


@dataclass(frozen=True)
class Crossing:
    """The design of n values: `unit` and `bench` (n,) are numbers from 0, `kind` (n,) is the unit's type."""

    unit: Ints
    bench: Ints
    kind: Ints

    @cached_property
    def units(self) -> int:
        """Number of units."""
        return int(self.unit.max()) + 1

    @cached_property
    def benches(self) -> int:
        """Number of benches."""
        return int(self.bench.max()) + 1

    @cached_property
    def cells(self) -> tuple[Ints, Ints, Ints]:
        """The cells, that is, the pairs of a unit and a bench that have values.

        Returns the cell of each value (n,), then the unit and the bench of each of the m cells (m,).
        """
        keys, cell = np.unique(self.unit * self.benches + self.bench, return_inverse=True)
        return cell, keys // self.benches, keys % self.benches

    @cached_property
    def pairs(self) -> tuple[Ints, Ints]:
        """Index pairs (k,) of different cells of the same unit, each pair once."""
        _, unit, _ = self.cells
        first, second = [], []
        start = np.searchsorted(unit, np.arange(self.units))
        size = np.diff([*start, len(unit)])
        for many in np.unique(size[size > 1]):
            i, j = np.triu_indices(many, 1)
            base = start[size == many][:, None]
            first.append((base + i).ravel())
            second.append((base + j).ravel())
        none = [np.zeros(0, dtype=np.int64)]
        return np.concatenate(first or none), np.concatenate(second or none)

    @cached_property
    def component(self) -> Ints:
        """The connected set of each bench (B,): units measured on two benches connect them."""
        _, unit, bench = self.cells
        ones = np.ones(len(unit))
        at = (np.concatenate([unit, self.units + bench]), np.concatenate([self.units + bench, unit]))
        size = self.units + self.benches
        graph = sparse.coo_array((np.concatenate([ones, ones]), at), shape=(size, size))
        _, label = connected_components(graph, directed=False)
        return np.unique(label[self.units :], return_inverse=True)[1].astype(np.int64)

    @cached_property
    def group(self) -> Ints:
        """The group of each unit (U,): units of one type on one connected set of benches form a group."""
        pair = self.kind * (int(self.component.max()) + 1) + self.component[self.bench]
        of_value = np.unique(pair, return_inverse=True)[1]
        group = np.zeros(self.units, dtype=np.int64)
        group[self.unit] = of_value
        return group

    @cached_property
    def groups(self) -> int:
        """Number of groups."""
        return int(self.group.max()) + 1

    @cached_property
    def repeated(self) -> int:
        """Degrees of freedom within units: the number of values beyond the first of each unit."""
        return len(self.unit) - self.units

    def alone(self) -> Ints:
        """Return the benches (k,) that share no unit with any other bench."""
        size = np.bincount(self.component)
        return np.flatnonzero(size[self.component] == 1)


@dataclass(frozen=True)
class MixedModelEquations:
    """The solved mixed model equations for T groups and B benches, with the units eliminated.

    `sizes` (3,) are standard deviations of unit effects, bench effects and excess scatter. `w` (n,) are
    weights; `W` (U,) is the sum of the weights of each unit. Elimination replaces w x by w (x - `s` sum(w
    x)), with the sum over one unit and `s` (U,). `lower` (T + B, T + B) is the Cholesky factor of the
    equations. The unknowns, `solution` (T + B,), are the means of groups, then the bench effects divided by
    their standard deviation. `likelihood` is the restricted log likelihood, up to a constant.
    """

    crossing: Crossing
    sizes: Floats
    w: Floats
    W: Floats
    s: Floats
    lower: Floats
    solution: Floats
    likelihood: float

    @property
    def bench(self) -> Floats:
        """Predicted effects of benches, (B,)."""
        return np.asarray(self.sizes[BENCH] * self.solution[self.crossing.groups :])

    @cached_property
    def bench_covariance(self) -> Floats:
        """Covariance (B, B) of the prediction errors of bench effects, for known standard deviations."""
        inverse = linalg.cho_solve((self.lower, True), np.eye(len(self.lower)))
        own = inverse[self.crossing.groups :, self.crossing.groups :]
        return np.asarray(self.sizes[BENCH] ** 2 * own)

    def unit(self, y: Floats) -> tuple[Floats, Floats]:
        """Return the predicted effects of units (U,) and the variances of the predictions, not of their errors."""
        fixed = self.solution[self.crossing.groups :] * self.sizes[BENCH]
        left = y - self.solution[self.crossing.group[self.crossing.unit]] - fixed[self.crossing.bench]
        sums = np.bincount(self.crossing.unit, self.w * left, self.crossing.units)
        variance = self.sizes[UNIT] ** 2
        part = variance / (1.0 + variance * self.W)
        # errors of group means and bench effects are neglected: they are small compared with a unit's own error
        return part * sums, variance - part

    def project(self, x: Floats) -> Floats:
        """Return P x (n, k) for x (n, k): V^-1 times the residual of x after a GLS fit of the means of groups."""
        own = self._without_units(x)
        crossing = self.crossing
        right = np.stack([_sums(crossing, column, self.sizes[BENCH]) for column in own.T], axis=1)
        solved = linalg.cho_solve((self.lower, True), right)
        at_group = solved[crossing.group[crossing.unit]]
        at_bench = self.sizes[BENCH] * solved[crossing.groups + crossing.bench]
        return np.asarray(own - self._without_units(at_group + at_bench))

    def _without_units(self, x: Floats) -> Floats:
        """Return V^-1 x for x (n, k), where V lacks the variance of benches."""
        crossing = self.crossing
        weighed = self.w[:, None] * x
        sums = np.stack([np.bincount(crossing.unit, c, crossing.units) for c in weighed.T], axis=1)
        return np.asarray(weighed - self.w[:, None] * (self.s[:, None] * sums)[crossing.unit])

    def information(self, y: Floats) -> Floats:
        """Return the average information (3, 3) of the variances of units, benches and excess scatter."""
        crossing = self.crossing
        py = self.project(y[:, None])[:, 0]
        moved = np.stack(
            [
                np.bincount(crossing.unit, py, crossing.units)[crossing.unit],
                np.bincount(crossing.bench, py, crossing.benches)[crossing.bench],
                py,
            ],
            axis=1,
        )
        return np.asarray(0.5 * moved.T @ self.project(moved))


def _sums(crossing: Crossing, weighed: Floats, size: float) -> Floats:
    """Return the sums of values (n,) by group, (T,), followed by `size` times their sums by bench, (B,)."""
    groups = np.bincount(crossing.group[crossing.unit], weighed, crossing.groups)
    return np.concatenate([groups, size * np.bincount(crossing.bench, weighed, crossing.benches)])


def solve(crossing: Crossing, y: Floats, variance: Floats, sizes: Floats) -> MixedModelEquations:
    """Solve the mixed model equations for values `y` (n,) with stated variances `variance` (n,).

    `sizes` (3,) are the standard deviations of unit effects, bench effects and excess scatter. An infinite
    one of units makes the unit effects fixed: only differences within units count.
    """
    w = 1.0 / (variance + sizes[EXCESS] ** 2)
    W = np.bincount(crossing.unit, w, crossing.units).astype(np.float64)
    mean = np.bincount(crossing.unit, w * y, crossing.units) / W
    fixed_units = bool(np.isinf(sizes[UNIT]))
    between = np.zeros_like(W) if fixed_units else W / (1.0 + sizes[UNIT] ** 2 * W)
    s = 1.0 / W - between / W**2
    cell, unit, bench = crossing.cells
    by_cell = np.bincount(cell, w, len(unit))
    T, B = crossing.groups, crossing.benches
    A = np.zeros((T + B, T + B))
    p, q = crossing.pairs
    crossed = np.bincount(bench[p] * B + bench[q], by_cell[p] * by_cell[q] * s[unit[p]], B * B).reshape(B, B)
    own = np.diag(np.bincount(bench, by_cell * (1.0 - s[unit] * by_cell), B)) - crossed - crossed.T
    A[T:, T:] = sizes[BENCH] ** 2 * own + np.eye(B)
    A[np.arange(T), np.arange(T)] = np.bincount(crossing.group, between, T) + fixed_units
    across = np.bincount(crossing.group[unit] * B + bench, by_cell * (between / W)[unit], T * B)
    A[:T, T:] = sizes[BENCH] * across.reshape(T, B)
    A[T:, :T] = A[:T, T:].T
    right = np.concatenate(
        [
            np.bincount(crossing.group, between * mean, T),
            sizes[BENCH]
            * (
                np.bincount(crossing.bench, w * (y - mean[crossing.unit]), B)
                + np.bincount(bench, by_cell * (between * mean / W)[unit], B)
            ),
        ]
    )
    lower = linalg.cholesky(A, lower=True, check_finite=False)
    solution = linalg.cho_solve((lower, True), right)
    within = float(np.sum(w * (y - mean[crossing.unit]) ** 2))
    misfit = within + float(np.sum(between * mean**2)) - float(right @ solution)
    logs = -float(np.sum(np.log(w))) + 2.0 * float(np.sum(np.log(np.diag(lower))))
    logs += float(np.sum(np.log(W if fixed_units else 1.0 + sizes[UNIT] ** 2 * W)))
    return MixedModelEquations(crossing, sizes, w, W, s, lower, solution, -0.5 * (logs + misfit))


@dataclass(frozen=True)
class Crossed:
    """The estimated standard deviations of unit effects, bench effects and excess scatter of one coefficient.

    `at` are the equations solved at these standard deviations. `y` (n,) are the values minus `centre`, `variance`
    (n,) their stated variances. `variance_covariance` (3, 3) is the covariance of the squares of the estimated
    standard deviations.
    """

    at: MixedModelEquations
    y: Floats
    variance: Floats
    variance_covariance: Floats
    centre: float

    @property
    def sizes(self) -> Floats:
        """Standard deviations (3,) of unit effects, bench effects and excess scatter."""
        return self.at.sizes

    @property
    def u_sizes(self) -> Floats:
        """Standard uncertainties (3,) of the estimated standard deviations; NaN for an estimate of zero."""
        u = np.sqrt(np.diag(self.variance_covariance))
        return np.where(self.sizes > 0, u / (2.0 * np.where(self.sizes > 0, self.sizes, 1.0)), np.nan)

    @cached_property
    def bench(self) -> tuple[Floats, Floats]:
        """Effects of benches (B,) about the mean of their connected set, and their covariance (B, B).

        The covariance includes the uncertainty of the estimated standard deviations.
        """
        crossing = self.at.crossing
        about = about_sets(crossing)
        own = self.at.bench_covariance
        slopes = np.zeros((crossing.benches, 3))
        for j in np.flatnonzero((self.sizes > 0) & np.isfinite(self.sizes)):
            step = 0.01 * self.sizes[j]
            ends = []
            for side in (1.0, -1.0):
                moved = self.sizes.copy()
                moved[j] += side * step
                ends.append(solve(crossing, self.y, self.variance, moved).bench)
            slopes[:, j] = (ends[0] - ends[1]) / (4.0 * self.sizes[j] * step)
        own = own + slopes @ self.variance_covariance @ slopes.T
        return about @ self.at.bench, about @ own @ about.T

    def unit(self) -> tuple[Floats, Floats]:
        """Return the predicted effects of units (U,), and each effect divided by its standard deviation."""
        effect, spread = self.at.unit(self.y)
        return effect, effect / np.sqrt(np.where(spread > 0, spread, np.inf))


def fit(
    crossing: Crossing,
    values: Floats,
    variance: Floats,
    *,
    without: int | None = None,
    units_fixed: bool = False,
) -> Crossed:
    """Return the standard deviations of greatest restricted likelihood for values (n,).

    `variance` (n,) are the stated variances of the values. `without` is the index of a standard deviation
    fixed at zero; None fixes none. With `units_fixed` that of units is infinite (see `solve`).
    """
    centre = float(np.median(values))
    y = values - centre
    scale = scales_of(crossing, y, variance)
    kept = [j for j in range(3) if j != without]

    def sized(parts: Floats) -> Floats:
        sizes = np.zeros(3)
        sizes[kept] = scale[kept] * parts
        if units_fixed:
            sizes[UNIT] = np.inf
        return sizes

    def cost(parts: Floats) -> float:
        return -solve(crossing, y, variance, sized(parts)).likelihood

    found = optimize.minimize(
        cost, np.full(len(kept), 0.5), method="L-BFGS-B", bounds=[(0.0, None)] * len(kept),
        options={"ftol": 1e-12, "gtol": 1e-6},
    )  # fmt: skip
    parts = found.x
    for j in np.flatnonzero(parts < TRIED):
        none = np.where(np.arange(len(parts)) == j, 0.0, parts)
        if parts[j] < LEAST_PART or cost(none) <= cost(parts):
            parts = none
    at = solve(crossing, y, variance, sized(parts))
    return Crossed(at, y, variance, _variance_covariance(at, y), centre)


def most(found: Crossed, which: int) -> float:
    """Return the upper 95 % limit of the standard deviation `which`, by the profile likelihood.

    `which` is `UNIT`, `BENCH` or `EXCESS`.
    """
    at = found.at
    fixed = np.isinf(found.sizes)

    def likelihood(variances: Floats) -> float:
        sizes = np.where(fixed, np.inf, np.sqrt(variances))
        return solve(at.crossing, found.y, found.variance, sizes).likelihood

    variances = np.where(fixed, 0.0, found.sizes) ** 2
    scale = float(scales_of(at.crossing, found.y, found.variance)[which])
    free = np.flatnonzero(~fixed).tolist()
    return profile_of(likelihood, variances, at.information(found.y), which, free, scale).most()


def scales_of(crossing: Crossing, y: Floats, variance: Floats) -> Floats:
    """Return rough standard deviations (3,) of units, benches and excess scatter from values `y` (n,).

    Benches and excess both get the standard deviation within units, but at least the median stated u.
    Unit effects get the standard deviation of unit means within groups, but at least a tenth of the former.
    """
    count = np.bincount(crossing.unit, minlength=crossing.units)
    mean = np.bincount(crossing.unit, y, crossing.units) / count
    kind = crossing.group
    middle = np.bincount(kind, mean, crossing.groups) / np.bincount(kind, minlength=crossing.groups)
    within = np.sqrt(np.sum((y - mean[crossing.unit]) ** 2) / max(crossing.repeated, 1))
    within = max(within, float(np.sqrt(np.median(variance))))
    between = np.sqrt(np.mean((mean - middle[kind]) ** 2))
    return np.array([max(between, 0.1 * within), within, within])


def _variance_covariance(at: MixedModelEquations, y: Floats) -> Floats:
    """Return the covariance (3, 3) of the estimated variances of units, benches and excess.

    It is zero for a variance that is zero or infinite.
    """
    free = np.flatnonzero((at.sizes > 0) & np.isfinite(at.sizes))
    covariance = np.zeros((3, 3))
    if len(free):
        information = at.information(y)[np.ix_(free, free)]
        covariance[np.ix_(free, free)] = np.linalg.pinv(information, hermitian=True)
    return covariance


def about_sets(crossing: Crossing) -> Floats:
    """Return the matrix (B, B) that subtracts from bench effects the mean of their connected set."""
    alike = crossing.component[:, None] == crossing.component[None, :]
    return np.asarray(np.eye(crossing.benches) - alike / alike.sum(axis=1, keepdims=True))
