"""Wrong settings and outliers: readings that contradict their repeats, judged by the tails of the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, Ints
from bench.calibration.design import Problem
from bench.calibration.noise import whiten
from bench.calibration.result import Noise
from bench.diagnosis.mistakes.describing import (
    NEAR_DEG,
    Description,
    Descriptions,
    Examination,
    Precision,
    Situation,
    descriptions,
    examine,
    expected_chi2,
    finish,
    turns,
    weigh,
)
from bench.model.geometry import Block
from bench.readings.corrected import SLIPS_RAD as SLIP_SIZES_RAD
from bench.readings.corrected import reflected_rad

BEYOND_TAILS: Final = 17.0
"""Least size of an outlier, in units of the noise of a reading.

A smaller one may be a tail of the noise: the comparison of noise hypotheses and single readings decides. Student's
t of 4 degrees of freedom, with a scale a fifth too small for its tails, exceeds this size in 7 of 1,000 runs of the
paper's length. An outlier of 20 times the noise still exceeds it if the noise is estimated 15 % too large.
"""


SLIPS_RAD: Final = tuple(
    sign * slip
    for slip in SLIP_SIZES_RAD.values()
    if slip < np.radians(NEAR_DEG)  # further off, nothing is known to be a repeat of it
    for sign in (1, -1)
)
"""Errors of a setting by 1°, 10′ or 1′. An angle counted backwards, 360° - φ, is tried separately."""
REFLECTED_RAD: Final = float(np.radians(0.5))
"""Least change of the head angle that counts as a reflection."""
SLIP_PART: Final = 0.01
"""Relative uncertainty of the shift by a wrong setting, because effects outside the model change it a little."""
SLIP_G: Final = 5e-4
"""Upper limit of this uncertainty, g."""

MOST_STRANGE: Final = 6
"""Most readings that may be single mistakes; an eighth of the readings, if that is more."""
ADEQUATE: Final = 0.05
"""A description with more unknowns is adopted if its improvement has a p-value below this."""
INADEQUATE: Final = 1e-4
"""The model alone is certainly inadequate if the p-value of the improvement is below this."""
LEAST_OF_TURN: Final = 6
"""Least number of readings in a pass for a slip: in six, nine numbers (slip and voltmeter) explain only half."""
SEVERAL: Final = 3
"""Strange readings in a pass that suggest a slip of the block: it shifts most of them, if not as clearly."""
STANDS_OUT: Final = 3.5
"""Least size of a mistake, in standard deviations, also in the descriptions that have more unknowns than needed."""
EXPLAINED: Final = 1e-4
"""A kind of mistake explains a reading if the p-value of the remaining difference is above this."""
DIRECTIONS: Final = 4
"""Tests of each reading: its three channels, and the direction of du/dphi."""


@dataclass(frozen=True)
class SingleMistake:
    """A wrong reading, `row` of the problem: a wrong setting of the head by `off_rad`, or an outlier.

    `off_rad` is the true angle minus the recorded one, None for an outlier of `channels`. `as_outlier` marks a
    wrong setting that an outlier of one channel explains as well. `shift` (3,) is the error of the signals, in
    the unit of the signal; `p` is corrected for all looks; `sigma` is the size in standard deviations.
    """

    row: int
    channels: tuple[str, ...]
    off_rad: float | None
    as_outlier: bool
    shift: Floats
    p: float
    sigma: float


def find_single(
    problem: Problem, block: Block, situation: Situation, looks: int, significance: float
) -> tuple[list[SingleMistake], int]:
    """Return the wrong readings, the largest first, and the number of looks, including the earlier `looks`.

    `block` is a first guess that wrong readings do not affect, and `situation` the readings minus its
    prediction. `significance` is the probability of reporting any reading if none is wrong.
    """
    described = descriptions(problem, block)
    looks += DIRECTIONS * len(situation.left)
    ladder = _Ladder(situation, described, max(MOST_STRANGE, len(situation.left) // 8))
    level = ladder.adequate(turns(problem.conditions))
    examined = ladder.examined(level)
    if not examined.strange or len(examined.strange) > ladder.most:
        return [], looks
    judged = _significant(situation, described.ladder[level], examined, significance / looks)
    slips = _slips(problem, block)
    first = problem.conditions.remounted
    found = []
    for row in judged.strange:
        mistake = _classify(situation, judged, row, slips, looks)
        others = [r for r in judged.strange if r != row]
        held = ladder.freer(level, mistake, bool(first[row]))
        freer = [weigh(description, situation, judged.noise).without(others) for description in held]
        if all(float(np.max(_studentised(p, situation, judged.noise, row))) > STANDS_OUT for p in freer):
            found.append(mistake)
    found = [m for m in found if m.off_rad is not None or _in_readings(m, judged.noise) >= BEYOND_TAILS]
    turned = level + 1 == len(described.ladder)
    return sorted(_alone(found, turned=turned), key=lambda m: -m.sigma), looks


def _in_readings(mistake: SingleMistake, noise: Noise) -> float:
    """Return the size of an outlier in units of the noise of a reading."""
    return float(max(abs(mistake.shift["xyz".index(c)]) for c in mistake.channels)) / noise.reading


def _ways_of(block: Floats, pull: Floats, ways: Floats) -> Floats:
    variance = np.einsum("iw,ij,jw->w", ways, block, ways)
    return np.asarray(pull @ ways / np.sqrt(np.maximum(variance, 1e-300)))


def _alone(found: Sequence[SingleMistake], *, turned: bool) -> list[SingleMistake]:
    """Return the mistakes without outliers of one channel in adjacent readings, which a change of the bench causes.

    Such outliers have the same sign. With the freest description (`turned`), which has a slip in each pass,
    their signs do not matter: the block may have slipped within a pass.
    """

    def goes_on(one: SingleMistake, other: SingleMistake) -> bool:
        common = ["xyz".index(channel) for channel in one.channels if channel in other.channels]
        alike = any(turned or one.shift[i] * other.shift[i] > 0 for i in common)
        return abs(one.row - other.row) == 1 and alike

    return [m for m in found if m.off_rad is not None or not any(goes_on(m, other) for other in found)]


class _Ladder:
    """The descriptions from the fewest unknowns to the most; readings are tested against each when first needed."""

    def __init__(self, situation: Situation, described: Descriptions, most: int) -> None:
        self.most = most
        self._situation = situation
        self._described = described
        self._examined: dict[int, Examination] = {}

    def examined(self, level: int) -> Examination:
        """Return the test of the readings against the description at `level`, from 0."""
        if level not in self._examined:
            start = self._examined[max(self._examined)].noise if self._examined else None
            description = self._described.ladder[level]
            self._examined[level] = examine(description, self._situation, start, self.most)
        return self._examined[level]

    def adequate(self, turn: Ints) -> int:
        """Return the level of the first description that the next one does not improve significantly.

        Levels are compared only while there are strange readings. `turn` (n,) numbers the passes. Several
        strange readings in one pass may come from a slip of the block, which only the last description
        contains: if it explains some of them and makes no other reading of the pass strange, the last level is
        returned. Passes of fewer than `LEAST_OF_TURN` readings or `SEVERAL` strange ones are not examined for a
        slip, which could explain them by chance.
        """
        level = self._plainest()
        strange = np.array(self.examined(level).strange, dtype=np.int64)
        told = np.bincount(turn) >= LEAST_OF_TURN
        slipped = told & (np.bincount(turn[strange], minlength=len(told)) >= SEVERAL)
        freest = len(self._described.ladder) - 1
        if np.any(slipped):
            left = {row for row in self.examined(freest).strange if slipped[turn[row]]}
            if left < set(strange[slipped[turn[strange]]].tolist()):
                return freest
        return level

    def _plainest(self) -> int:
        level = 0
        while level + 1 < len(self._described.ladder):
            plain = self.examined(level)
            if not plain.strange:
                break
            free = self.examined(level + 1)
            strange = tuple(dict.fromkeys((*plain.strange, *free.strange)))
            description = self._described.ladder[level + 1]
            if (
                len(plain.strange) <= self.most
                and self._p(level, description, free.noise, strange) > ADEQUATE
            ):
                break
            level += 1
        return level

    def freer(self, level: int, mistake: SingleMistake, first: bool) -> Sequence[Description]:
        """Return the other descriptions in which a mistake must be significant, as they contain what looks like it.

        These are descriptions with slow changes and, for outliers, with hysteresis. Where the model alone is
        inadequate, any of the first readings of a mounting may be shifted (`beginning`); else hysteresis of the
        catalogue is allowed if the reading is the `first` of a mounting, because small hysteresis looks like
        stand angles in all others. A wrong setting shifts the signals by known amounts, which hysteresis hardly
        imitates.
        """
        described, examined = self._described, self.examined(level)
        ladder = described.ladder[level + 1 :]
        hysteresis: list[Description] = []
        if mistake.off_rad is None and level > 0 and self._plainly_not(level):
            hysteresis = [described.beginning]
        elif mistake.off_rad is None and first:
            hysteresis = [*described.hysteretic]
        if level > 0:
            return [*ladder, *hysteresis]
        steady = self._p(level, described.drifting, examined.noise, examined.strange) > ADEQUATE
        return [*(ladder[:-1] if steady else ladder), *hysteresis]

    def _plainly_not(self, level: int) -> bool:
        """Return whether the model alone is certainly inadequate (p below `INADEQUATE`)."""
        free = self.examined(level)
        strange = tuple(dict.fromkeys((*self.examined(0).strange, *free.strange)))
        return self._p(0, self._described.ladder[level], free.noise, strange) < INADEQUATE

    def _p(self, level: int, free: Description, noise: Noise, strange: Sequence[int]) -> float:
        """Return the p-value (F test) of the improvement by the description `free` over that at `level`.

        The rows `strange` are left out of both.
        """
        chi2, dof = [], []
        for description in (self._described.ladder[level], free):
            precision = weigh(description, self._situation, noise).without(strange)
            chi2.append(precision.chi2)
            dof.append(expected_chi2(precision, description, self._situation, noise))
        more = max(dof[0] - dof[1], 1.0)
        ratio = max(chi2[0] - chi2[1], 0.0) / more / max(chi2[1] / dof[1], 1e-300)
        return float(special.fdtrc(more, dof[1], ratio))


def _significant(
    situation: Situation, description: Description, examined: Examination, limit: float
) -> Examination:
    """Return the test without the strange readings whose p-value, given the others, is not below `limit`.

    The reading with the largest p-value is accepted first, and the rest is tested again.
    """
    judged = examined
    while judged.strange:
        p = [_p(situation, judged, row)[0] for row in judged.strange]
        worst = int(np.argmax(p))
        if p[worst] < limit:
            break
        kept = [row for row in judged.strange if row != judged.strange[worst]]
        judged = finish(description, situation, judged.noise, kept)
    return judged


def _p(situation: Situation, judged: Examination, row: int) -> tuple[float, float]:
    """Return the smallest p-value of a strange reading over the four directions, and its size there in sigma.

    In a direction that scatters more than the noise, the scatter of the other readings replaces the noise.
    """
    others = [r for r in judged.strange if r != row]
    size = _studentised(judged.precision.without(others), situation, judged.noise, row)
    rest = judged.precision.without(judged.strange)
    good = np.setdiff1d(np.arange(len(situation.left)), judged.strange)
    all_sizes = np.array([_studentised(rest, situation, judged.noise, r) for r in good.tolist()])
    size = size / np.maximum(np.sqrt(np.mean(all_sizes**2, axis=0)), 1.0)
    along = _along_parts(situation, judged.noise, row)
    dof = 1 / (along**2 / judged.dof[0] + (1 - along) ** 2 / judged.dof[1])
    p = 2 * special.stdtr(dof, -size)
    best = int(np.argmin(p))
    return float(p[best]), float(size[best])


def _ways(situation: Situation, noise: Noise, row: int) -> Floats:
    """Return whitened unit shifts of x, y, z and along du/dphi, (3, 4)."""
    raw = np.column_stack([np.eye(3), situation.unit[row]])
    return np.asarray(whiten(raw[None], situation.slope[row : row + 1], noise)[0])


def _along_parts(situation: Situation, noise: Noise, row: int) -> Floats:
    """Return for each of the four directions the part of its whitened shift along du/dphi, 0 to 1, (4,)."""
    ways = _ways(situation, noise, row)
    return np.asarray((situation.unit[row] @ ways) ** 2 / np.sum(ways**2, axis=0))


def _studentised(precision: Precision, situation: Situation, noise: Noise, row: int) -> Floats:
    """Return a reading's absolute difference from the others in four directions, in standard deviations, (4,)."""
    return np.abs(_ways_of(precision.blocks[row], precision.pulls[row], _ways(situation, noise, row)))


def _slips(problem: Problem, block: Block) -> list[tuple[Floats, Floats]]:
    """Return for each kind of wrong setting the error of the angle (n,), rad, and of the signals (n, 3).

    The kinds are the slips `SLIPS_RAD`, an angle counted backwards, and the stop before or after in the pass.
    """
    angle, turn = problem.conditions.angle_rad, turns(problem.conditions)
    offs = [np.full(len(angle), off) for off in SLIPS_RAD]
    offs.append(reflected_rad(angle))
    same = turn[1:] == turn[:-1]
    step = np.where(same, np.diff(angle), 0.0)
    offs += [np.append(0.0, -step), np.append(step, 0.0)]
    here = problem.predict(block, problem.prior_mean)
    slips = []
    for off in offs:
        there = replace(problem, conditions=replace(problem.conditions, angle_rad=angle + off))
        slips.append((off, there.predict(block, problem.prior_mean) - here))
    return slips


def _classify(
    situation: Situation, judged: Examination, row: int, slips: Sequence[tuple[Floats, Floats]], looks: int
) -> SingleMistake:
    """Return a strange reading as a wrong setting if one explains the three signals, else as an outlier."""
    others = [r for r in judged.strange if r != row]
    precision = judged.precision.without(others)
    covariance = np.linalg.inv(precision.blocks[row])
    shift = covariance @ precision.pulls[row]
    ways = _ways(situation, judged.noise, row)[:, :3]
    raw = np.linalg.solve(ways, shift)
    p, sigma = _p(situation, judged, row)

    channels, outlier_p = _outlier(shift, precision.blocks[row], ways)
    off, least = None, float(special.chdtri(3, EXPLAINED))
    for offs, moved in slips:
        expected = ways @ moved[row]
        if abs(offs[row]) < REFLECTED_RAD and not np.isclose(np.abs(SLIPS_RAD), abs(offs[row])).any():
            continue
        known = min(
            SLIP_PART,
            SLIP_G * float(np.linalg.norm(situation.slope[row])) / float(np.linalg.norm(moved[row])),
        )
        around = covariance + known**2 * float(expected @ expected) * np.eye(3)
        missed = shift - expected
        chi2 = float(missed @ np.linalg.solve(around, missed))
        if chi2 < least:
            off, least = float(offs[row]), chi2
    as_outlier = len(channels) == 1 and outlier_p > EXPLAINED
    if off is not None:
        moved_by = zip(CHANNELS, np.abs(raw), strict=True)
        channels = tuple(c for c, size in moved_by if size > SLIP_PART * np.max(np.abs(raw)))
    return SingleMistake(row, channels, off, as_outlier, raw, min(looks * p, 1.0), sigma)


def _outlier(shift: Floats, precision: Floats, ways: Floats) -> tuple[tuple[str, ...], float]:
    """Return the fewest channels whose errors explain a reading, and the p-value of the remaining difference."""
    pull = precision @ shift
    whole = float(shift @ pull)
    for number in (1, 2):
        best: tuple[int, ...] = ()
        least = np.inf
        for chosen in combinations(range(3), number):
            own = ways[:, list(chosen)]
            left = whole - float((own.T @ pull) @ np.linalg.solve(own.T @ precision @ own, own.T @ pull))
            if left < least:
                best, least = chosen, left
        p = float(special.chdtrc(3 - number, max(least, 0.0)))
        if p > EXPLAINED:
            return tuple("xyz"[i] for i in best), p
    return ("x", "y", "z"), 1.0
