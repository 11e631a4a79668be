"""The paper's check (9)-(10): the modulus of the specific force at the verification points must be g."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from bench.analysis.calibration.result import CalibrationError
from bench.base.arrays import Floats
from bench.model.block import Block
from bench.readings.table import Readings

HIGHEST_CONDITION: Final = 1e8
"""Condition number of K above which its inverse is noise: a real block has one near 1."""

SIMPLE: Final = "simple acceptance"
GUARDED: Final = "guarded"
RULES: Final = (SIMPLE, GUARDED)
"""Decision rules: |delta g| within the limit (JCGM 106:2012, 8.2), or within the limit less a guard band that
is the expanded uncertainty U (8.3.2, w = U)."""

COVERAGE_FACTOR: Final = 2.0
"""U is so many times u."""


@dataclass(frozen=True)
class VerificationPoint:
    """One reading at a verification point: modulus `g_p` and its error `delta_g` in local g, with u.

    `accepted_up_to` is the acceptance limit of the rule there: negative where U is more than the limit, and
    then nothing is accepted.
    """

    angle_deg: float
    pass_number: int
    point: int
    g_p: float
    delta_g: float
    u: float
    passed: bool
    accepted_up_to: float = float("inf")


@dataclass(frozen=True)
class Verification:
    """The verdict: |delta g| within the limit, by the rule, at every verification point.

    `missing` counts points that were planned or written down but could not be judged: with one missing
    nothing is accepted, since (10) is demanded of every point.
    """

    limit_g: float
    points: tuple[VerificationPoint, ...]
    missing: int = 0
    rule: str = SIMPLE

    @property
    def passed(self) -> bool:
        """Whether every point was measured and passed."""
        return not self.missing and all(point.passed for point in self.points)

    def to_json(self) -> dict[str, Any]:
        """Return the promised result."""
        return {
            "limit_g": self.limit_g,
            "rule": self.rule,
            "passed": self.passed,
            "missing": self.missing,
            "points": [
                {
                    "angle_deg": p.angle_deg,
                    "pass": p.pass_number,
                    "point": p.point,
                    "g_p": p.g_p,
                    "delta_g": p.delta_g,
                    "u": p.u,
                    "accepted_up_to": p.accepted_up_to,
                    "passed": p.passed,
                }
                for p in self.points
            ],
        }


def verify(
    readings: Readings,
    block: Block,
    covariance: Floats,
    reading_noise: float,
    limit_g: float,
    g_ratio: float = 1.0,
    rule: str = SIMPLE,
) -> Verification:
    """Apply (9)-(10) to the verification rows of a table.

    `g_ratio` is the gravity in which the coefficients are given over the local one: a block calibrated
    elsewhere measures in units of the gravity there. `covariance` (12, 12) of the coefficients and
    `reading_noise` (unit of the signal) give u of each delta g; the setting of the head does not enter, the
    modulus does not depend on it. `rule` is one of `RULES`. Raises `CalibrationError` when there is no
    verification row, K is singular or the rule is unknown.
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
    force = block.specific_force(rows.signal)
    g_p = np.linalg.norm(force, axis=1) * g_ratio
    by_coefficient, by_signal = modulus_slopes(force, block)
    variance = np.einsum("np,pq,nq->n", by_coefficient, covariance, by_coefficient)
    variance += reading_noise**2 * np.sum(by_signal**2, axis=1)
    u = np.sqrt(variance) * g_ratio
    limits = [acceptance_limit(limit_g, COVERAGE_FACTOR * float(one), rule) for one in u]
    points = tuple(
        VerificationPoint(
            angle_deg=float(np.degrees(rows.angle_rad[i])),
            pass_number=int(rows.pass_number[i]),
            point=int(rows.point[i]),
            g_p=float(g_p[i]),
            delta_g=float(g_p[i] - 1.0),
            u=float(u[i]),
            passed=bool(abs(g_p[i] - 1.0) <= limits[i]),
            accepted_up_to=limits[i],
        )
        for i in range(len(rows))
    )
    return Verification(limit_g, points, readings.verification_missing, rule)


def rule_name(asked: str) -> str:
    """Return the rule for what a person typed: "simple" is simple acceptance. Raises `CalibrationError`."""
    name = SIMPLE if asked == "simple" else asked
    if name not in RULES:
        raise CalibrationError(f"no decision rule {asked!r}; there are {', '.join(RULES)}")
    return name


def acceptance_limit(limit_g: float, expanded: float, rule: str) -> float:
    """Return up to which |delta g| a rule accepts; negative where the guard band leaves nothing.

    `expanded` is the uncertainty U of delta g. Source: JCGM 106:2012, 8.2.1 and 8.3.2.1 (w = U). Raises
    `CalibrationError` for an unknown rule.
    """
    return limit_g - expanded if rule_name(rule) == GUARDED else limit_g


def modulus_slopes(force: Floats, block: Block) -> tuple[Floats, Floats]:
    """Return the derivatives of |N (U - U0)| by the 12 coefficients (n, 12) and by the signals (n, 3).

    `force` (n, 3) is the measured specific force, g.
    """
    # d|a|/dU = (a/|a|)^T N, d|a|/dK_ij = -(that)_i a_j, d|a|/dU0 = -(that)
    modulus = np.linalg.norm(force, axis=1)
    by_signal = (force / modulus[:, None]) @ np.linalg.inv(block.K)
    by_k = -(by_signal[:, :, None] * force[:, None, :]).reshape(len(force), 9)
    return np.concatenate([by_k, -by_signal], axis=1), by_signal
