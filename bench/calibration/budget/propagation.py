"""Propagation of uncertainty: linear, by Monte Carlo, and whether both agree."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from bench.base.arrays import Floats, HasCovariance, Mask, Singles, u_of
from bench.calibration.result import CalibrationError
from bench.model.geometry import Distribution

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


Draw = Callable[[np.random.Generator, int], Floats]
"""Returns so many draws of all inputs of a function, the draws along the first axis."""

Function = Callable[[Floats], Floats]
"""From draws (trials, …) to outputs (trials, m) or (trials,), each row by itself."""

BATCH: Final = 8192
_LEAST_SEQUENCE: Final = 10_000


def drawn(distribution: Distribution, shape: tuple[int, ...], rng: np.random.Generator,
          dof: float = math.inf) -> Floats:  # fmt: skip
    """Return draws of an error with mean zero: rectangular, normal, or scaled t where dof is finite.

    Source: JCGM 101:2008, 6.4.2, 6.4.7, 6.4.9 (u is the scale of the t, as for a type A evaluation).
    """
    if distribution.shape == "rectangular":
        return rng.uniform(-distribution.limit, distribution.limit, shape)
    if math.isinf(dof):
        return distribution.u * rng.standard_normal(shape)
    return distribution.u * rng.standard_t(dof, shape)


def joint(*inputs: Callable[[np.random.Generator, int], Floats]) -> Draw:
    """Return the draw of independent inputs, each a function of generator and count, side by side."""

    def draw(rng: np.random.Generator, count: int) -> Floats:
        return np.stack([one(rng, count) for one in inputs], axis=-1)

    return draw


def about(mean: float, distribution: Distribution, dof: float = math.inf) -> Draw:
    """Return the draw of one input with this mean and this distribution of its error."""
    return lambda rng, count: mean + drawn(distribution, (count,), rng, dof)


@dataclass(frozen=True)
class Distributed(HasCovariance):
    """Outputs as Monte Carlo gives them: `mean` (m,), `u` (m,), `covariance` (m, m).

    `symmetric` (m, 2) are the ends of the probabilistically symmetric coverage intervals for `probability`,
    `shortest` (m, 2) of the shortest ones. `stable` tells that the adaptive procedure reached its tolerance;
    with a fixed number of trials it is true.
    """

    mean: Floats
    covariance: Floats
    symmetric: Floats
    shortest: Floats
    probability: float
    trials: int
    stable: bool = True


def monte_carlo(
    function: Function,
    draw: Draw,
    rng: np.random.Generator,
    trials: int = 200_000,
    probability: float = COVERAGE,
) -> Distributed:
    """Propagate distributions with a fixed number of trials. Source: JCGM 101:2008, 7.2 to 7.7.

    Raises `CalibrationError` for fewer trials than an interval needs, 100/(1 - p), or outputs that are no
    number.
    """
    require_trials(trials, probability)
    outputs = np.concatenate([*_outputs(function, draw, rng, trials)])
    return summary(outputs, probability)


def adaptive_monte_carlo(
    function: Function,
    draw: Draw,
    rng: np.random.Generator,
    digits: int = 2,
    probability: float = COVERAGE,
    most_trials: int = 10_000_000,
) -> Distributed:
    """Propagate distributions until mean, u and interval ends are stable to `digits` of u.

    Sequences of trials are added until twice the standard deviation of each average is within the numerical
    tolerance. Source: JCGM 101:2008, 7.9.4. `stable` is false where `most_trials` came first.
    """
    size = max(_least_trials(probability), _LEAST_SEQUENCE)
    found: list[Floats] = []
    results: list[Floats] = []
    while True:
        outputs = np.concatenate([*_outputs(function, draw, rng, size)])
        one = summary(outputs, probability)
        found.append(outputs)
        results.append(np.stack([one.mean, one.u, *one.symmetric.T]))
        if len(results) > 1:
            u = np.std(np.concatenate(found), axis=0, ddof=1)
            tolerance = np.array([numerical_tolerance(float(v), digits) for v in u])
            spread = 2.0 * np.std(np.stack(results), axis=0, ddof=1) / math.sqrt(len(results))
            stable = bool(np.all(spread < tolerance))
            if stable or (len(found) + 1) * size > most_trials:
                return summary(np.concatenate(found), probability, stable=stable)


def summary(outputs: Floats, probability: float = COVERAGE, *, stable: bool = True) -> Distributed:
    """Return the statistics of outputs (trials, m). Source: JCGM 101:2008, 7.5 to 7.7, 5.3.4."""
    if not np.all(np.isfinite(outputs)):
        raise CalibrationError("the function gives no number for some draws of its inputs; limit them")
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
    return Distributed(outputs.mean(axis=0), covariance, symmetric, shortest, probability, trials, stable)


# --- clause 8 ---------------------------------------------------------------------------------------


def numerical_tolerance(u: float, digits: int = 2) -> float:
    """Return delta: half a unit of the last of so many significant digits of u. Source: JCGM 101:2008, 7.9.2."""
    if u <= 0.0 or not math.isfinite(u):
        return 0.0
    mantissa = f"{u:.{digits - 1}e}"
    return 0.5 * 10.0 ** (int(mantissa.split("e")[1]) - digits + 1)


@dataclass(frozen=True)
class Validation:
    """Whether linear propagation stands beside Monte Carlo: a row for each of m outputs.

    `low`, `high` (m,) are the absolute differences of the interval ends, `tolerance` (m,) is delta, `ratio`
    (m,) Monte Carlo's u over the linear one.
    """

    low: Floats
    high: Floats
    tolerance: Floats
    ratio: Floats

    @property
    def validated(self) -> Mask:
        """Where both ends agree within delta, shape (m,)."""
        return np.asarray((self.low <= self.tolerance) & (self.high <= self.tolerance))


def validate(
    linear: Propagated, trials: Distributed, digits: int = 1, *, shortest: bool = False
) -> Validation:
    """Compare the coverage intervals of both methods. Source: JCGM 101:2008, 8.1.

    `digits` of u are those that count as meaningful. Compared is the probabilistically symmetric interval,
    or the shortest.
    """
    reach = linear.expanded(trials.probability)
    low, high = (trials.shortest if shortest else trials.symmetric).T
    tolerance = np.array([numerical_tolerance(float(u), digits) for u in linear.u])
    ratio = np.divide(trials.u, linear.u, out=np.ones_like(linear.u), where=linear.u > 0.0)
    return Validation(
        np.abs(linear.value - reach - low), np.abs(linear.value + reach - high), tolerance, ratio
    )


def require_trials(trials: int, probability: float) -> None:
    """Refuse too few trials for a coverage interval (JCGM 101:2008, 7.2). Raises `CalibrationError`."""
    require_probability(probability)
    least = _least_trials(probability)
    if trials < least:
        raise CalibrationError(f"{trials} trials are too few for a coverage interval; take {least} or more")


def _least_trials(probability: float) -> int:
    return math.ceil(100.0 / (1.0 - probability))


def batches(count: int, batch: int) -> Iterator[int]:
    """Yield the sizes of the batches in which so many trials are made."""
    for begun in range(0, count, batch):
        yield min(batch, count - begun)


def _outputs(function: Function, draw: Draw, rng: np.random.Generator, trials: int) -> Iterator[Floats]:
    for size in batches(trials, BATCH):
        outputs = np.asarray(function(draw(rng, size)), dtype=np.float64)
        yield outputs.reshape(size, -1)


DRAWS_AT_ONCE: Final = 512
"""So small that a batch stays in the cache and that its product is not shared out among threads."""


@dataclass(frozen=True)
class Moments(HasCovariance):
    """Mean (m,) and covariance (m, m) of outputs, with the number of trials."""

    mean: Floats
    covariance: Floats
    trials: int


def linear_noise(gain: Floats, sigma: Floats, seed: int, trials: int) -> Moments:
    """Propagate independent normal noise of sizes `sigma` (n,) through a gain (m, n).

    Draws are of single precision, sums of double. The result depends on the number of processors, each of
    which has a stream of its own from `seed`.
    """
    workers = os.cpu_count() or 1
    streams = np.random.SeedSequence(seed).spawn(workers)
    counts = [trials // workers + (i < trials % workers) for i in range(workers)]
    scaled = np.zeros((len(sigma) + len(sigma) % 2, len(gain)), dtype=np.float32)
    scaled[: len(sigma)] = (gain * sigma).T

    def run(stream: np.random.SeedSequence, count: int) -> tuple[Floats, Floats]:
        draws = _NormalDraws(np.random.Generator(np.random.SFC64(stream)), len(scaled))
        total, squares = np.zeros(len(gain)), np.zeros((len(gain), len(gain)))
        for begun in range(0, count, DRAWS_AT_ONCE):
            outputs = draws.batch()[: count - begun] @ scaled
            total += outputs.sum(axis=0, dtype=np.float64)
            squares += outputs.T @ outputs
        return total, squares

    with ThreadPoolExecutor(workers) as pool:
        sums = list(pool.map(run, streams, counts))
    mean = np.sum([part[0] for part in sums], axis=0) / trials
    squares = np.sum([part[1] for part in sums], axis=0)
    return Moments(mean, (squares - trials * np.outer(mean, mean)) / (trials - 1), trials)


class _NormalDraws:
    """Standard normal draws by pairs (Box and Muller, Ann. Math. Stat. 29 (1958) 610).

    Twice as fast as the generator's own, since logarithm and sines go through vector instructions. Steps of
    2^-24 in the uniform draws end the tails at 5.8 standard deviations.
    """

    def __init__(self, rng: np.random.Generator, count: int) -> None:
        self._rng = rng
        self._half = count // 2
        self._uniform = np.empty((2, DRAWS_AT_ONCE, self._half), dtype=np.float32)
        self._radius = np.empty((DRAWS_AT_ONCE, self._half), dtype=np.float32)
        self._normal = np.empty((DRAWS_AT_ONCE, count), dtype=np.float32)

    def batch(self) -> Singles:
        """Return draws (BATCH, count) in memory that the next batch takes again."""
        radius, (first, angle) = self._radius, self._uniform
        self._rng.random(out=self._uniform, dtype=np.float32)
        np.log(np.subtract(np.float32(1.0), first, out=radius), out=radius)
        np.sqrt(np.multiply(radius, np.float32(-2.0), out=radius), out=radius)
        np.multiply(angle, np.float32(2.0 * np.pi), out=angle)
        for function, part in ((np.cos, slice(0, self._half)), (np.sin, slice(self._half, None))):
            function(angle, out=self._normal[:, part])
            self._normal[:, part] *= radius
        return self._normal
