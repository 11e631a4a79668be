"""Propagation of uncertainty: linear, by Monte Carlo, and a comparison of the two."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from bench.base.arrays import Floats, HasCovariance, Mask, u_of
from bench.calibration.result import CalibrationError
from bench.model.geometry import Distribution

COVERAGE: Final = 0.9545
"""The coverage probability of results: that of k = 2 for a normal distribution (EA-4/02 M:2022, section 5)."""


def coverage_factor(dof: ArrayLike, probability: float = COVERAGE) -> Floats:
    """Return the two-sided quantile of the t distribution for degrees of freedom, of any shape.

    Source: JCGM 100:2008, G.3.
    """
    nu = np.asarray(dof, dtype=np.float64)
    finite = special.stdtrit(np.where(np.isinf(nu), 1.0, nu), 0.5 * (1.0 + probability))
    normal = special.ndtri(0.5 * (1.0 + probability))
    return np.asarray(np.where(np.isinf(nu), normal, finite), dtype=np.float64)


def effective_dof(variances: Floats, dof: ArrayLike) -> Floats:
    """Return the Welch-Satterthwaite degrees of freedom of each output, shape (m,).

    `variances` (m, s) are the contributions of s independent sources to the variances of m outputs, `dof` (s,) the
    degrees of freedom of each. The result is infinite if no source with finite degrees of freedom contributes.
    Source: JCGM 100:2008, (G.2b). Correlated inputs belong to one source with common degrees of freedom (Willink,
    Metrologia 44 (2007) 340).
    """
    total = variances.sum(axis=1)
    share = np.sum(variances**2 / np.asarray(dof, dtype=np.float64), axis=1)
    with np.errstate(divide="ignore"):
        return np.where(share > 0.0, total**2 / np.where(share > 0.0, share, 1.0), np.inf)


@dataclass(frozen=True)
class Propagated(HasCovariance):
    """Propagated outputs: `value` (m,), `covariance` (m, m), effective degrees of freedom `dof` (m,)."""

    value: Floats
    covariance: Floats
    dof: Floats

    @property
    def correlation(self) -> Floats:
        """Correlation coefficients (m, m); zero for outputs without uncertainty."""
        return correlation_of(self.covariance)

    def expanded(self, probability: float = COVERAGE) -> Floats:
        """Expanded uncertainties U = k u with k from the t distribution, shape (m,). Source: GUM, G.4.1."""
        return coverage_factor(self.dof, probability) * self.u


def correlation_of(covariance: Floats) -> Floats:
    """Return the correlation coefficients of a covariance (m, m).

    They are zero off the diagonal for a quantity with u = 0.
    """
    u = u_of(covariance)
    size = np.where(u > 0.0, u, np.inf)
    matrix: Floats = covariance / np.outer(size, size)
    np.fill_diagonal(matrix, 1.0)
    return matrix


def drawn(distribution: Distribution, shape: tuple[int, ...], rng: np.random.Generator,
          dof: float = math.inf) -> Floats:  # fmt: skip
    """Return random errors of this `shape`, mean zero: rectangular, normal, or scaled t if `dof` is finite."""
    if distribution.shape == "rectangular":
        return rng.uniform(-distribution.limit, distribution.limit, shape)
    if math.isinf(dof):
        return distribution.u * rng.standard_normal(shape)
    return distribution.u * rng.standard_t(dof, shape)


@dataclass(frozen=True)
class Distributed(HasCovariance):
    """Statistics of Monte Carlo outputs: `mean` (m,), `u` (m,), `covariance` (m, m).

    `symmetric` (m, 2) are the ends of the probabilistically symmetric coverage intervals for `probability`;
    `shortest` (m, 2) are the ends of the shortest coverage intervals.
    """

    mean: Floats
    covariance: Floats
    symmetric: Floats
    shortest: Floats
    probability: float
    trials: int


def summary(outputs: Floats, probability: float = COVERAGE) -> Distributed:
    """Return the statistics of outputs (trials, m). Source: JCGM 101:2008, 7.5 to 7.7, 5.3.4."""
    if not np.all(np.isfinite(outputs)):
        bad = int(np.sum(~np.isfinite(outputs).all(axis=1)))
        raise CalibrationError(
            f"{bad} of {len(outputs)} draws give no finite result; narrow the distributions of the inputs"
        )
    ordered = np.sort(outputs, axis=0)
    trials = len(ordered)
    inside = math.floor(probability * trials + 0.5)
    low = (trials - inside) // 2
    symmetric = np.stack([ordered[low], ordered[low + inside - 1]], axis=-1)
    widths = ordered[inside - 1 :] - ordered[: trials - inside + 1]
    start = np.argmin(widths, axis=0)
    columns = np.arange(ordered.shape[1])
    shortest = np.stack([ordered[start, columns], ordered[start + inside - 1, columns]], axis=-1)
    covariance = np.atleast_2d(np.cov(outputs, rowvar=False))
    return Distributed(outputs.mean(axis=0), covariance, symmetric, shortest, probability, trials)


# --- clause 8 ---------------------------------------------------------------------------------------


def numerical_tolerance(u: float, digits: int = 2) -> float:
    """Return delta, half a unit of the last of `digits` significant digits of u. Source: JCGM 101:2008, 7.9.2."""
    if u <= 0.0 or not math.isfinite(u):
        return 0.0
    mantissa = f"{u:.{digits - 1}e}"
    return 0.5 * 10.0 ** (int(mantissa.split("e")[1]) - digits + 1)


@dataclass(frozen=True)
class Validation:
    """Validation of linear propagation by Monte Carlo, with one row for each of m outputs.

    `low` (m,) and `high` (m,) are the absolute differences of the lower and of the upper interval ends.
    `tolerance` (m,) is delta of JCGM 101:2008. `ratio` (m,) is u by Monte Carlo divided by u by linear
    propagation.
    """

    low: Floats
    high: Floats
    tolerance: Floats
    ratio: Floats

    @property
    def validated(self) -> Mask:
        """Whether both interval ends agree within delta, for each output, shape (m,)."""
        return np.asarray((self.low <= self.tolerance) & (self.high <= self.tolerance))


def validate(linear: Propagated, trials: Distributed, digits: int = 1) -> Validation:
    """Compare the probabilistically symmetric coverage intervals of linear propagation and Monte Carlo.

    `digits` is the number of meaningful digits of u. Source: JCGM 101:2008, 8.1.
    """
    reach = linear.expanded(trials.probability)
    low, high = trials.symmetric.T
    tolerance = np.array([numerical_tolerance(float(u), digits) for u in linear.u])
    ratio = np.divide(trials.u, linear.u, out=np.ones_like(linear.u), where=linear.u > 0.0)
    return Validation(
        np.abs(linear.value - reach - low), np.abs(linear.value + reach - high), tolerance, ratio
    )


def require_trials(trials: int) -> None:
    """Raise `CalibrationError` for too few trials for a coverage interval (JCGM 101:2008, 7.2)."""
    least = math.ceil(100.0 / (1.0 - COVERAGE))
    if trials < least:
        raise CalibrationError(f"{trials} trials are too few for a coverage interval; give {least} or more")


def batches(count: int, batch: int) -> Iterator[int]:
    """Yield the numbers of trials, at most `batch` each, that add up to `count`."""
    for begun in range(0, count, batch):
        yield min(batch, count - begun)
