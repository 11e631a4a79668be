"""Conformity of a measured value with a tolerance ±limit, and the risk of a wrong decision.

A measured value y with standard uncertainty u gives the measurand a normal distribution, or a scaled and
shifted Student t for finite degrees of freedom (JCGM 101:2008, 6.4.9). Without other knowledge this is the
posterior. A stated population is the prior, and Bayes' theorem gives the posterior (JCGM 106:2012, 6.2 and
A.4). The conformance probability is the posterior probability of the tolerance interval (JCGM 106:2012, 7).
Rules and statements: JCGM 106:2012, 8 and ILAC-G8:09/2019.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from bench.base.arrays import Floats, Mask
from bench.base.languages import message
from bench.calibration.result import CalibrationError

SIMPLE: Final = message("simple acceptance")
GUARDED: Final = message("guarded")
NON_BINARY: Final = message("non-binary")
RULES: Final = (SIMPLE, GUARDED, NON_BINARY)

FALSE_ACCEPTANCE: Final = 0.05
"""Largest probability of a false acceptance at a point under the default decision rule."""
NOMINAL_BAND: Final = float(special.ndtri(1.0 - FALSE_ACCEPTANCE)) / 2.0
"""Default guard band in units of U: 1.645 u, for a normal distribution far from the other limit."""

COVERAGE_FACTOR: Final = 2.0
"""Coverage factor k of U = k u for infinite degrees of freedom."""

_SEED: Final = 106
"""Seed of the Monte Carlo draws for the joint probability of several values."""
_DRAWS: Final = 100_000
_AT_ONCE: Final = 10_000
_NEGLIGIBLE: Final = 1e-9
_SCALES: Final = 201
"""Number of normal distributions in the mixture that approximates a t distribution."""
_FARTHEST: Final = 30.0
_ALIKE: Final = {1.0: 0.8, 0.0: 0.2}
"""Prior probability of each correlation between the errors at the points of one block.

One error common to all points (correlation 1) is more probable than independent errors (0).
"""
_HALVINGS: Final = 50
_FAR: Final = 12.0
"""Number of standard deviations beyond which a normal distribution is negligible."""


class Statement(StrEnum):
    """A statement of conformity (ILAC-G8:09/2019, 4.2), or the reason for none, from best to worst."""

    PASS = message("pass", "statement")
    CONDITIONAL_PASS = message("conditional pass")
    CONDITIONAL_FAIL = message("conditional fail")
    INCONCLUSIVE = "inconclusive"
    NOT_COMPLETE = "not complete"
    MISFIT = message("does not fit")
    FAIL = message("fail", "statement")


@dataclass(frozen=True)
class DecisionRule:
    """A decision rule: `name` is one of `RULES`, the guard band is w = `guard_band` · U.

    Simple acceptance accepts values up to the limit, and uses w = U only for its statements. The guarded and the
    non-binary rule accept values up to limit − w. Values between limit − w and the limit are rejected by the
    guarded rule; for the non-binary rule they are conditional passes, on which the customer decides. Values beyond
    the limit are rejected: up to limit + w they are conditional fails. If U exceeds the limit, no value is accepted
    (see `statements`). If `guard_band` is None (the default rule), w makes the largest probability of a false
    acceptance equal to `FALSE_ACCEPTANCE`.
    """

    name: str = NON_BINARY
    guard_band: float | None = None

    @classmethod
    def of(cls, asked: str | DecisionRule | None, guard_band: float | None = None) -> DecisionRule:
        """Return the decision rule with the name that the user typed; "simple" means simple acceptance.

        None gives the default rule, or the non-binary rule if a `guard_band` is given. A named rule without a guard
        band has w = U. Raises `CalibrationError` for an unknown rule or an unsuitable guard band.
        """
        if isinstance(asked, DecisionRule):
            return asked
        if asked is None and guard_band is None:
            return cls()
        name = {None: NON_BINARY, "simple": SIMPLE}.get(asked, asked)
        if name not in RULES:
            raise CalibrationError(f"unknown decision rule {asked!r}; choose from {', '.join(RULES)}")
        if guard_band is None:
            return cls(name, 1.0)
        if name == SIMPLE:
            raise CalibrationError(
                "simple acceptance has no guard band; remove the guard band, or choose the rule 'guarded'"
            )
        if not (math.isfinite(guard_band) and guard_band > 0.0):
            raise CalibrationError(
                f"a guard band of {guard_band:g} U is not positive; give a positive number, such as 0.83"
            )
        return cls(name, guard_band)

    @property
    def false_acceptance(self) -> float | None:
        """Probability of a false acceptance that sets the guard band; None if the band is a multiple of U."""
        return FALSE_ACCEPTANCE if self.guard_band is None else None

    def to_json(self) -> dict[str, str | float | None]:
        """Return the rule in the JSON form of results."""
        band = NOMINAL_BAND if self.guard_band is None else self.guard_band
        return {"rule": self.name, "guard_band": band, "false_acceptance": self.false_acceptance}

    @classmethod
    def of_json(cls, told: Mapping[str, Any]) -> DecisionRule:
        """Return the rule from its JSON form, which an earlier version may have written."""
        return cls(told["rule"], None if told.get("false_acceptance") else told["guard_band"])

    @property
    def words(self) -> str:
        """The rule as a verdict names it: "guarded (w = 0.83 U)"."""
        if self.guard_band is None:
            return message(f"{self.name} (false acceptance ≤ {100 * FALSE_ACCEPTANCE:g} % a point)")
        times = "" if self.guard_band == 1.0 else f"{self.guard_band:g} "
        return self.name if self.name == SIMPLE else message(f"{self.name} (w = {times}U)")

    def acceptance_limit(self, limit: float, known: MeasuredValues) -> Floats:
        """Return the largest accepted |y| of each of n measured values, shape (n,).

        A negative result means that no value is accepted, for example because U exceeds the limit. Source: JCGM
        106:2012, 8.2.1 and 8.3.2.1.
        """
        sure = self.pass_limit(limit, known)
        return np.where(known.expanded <= limit, limit, sure) if self.name == SIMPLE else sure

    def pass_limit(self, limit: float, known: MeasuredValues) -> Floats:
        """Return the largest |y| (n,) with the statement "pass"; negative if no value passes."""
        if self.guard_band is None:
            capable = known.expanded <= limit
            return np.where(capable, _largest_sure(limit, known), limit - known.expanded)
        return (
            limit
            - np.where(known.expanded <= limit, self.guard_band, max(1.0, self.guard_band)) * known.expanded
        )

    def rejects(self, statement: Statement) -> bool:
        """Return whether the rule rejects a value that it does not accept, given the `statement` on it.

        An inconclusive value is not rejected, nor is a conditional pass under the non-binary rule. A conditional
        fail is rejected, because nonconformity is more likely than conformity; the result states the probability
        of a false rejection.
        """
        left_open = statement is Statement.CONDITIONAL_PASS and self.name == NON_BINARY
        return statement is not Statement.INCONCLUSIVE and not left_open

    def statements(self, value: Floats, limit: float, known: MeasuredValues) -> list[Statement]:
        """Return the statements on measured values (n,).

        If U exceeds the limit, a value fails if it is beyond the limit by more than the guard band and by more than
        U. Any other value is then inconclusive. The guard band beyond the limit follows from the measurement alone,
        without the population.
        """
        if self.guard_band is None:
            guard = _quantile(1.0 - FALSE_ACCEPTANCE, known.dof) * known.u
        else:
            guard = self.guard_band * known.expanded
        rows = zip(
            np.abs(value).tolist(), guard.tolist(), known.expanded.tolist(),
            self.pass_limit(limit, known).tolist(), strict=True,
        )  # fmt: skip
        return [_statement(*row, limit) for row in rows]


def _statement(size: float, guard: float, expanded: float, passes_to: float, limit: float) -> Statement:
    capable = expanded <= limit
    if not math.isfinite(size) or size > limit + (guard if capable else max(guard, expanded)):
        return Statement.FAIL
    if not capable:
        return Statement.INCONCLUSIVE
    if size > limit:
        return Statement.CONDITIONAL_FAIL
    return Statement.PASS if size <= passes_to else Statement.CONDITIONAL_PASS


@dataclass(frozen=True)
class MeasuredValues:
    """Standard and expanded uncertainties (n,) of n measured values, and the prior of the measurand.

    `dof` (n,) are the degrees of freedom; `population` is the prior, None without prior knowledge.
    """

    u: Floats
    expanded: Floats
    dof: Floats
    population: Population | None = None

    @classmethod
    def of(cls, u: ArrayLike, population: Population | None = None) -> MeasuredValues:
        """Return the uncertainties of normal distributions, with U = 2 u."""
        size = np.atleast_1d(np.asarray(u, dtype=np.float64))
        return cls(size, COVERAGE_FACTOR * size, np.full(size.shape, np.inf), population)

    def but(self, *, times: float) -> MeasuredValues:
        """Return a copy with all uncertainties multiplied by `times`."""
        return replace(self, u=times * self.u, expanded=times * self.expanded)

    def outside(self, value: ArrayLike, limit: float) -> Floats:
        """Return the probabilities (n,) that the measurands of the measured values (n,) lie outside ±limit."""
        return probability_outside(value, self.u, limit, self.dof, self.population)


def _largest_sure(limit: float, known: MeasuredValues) -> Floats:
    """Return the largest |y| (n,) at which a false acceptance is at most as probable as `FALSE_ACCEPTANCE`.

    The limit holds for y and for −y. The result is at most the limit, and −limit if even y = 0 is too risky.
    Bisection finds it, because the probability for the worse sign grows with |y|.
    """

    def sure(size: Floats) -> Mask:
        both = [known.outside(side * size, limit) for side in (1.0, -1.0)]
        return np.maximum(*both) <= FALSE_ACCEPTANCE

    low, high = np.zeros(known.u.shape), np.full(known.u.shape, limit)
    none, all_of_it = ~sure(low), sure(high)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        inside = sure(middle)
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return np.where(none, -limit, np.where(all_of_it, limit, low))


def _quantile(level: float, dof: Floats) -> Floats:
    """Return the quantile of Student t, normal where the degrees of freedom are infinite."""
    finite = special.stdtrit(np.where(np.isinf(dof), 1.0, dof), level)
    return np.where(np.isinf(dof), special.ndtri(level), finite)


def probability_outside(
    value: ArrayLike,
    u: ArrayLike,
    limit: float,
    dof: ArrayLike = np.inf,
    population: Population | None = None,
) -> Floats:
    """Return the probability that the measurand lies outside ±limit: one minus the conformance probability.

    `value`, `u` and `dof` are broadcast to one shape. For an accepted value, the result is the specific
    consumer's risk; for a rejected value, one minus the result is the specific producer's risk. `population`
    is the prior of the measurand. Source: JCGM 106:2012, 7.4, 9.3 and A.4.
    """
    y, size, nu = np.broadcast_arrays(*(np.asarray(each, dtype=np.float64) for each in (value, u, dof)))
    if population is not None:
        sizes, weight = _mixture(y, size, nu, population)
        shrunk = population.variance / (population.variance + sizes**2)
        mean = population.mean + shrunk * (y - population.mean)
        infinite = np.full(mean.shape, np.inf)
        beyond = _beyond(mean, np.sqrt(shrunk) * sizes, limit, infinite)
        return np.asarray(np.sum(weight * beyond, axis=0))
    return _beyond(y, size, limit, nu)


def _beyond(mean: Floats, size: Floats, limit: float, dof: Floats) -> Floats:
    """Return the probability (…) outside ±limit of a t distribution about `mean`; 0 or 1 where `size` is 0."""
    spread, y = np.where(size > 0.0, size, 1.0), np.abs(mean)
    beyond = _below((y - limit) / spread, dof) + _below((-y - limit) / spread, dof)
    return np.where(size > 0.0, beyond, np.where(y > limit, 1.0, 0.0))


def _mixture(y: Floats, u: Floats, dof: Floats, population: Population) -> tuple[Floats, Floats]:
    """Return the normal mixture that replaces Student t: standard deviations and posterior weights, (m, …) each.

    The weights are those after the measured values `y` (…), whose measurands have the prior `population`.
    """
    if np.all(np.isinf(dof)):
        return u[None], np.ones((1, *y.shape))
    factors, log_weights = _scales(dof)
    sizes = np.sqrt(factors) * u
    variance = population.variance + sizes**2
    off = (y - population.mean) ** 2 / variance + np.log(variance)
    return sizes, special.softmax(log_weights - 0.5 * off, axis=0)


def _scales(dof: Floats) -> tuple[Floats, Floats]:
    """Return variance factors and log weights, each (m, …), of normal distributions whose mixture approximates a t.

    The factors are quantiles of chi-square at probabilities evenly spaced in the logit, which covers the far tails.
    """
    logit = np.linspace(-_FARTHEST, _FARTHEST, _SCALES).reshape(-1, *[1] * np.ndim(dof))
    nu = np.where(np.isinf(dof), 1.0, dof)[None]
    factors = np.where(np.isinf(dof)[None], 1.0, nu / special.chdtri(nu, special.expit(-logit)))
    return factors, np.broadcast_to(special.log_expit(logit) + special.log_expit(-logit), factors.shape)


def _below(t: Floats, dof: Floats) -> Floats:
    """Return the distribution function of Student t, normal where the degrees of freedom are infinite."""
    finite = special.stdtr(np.where(np.isinf(dof), 1.0, dof), t)
    return np.where(np.isinf(dof), special.ndtr(t), finite)


def probability_one_outside(
    value: Floats, covariance: Floats, limit: float, population: Population | None = None
) -> float:
    """Return the probability that at least one of n quantities lies outside ±limit.

    `value` (n,) are measured values whose errors are normal with the `covariance` (n, n). `population` is the
    prior of each quantity. With it, the n quantities are equal with the prior probability 0.8, and else
    independent.

    The result is from random draws with a fixed seed, hence reproducible; a probability of 0.01 is accurate
    to 0.0001. The result is limited to the range from the largest single probability to the sum of all n.
    """
    return _one_outside(*(tuple(np.ravel(each).tolist()) for each in (value, covariance)), limit, population)


@lru_cache(maxsize=64)  # a command asks for its verdict several times: in text, result and report
def _one_outside(
    values: tuple[float, ...], covariances: tuple[float, ...], limit: float, population: Population | None
) -> float:
    value, covariance = np.array(values), np.reshape(covariances, (len(values), -1))
    parts = [(1.0, value, covariance)] if population is None else _after(value, covariance, population)
    single = _each_outside(parts, limit)
    least, most = float(np.max(single)), min(float(np.sum(single)), 1.0)
    if len(value) == 1 or most - least <= _NEGLIGIBLE:
        return least
    rng = np.random.default_rng(_SEED)
    outside = 0.0
    for weight, mean, spread in parts:
        times = max(_DRAWS // len(parts) // _AT_ONCE, 1)
        outside += weight * float(np.mean([_union(rng, mean, spread, limit) for _ in range(times)]))
    return min(max(outside, least), most)


def probability_worst_outside(
    value: Floats, covariance: Floats, limit: float, population: Population
) -> float:
    """Return the largest of the n probabilities that a quantity lies outside ±limit, given all values.

    See `probability_one_outside` for the arguments.
    """
    parts = _after(value, covariance, population)
    return float(np.max(_each_outside(parts, limit)))


def _each_outside(parts: Sequence[tuple[float, Floats, Floats]], limit: float) -> Floats:
    """Return for each quantity the probability (n,) that it is outside ±limit, given a mixture of normals.

    Each of `parts` is the weight, mean (n,) and covariance (n, n) of one normal.
    """
    return np.asarray(sum(w * probability_outside(mean, _sizes(c), limit) for w, mean, c in parts))


def _sizes(covariance: Floats) -> Floats:
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def _union(rng: np.random.Generator, mean: Floats, covariance: Floats, limit: float) -> float:
    """Return the probability that at least one of n normal quantities is outside ±limit, from `_AT_ONCE` draws.

    In each draw, one quantity is outside: it is chosen with its own probability, and the others are conditional on
    it. A draw counts 1 / (number outside). Source: Owen, Maximov and Chertkov, Electron. J. Statist. 13 (2019) 231.
    """
    size, single = _sizes(covariance), probability_outside(mean, _sizes(covariance), limit)
    spread = np.where(size > 0.0, size, 1.0)
    total, draws = float(single.sum()), np.arange(_AT_ONCE)
    if total == 0.0:
        return 0.0
    own = rng.choice(len(mean), _AT_ONCE, p=single / total)
    variances, axes = np.linalg.eigh(covariance)
    drawn = rng.standard_normal((_AT_ONCE, len(mean))) @ (axes * np.sqrt(np.maximum(variances, 0.0))).T
    below, place = special.ndtr((-limit - mean) / spread)[own], rng.random(_AT_ONCE) * single[own]
    is_below = place < below
    z = special.ndtri(np.where(is_below, place, np.maximum(place - below, np.finfo(float).tiny)))
    z = np.where(is_below, z, -z)
    shift = (spread[own] * z - drawn[draws, own]) / spread[own] ** 2
    outside = np.abs(mean + drawn + shift[:, None] * covariance[own]) > limit
    outside[draws, own] = True
    return total * float(np.mean(1.0 / outside.sum(axis=1)))


def _after(value: Floats, covariance: Floats, population: Population) -> list[tuple[float, Floats, Floats]]:
    """Return weight, mean (n,) and covariance (n, n) of each normal distribution in the posterior mixture."""
    n, off = len(value), value - population.mean
    found, log_weights = [], []
    for alike, probability in _ALIKE.items() if n > 1 else [(0.0, 1.0)]:
        prior = population.variance * (alike * np.ones((n, n)) + (1.0 - alike + _NEGLIGIBLE) * np.eye(n))
        both = prior + covariance
        gain = np.linalg.solve(both, prior).T
        found.append((population.mean + gain @ off, prior - gain @ prior))
        fit = off @ np.linalg.solve(both, off) + np.linalg.slogdet(both)[1]
        log_weights.append(math.log(probability) - 0.5 * fit)
    weights = special.softmax(log_weights).tolist()
    return [(w, *after) for w, after in zip(weights, found, strict=True) if w > _NEGLIGIBLE]


@dataclass(frozen=True)
class Population:
    """Normal prior distribution of a quantity over all items, with its mean and standard deviation."""

    mean: float
    standard_deviation: float

    def __post_init__(self) -> None:
        """Raise `CalibrationError` unless mean and standard deviation are finite and the latter is positive."""
        sizes = (self.mean, self.standard_deviation)
        if not all(map(math.isfinite, sizes)) or self.standard_deviation <= 0.0:
            raise CalibrationError(
                f"a population of mean {self.mean:g} and standard deviation {self.standard_deviation:g} is "
                "impossible; give two numbers, the second above 0"
            )

    @property
    def variance(self) -> float:
        """The square of the standard deviation."""
        return self.standard_deviation**2


@dataclass(frozen=True)
class GlobalRisk:
    """Fractions of a population that are accepted but nonconforming, or rejected but conforming."""

    false_accept: float
    false_reject: float


def global_risk(population: Population, u: float, limit: float, accepted_up_to: float) -> GlobalRisk:
    """Return the global risks if values measured with uncertainty `u` are accepted up to ±`accepted_up_to`.

    The double integral over true and measured value has an inner integral in closed form. Source: JCGM 106:2012,
    9.5.
    """
    from scipy.integrate import quad

    mean, deviation = population.mean, population.standard_deviation

    def accepted(true: float) -> float:
        if accepted_up_to < 0.0:
            return 0.0
        if u == 0.0:
            return float(abs(true) <= accepted_up_to)
        at = np.array([accepted_up_to - true, -accepted_up_to - true]) / u
        high, low = special.ndtr(at)
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


def global_risk_together(
    population: Population, covariance: Floats, limit: float, accepted_up_to: Floats
) -> GlobalRisk:
    """Return the global risks if a block is accepted only with each of its n values within ±`accepted_up_to` (n,).

    The values are of one true value; their errors have the `covariance` (n, n). The errors are drawn, with a fixed
    seed; for each draw the accepted true values form an interval, whose fraction of the population is computed
    exactly.
    """
    errors = _drawn(covariance)
    low, high = np.max(-accepted_up_to - errors, axis=1), np.min(accepted_up_to - errors, axis=1)

    def share(first: ArrayLike, last: ArrayLike) -> float:
        ends = [(np.asarray(end) - population.mean) / population.standard_deviation for end in (first, last)]
        return float(np.mean(np.maximum(special.ndtr(ends[1]) - special.ndtr(ends[0]), 0.0)))

    consumer = share(low, np.minimum(high, -limit)) + share(np.maximum(low, limit), high)
    return GlobalRisk(
        consumer, share(-limit, limit) - share(np.maximum(low, -limit), np.minimum(high, limit))
    )


def probability_all_accepted(covariance: Floats, accepted_up_to: Floats) -> float:
    """Return the probability that n errors with the `covariance` (n, n) are all within ±`accepted_up_to` (n,)."""
    return float(np.mean(np.all(np.abs(_drawn(covariance)) <= accepted_up_to, axis=1)))


def _drawn(covariance: Floats) -> Floats:
    """Return normal draws (m, n) with a `covariance` (n, n), which may be singular; the seed is fixed."""
    sizes, axes = np.linalg.eigh(covariance)
    drawn = np.random.default_rng(_SEED).standard_normal((_DRAWS, len(sizes)))
    return np.asarray(drawn @ (axes * np.sqrt(np.maximum(sizes, 0.0))).T)
