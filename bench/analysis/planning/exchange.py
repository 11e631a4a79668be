"""Optimal designs by greedy addition and exchange on the information matrix.

The stand's angles of each mounting are random effects with a prior: in the joint information of coefficients
and angles every setting adds F^T F, with F its derivatives whitened by reading and setting noise, and the
prior adds its part. The coefficients' block of the inverse is then the covariance of generalised least squares.
Source of the exchange: Fedorov, Theory of Optimal Experiments (1972); Cook and Nachtsheim, Technometrics 22
(1980) 315.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from bench.analysis.calibration.design import FIXED
from bench.analysis.calibration.result import Noise
from bench.analysis.planning.goals import Goal
from bench.base.arrays import Floats, Ints

_POWERS: Final = (8.0, 40.0)
"""The largest of several ratios is taken as their power mean: of the first order, smooth, then nearly itself."""
_WITHIN_REACH: Final = 1.05
"""Exchanges bring the largest ratio down by a few percent; they are not tried from further away."""
_GAIN: Final = 1e-6
_WEAKLY_KNOWN: Final = 1.0
"""Prior of the coefficients, in V/g and V: wide beside any calibration; only makes the first steps possible."""
_DETERMINED: Final = 1e-2
_MANY: Final = 1e5
LEAST_FREEDOM: Final = 6
"""Signals more than unknowns that a plan must have: fewer tell nothing of the noise."""


@dataclass(frozen=True)
class SettingPool:
    """Settings that may be chosen: whitened derivatives `rows` (c, 3, p), the 12 coefficients first.

    The p - 12 angles of the mountings are in units of their prior standard uncertainty.
    """

    rows: Floats

    @property
    def unknowns(self) -> int:
        """Number of unknowns p."""
        return int(self.rows.shape[2])

    @cached_property
    def information(self) -> Floats:
        """What one visit to each candidate adds, shape (c, p, p)."""
        return np.asarray(np.einsum("cip,ciq->cpq", self.rows, self.rows))


class ExchangeDesign:
    """Visits `counts` (c,) to the candidates, for goals; moves change them one visit at a time.

    They stay between `least` and `most` (c,), where these are given.
    """

    def __init__(
        self,
        candidates: SettingPool,
        goals: Sequence[Goal],
        counts: Ints | None = None,
        least: Ints | None = None,
        most: Ints | None = None,
    ) -> None:
        self._rows = candidates.rows
        self._information_of = candidates.information
        self._functionals = np.concatenate([goal.functionals for goal in goals])
        self._goal = np.repeat(np.arange(len(goals)), [len(goal.functionals) for goal in goals])
        self._floor = np.array([goal.floor for goal in goals])
        self._asked2 = np.array([goal.asked for goal in goals]) ** 2
        prior = np.ones(candidates.unknowns)
        prior[:FIXED] = _WEAKLY_KNOWN**-2
        self._prior = np.diag(prior)
        self.counts = np.zeros(len(self._rows), dtype=np.int64) if counts is None else counts.copy()
        self._least = np.zeros_like(self.counts) if least is None else least
        self._most = np.full_like(self.counts, np.iinfo(np.int64).max) if most is None else most

    @property
    def settings(self) -> int:
        """How many visits there are."""
        return int(self.counts.sum())

    def covariance(self, counts: Floats | Ints | None = None) -> Floats:
        """Return the joint covariance (p, p) of coefficients and angles."""
        weight = self.counts if counts is None else counts
        information = self._prior + np.tensordot(weight.astype(np.float64), self._information_of, axes=1)
        scale = 1 / np.sqrt(np.diag(information))
        return np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)

    @property
    def coefficient_covariance(self) -> Floats:
        """Covariance of the coefficients, shape (12, 12)."""
        return self.covariance()[:FIXED, :FIXED]

    @property
    def largest(self) -> float:
        """The largest ratio of an uncertainty to what is asked, the noise being estimated from the readings."""
        wider2 = widening(3 * self.settings - len(self._prior)) ** 2
        variances = wider2 * (self._variances(self.covariance()) - self._floor) + self._floor
        return self._largest(variances)

    def limit(self) -> float:
        """Return the largest ratio that is left when every candidate is visited without end."""
        return self._largest(self._variances(self.covariance(np.full(len(self._rows), _MANY))))

    @property
    def determines(self) -> bool:
        """Whether all candidates together determine the coefficients, and not their weak prior alone."""
        covariance = self.covariance(np.full(len(self._rows), _MANY))
        return bool(np.max(np.diag(covariance)[:FIXED]) < _DETERMINED)

    # --- moves --------------------------------------------------------------------------------------

    def add_best(self) -> None:
        """Visit once more the candidate that helps most."""
        gain = self._after(self.covariance(), 1.0, _POWERS[0])
        self.counts[int(np.argmin(np.where(self.counts < self._most, gain, np.inf)))] += 1

    def drop_least(self) -> None:
        """Leave out the visit that matters least."""
        loss = self._after(self.covariance(), -1.0, _POWERS[-1])
        loss[self.counts <= self._least] = np.inf
        self.counts[int(np.argmin(loss))] -= 1

    def exchange(self) -> None:
        """Exchange visits for others as long as that brings the goals nearer."""
        for power in _POWERS if len(self._asked2) > 1 else _POWERS[:1]:
            score = float(self._score(self._variances(self.covariance()), power))
            while (better := self._exchanged(score, power)) < score:
                score = better

    def _exchanged(self, score: float, power: float) -> float:
        """Make the first exchange that helps, visits that matter least first; return the score after it."""
        loss = self._after(self.covariance(), -1.0, power)
        for leave in sorted(np.flatnonzero(self.counts > self._least), key=loss.__getitem__):
            self.counts[leave] -= 1
            scores = self._after(self.covariance(), 1.0, power)
            scores = np.where(self.counts < self._most, scores, np.inf)
            enter = int(np.argmin(scores))
            if scores[enter] < score * (1 - _GAIN):
                self.counts[enter] += 1
                return float(scores[enter])
            self.counts[leave] += 1
        return score

    # --- what a design is worth ---------------------------------------------------------------------

    def _variances(self, covariance: Floats) -> Floats:
        each = np.einsum(
            "ki,ij,kj->k", self._functionals, covariance[:FIXED, :FIXED], self._functionals, optimize=True
        )
        return np.asarray(np.bincount(self._goal, each) + self._floor)

    def _after(self, covariance: Floats, sign: float, power: float) -> Floats:
        """Return the score after one visit more (+1) or less (-1) of each candidate, by Woodbury's identity."""
        through = self._rows @ covariance
        core = np.eye(3) + sign * through @ np.swapaxes(self._rows, 1, 2)
        seen = through[:, :, :FIXED] @ self._functionals.T
        solved = np.linalg.solve(core, seen)
        change = np.einsum("cik,cik->ck", seen, solved)
        variances = self._variances(covariance)
        goals = np.zeros((len(change), len(self._floor)))
        np.add.at(goals.T, self._goal, change.T)
        after = variances - sign * goals
        if sign < 0:  # what is left may no longer determine everything
            after = np.where(np.linalg.det(core)[:, None] > 1e-9, after, np.inf)
        return self._score(after, power)

    def _largest(self, variances: Floats) -> float:
        return float(np.sqrt(np.max(variances / self._asked2)))

    def _score(self, variances: Floats, power: float) -> Floats:
        """Power mean of the ratios squared, over the last axis; infinite where one of them is."""
        ratio = np.maximum(variances, 0.0) / self._asked2
        top = np.max(ratio, axis=-1)
        size = np.where(np.isfinite(top) & (top > 0), top, 1.0)
        part = np.where(np.isfinite(ratio), ratio, 0.0) / size[..., None]
        mean: Floats = size * np.sum(part**power, axis=-1) ** (1 / power)
        return np.where(np.isfinite(top), mean, np.inf)


def widening(freedom: float) -> float:
    """Return how much larger an uncertainty is whose noise is estimated with so many degrees of freedom."""
    return Noise(1.0, 1.0, max(float(freedom), 1.0), "residuals").widened().reading


def least_settings(candidates: SettingPool) -> int:
    """Return the fewest settings that tell the coefficients, the angles of the mountings and the noise."""
    return -(-(candidates.unknowns + LEAST_FREEDOM) // 3)


def even(candidates: SettingPool, mounts: int, settings: int) -> Ints:
    """Return counts (c,) of settings spread evenly over the mountings and over the angles of each."""
    angles = len(candidates.rows) // mounts
    counts = np.zeros((mounts, angles), dtype=np.int64)
    for mount in range(mounts):
        own = (settings + mounts - 1 - mount) // mounts
        np.add.at(counts[mount], np.round(np.arange(own) * angles / max(own, 1)).astype(np.int64) % angles, 1)
    return counts.ravel()


def best_of(candidates: SettingPool, goals: Sequence[Goal], mounts: int, settings: int) -> ExchangeDesign:
    """Return the best design of so many settings that exchanges find, from a greedy and from an even start."""
    greedy = ExchangeDesign(candidates, goals)
    for _ in range(settings):
        greedy.add_best()
    spread = ExchangeDesign(candidates, goals, even(candidates, mounts, settings))
    for design in (greedy, spread):
        design.exchange()
    return min((greedy, spread), key=lambda design: design.largest)


def fewest(candidates: SettingPool, goals: Sequence[Goal], mounts: int, most: int) -> ExchangeDesign | None:
    """Return the design with the fewest settings found that reaches all goals, None with more than `most`."""
    design = ExchangeDesign(candidates, goals)
    if design.limit() > 1:
        return None
    least = least_settings(candidates)
    while (design.largest > 1 or design.settings < least) and design.settings < most:
        design.add_best()
    if design.largest > _WITHIN_REACH or most < least:
        return None
    if design.largest > 1:
        design = best_of(candidates, goals, mounts, most)
        if design.largest > 1:
            return None
    while True:
        reached = design.counts.copy()
        if design.settings == least:
            return design
        design.drop_least()
        if design.largest > 1:
            design.exchange()
        if design.largest > 1:
            design = ExchangeDesign(candidates, goals, even(candidates, mounts, design.settings))
            design.exchange()
        if design.largest > 1:
            return ExchangeDesign(candidates, goals, reached)
