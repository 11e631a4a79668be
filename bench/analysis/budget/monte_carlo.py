"""Propagation of distributions by Monte Carlo, and whether linear propagation agrees with it.

Source: JCGM 101:2008 (GUM Supplement 1), clauses 5.3.4, 6.4, 7 and 8; JCGM 102:2011 for several outputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.analysis.budget.propagation import COVERAGE, Propagated, require_probability
from bench.analysis.calibration.result import CalibrationError
from bench.base.arrays import Floats, HasCovariance, Mask
from bench.model.distribution import Distribution

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
