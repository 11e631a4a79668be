"""Restricted maximum likelihood of variance components.

y = X b + sum over k of Z_k e_k, where e_k has the variance theta_k: V = sum of theta_k Z_k Z_k^T + a known
covariance. With P = V^-1 - V^-1 X (X^T V^-1 X)^-1 X^T V^-1 the score of theta_k is 1/2 (y^T P V_k P y - tr(P V_k)),
its information 1/2 tr(P V_k P V_l). Steps use the average information 1/2 y^T P V_k P V_l P y, which needs no
products of matrices. Sources: D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320; A. R. Gilmour, R. Thompson, B. R.
Cullis, Biometrics 51 (1995) 1440.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import scipy
from scipy import linalg, sparse, special

from bench.base.arrays import Floats, Ints, Mask

ROUNDS: Final = 40
AT_REST: Final = 3e-3
"""Convergence limit: no parameter moves by more than this part of itself."""
MOST_CHANGE: Final = 4.0
LEAST: Final = 1e-6
"""Least variance of a component, as a fraction of its scale: at this bound it counts as zero."""


@dataclass(frozen=True)
class ComponentColumns:
    """The sparse columns of all components: `whole` (N, q); component k begins at column `starts[k]`."""

    whole: sparse.csc_array
    starts: Ints

    @property
    def widths(self) -> Ints:
        """The number of columns of each component (k,)."""
        return np.diff([*self.starts, self.whole.shape[1]])

    @classmethod
    def of(cls, Z: Sequence[Floats]) -> ComponentColumns:
        """Return the sparse columns of the components whose dense columns are `Z`, an array (N, q_k) each."""
        widths = [z.shape[1] for z in Z]
        return cls(sparse.csc_array(np.concatenate(list(Z), axis=1)), np.cumsum([0, *widths[:-1]]))

    def sums(self, by_column: Floats) -> Floats:
        """Return the sums of `by_column` (..., q) over the columns of each component, shape (..., k)."""
        return np.asarray(np.add.reduceat(by_column, self.starts, axis=-1))

    def sized(self, sizes: Floats) -> sparse.csc_array:
        """Return the columns, each multiplied by the standard deviation `sizes` (k,) of its component."""
        by_column = np.repeat(sizes, self.widths)
        data = self.whole.data * np.repeat(by_column, np.diff(self.whole.indptr))
        return sparse.csc_array((data, self.whole.indices, self.whole.indptr), self.whole.shape)


@dataclass(frozen=True)
class Mixed:
    """A mixed model: data `y` (N,), fixed effects `X` (N, p), random effects with the columns `Z` (N, q_k).

    There is one array in `Z` for each variance component. `known` (N, N) is a covariance of the data that is not
    estimated.
    """

    y: Floats
    X: Floats
    Z: tuple[Floats, ...]
    known: Floats

    @cached_property
    def columns(self) -> ComponentColumns:
        """The columns of all components, joined into one sparse matrix."""
        return ComponentColumns.of(self.Z)

    def covariance(self, theta: Floats) -> Floats:
        """Return the covariance V (N, N) of the data for variances `theta` (k,)."""
        sized = self.columns.sized(np.sqrt(theta))
        return np.asarray(self.known + sized @ sized.toarray().T)

    def only(self, kept: Mask) -> Mixed:
        """Return the model with only those components where `kept` (k,) is true."""
        return Mixed(self.y, self.X, tuple(z for z, k in zip(self.Z, kept, strict=True) if k), self.known)


@dataclass(frozen=True)
class Projection:
    """P = V^-1 - V^-1 X (X^T V^-1 X)^-1 X^T V^-1 (N, N) at given variances, and P y (N,)."""

    P: Floats
    Py: Floats

    @classmethod
    def at(cls, mixed: Mixed, theta: Floats) -> Projection:
        """Return the projection for variances (k,). Raises `numpy.linalg.LinAlgError` if V is singular."""
        lower = linalg.cholesky(mixed.covariance(theta), lower=True, check_finite=False)
        half, _ = linalg.lapack.dpotri(lower, lower=1)
        inverse = np.tril(half) + np.tril(half, -1).T
        q, _ = np.linalg.qr(linalg.solve_triangular(lower, mixed.X, lower=True, check_finite=False))
        back = linalg.solve_triangular(lower, q, lower=True, trans="T", check_finite=False)
        P = inverse - back @ back.T
        return cls(P, P @ mixed.y)

    def scores(self, Z: ComponentColumns) -> Floats:
        """Return the scores: the derivatives of ln L by the variances, shape (k,)."""
        row, column = Z.whole.indices, np.repeat(np.arange(Z.whole.shape[1]), np.diff(Z.whole.indptr))
        terms = Z.whole.data * (self.P @ Z.whole)[row, column]
        traces = Z.sums(np.asarray(np.bincount(column, terms, Z.whole.shape[1]), dtype=np.float64))
        return np.asarray(0.5 * (self._squares(Z) - traces))

    def _squares(self, Z: ComponentColumns) -> Floats:
        return Z.sums((Z.whole.T @ self.Py) ** 2)

    def moments(self, Z: ComponentColumns) -> tuple[Floats, Floats, Floats]:
        """Return scores (k,), tr(P V_k) (k,) and information 1/2 tr(P V_k P V_l) (k, k); V_k = Z_k Z_k^T."""
        crossed = Z.whole.T @ (self.P @ Z.whole)
        traces = Z.sums(np.diag(crossed))
        information = 0.5 * Z.sums(Z.sums(crossed**2).T)
        return 0.5 * (self._squares(Z) - traces), traces, np.asarray(information)

    def average_information(self, Z: ComponentColumns) -> Floats:
        """Return the average information 1/2 y^T P V_k P V_l P y, shape (k, k), with V_k = Z_k Z_k^T."""
        by_column = Z.whole.T @ self.Py
        component = np.repeat(np.arange(len(Z.starts)), Z.widths)
        moved = Z.whole @ (by_column[:, None] * (component[:, None] == np.arange(len(Z.starts))))
        return np.asarray(0.5 * moved.T @ self.P @ moved)


def scoring_step(
    theta: Floats,
    score: Floats,
    information: Floats,
    least: Floats | float,
    damping: float,
    ridge: float,
    most_change: float = MOST_CHANGE,
) -> Floats:
    """Return the variances (…, k), at least `least`, after one more scoring step in their logarithms.

    The diagonal of the information (…, k, k) is raised by a fraction `damping` of itself and `ridge` of the trace.
    No variance changes by more than a factor of `most_change`; a variance at `least` stays there if the score is
    negative.
    """
    slope = score * theta
    free = (theta > least) | (slope > 0)
    both = free[..., :, None] & free[..., None, :]
    curvature = np.where(both, information * theta[..., :, None] * theta[..., None, :], 0.0)
    own = np.diagonal(curvature, axis1=-2, axis2=-1)
    wider = damping * own + ridge * own.sum(axis=-1, keepdims=True) + 1e-300
    # the equation of a fixed variance is step = 0
    curvature = curvature + np.where(free, wider, 1.0)[..., None] * np.eye(theta.shape[-1])
    step = np.linalg.solve(curvature, np.where(free, slope, 0.0)[..., None])[..., 0]
    return np.asarray(np.maximum(theta * np.clip(1.0 + step, 1 / most_change, most_change), least))


def maximise(
    mixed: Mixed, start: Floats, scale: Floats, believed: Floats | None = None
) -> tuple[Floats, Projection]:
    """Return the non-negative variances (k,) of largest restricted likelihood, and the projection P there.

    `start` (k,) are start values. A variance below 1e-5 of `scale` (k,) counts as zero. `believed` (k,) holds lower
    limits of the variances, by default zero.
    """
    bottom = np.zeros_like(start) if believed is None else believed
    least = np.maximum(LEAST * scale, bottom)
    theta = np.maximum(start, least)
    for _ in range(ROUNDS):
        at = Projection.at(mixed, theta)
        score, information = at.scores(mixed.columns), at.average_information(mixed.columns)
        moved = scoring_step(theta, score, information, least, 0.05, 1e-9)
        still = np.all(np.abs(moved - theta) <= AT_REST * theta + 10 * LEAST * scale)
        theta = moved
        if still:
            break
    theta = np.where(theta <= 10 * LEAST * scale, bottom, theta)
    return theta, Projection.at(mixed, theta)


@dataclass(frozen=True)
class ComponentsAsked:
    """Score tests of k variance components that the model does not contain yet.

    `chance` (k,) is the p-value of the score for a variance of zero. `expected` (k,) is the posterior mean of
    the variance: the prior is flat above zero, the likelihood is normal about the result of one scoring step.
    """

    chance: Floats
    expected: Floats


def asked_for(at: Projection, Z: ComponentColumns, inside: int, dof: float) -> ComponentsAsked:
    """Test the components that the model does not contain yet: all after the first `inside`.

    The variances of the first `inside` components are estimates from the repeats alone, which do not maximise
    the likelihood. Score and information are therefore corrected for them (the C(alpha) test: J. Neyman, in
    Probability and Statistics: The Harald Cramer Volume (1959) 213). A quadratic form divided by its mean is
    treated as chi-square divided by nu, with nu for equal variance (Satterthwaite, Biometrics Bull. 2 (1946)
    110). The quotient is tested as F, with at most `dof` denominator degrees of freedom, because the
    variances of the first components are estimates.
    """
    scores, traces, whole = at.moments(Z)
    scale = np.sqrt(np.diag(whole)[:inside])
    across = whole[inside:, :inside] / scale
    through = across @ np.linalg.pinv(whole[:inside, :inside] / np.outer(scale, scale), rcond=1e-8)
    score = scores[inside:] - through @ (scores[:inside] / scale)
    taken = np.sum(through * across, axis=1)
    own = np.diag(whole)[inside:]
    left = own - taken
    told = left > 1e-6 * own
    size = np.where(told, score / np.sqrt(np.where(told, left, 1.0)), -np.inf)
    freedom = traces[inside:] ** 2 / (2.0 * own)
    # denominator degrees of freedom at which an F statistic keeps this part of the information of the score
    part = np.clip(np.where(told, left / own, 1.0), 0.0, 1.0 - 1e-6)
    within = np.minimum(freedom * part / (1.0 - part), dof)
    ratio = np.maximum(1.0 + size * np.sqrt(2.0 / freedom + 2.0 / within), 0.0)
    chance = special.fdtrc(freedom, within, ratio)
    u = 1.0 / np.sqrt(np.where(told, left, np.inf))
    # mean of a normal distribution truncated at zero; for a mode far below zero it tends to u/|size|
    tail = np.exp(-0.5 * size**2 - special.log_ndtr(size)) / np.sqrt(2.0 * np.pi)
    expected = np.where(told, u * np.maximum(np.where(told, size, 0.0) + tail, 0.0), 0.0)
    return ComponentsAsked(chance, expected)


# --- along one size -----------------------------------------------------------------------------------

ONE_SIDED: Final = 0.5 * 1.6449**2
"""Loss of log likelihood at a one-sided 95 % limit."""
GONE: Final = 8.0
"""Loss of log likelihood beyond which a size is left out of integrals over the likelihood."""
NODES: Final = 24
MOST_TIMES: Final = 1e3
LIMIT_AT_REST: Final = 0.01
"""Relative accuracy to which a limit is found."""


@dataclass(frozen=True)
class Profile:
    """The restricted log likelihood as a function of one standard deviation s, other variances adjusted.

    The other variances change linearly with s², which is exact near the maximum at `variances` (k,). `follow` (k,)
    is the change of each variance per change of s². `which` is the index of the variance s²; `scale` is a rough
    value of s.
    """

    likelihood: Callable[[Floats], float]
    variances: Floats
    which: int
    follow: Floats
    scale: float

    @cached_property
    def greatest(self) -> float:
        """The maximum of the log likelihood."""
        return self.likelihood(self.variances)

    @property
    def middle(self) -> float:
        """The standard deviation s at the maximum of the likelihood."""
        return float(np.sqrt(self.variances[self.which]))

    def lost(self, size: float) -> float:
        """Return by how much the log likelihood at s = `size` is below its maximum."""
        moved = self.variances + self.follow * (size**2 - self.variances[self.which])
        return self.greatest - self.likelihood(np.maximum(moved, 0.0))

    def beyond(self, loss: float) -> float:
        """Return an s above the maximum at which the log likelihood is lower by at least `loss`.

        Return infinity if the log likelihood does not fall so far up to `MOST_TIMES` times `scale`.
        """
        end = max(1.2 * self.middle, 0.2 * self.scale)
        while self.lost(end) < loss:
            end *= 1.5
            if end > MOST_TIMES * self.scale:
                return float("inf")
        return end

    def most(self) -> float:
        """Return the upper 95 % limit of s, to the relative accuracy `LIMIT_AT_REST`; infinity if none."""
        end = self.beyond(ONE_SIDED)
        if not np.isfinite(end):
            return end
        return float(
            scipy.optimize.brentq(
                lambda size: self.lost(size) - ONE_SIDED, self.middle, end, rtol=LIMIT_AT_REST
            )
        )

    def mean(self) -> float:
        """Return the root mean square of s, weighted by the likelihood.

        The result is `middle` if the likelihood does not fall towards infinity.
        """
        end = self.beyond(GONE)
        if not np.isfinite(end):
            return self.middle
        sizes = np.linspace(0.0, end, NODES)
        loss = np.array([self.lost(size) for size in sizes])
        weight = np.exp(loss.min() - loss)
        return float(np.sqrt(np.sum(weight * sizes**2) / np.sum(weight)))


def profile_of(
    likelihood: Callable[[Floats], float],
    variances: Floats,
    information: Floats,
    which: int,
    free: Sequence[int],
    scale: float,
) -> Profile:
    """Return the profile over the square root of variance `which`; only the variances `free` were estimated.

    All other variances keep their values. `information` (k, k) is the information on the variances at the maximum
    of the likelihood.
    """
    others = [j for j in free if j != which]
    follow = np.zeros(len(variances))
    follow[others] = -np.linalg.pinv(information[np.ix_(others, others)]) @ information[others, which]
    follow[which] = 1.0
    return Profile(likelihood, variances, which, follow, scale)
