"""Whether a measured value conforms to a tolerance of ±limit, and with which risk the decision is wrong.

The measured value y with its standard uncertainty u is the best estimate of what is measured, whose distribution
is normal, or a scaled and shifted Student t where u has finite degrees of freedom (JCGM 101:2008, 6.4.9); nothing
else is known of it, so that this is the distribution after the measurement. The conformance probability is
its part within the tolerance (JCGM 106:2012, 7). Rules and statements: JCGM 106:2012, 8 and ILAC-G8:09/2019.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from bench.analysis.calibration.result import CalibrationError
from bench.base.arrays import Floats

SIMPLE: Final = "simple acceptance"
GUARDED: Final = "guarded"
NON_BINARY: Final = "non-binary"
RULES: Final = (SIMPLE, GUARDED, NON_BINARY)

COVERAGE_FACTOR: Final = 2.0
"""U is so many times u where its degrees of freedom are infinite."""

_COVERAGE: Final = float(special.ndtr(COVERAGE_FACTOR) - special.ndtr(-COVERAGE_FACTOR))
_SEED: Final = 106
"""Of the draws that give the probability of several values together."""
_DRAWS: Final = 100_000
_AT_ONCE: Final = 10_000
_NEGLIGIBLE: Final = 1e-9
_FAR: Final = 12.0
"""So many standard deviations away nothing is left of a normal distribution."""


class Statement(StrEnum):
    """A statement of conformity (ILAC-G8:09/2019, 4.2), or why there is none; the worst of several stands last."""

    PASS = "pass"
    CONDITIONAL_PASS = "conditional pass"
    CONDITIONAL_FAIL = "conditional fail"
    INCONCLUSIVE = "inconclusive"
    NOT_COMPLETE = "not complete"
    FAIL = "fail"


@dataclass(frozen=True)
class DecisionRule:
    """How the uncertainty counts: `name` is one of `RULES`, the guard band is w = `guard_band` · U.

    Simple acceptance takes nothing off the limit; its statements have a guard band of U. The guarded rule accepts
    up to limit − w. The non-binary one accepts there, too, and rejects beyond limit + w; what lies between is
    stated, and accepted by nobody but the customer.
    """

    name: str = SIMPLE
    guard_band: float = 1.0

    @classmethod
    def of(cls, asked: str | DecisionRule, guard_band: float | None = None) -> DecisionRule:
        """Return the rule for what a person typed: "simple" is simple acceptance. Raises `CalibrationError`."""
        if isinstance(asked, DecisionRule):
            return asked
        name = SIMPLE if asked == "simple" else asked
        if name not in RULES:
            raise CalibrationError(f"no decision rule {asked!r}; there are {', '.join(RULES)}")
        if guard_band is None:
            return cls(name)
        if name == SIMPLE:
            raise CalibrationError(
                "simple acceptance takes no guard band off the limit; leave it out, or ask for the rule guarded"
            )
        if not (math.isfinite(guard_band) and guard_band > 0.0):
            raise CalibrationError(
                f"a guard band of {guard_band:g} U: expected a positive number, such as 0.83"
            )
        return cls(name, guard_band)

    @property
    def words(self) -> str:
        """The rule as a verdict names it: "guarded (w = 0.83 U)"."""
        times = "" if self.guard_band == 1.0 else f"{self.guard_band:g} "
        return self.name if self.name == SIMPLE else f"{self.name} (w = {times}U)"

    def acceptance_limit(self, limit: float, expanded: float) -> float:
        """Return up to which |y| is accepted where y has the expanded uncertainty `expanded`.

        Negative where nothing is: where U is more than the limit no value can be stated to conform, not even 0.
        Source: JCGM 106:2012, 8.2.1 and 8.3.2.1.
        """
        if not expanded <= limit:
            return limit - max(1.0, self.guard_band) * expanded
        return limit if self.name == SIMPLE else limit - self.guard_band * expanded

    def rejects(self, statement: Statement) -> bool:
        """Whether a value with this statement that is not accepted is rejected.

        What nothing can be said of is not, nor is a conditional pass under the non-binary rule.
        """
        left_open = statement is Statement.CONDITIONAL_PASS and self.name == NON_BINARY
        return statement is not Statement.INCONCLUSIVE and not left_open

    def statement(self, value: float, limit: float, expanded: float) -> Statement:
        """Return the statement on a measured value.

        With U beyond the limit there is none but "fail", of a value that is out by more than the guard band and U.
        """
        size, guard, capable = abs(value), self.guard_band * expanded, expanded <= limit
        if not math.isfinite(size) or size > limit + (guard if capable else max(guard, expanded)):
            return Statement.FAIL
        if not capable:
            return Statement.INCONCLUSIVE
        if size > limit:
            return Statement.CONDITIONAL_FAIL
        return Statement.PASS if size <= limit - guard else Statement.CONDITIONAL_PASS


def coverage_factor(dof: ArrayLike) -> Floats:
    """Return k of U = k u for degrees of freedom, of any shape: 2 where they are infinite, else of the same level.

    Source: JCGM 100:2008, G.3.
    """
    nu = np.asarray(dof, dtype=np.float64)
    finite = special.stdtrit(np.where(np.isinf(nu), 1.0, nu), 0.5 * (1.0 + _COVERAGE))
    return np.asarray(np.where(np.isinf(nu), COVERAGE_FACTOR, finite), dtype=np.float64)


def probability_outside(value: ArrayLike, u: ArrayLike, limit: float, dof: ArrayLike = np.inf) -> Floats:
    """Return the probability that what was measured lies outside ±limit; 1 less it is the conformance probability.

    `value`, `u` and `dof` have one shape. It is the probability of a false acceptance where the value is accepted,
    and 1 less it that of a false rejection where not: the specific risks. Source: JCGM 106:2012, 7.4 and 9.3.
    """
    y, size, nu = np.broadcast_arrays(
        *(np.asarray(each, dtype=np.float64) for each in (np.abs(value), u, dof))
    )
    spread = np.where(size > 0.0, size, 1.0)
    beyond = _below((y - limit) / spread, nu) + _below((-y - limit) / spread, nu)
    return np.where(size > 0.0, beyond, np.where(y > limit, 1.0, 0.0))


def _below(t: Floats, dof: Floats) -> Floats:
    """Return the distribution function of Student t, normal where the degrees of freedom are infinite."""
    finite = special.stdtr(np.where(np.isinf(dof), 1.0, dof), t)
    return np.where(np.isinf(dof), special.ndtr(t), finite)


def probability_one_outside(
    value: Floats, covariance: Floats, limit: float, dof: ArrayLike = np.inf
) -> float:
    """Return the probability that of n quantities at least one lies outside ±limit.

    `value` (n,) with `covariance` (n, n) and `dof`, of which the least counts for all: they were found together.
    By `_DRAWS` draws with a seed of its own, the same at each call: a probability of 0.01 is found to 0.0003.
    Rarer ones are held by those of the single quantities: at least the largest, at most their sum.
    """
    single = probability_outside(value, np.sqrt(np.maximum(np.diag(covariance), 0.0)), limit, dof)
    least, most = float(np.max(single)), min(float(np.sum(single)), 1.0)
    if len(value) == 1 or most - least <= _NEGLIGIBLE:
        return least
    variances, axes = np.linalg.eigh(covariance)
    spread = axes * np.sqrt(np.maximum(variances, 0.0))
    nu = float(np.min(np.asarray(dof)))
    rng = np.random.default_rng(_SEED)
    outside = 0
    for _ in range(_DRAWS // _AT_ONCE):
        drawn = rng.standard_normal((_AT_ONCE, len(value))) @ spread.T
        if math.isfinite(nu):
            drawn *= np.sqrt(nu / rng.chisquare(nu, _AT_ONCE))[:, None]
        outside += int(np.sum(np.any(np.abs(value + drawn) > limit, axis=1)))
    return min(max(outside / _DRAWS, least), most)


@dataclass(frozen=True)
class Population:
    """What is known of a quantity over all items before one is measured: normal, with mean and deviation."""

    mean: float
    standard_deviation: float

    def __post_init__(self) -> None:
        """Refuse what is no population. Raises `CalibrationError`."""
        sizes = (self.mean, self.standard_deviation)
        if not all(map(math.isfinite, sizes)) or self.standard_deviation <= 0.0:
            raise CalibrationError(
                f"a population of mean {self.mean:g} and standard deviation {self.standard_deviation:g}: "
                "expected two numbers, the second positive"
            )


@dataclass(frozen=True)
class GlobalRisk:
    """Of all items of a population: the part accepted without conforming, and the part rejected that conforms."""

    false_accept: float
    false_reject: float


def global_risk(
    population: Population, u: float, limit: float, accepted_up_to: float, dof: float = math.inf
) -> GlobalRisk:
    """Return the global risks of accepting measured values up to ±`accepted_up_to`, measured with u.

    The double integral over true and measured value, of which the inner one has a closed form. Source:
    JCGM 106:2012, 9.5.
    """
    from scipy.integrate import quad

    mean, deviation = population.mean, population.standard_deviation

    def accepted(true: float) -> float:
        if accepted_up_to < 0.0:
            return 0.0
        if u == 0.0:
            return float(abs(true) <= accepted_up_to)
        at = np.array([accepted_up_to - true, -accepted_up_to - true]) / u
        high, low = _below(at, np.full(2, dof))
        return float(high - low)

    def density(true: float) -> float:
        z = (true - mean) / deviation
        return math.exp(-0.5 * z * z) / (deviation * math.sqrt(2.0 * math.pi))

    def part(low: float, high: float, *, of_accepted: bool) -> float:
        low, high = max(low, mean - _FAR * deviation), min(high, mean + _FAR * deviation)
        if high <= low:
            return 0.0
        bends = [x for x in (mean, accepted_up_to, -accepted_up_to, limit, -limit) if low < x < high]
        return float(
            quad(
                lambda x: density(x) * (accepted(x) if of_accepted else 1.0 - accepted(x)),
                low, high, points=bends or None, limit=200, epsabs=1e-12,
            )[0]
        )  # fmt: skip

    consumer = part(-math.inf, -limit, of_accepted=True) + part(limit, math.inf, of_accepted=True)
    return GlobalRisk(consumer, part(-limit, limit, of_accepted=False))
