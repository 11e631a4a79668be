"""Control charts: baseline, Shewhart, EWMA, components of variability, average run lengths (ARL) and their limits.

Sources of the run lengths: S. V. Crowder, "A simple method for studying run-length distributions of exponentially
weighted moving average charts", Technometrics 29 (1987), 401-407 (the integral equation of the EWMA); J. M. Lucas
and M. S. Saccucci, "Exponentially weighted moving average control schemes: properties and enhancements",
Technometrics 32 (1990), 1-12 (its tables); S. E. Rigdon, "An integral equation for the in-control average run
length of a multivariate exponentially weighted moving average control chart", J. Statist. Comput. Simul. 52 (1995),
351-365; S. Knoth, "ARL numerics for MEWMA charts", J. Quality Technology 49 (2017), 78-89 (the substitution that
makes its quadrature quick).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final, Literal

import numpy as np
import scipy
from scipy import special

from bench.base.arrays import Floats, Mask, u_of
from bench.base.computing import CalibrationError

NODES: Final = 96
"""Number of Gauss-Legendre quadrature points: they give six digits of the ARL for smoothing of 0.03 or more."""
LEAST_SMOOTHING: Final = 0.03
"""Least smoothing: below it the published tables end, and the quadrature needs more points."""


def shewhart_arl(k: float, shift: float = 0.0) -> float:
    """Return the ARL of a two-sided Shewhart chart with limits ±`k`, after a shift by `shift`.

    `k` and `shift` are in standard deviations.
    """
    return float(1.0 / (special.ndtr(shift - k) + special.ndtr(-shift - k)))


def ewma_arl(smoothing: float, k: float, shift: float = 0.0) -> float:
    """Return the ARL of a two-sided EWMA chart that starts at the centre, with asymptotic limits throughout.

    The limits are k sqrt(smoothing/(2 - smoothing)) standard deviations of one value from the centre; the mean
    differs from the centre by `shift` standard deviations from the first value on (Crowder 1987, equation 3).
    """
    if smoothing == 1.0:
        return shewhart_arl(k, shift)
    limit = k * np.sqrt(smoothing / (2.0 - smoothing))
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    places, weights = limit * nodes, limit * weights

    def kernel(start: Floats) -> Floats:
        value = (places - (1.0 - smoothing) * start[:, None]) / smoothing - shift
        return np.asarray(weights * scipy.stats.norm.pdf(value) / smoothing)

    lengths = np.linalg.solve(np.eye(NODES) - kernel(places), np.ones(NODES))
    return float(1.0 + (kernel(np.zeros(1)) @ lengths)[0])


def mewma_arl(smoothing: float, limit: float, dimensions: int) -> float:
    """Return the in-control ARL of a multivariate EWMA chart that starts at the centre.

    The chart signals if Z' V^-1 Z exceeds `limit`, where V is smoothing/(2 - smoothing) times the covariance of one
    value (Rigdon 1995, equation 8, integrated over the length of Z rather than its square, after Knoth 2017).
    """
    if smoothing == 1.0:
        return float(1.0 / special.chdtrc(dimensions, limit))
    radius = np.sqrt(limit * smoothing / (2.0 - smoothing))
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    places, weights = 0.5 * radius * (nodes + 1.0), 0.5 * radius * weights

    def kernel(start: Floats) -> Floats:
        from_there = (start[:, None] * (1.0 - smoothing) / smoothing) ** 2
        density = scipy.stats.ncx2.pdf((places / smoothing) ** 2, dimensions, from_there)
        return np.asarray(weights * 2.0 * places / smoothing**2 * density)

    lengths = np.linalg.solve(np.eye(NODES) - kernel(places), np.ones(NODES))
    return float(1.0 + (kernel(np.zeros(1)) @ lengths)[0])


def shewhart_k(arl: float) -> float:
    """Return the limit, in standard deviations, of a two-sided Shewhart chart of in-control ARL `arl`."""
    return float(-special.ndtri(0.5 / arl))


@cache
def ewma_k(smoothing: float, arl: float) -> float:
    """Return the limit, in standard deviations of the EWMA, of a chart whose in-control ARL is `arl`."""
    return _root(lambda k: ewma_arl(smoothing, k), arl, shewhart_k(arl))


@cache
def mewma_limit(smoothing: float, arl: float, dimensions: int) -> float:
    """Return the limit of a multivariate EWMA chart whose in-control ARL is `arl`."""
    most = float(special.chdtri(dimensions, 1.0 / arl))
    return _root(lambda limit: mewma_arl(smoothing, limit, dimensions), arl, most)


def _root(length: Callable[[float], float], arl: float, most: float) -> float:
    """Return the limit, up to about `most`, at which the increasing function `length` has the value `arl`."""
    return float(
        scipy.optimize.brentq(lambda limit: np.log(length(limit) / arl), 0.2 * most, 1.01 * most, xtol=1e-6)
    )


Basis = Literal["stated", "scaled", "scatter"]
BASES: Final = ("stated", "scaled", "scatter")
"""Bases of control limits: stated u of a run; stated u times a factor from the baseline; the baseline's scatter."""


@dataclass(frozen=True)
class Centre:
    """The centre of a chart and the variance for its limits, from a baseline of m runs.

    `value` (…, p) of p coefficients has the `covariance` (p, p). `scale` (…,) is the factor on the stated
    covariance: 1 if the stated u is used, else the squared Birge ratio. `scatter` (…, p, p) is the sample
    covariance if the limits rest on it alone, else None. `dof` are the degrees of freedom of `scale`, of `scatter`,
    or of the stated covariance, which is `widened` for them by this factor. Leading axes are separate charts.
    """

    value: Floats
    covariance: Floats
    scale: Floats
    dof: float
    runs: int
    scatter: Floats | None = None
    widened: float = 1.0

    @property
    def dimensions(self) -> int:
        """Number of coefficients, p."""
        return int(self.value.shape[-1])

    def p_single(self, z: Floats) -> Floats:
        """Return the two-sided p-values of deviations `z` of one coefficient, in units of its u."""
        if np.isinf(self.dof):
            return np.asarray(special.erfc(np.abs(z) / np.sqrt(2.0)))
        return np.asarray(2.0 * special.stdtr(self.dof, -np.abs(z) * np.sqrt(self.widened)))

    def p_joint(self, t2: Floats) -> Floats:
        """Return the p-values of joint statistics T² `t2`, of the same shape."""
        p = self.dimensions
        if np.isinf(self.dof):
            return np.asarray(special.chdtrc(p, t2))
        if self.scatter is None:
            return np.asarray(special.fdtrc(p, self.dof, self.widened * t2 / p))
        left = self.dof - p + 1.0
        return np.asarray(special.fdtrc(p, left, t2 * left / (p * self.dof)))

    def single_limit(self, probability: float) -> float:
        """Return the deviation, in u of one coefficient, that chance exceeds in either sign with `probability`."""
        if np.isinf(self.dof):
            return float(-special.ndtri(0.5 * probability))
        return float(-special.stdtrit(self.dof, 0.5 * probability) / np.sqrt(self.widened))

    def joint_limit(self, probability: float) -> float:
        """Return the joint statistic T² that chance exceeds with `probability`."""
        p = self.dimensions
        if np.isinf(self.dof):
            return float(special.chdtri(p, probability))
        if self.scatter is None:
            return float(p * special.fdtri(p, self.dof, 1.0 - probability) / self.widened)
        left = self.dof - p + 1.0
        return float(p * self.dof / left * special.fdtri(p, left, 1.0 - probability))


@dataclass(frozen=True)
class JudgedDeviations:
    """Deviations from the centre (…, n, p) with their `u`, `z` = deviation/u and its p-value `p`.

    `t2` (…, n) is the joint statistic T² of all coefficients; `p_joint` (…, n) is its p-value.
    """

    deviation: Floats
    u: Floats
    z: Floats
    p: Floats
    t2: Floats
    p_joint: Floats


@dataclass(frozen=True)
class StatedDof:
    """The degrees of freedom `dof` of the noise behind a stated covariance, which is `widened` for them."""

    dof: float = np.inf
    widened: float = 1.0

    def part(self, share: float) -> StatedDof:
        """Return the degrees of freedom of a `share` of the runs."""
        return replace(self, dof=share * self.dof)

    def above(self, ratio: Floats | float, dof: float) -> Floats:
        """Return the p-values of variances with `dof`, as a `ratio` of the stated ones, if they are equal."""
        if np.isinf(self.dof):
            return np.asarray(special.chdtrc(dof, dof * ratio))
        return np.asarray(special.fdtrc(dof, self.dof, self.widened * ratio))


EXACT: Final = StatedDof()


def least_runs(basis: Basis, dimensions: int) -> int:
    """Return the least number of runs in a baseline for control limits from `basis`.

    Limits from scatter alone need more runs than coefficients.
    """
    return {"stated": 1, "scaled": 3, "scatter": dimensions + 2}[basis]


def centre_of(
    values: Floats,
    covariances: Floats,
    basis: Basis,
    stated: StatedDof = EXACT,
    places: Mask | None = None,
) -> Centre:
    """Return the centre of a chart from baseline runs (…, m, p) with stated covariances (m, p, p).

    `stated` counts only if the limits are from stated u. `places` (m, k) marks the place of each run, if there are
    several: scatter between them is none of the runs. Raises `CalibrationError` if control limits from `basis` need
    more runs.
    """
    runs, p = values.shape[-2:]
    alike = runs - (0 if places is None else places.shape[1] - 1)
    if alike < (least := least_runs(basis, p)):
        raise CalibrationError(
            f"limits from '{basis}' need a baseline of {least} runs for {p} coefficients, and there are {alike}; "
            "measure the check block more often, or choose limits from 'stated'"
        )
    same = np.ones((runs, runs)) if places is None else 1.0 * (places @ places.T)
    own = values - same / same.sum(axis=1, keepdims=True) @ values
    if basis == "scatter":
        mean = values.mean(axis=-2)
        sample = np.swapaxes(own, -1, -2) @ own / (alike - 1)
        one = np.ones(values.shape[:-2])
        return Centre(mean, np.zeros((p, p)), one, alike - 1.0, runs, sample)
    weights = np.linalg.inv(covariances)
    covariance = np.linalg.inv(weights.sum(axis=0))
    mean = np.einsum("...mp,mpq->...q", values, weights) @ covariance
    if basis == "stated":
        one = np.ones(values.shape[:-2])
        return Centre(mean, covariance, one, stated.dof, runs, widened=stated.widened)
    left = values - mean[..., None, :] if places is None else own
    dof = p * (alike - 1.0)
    scale = np.einsum("...mp,mpq,...mq->...", left, weights, left) / dof
    return Centre(mean, covariance, scale, dof, runs)


def judge(
    centre: Centre,
    values: Floats,
    covariances: Floats,
    smoothing: float = 1.0,
    shared: Floats | None = None,
    *,
    settled: bool = False,
) -> JudgedDeviations:
    """Judge runs (…, n, p), in their order, with covariances (n, p, p) against a centre.

    With `smoothing` below 1, their EWMA is judged: Z_t = smoothing r_t + (1 - smoothing) Z_{t-1}, Z_0 = 0, where r
    are the deviations from the centre. `shared` (n, p, q) holds the changes of each run by q errors common to
    all runs, one standard uncertainty each. With `settled`, the EWMA has its asymptotic variance from the
    first value on, as in published tables.
    """
    weight = 1.0 - smoothing
    deviation = _filtered(values - centre.value[..., None, :], smoothing, weight, -2)
    count = np.arange(1, values.shape[-2] + 1)
    of_centre = np.ones(len(count)) if settled else 1.0 - weight**count
    ended = smoothing / (2.0 - smoothing)
    if centre.scatter is not None:
        of_values = np.full(len(count), ended) if settled else ended * (1.0 - weight ** (2 * count))
        total = of_values + of_centre**2 / centre.runs
        covariance = total[:, None, None] * centre.scatter[..., None, :, :]
    else:
        random = ended * covariances if settled else _filtered(covariances, smoothing**2, weight**2, 0)
        random = random + of_centre[:, None, None] ** 2 * centre.covariance
        covariance = random
    scale = centre.scale[..., None]
    if shared is not None:
        # shared errors keep their stated size: the baseline shows only errors that differ between runs
        common = _filtered(shared, smoothing, weight, 0)
        covariance = scale[..., None, None] * covariance + common @ np.swapaxes(common, -1, -2)
        scale = np.ones_like(scale)
    unscaled = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    weights = np.linalg.inv(covariance / (unscaled[..., :, None] * unscaled[..., None, :]))
    u = unscaled * np.sqrt(scale)[..., None]
    z = deviation / u
    t2 = np.sum((z[..., None, :] @ weights)[..., 0, :] * z, axis=-1)
    return JudgedDeviations(deviation, u, z, centre.p_single(z), t2, centre.p_joint(t2))


def without_one(
    values: Floats, covariances: Floats, basis: Basis, stated: StatedDof = EXACT
) -> Floats | None:
    """Return the p-values (m,) of a joint test of each run of a baseline (m, p) against all its other runs.

    `stated` is that of all runs. Return None if these are fewer than `least_runs`.
    """
    runs, p = values.shape
    if runs - 1 < least_runs(basis, p) or runs < 2:
        return None
    found = []
    for k in range(runs):
        rest = np.arange(runs) != k
        centre = centre_of(values[rest], covariances[rest], basis, stated.part(1.0 - 1.0 / runs))
        found.append(float(judge(centre, values[[k]], covariances[[k]]).p_joint[0]))
    return np.array(found)


def _filtered(values: Floats, gain: float, weight: float, axis: int) -> Floats:
    """Return y_t = gain x_t + weight y_{t-1} along an axis; x are the `values`."""
    filtered: Any = scipy.signal.lfilter([gain], [1.0, -weight], values, axis=axis)
    return np.asarray(filtered)


STATISTICS: Final = 3
"""Number of statistics that can reject a run: its T², the T² of the EWMA, its short-term standard deviation."""
DEFAULT_ARL: Final = 370.0
DEFAULT_SMOOTHING: Final = 0.2


@dataclass(frozen=True)
class ChartDesign:
    """Design of a chart: average run length between false alarms, smoothing of the EWMA, basis of limits.

    Three statistics can reject a run: its T², the T² of the EWMA, and its short-term standard deviation. Each
    gets a third of the false-alarm rate, because the rates of rare alarms add up.
    """

    arl: float = DEFAULT_ARL
    smoothing: float = DEFAULT_SMOOTHING
    basis: Basis = "scaled"

    @property
    def each_arl(self) -> float:
        """The average run length, between false alarms, of one of the three statistics alone."""
        return STATISTICS * self.arl

    @property
    def alpha(self) -> float:
        """False-alarm probability per run of T², and equally of the short-term standard deviation."""
        return 1.0 / self.each_arl

    def alpha_ewma(self, dimensions: int) -> float:
        """Return the chi-square tail probability of the limit on the EWMA's T², whose ARL is `each_arl`."""
        return float(special.chdtrc(dimensions, mewma_limit(self.smoothing, self.each_arl, dimensions)))

    def alpha_single(self, dimensions: int) -> float:
        """Return the false-alarm probability per run of a single coefficient out of `dimensions`.

        It is the false-alarm probability of T² divided by `dimensions`.
        """
        return self.alpha / dimensions

    def alpha_single_ewma(self, dimensions: int) -> float:
        """Return the two-sided tail probability at the EWMA limit of a single coefficient out of `dimensions`."""
        k = ewma_k(self.smoothing, self.each_arl * dimensions)
        return float(2.0 * special.ndtr(-k))


ALIKE_P = 0.01
"""P-value below which the scatter of the baseline contradicts the stated u."""


@dataclass(frozen=True)
class ShortTerm:
    """Short-term standard deviations `s` (n,) with `dof`, and that of the baseline, `pooled`, with `pooled_dof`.

    `f` is the square of the ratio of `s` to `pooled`; `p` is the p-value of `f` (one-sided F test).
    """

    s: Floats
    dof: Floats
    pooled: float
    pooled_dof: float
    f: Floats
    p: Floats

    def limits(self, probability: float) -> Floats:
        """Return the standard deviations (n,) that chance exceeds with `probability`."""
        return np.asarray(
            self.pooled
            * np.sqrt(special.fdtri(np.maximum(self.dof, 1.0), self.pooled_dof, 1.0 - probability))
        )


def short_term(s: Floats, dof: Floats, baseline_s: Floats, baseline_dof: Floats) -> ShortTerm:
    """Compare standard deviations `s` (n,) with those of the baseline, pooled by their degrees of freedom.

    `s` and `baseline_s` have the degrees of freedom `dof` and `baseline_dof`. Source: NIST/SEMATECH e-Handbook,
    2.2.3.1 and 2.3.5.1.
    """
    pooled_dof = float(baseline_dof.sum())
    pooled = float(np.sqrt((baseline_dof @ baseline_s**2) / pooled_dof))
    f = (s / pooled) ** 2
    # without degrees of freedom there is no estimate to test
    p = np.where(dof > 0, special.fdtrc(np.maximum(dof, 1.0), pooled_dof, f), 1.0)
    return ShortTerm(s, dof, pooled, pooled_dof, f, p)


@dataclass(frozen=True)
class Components:
    """The variability of each coefficient (p,) in a baseline of `runs` runs.

    `noise` is the standard deviation from reading noise. `stated` is the u of one run from all errors that
    differ between runs, `scatter` the standard deviation between runs, with `runs` - 1 degrees of freedom.
    `f` is the squared ratio of `scatter` to `stated`; `p` is the one-sided p-value of `f`. `between` is the
    standard deviation between runs in excess of `stated`; `between_most` is its upper 95 % limit. `birge2` is
    the squared Birge ratio of all coefficients, with `birge_dof` degrees of freedom and the two-sided p-value
    `birge_p`. `alike_p` is the p-value of the hypothesis that the stated u of all coefficients is wrong by
    one common factor.
    """

    runs: int
    noise: Floats
    stated: Floats
    scatter: Floats
    f: Floats
    p: Floats
    between: Floats
    between_most: Floats
    birge2: float
    birge_dof: int
    birge_p: float
    alike_p: float

    @property
    def more_than_stated(self) -> Floats:
        """P-values (p,) for a larger scatter than stated, adjusted by Bonferroni's method."""
        return np.minimum(1.0, len(self.p) * self.p)


def components_of(values: Floats, covariance: Floats, noise: Floats, known: StatedDof = EXACT) -> Components:
    """Return the components of variability of a baseline (m, p) of more than one run.

    Each run has the stated covariance `covariance` (p, p) and the noise `noise` (p,); `known` are the degrees of
    freedom behind this covariance.
    """
    runs, p = values.shape
    left = values - values.mean(axis=0)
    stated, scatter = u_of(covariance), values.std(axis=0, ddof=1)
    f = (scatter / stated) ** 2
    excess = np.maximum(0.0, scatter**2 - stated**2)
    # the upper 95 % limit of a variance estimated from few runs
    largest = (runs - 1) * scatter**2 / special.chdtri(runs - 1, 0.95)
    scale, axes = np.linalg.eigh(covariance / np.outer(stated, stated))
    squares = ((left / stated) @ axes / np.sqrt(scale)) ** 2
    ratio = squares.sum(axis=0) / (runs - 1)
    total, dof = float(squares.sum()), p * (runs - 1)
    upper = float(known.above(total / dof, dof))
    return Components(
        runs=runs,
        noise=noise,
        stated=stated,
        scatter=scatter,
        f=f,
        p=known.above(f, runs - 1),
        between=np.sqrt(excess),
        between_most=np.sqrt(np.maximum(0.0, largest - stated**2)),
        birge2=total / dof,
        birge_dof=dof,
        birge_p=2.0 * min(upper, 1.0 - upper),
        alike_p=_bartlett(ratio, runs - 1),
    )


def _bartlett(variances: Floats, dof: int) -> float:
    """Return the p-value of equal variances (p,), each with `dof`, by Bartlett's test."""
    p = len(variances)
    gap = p * dof * np.log(variances.mean()) - dof * np.log(variances).sum()
    return float(special.chdtrc(p - 1, gap / (1.0 + (p + 1.0) / (3.0 * p * dof))))


@dataclass(frozen=True)
class DriftSeen:
    """Drifts of the check block's coefficients, (m,) each: `per_year` with `u`; adjusted p-values `p`."""

    per_year: Floats
    u: Floats
    p: Floats


def drift_of(
    years: Floats, values: Floats, u: Floats, dof: float, u_known: Floats | float = 0.0
) -> DriftSeen:
    """Return the slopes of lines fitted to coefficients (n, p) at times `years` (n,), with u and p-values.

    `u` (p,) is the standard uncertainty of each value, with `dof` degrees of freedom. `u_known` is the
    standard uncertainty, per year, of a known drift that was already subtracted from the values.
    """
    centred = years - years.mean()
    spread = float(centred @ centred)
    slope = centred @ values / spread
    u_slope = np.hypot(u / np.sqrt(spread), u_known)
    t = np.abs(slope / u_slope)
    p = special.erfc(t / np.sqrt(2.0)) if np.isinf(dof) else 2.0 * special.stdtr(dof, -t)
    return DriftSeen(slope, u_slope, np.minimum(1.0, len(slope) * np.asarray(p)))
