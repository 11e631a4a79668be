"""Linear propagation of uncertainty, of one output or of several together.

Source: JCGM 100:2008 (GUM), 5.1, 5.2, G.4; JCGM 102:2011 (GUM Supplement 2), 6.2 and 6.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from bench.analysis.calibration.result import CalibrationError
from bench.base.arrays import Floats, HasCovariance, u_of

COVERAGE: Final = 0.9545
"""The coverage probability of results: that of k = 2 for a normal distribution (EA-4/02 M:2022, section 5)."""

_NOT_NEGATIVE: Final = -1e-9
"""Least eigenvalue of a correlation matrix that rounding explains."""


def coverage_factor(dof: ArrayLike, probability: float = COVERAGE) -> Floats:
    """Return the two-sided quantile of the t distribution for degrees of freedom, of any shape.

    Source: JCGM 100:2008, G.3. Raises `CalibrationError` for a probability outside 0 to 1.
    """
    require_probability(probability)
    nu = np.asarray(dof, dtype=np.float64)
    finite = special.stdtrit(np.where(np.isinf(nu), 1.0, nu), 0.5 * (1.0 + probability))
    normal = special.ndtri(0.5 * (1.0 + probability))
    return np.asarray(np.where(np.isinf(nu), normal, finite), dtype=np.float64)


def require_probability(probability: float) -> None:
    """Refuse what is no coverage probability. Raises `CalibrationError`."""
    if not 0.0 < probability < 1.0:
        raise CalibrationError(f"a coverage probability lies between 0 and 1, not at {probability:g}")


def effective_dof(variances: Floats, dof: ArrayLike) -> Floats:
    """Return the Welch-Satterthwaite degrees of freedom of each output, shape (m,).

    `variances` (m, s) are the contributions of s independent sources to the variances of m outputs, `dof` (s,)
    the degrees of freedom of each. Where no source with finite ones contributes, the result is infinite.
    Source: JCGM 100:2008, (G.2b). Correlated inputs belong into one source, known with common degrees of
    freedom (Willink, Metrologia 44 (2007) 340).
    """
    total = variances.sum(axis=1)
    share = np.sum(variances**2 / np.asarray(dof, dtype=np.float64), axis=1)
    with np.errstate(divide="ignore"):
        return np.where(share > 0.0, total**2 / np.where(share > 0.0, share, 1.0), np.inf)


@dataclass(frozen=True)
class Propagated(HasCovariance):
    """Outputs `value` (m,) with their `covariance` (m, m) and effective degrees of freedom `dof` (m,)."""

    value: Floats
    covariance: Floats
    dof: Floats

    @property
    def correlation(self) -> Floats:
        """Correlation coefficients (m, m); zero with an output that has no uncertainty."""
        return correlation_of(self.covariance)

    def expanded(self, probability: float = COVERAGE) -> Floats:
        """Expanded uncertainties U = k u with k from the t distribution, shape (m,). Source: GUM, G.4.1."""
        return coverage_factor(self.dof, probability) * self.u

    def region_factor(self, probability: float = COVERAGE) -> float:
        """Return k of the ellipsoid that covers all outputs together. Source: JCGM 102:2011, 6.5.2.2.

        With finite degrees of freedom nu (the least of the outputs') the covariance is known up to a factor,
        and the outputs have a multivariate t distribution: k^2 is m times the quantile of F for m and nu.
        """
        m, nu = len(self.value), float(np.min(self.dof))
        if np.isinf(nu):
            return float(np.sqrt(2.0 * special.gammaincinv(0.5 * m, probability)))
        return float(np.sqrt(m * special.fdtri(m, nu, probability)))


@dataclass(frozen=True)
class Inputs:
    """Input quantities of a model: estimates `value` (n,), `covariance` (n, n), degrees of freedom.

    `dof` is one number for each of `groups`, which list the numbers of inputs that were found together;
    without groups each input stands alone. Inputs of different groups are independent.
    """

    value: Floats
    covariance: Floats
    dof: Sequence[float] = ()
    groups: Sequence[Sequence[int]] = field(default=())

    @classmethod
    def independent(cls, value: ArrayLike, u: ArrayLike, dof: ArrayLike = np.inf) -> Inputs:
        """Build from estimates (n,) with standard uncertainties (n,) and degrees of freedom of each."""
        values = np.asarray(value, dtype=np.float64)
        sizes = np.broadcast_to(np.asarray(u, dtype=np.float64), values.shape)
        known = np.broadcast_to(np.asarray(dof, dtype=np.float64), values.shape)
        return cls(values, np.diag(sizes**2), tuple(known.tolist()))

    @classmethod
    def together(cls, value: ArrayLike, u: ArrayLike, correlation: ArrayLike, dof: float = np.inf) -> Inputs:
        """Build from estimates (n,) that were found together, with their correlation matrix (n, n)."""
        sizes = np.asarray(u, dtype=np.float64)
        covariance = np.asarray(correlation, dtype=np.float64) * np.outer(sizes, sizes)
        return cls(np.asarray(value, dtype=np.float64), covariance, (dof,), (tuple(range(len(sizes))),))


def propagate(value: ArrayLike, sensitivity: ArrayLike, inputs: Inputs) -> Propagated:
    """Propagate the covariance of inputs through sensitivity coefficients (m, n) to outputs at `value` (m,).

    Source: JCGM 100:2008, (13); JCGM 102:2011, (3). Raises `CalibrationError` when shapes do not fit, the
    covariance is none, or inputs that are correlated stand in different groups with finite dof.
    """
    outputs = np.atleast_1d(np.asarray(value, dtype=np.float64))
    slopes = np.asarray(sensitivity, dtype=np.float64).reshape(len(outputs), -1)
    n = len(inputs.value)
    if slopes.shape[1] != n or inputs.covariance.shape != (n, n):
        raise CalibrationError(
            f"sensitivities {slopes.shape} and covariance {inputs.covariance.shape} do not fit {n} inputs"
        )
    _require_covariance(inputs.covariance)
    groups = inputs.groups or tuple((i,) for i in range(n))
    dof = tuple(inputs.dof) or (np.inf,) * len(groups)
    if sorted(i for group in groups for i in group) != list(range(n)) or len(dof) != len(groups):
        raise CalibrationError("each input belongs to one group, and each group has its degrees of freedom")
    if not np.all(np.isinf(dof)):
        _require_independent(inputs.covariance, groups)
    shares = np.stack([_variance(slopes, inputs.covariance, group) for group in groups], axis=1)
    return Propagated(outputs, slopes @ inputs.covariance @ slopes.T, effective_dof(shares, dof))


def correlation_of(covariance: Floats) -> Floats:
    """Return the correlation coefficients of a covariance (m, m); zero beside the diagonal where a u is zero."""
    u = u_of(covariance)
    size = np.where(u > 0.0, u, np.inf)
    matrix: Floats = covariance / np.outer(size, size)
    np.fill_diagonal(matrix, 1.0)
    return matrix


def _variance(slopes: Floats, covariance: Floats, group: Sequence[int]) -> Floats:
    own = slopes[:, list(group)]
    return np.asarray(np.einsum("mi,ij,mj->m", own, covariance[np.ix_(list(group), list(group))], own))


def _require_covariance(covariance: Floats) -> None:
    finite = np.all(np.isfinite(covariance)) and np.allclose(covariance, covariance.T, rtol=1e-9, atol=0.0)
    if not finite or np.any(np.diag(covariance) < 0.0):
        raise CalibrationError("a covariance matrix is finite, symmetric, with no negative variance")
    if np.linalg.eigvalsh(correlation_of(covariance))[0] < _NOT_NEGATIVE * len(covariance):
        raise CalibrationError(
            "the correlations contradict each other: the covariance has a negative eigenvalue"
        )


def _require_independent(covariance: Floats, groups: Sequence[Sequence[int]]) -> None:
    group_of = np.empty(len(covariance), dtype=np.int64)
    for number, group in enumerate(groups):
        group_of[list(group)] = number
    across = group_of[:, None] != group_of[None, :]
    if np.any(covariance[across] != 0.0):
        raise CalibrationError(
            "inputs of different groups are correlated, for which degrees of freedom are not defined; "
            "put them into one group"
        )
