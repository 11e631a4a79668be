"""The check (9)-(10) of the paper: |a| = g at the verification points; do they show the stated orientation?"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Mask, u_of
from bench.base.languages import message
from bench.calibration.conformity import (
    COVERAGE_FACTOR,
    NON_BINARY,
    DecisionRule,
    GlobalRisk,
    MeasuredValues,
    Population,
    Statement,
    global_risk,
    global_risk_together,
    probability_one_outside,
    probability_worst_outside,
)
from bench.calibration.result import CalibrationError
from bench.model import ForwardModel
from bench.model.geometry import STAND_ANGLES, Block, modulus_slopes
from bench.readings.corrected import EXCHANGED, REVERSED
from bench.readings.table import UNORIENTED, VERIFICATION, Readings

FARTHEST_RAD: Final = math.radians(5.0)
FARTHEST_U: Final = 10.0
"""A measured direction contradicts the stated one beyond both: this angle, rad, and this multiple of its u."""
MOST_NAMED: Final = 2
"""Largest number of explanations that a sentence names."""


@dataclass(frozen=True)
class Contradiction:
    """Verification points that contradict the stated orientation (mask `points`), and a sentence on them."""

    points: Mask
    sentence: str


@dataclass(frozen=True)
class StatedOrientation:
    """The orientations that a bench file states, and u (rad) of a direction that the block measures."""

    model: ForwardModel
    u_rad: float

    @classmethod
    def of(
        cls, model: ForwardModel, stand_u: Mapping[str, float], block: Block, covariance: Floats
    ) -> StatedOrientation | None:
        """Return what `model` states for installation V; None if no reading could contradict it.

        `stand_u` are the standard uncertainties (rad) of the stand by name, `covariance` (12, 12) is the covariance
        of the coefficients. Coefficients of free positions alone contradict no orientation: they leave the block's
        axes open, and some are zero by convention, with u = 0.
        """
        u_K = u_of(covariance)[:9].reshape(3, 3)
        if VERIFICATION not in model.installations or (u_K.any() and not u_K.all()):
            return None
        of_axes = np.linalg.norm(u_K, axis=1) / np.linalg.norm(block.K, axis=1)
        of_stand = [u for name, u in stand_u.items() if name in (*STAND_ANGLES, "setting_error")]
        return cls(replace(model, effects=()), math.hypot(float(np.max(of_axes)), *of_stand))

    def contradiction(self, rows: Readings, block: Block) -> Contradiction | None:
        """Return which of the verification `rows` contradict the stated orientation; None if none does."""
        limit_rad = max(FARTHEST_RAD, FARTHEST_U * self.u_rad)

        def off(signal: Floats, label: str) -> Floats:
            return _between(block.specific_force(signal), self._force(rows, label))

        off_rad = off(rows.signal, VERIFICATION)
        points = off_rad > limit_rad  # false for an unknown angle, which is NaN
        if not points.any():
            return None

        def agrees(signal: Floats, label: str) -> bool:
            return bool((off(signal, label)[np.isfinite(off_rad)] <= limit_rad).all())

        causes = [*self._causes(rows, agrees)][:MOST_NAMED]
        remedy = (
            message(
                f", and agree with {' or '.join(causes)}; mount and connect the block as stated, then measure "
                "them again"
            )
            if causes
            else message(
                "; check mounting and wiring, the labels and angles of all readings, and what the bench file "
                "states for V"
            )
        )
        off_deg = math.degrees(float(np.max(off_rad[points])))
        where = message(
            f"installation V: {int(points.sum())} of {len(rows)} verification points are up to {off_deg:.0f}° off "
            "the orientation in the bench file"
        )
        return Contradiction(points, f"{where}{remedy}")

    def _force(self, rows: Readings, label: str) -> Floats:
        """Return the specific force, g, that the nominal stand gives the rows in the installation `label`."""
        conditions = replace(rows, installation=np.full(len(rows), label)).conditions()
        still = np.zeros((len(conditions.mounts), len(STAND_ANGLES)))
        force: Floats = self.model.specific_force(conditions, still, Block(np.eye(3), np.zeros(3)))
        return force

    def _causes(self, rows: Readings, agrees: Callable[[Floats, str], bool]) -> Iterator[str]:
        """Yield the installations and wirings with which all readings agree."""
        for label in sorted(self.model.installations.keys() - {*UNORIENTED, VERIFICATION}):
            if agrees(rows.signal, label):
                yield message(f"installation {label}")
        for wiring in (*EXCHANGED, *REVERSED):
            if agrees(rows.signal @ wiring.matrix.T, VERIFICATION):
                channels = ", ".join(axis for axis in CHANNELS if axis in wiring.channels)
                how = message("exchanged") if wiring in EXCHANGED else message("reversed")
                yield message(f"channels {channels} {how}")


def _between(one: Floats, other: Floats) -> Floats:
    """Return the angle, rad, between the vectors in corresponding rows of two arrays (n, 3)."""
    across = np.linalg.norm(np.cross(one, other), axis=1)
    angles: Floats = np.arctan2(across, np.sum(one * other, axis=1))
    return angles


HIGHEST_CONDITION: Final = 1e8
"""Condition number above which the inverse of K is mere noise; that of a real block is near 1."""


@dataclass(frozen=True)
class VerificationPoint:
    """One reading at a verification point: modulus `g_p`, its error `delta_g` in local g, u and U = k u.

    `accepted_up_to` is the acceptance limit of the rule; it is negative if no value is accepted, for example
    because U exceeds the limit. A point on which the rule makes no decision is not `rejected`. `p_outside` is the
    probability that the true error is outside the limit. u is already widened for few degrees of freedom, so that
    `k` and `dof` are the same for all points.
    """

    k: ClassVar[float] = COVERAGE_FACTOR
    dof: ClassVar[float] = math.inf

    angle_deg: float
    pass_number: int
    point: int
    g_p: float
    delta_g: float
    u: float
    U: float
    limit_g: float
    accepted_up_to: float
    statement: Statement
    rejected: bool
    p_outside: float
    series: int = 1

    @property
    def tur(self) -> float:
        """Test uncertainty ratio: the limit over U."""
        return self.limit_g / self.U if self.U > 0.0 else float("inf")

    @property
    def passed(self) -> bool:
        """Whether the rule accepts the point; no point is accepted if the model does not fit."""
        return abs(self.delta_g) <= self.accepted_up_to and self.statement is not Statement.MISFIT

    @property
    def p_false_accept(self) -> float | None:
        """Probability that accepting the point is wrong; None unless the rule accepts it or leaves it open.

        The rule leaves a point open that it does not reject and that has the statement "conditional pass".
        """
        left_open = self.statement is Statement.CONDITIONAL_PASS and not self.rejected
        return self.p_outside if self.passed or left_open else None

    @property
    def p_false_reject(self) -> float | None:
        """Probability that rejecting the point is wrong; None unless the point is rejected."""
        return 1.0 - self.p_outside if self.rejected else None


@dataclass(frozen=True)
class LimitToPass:
    """The limit of |delta g|, or else the factor on u, with which a verification would pass.

    `limit_g` is this limit, g; `u_times` is this factor, None if no factor suffices. `point` is the point
    that exceeds its acceptance limit most.
    """

    limit_g: float
    u_times: float | None
    point: VerificationPoint


def _bisected(passes: Callable[[float], bool], good: float, bad: float) -> float:
    """Return, by bisection, the passing value closest to `bad`; it is `good` if no other value tried passes."""
    for _ in range(12):
        middle = 0.5 * (good + bad)
        good, bad = (middle, bad) if passes(middle) else (good, middle)
    return good


@dataclass(frozen=True)
class Verification:
    """The verdict: |delta g| within the limit, by the decision rule, at every verification point.

    `missing` is the number of points that were planned or recorded but have no verdict. If one is missing,
    the verification does not pass, since equation (10) of the paper applies to every point. `covariance` (n,
    n) is the covariance of delta g at the points; `contributions` are the parts of this covariance by name.
    `population` is the prior distribution of delta g, over many blocks. `fits` is false if the coefficients
    contradict their own readings. `contradiction` is a sentence on readings that contradict the orientation
    stated for installation V, empty if none does.
    """

    limit_g: float
    points: tuple[VerificationPoint, ...]
    covariance: Floats
    missing: int = 0
    decision: DecisionRule = field(default_factory=DecisionRule)
    population: Population | None = None
    contributions: Mapping[str, Floats] = field(default_factory=dict)
    fits: bool = True
    contradiction: str = ""

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
        """The worst of the statements on all points; points that are missing count as "not complete"."""
        found = [point.statement for point in self.points]
        found += [Statement.NOT_COMPLETE] * bool(self.missing)
        return max(found, key=list(Statement).index)

    @property
    def rejected(self) -> bool:
        """Whether the rule rejects a point, so that nothing more need be measured."""
        return any(point.rejected for point in self.points)

    @property
    def left_open(self) -> bool:
        """Whether the verdict is a conditional pass, which the rule neither accepts nor rejects."""
        return self.statement is Statement.CONDITIONAL_PASS and not self.passed and not self.rejected

    @property
    def worst(self) -> VerificationPoint:
        """The point with the largest |delta g|."""
        return max(self.points, key=lambda p: abs(p.delta_g))

    @property
    def expanded(self) -> float:
        """Largest expanded uncertainty of delta g over the points, local g."""
        return max(point.U for point in self.points)

    @property
    def tur(self) -> float:
        """Smallest test uncertainty ratio over the points."""
        return min(point.tur for point in self.points)

    @property
    def p_outside_worst(self) -> float:
        """Largest probability, over the points, that the true error at a point is outside the limit.

        With a population, it is the posterior probability given the readings at all points.
        """
        if self.population is None:
            return max(point.p_outside for point in self.points)
        return probability_worst_outside(self._errors, self.covariance, self.limit_g, self.population)

    @cached_property
    def p_outside(self) -> float:
        """Probability that the true error is outside the limit at one point or more."""
        return probability_one_outside(self._errors, self.covariance, self.limit_g, self.population)

    @property
    def _errors(self) -> Floats:
        return np.array([point.delta_g for point in self.points])

    @cached_property
    def to_pass(self) -> LimitToPass | None:
        """The limit, or the u, with which the verification would pass, all else equal.

        None if the verification passes, lacks points, or the model or the stated orientation does not fit.
        """
        if self.passed or self.missing or not self.fits or self.contradiction:
            return None
        u, sizes = np.array([point.u for point in self.points]), np.abs(self._errors)
        known = MeasuredValues.of(u, self.population)

        def passes(limit: float, times: float) -> bool:
            return bool(np.all(sizes <= self.decision.acceptance_limit(limit, known.but(times=times))))

        most = float(np.max(sizes + (4.0 + (self.decision.guard_band or 0.0)) * known.expanded))
        needed = max(range(len(sizes)), key=lambda i: sizes[i] - self.points[i].accepted_up_to)
        return LimitToPass(
            limit_g=_bisected(lambda limit: passes(limit, 1.0), most, self.limit_g),
            u_times=_bisected(lambda times: passes(self.limit_g, times), 0.0, 1.0) or None,
            point=self.points[needed],
        )

    @cached_property
    def global_risk(self) -> GlobalRisk | None:
        """Global risks of the rule at the point with the largest U; None without a population."""
        if self.population is None:
            return None
        point = max(self.points, key=lambda p: p.U)
        return global_risk(self.population, point.u, self.limit_g, point.accepted_up_to)

    @cached_property
    def global_risk_of_all(self) -> GlobalRisk | None:
        """Global risks of the whole check, which accepts a block only at all points; None without a population."""
        if self.population is None or len(self.points) == 1:
            return self.global_risk
        limits = np.array([point.accepted_up_to for point in self.points])
        return global_risk_together(self.population, self.covariance, self.limit_g, limits)


def points_of(readings: Readings) -> Readings:
    """Return the verification rows of a table. Raises `CalibrationError` if there are none."""
    rows = readings.verification()
    if len(rows) == 0:
        raise CalibrationError(
            f"{readings.source}: the readings have no verification point (installation V); run a procedure with "
            "some, such as 'calibration'"
        )
    return rows


def verify(
    readings: Readings,
    block: Block,
    covariance: Floats,
    reading_noise: float | Floats,
    limit_g: float,
    g_ratio: float = 1.0,
    rule: str | DecisionRule | None = None,
    *,
    joint: Mapping[str, Floats] | None = None,
    population: Population | None = None,
    fits: bool = True,
    stated: StatedOrientation | None = None,
) -> Verification:
    """Return the verdict of the paper's check (9)-(10) on the verification rows of a table.

    `g_ratio` is the gravity to which the coefficients refer, divided by local gravity; it differs from 1 for a
    block calibrated elsewhere. u of each delta g follows from the `covariance` (12, 12) of the coefficients and
    from `reading_noise`, independent in each signal (unit of the signal; one value, one per channel, or
    one per signal). `joint`
    replaces both: parts by name, (n, n) each, of the covariance of |a| at the points, in the gravity of the
    coefficients. The setting error of the head has no effect, because the modulus does not depend on it. `rule` is
    one of `RULES`, a `DecisionRule`, or None for the default. If `fits` is false, the coefficients contradict their
    own readings, and no point is accepted. A point whose readings contradict the orientation `stated` for it is not
    accepted either. Raises `CalibrationError` if there is no verification row, K is singular or the rule is
    unknown.
    """
    rows = points_of(readings)
    if not np.isfinite(block.K).all() or np.linalg.cond(block.K) > HIGHEST_CONDITION:
        raise CalibrationError(
            f"{readings.source}: K of the coefficients is singular (two channels are parallel, or one does not "
            "respond), so it gives no specific force; give another calibration"
        )
    decision = DecisionRule.of(rule)
    force = block.specific_force(rows.signal)
    g_p = np.linalg.norm(force, axis=1) * g_ratio
    errors = g_p - 1.0
    by_coefficient, by_signal = modulus_slopes(force, block)
    if joint is None:
        joint = {
            "coefficients": by_coefficient @ covariance @ by_coefficient.T,
            "reading_at_the_point": np.diag(np.sum(np.square(by_signal * reading_noise), axis=1)),
        }
    joint = {name: part * g_ratio**2 for name, part in joint.items()}
    together = sum(joint.values(), np.zeros((len(rows), len(rows))))
    u = np.sqrt(np.maximum(np.diag(together), 0.0))
    known = MeasuredValues.of(u, population)
    outside = known.outside(errors, limit_g)
    accepted_up_to = decision.acceptance_limit(limit_g, known)
    statements = decision.statements(errors, limit_g, known)
    wrong = None if stated is None else stated.contradiction(rows, block)
    misfits = np.full(len(rows), not fits) if wrong is None or not fits else wrong.points
    statements = [
        Statement.MISFIT if misfit and one is not Statement.FAIL else one
        for one, misfit in zip(statements, misfits, strict=True)
    ]
    points = tuple(
        VerificationPoint(
            angle_deg=float(np.degrees(rows.angle_rad[i])),
            pass_number=int(rows.pass_number[i]),
            point=int(rows.point[i]),
            g_p=float(g_p[i]),
            delta_g=float(errors[i]),
            u=float(u[i]),
            U=float(known.expanded[i]),
            limit_g=limit_g,
            accepted_up_to=float(accepted_up_to[i]),
            statement=statements[i],
            rejected=bool(
                not abs(errors[i]) <= accepted_up_to[i]
                and statements[i] is not Statement.MISFIT
                and decision.rejects(statements[i])
            ),
            p_outside=float(outside[i]),
            series=int(rows.series[i]),
        )
        for i in range(len(rows))
    )
    return Verification(
        limit_g, points, together, readings.verification_missing, decision, population, joint, fits,
        "" if wrong is None else wrong.sentence,
    )  # fmt: skip


def by_rule(statement: Statement, rule: str, *, passed: bool) -> Statement:
    """Return the statement in the terms of the decision rule named `rule`.

    Under a binary rule a conditional statement becomes pass if the point `passed`, else fail.
    """
    conditional = statement in {Statement.CONDITIONAL_PASS, Statement.CONDITIONAL_FAIL}
    if rule == NON_BINARY or not conditional:
        return statement
    return Statement.PASS if passed else Statement.FAIL
