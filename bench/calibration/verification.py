"""The paper's check (9)-(10): |a| = g at the verification points, and its verdict in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from bench.base.arrays import Floats
from bench.base.numbers import finite_or_none
from bench.calibration.conformity import (
    NON_BINARY,
    SIMPLE,
    DecisionRule,
    GlobalRisk,
    Known,
    Population,
    Statement,
    coverage_factor,
    global_risk,
    probability_one_outside,
    probability_worst_outside,
)
from bench.calibration.result import CalibrationError
from bench.model.geometry import Block
from bench.readings.table import Readings

HIGHEST_CONDITION: Final = 1e8
"""Condition number of K above which its inverse is noise: a real block has one near 1."""


@dataclass(frozen=True)
class VerificationPoint:
    """One reading at a verification point: modulus `g_p` and its error `delta_g` in local g, with u and U = k u.

    `accepted_up_to` is the acceptance limit of the rule there: negative where U is more than the limit, and
    then nothing is accepted; what nothing can be said of is not `rejected` either. `p_outside` is the probability
    that the true error is outside the limit.
    """

    angle_deg: float
    pass_number: int
    point: int
    g_p: float
    delta_g: float
    u: float
    U: float
    k: float
    dof: float
    limit_g: float
    accepted_up_to: float
    statement: Statement
    rejected: bool
    p_outside: float

    @property
    def tur(self) -> float:
        """Test uncertainty ratio: the limit over U."""
        return self.limit_g / self.U if self.U > 0.0 else float("inf")

    @property
    def passed(self) -> bool:
        """Whether the rule accepts it."""
        return abs(self.delta_g) <= self.accepted_up_to

    @property
    def p_false_accept(self) -> float | None:
        """Probability of a false acceptance, of a conditional pass that is left open, too; None of all else."""
        left_open = self.statement is Statement.CONDITIONAL_PASS and not self.rejected
        return self.p_outside if self.passed or left_open else None

    @property
    def p_false_reject(self) -> float | None:
        """Probability of a false rejection; None where it is not rejected."""
        return 1.0 - self.p_outside if self.rejected else None

    def to_json(self) -> dict[str, Any]:
        """Return the point as it was promised."""
        return {
            "angle_deg": self.angle_deg,
            "pass": self.pass_number,
            "point": self.point,
            "g_p": self.g_p,
            "delta_g": self.delta_g,
            "u": self.u,
            "U": self.U,
            "k": self.k,
            "dof": finite_or_none(self.dof),
            "tur": finite_or_none(self.tur),
            "accepted_up_to": self.accepted_up_to,
            "passed": self.passed,
            "statement": str(self.statement),
            "p_false_accept": self.p_false_accept,
            "p_false_reject": self.p_false_reject,
        }


@dataclass(frozen=True)
class ToPass:
    """The limit of |delta g| (g) that would be met, and the part of u that would meet the limit as it is.

    `u_times` is None where no u is small enough; `point` lies furthest beyond what is accepted.
    """

    limit_g: float
    u_times: float | None
    point: VerificationPoint


def _bisected(passes: Callable[[float], bool], good: float, bad: float) -> float:
    """Return the value next to `bad` that passes, to a thousandth of the way; `good` where none else does."""
    for _ in range(12):
        middle = 0.5 * (good + bad)
        good, bad = (middle, bad) if passes(middle) else (good, middle)
    return good


@dataclass(frozen=True)
class Verification:
    """The verdict: |delta g| within the limit, by the rule, at every verification point.

    `missing` counts points that were planned or written down but could not be judged: with one missing
    nothing is accepted, since (10) is demanded of every point. `covariance` (n, n) is that of delta g at the
    points, which have the coefficients in common, `contributions` its parts by name. `population` is what is known
    of delta g over many blocks.
    """

    limit_g: float
    points: tuple[VerificationPoint, ...]
    covariance: Floats
    missing: int = 0
    decision: DecisionRule = field(default_factory=DecisionRule)
    population: Population | None = None
    contributions: Mapping[str, Floats] = field(default_factory=dict)

    @property
    def rule(self) -> str:
        """Name of the decision rule."""
        return self.decision.name

    @property
    def passed(self) -> bool:
        """Whether every point was measured and passed."""
        return not self.missing and all(point.passed for point in self.points)

    @property
    def statement(self) -> Statement:
        """The statement on the worst of its points: one that fails cannot be made good by others."""
        found = [point.statement for point in self.points]
        found += [Statement.NOT_COMPLETE] * bool(self.missing)
        return max(found, key=list(Statement).index)

    @property
    def rejected(self) -> bool:
        """Whether the rule rejects a point, so that nothing more need be measured."""
        return any(point.rejected for point in self.points)

    @property
    def left_open(self) -> bool:
        """Whether it is a conditional pass that the rule neither accepts nor rejects."""
        return self.statement is Statement.CONDITIONAL_PASS and not self.passed and not self.rejected

    @property
    def worst(self) -> VerificationPoint:
        """The point with the largest |delta g|."""
        return max(self.points, key=lambda p: abs(p.delta_g))

    @property
    def expanded(self) -> float:
        """Largest expanded uncertainty of the points, local g."""
        return max(point.U for point in self.points)

    @property
    def tur(self) -> float:
        """Least test uncertainty ratio of the points."""
        return min(point.tur for point in self.points)

    @property
    def p_outside_worst(self) -> float:
        """Probability that the true error is outside the limit at that point where it is most probable.

        With a population it is that after all points' readings, as is the one of all points together.
        """
        if self.population is None:
            return max(point.p_outside for point in self.points)
        return probability_worst_outside(
            self._errors, self.covariance, self.limit_g, self._dof, self.population
        )

    @cached_property
    def p_outside(self) -> float:
        """Probability that the true error is outside the limit at one of the points at least."""
        return probability_one_outside(
            self._errors, self.covariance, self.limit_g, self._dof, self.population
        )

    @property
    def _errors(self) -> Floats:
        return np.array([point.delta_g for point in self.points])

    @property
    def _dof(self) -> Floats:
        return np.array([point.dof for point in self.points])

    @cached_property
    def to_pass(self) -> ToPass | None:
        """What would make it pass, all else as it is; None where it passes, or points are missing."""
        if self.passed or self.missing:
            return None
        u, sizes = np.array([point.u for point in self.points]), np.abs(self._errors)
        known = Known.of(u, self._dof, self.population)

        def passes(limit: float, times: float) -> bool:
            return bool(np.all(sizes <= self.decision.acceptance_limit(limit, known.but(times=times))))

        most = float(np.max(sizes + (4.0 + (self.decision.guard_band or 0.0)) * known.expanded))
        needed = max(range(len(sizes)), key=lambda i: sizes[i] - self.points[i].accepted_up_to)
        return ToPass(
            limit_g=_bisected(lambda limit: passes(limit, 1.0), most, self.limit_g),
            u_times=_bisected(lambda times: passes(self.limit_g, times), 0.0, 1.0) or None,
            point=self.points[needed],
        )

    @cached_property
    def global_risk(self) -> GlobalRisk | None:
        """What the rule does to all blocks of the population, at the point with the largest U; None without one."""
        if self.population is None:
            return None
        point = max(self.points, key=lambda p: p.U)
        return global_risk(self.population, point.u, self.limit_g, point.accepted_up_to, point.dof)

    def to_json(self) -> dict[str, Any]:
        """Return the promised result."""
        of_all, accepted = self.global_risk, self.passed or self.left_open
        return {
            "limit_g": self.limit_g,
            **self.decision.to_json(),
            "passed": self.passed,
            "statement": str(self.statement),
            "missing": self.missing,
            "U": self.expanded,
            "tur": finite_or_none(self.tur),
            "p_false_accept": self.p_outside if accepted else None,
            "p_false_accept_worst": self.p_outside_worst if accepted else None,
            "p_false_reject": 1.0 - self.p_outside if self.rejected else None,
            "global_risk": None
            if of_all is None or self.population is None
            else {**vars(of_all), "population": vars(self.population)},
            "points": [point.to_json() for point in self.points],
            "covariance": self.covariance.tolist(),
        }


def verify(
    readings: Readings,
    block: Block,
    covariance: Floats,
    reading_noise: float | Floats,
    limit_g: float,
    g_ratio: float = 1.0,
    rule: str | DecisionRule | None = None,
    *,
    dof: ArrayLike = np.inf,
    joint: Mapping[str, Floats] | None = None,
    population: Population | None = None,
) -> Verification:
    """Apply (9)-(10) to the verification rows of a table.

    `g_ratio` is the gravity in which the coefficients are given over the local one: a block calibrated
    elsewhere measures in units of the gravity there. `covariance` (12, 12) of the coefficients and `reading_noise`
    fresh in each signal (unit of the signal; one size, or one for each channel) give u of each delta g, with
    degrees of freedom `dof`; or `joint` are the parts by name, (n, n) each, of the covariance of |a| at the
    points, in the gravity of the coefficients. The setting of the head does not enter, the modulus does not depend
    on it. `rule` is one of `RULES`, a rule with another guard band, or None for the default. Raises
    `CalibrationError` when there is no verification row, K is singular or the rule is unknown.
    """
    rows = readings.verification()
    if len(rows) == 0:
        raise CalibrationError(
            f"{readings.source}: no verification point (installation V) in it; "
            "run a procedure that has them, such as 'calibration'"
        )
    if not np.isfinite(block.K).all() or np.linalg.cond(block.K) > HIGHEST_CONDITION:
        raise CalibrationError(
            "the matrix K is singular, so no specific force follows from a signal; check the coefficients"
        )
    decision = DecisionRule.of(rule)
    force = block.specific_force(rows.signal)
    g_p = np.linalg.norm(force, axis=1) * g_ratio
    errors = g_p - 1.0
    by_coefficient, by_signal = modulus_slopes(force, block)
    if joint is None:
        joint = {
            "coefficients": by_coefficient @ covariance @ by_coefficient.T,
            "reading_at_the_point": np.diag(by_signal**2 @ np.broadcast_to(np.square(reading_noise), 3)),
        }
    joint = {name: part * g_ratio**2 for name, part in joint.items()}
    together = sum(joint.values(), np.zeros((len(rows), len(rows))))
    u = np.sqrt(np.maximum(np.diag(together), 0.0))
    known = Known.of(u, dof, population)
    k, outside = coverage_factor(known.dof), known.outside(errors, limit_g)
    accepted_up_to = decision.acceptance_limit(limit_g, known)
    statements = decision.statements(errors, limit_g, known)
    points = tuple(
        VerificationPoint(
            angle_deg=float(np.degrees(rows.angle_rad[i])),
            pass_number=int(rows.pass_number[i]),
            point=int(rows.point[i]),
            g_p=float(g_p[i]),
            delta_g=float(errors[i]),
            u=float(u[i]),
            U=float(known.expanded[i]),
            k=float(k[i]),
            dof=float(known.dof[i]),
            limit_g=limit_g,
            accepted_up_to=float(accepted_up_to[i]),
            statement=statements[i],
            rejected=bool(not abs(errors[i]) <= accepted_up_to[i] and decision.rejects(statements[i])),
            p_outside=float(outside[i]),
        )
        for i in range(len(rows))
    )
    return Verification(limit_g, points, together, readings.verification_missing, decision, population, joint)


def modulus_slopes(force: Floats, block: Block) -> tuple[Floats, Floats]:
    """Return the derivatives of |N (U - U0)| by the 12 coefficients (n, 12) and by the signals (n, 3).

    `force` (n, 3) is the measured specific force, g.
    """
    # d|a|/dU = (a/|a|)^T N, d|a|/dK_ij = -(that)_i a_j, d|a|/dU0 = -(that)
    modulus = np.linalg.norm(force, axis=1)
    by_signal = (force / modulus[:, None]) @ np.linalg.inv(block.K)
    by_k = -(by_signal[:, :, None] * force[:, None, :]).reshape(len(force), 9)
    return np.concatenate([by_k, -by_signal], axis=1), by_signal


HEADLINES: Final = {
    Statement.PASS: "passed",
    Statement.CONDITIONAL_PASS: "conditional pass",
    Statement.CONDITIONAL_FAIL: "conditional fail",
    Statement.INCONCLUSIVE: "inconclusive",
    Statement.NOT_COMPLETE: "not complete",
    Statement.FAIL: "failed",
}
"""What the verdict on a whole verification is called."""

_LEAST_SHOWN: Final = 1e-4
_MOST: Final = 2
"""So many contributions to u are named."""


def headline(result: Verification, *, upper: bool = False) -> str:
    """Return the verdict in a word or two; of a conditional pass, whether the rule accepts it."""
    word = HEADLINES[result.statement]
    word = word.upper() if upper else word
    if result.statement is Statement.CONDITIONAL_PASS:
        left_open = "for the customer to accept" if result.left_open else "not accepted"
        return f"{word}, {'accepted' if result.passed else left_open}"
    return word


def by_rule(statement: Statement, rule: str, *, passed: bool) -> Statement:
    """Return a statement as its rule makes it: a binary one knows pass and fail, and nothing conditional."""
    conditional = statement in {Statement.CONDITIONAL_PASS, Statement.CONDITIONAL_FAIL}
    if rule == NON_BINARY or not conditional:
        return statement
    return Statement.PASS if passed else Statement.FAIL


def rule_in_words(rule: DecisionRule) -> str:
    """Return what a decision rule accepts, with its source."""
    if rule.name == SIMPLE:
        return (
            "accepted when |Δg| ≤ limit at every verification point; no guard band is taken off the limit "
            "(JCGM 106:2012, 8.2)"
        )
    if rule.guard_band is None:
        band = "w = 1.645 u, or what is 5 % where degrees of freedom, both limits or a population count"
        sure = f"the probability of a false acceptance is at most 5 % at every verification point ({band})"
        return (
            f"accepted when {sure}; what lies between there and the limit is conditional, and the customer's to "
            "accept (JCGM 106:2012, 8.3.2; ILAC-G8:09/2019)"
        )
    times = "" if rule.guard_band == 1.0 else f"{rule.guard_band:g} "
    accepted = (
        f"accepted when |Δg| + {times}U ≤ limit at every verification point; a guard band w = {times}U is taken "
        "off the limit (JCGM 106:2012, 8.3.2; ILAC-G8:09/2019)"
    )
    if rule.name != NON_BINARY:
        return accepted
    return f"{accepted}; what lies within w of the limit is conditional, and the customer's to accept"


def probability_in_words(p: float) -> str:
    """Return a probability with two digits: "0.012", "< 0.0001"."""
    if p < _LEAST_SHOWN:
        return f"< {_LEAST_SHOWN:g}"
    return f"{p:.2g}" if p < 1.0 - _LEAST_SHOWN else f"> {1.0 - _LEAST_SHOWN:g}"


def optional_probability(p: float | None) -> str:
    """Return a probability with two digits, a dash where there is none."""
    return "–" if p is None else probability_in_words(p)


def risk_in_words(result: Verification) -> str:
    """Return the specific risk of the decision, of all points together and of the worst; empty without one."""
    if result.passed or result.left_open:
        of_all, worst = (probability_in_words(p) for p in (result.p_outside, result.p_outside_worst))
        single = "" if of_all == worst else f" ({worst} at the worst point)"
        accepted = " if it is accepted" if result.left_open else ""
        return f"probability of false acceptance{accepted} {of_all}{single}"
    if result.rejected:
        return f"probability of false rejection {probability_in_words(1.0 - result.p_outside)}"
    return ""


def verdict_line(name: str, result: Verification) -> str:
    """Return the verdict on what is called `name` in one line."""
    worst = result.worst
    facts = [
        f"worst |Δg| = {abs(worst.delta_g) * 1e6:.1f} µg ± {worst.U * 1e6:.1f} µg (U, k = {worst.k:.3g})",
        f"limit {result.limit_g * 1e6:.4g} µg",
        f"rule: {result.decision.words}",
        f"TUR {result.tur:.2g}",
        risk_in_words(result),
        f"{result.missing} verification points are missing" if result.missing else "",
    ]
    return f"{name}: {headline(result, upper=True)}: {', '.join(fact for fact in facts if fact)}"


def advice(result: Verification) -> tuple[str, ...]:
    """Return what the statements mean and what can be done, a sentence each."""
    number = {s: sum(p.statement is s for p in result.points) for s in Statement}
    sentences = {
        Statement.FAIL: (
            "beyond the limit by more than the guard band: 'bench diagnose' tells what is wrong with block, stand "
            "or procedure"
        ),
        Statement.INCONCLUSIVE: (
            f"inconclusive: U, up to {result.expanded * 1e6:.0f} µg, is larger than the limit of "
            f"{result.limit_g * 1e6:.4g} µg, so nothing can be said safely, neither that the block "
            "conforms nor that it does not; more passes, a better voltmeter or a better known stand make U "
            "smaller, and 'bench budget' says what makes most of it"
        ),
        Statement.CONDITIONAL_FAIL: (
            "beyond the limit by less than the guard band: the block may conform all the same; a smaller U "
            "tells, and 'bench budget' says what makes most of it"
        ),
        Statement.CONDITIONAL_PASS: (
            "within the limit by less than the guard band: the block may not conform all the same; a smaller U "
            "tells, and 'bench budget' says what makes most of it"
        ),
    }
    of = f"of {len(result.points)} verification points"
    found = [f"{number[s]} {of} {sentence}" for s, sentence in sentences.items() if number[s]]
    if result.missing:
        found.append(
            f"{result.missing} verification points are missing, and nothing is accepted without them: "
            "measure them, too"
        )
    return (*found, *_to_pass(result))


def _to_pass(result: Verification) -> Iterator[str]:
    """Say what would make it pass, and what makes most of u at the point that is furthest from it."""
    needed = result.to_pass
    if needed is None:
        return
    point = needed.point
    at = result.points.index(point)
    parts = {name: math.sqrt(max(part[at, at], 0.0)) for name, part in result.contributions.items()}
    most = sorted(parts, key=lambda name: -parts[name])[:_MOST]
    of_which = ", ".join(f"{name.replace('_', ' ')} {parts[name] * 1e6:.0f} µg" for name in most)
    of_which = f" ({of_which})" if most else ""
    smaller = (
        "no smaller u makes it pass"
        if needed.u_times is None
        else f"u(Δg) up to {needed.u_times * point.u * 1e6:.3g} µg"
    )
    yield (
        f"to pass: {smaller} at pass {point.pass_number} point {point.point}, where it is {point.u * 1e6:.3g} µg"
        f"{of_which}; or a limit from {math.ceil(needed.limit_g * 1e6)} µg, if that is agreed"
    )


def global_risk_in_words(result: Verification) -> tuple[str, ...]:
    """Return what the rule does to all blocks of the stated population, nothing where none is stated."""
    risk, population = result.global_risk, result.population
    if risk is None or population is None:
        return ()
    return (
        f"of all blocks with Δg of mean {population.mean * 1e6:.3g} µg and standard deviation "
        f"{population.standard_deviation * 1e6:.3g} µg, as stated, this check accepts "
        f"{probability_in_words(risk.false_accept)} without conforming and does not accept "
        f"{probability_in_words(risk.false_reject)} that conform (global risks, at the largest U); the risks of "
        "this block are those of one of them that was measured so (JCGM 106:2012, A.4)",
    )
