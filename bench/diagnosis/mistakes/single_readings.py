"""Wrong settings and outliers: single readings whose error is likelier than any change of the bench."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np
from scipy import special
from scipy.special import logsumexp

from bench.base.arrays import CHANNELS, Floats
from bench.diagnosis.levels import HARDLY_EVER
from bench.diagnosis.mistakes.hypotheses import NEAR_DEG, ProjectedReadings, Table
from bench.diagnosis.noise_grid import RATIOS
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
MOST: Final = 1 / 8
"""Largest part of the readings that may be single mistakes."""


@dataclass(frozen=True)
class SingleMistake:
    """A wrong reading, `row` of the problem: a wrong setting of the head by `off_rad`, or an outlier.

    `off_rad` is the true angle minus the recorded one, None for an outlier of `channels`. `as_outlier` marks a
    wrong setting that an outlier of one channel explains as well. `shift` (3,) is the error of the signals, in
    the unit of the signal; `p` is 1 over the odds against no mistake; `sigma` is the size in units of the noise.
    """

    row: int
    channels: tuple[str, ...]
    off_rad: float | None
    as_outlier: bool
    shift: Floats
    p: float
    sigma: float


def find_single(table: Table, significance: float) -> list[SingleMistake]:
    """Return the wrong readings, the largest first.

    The likeliest of all errors of single readings and all changes of the bench (`Table.changes`) joins the model,
    and all others are compared beside it, until no reading is wrong with odds of 1 over `significance`.
    """
    n, changes = len(table.left), list(table.changes())
    known: list[Floats] = []
    rows: list[int] = []
    enough = -float(np.log(significance))
    while True:
        seen, weight = _seen(table, [*known, *(_error(n, row) for row in rows)])
        of_rows = logsumexp([w + one.of_readings() for w, one in zip(weight, seen, strict=True)], axis=0)
        of_rows = np.where(np.isin(np.arange(n), rows), -np.inf, of_rows - np.log(n))
        best = int(np.argmax(of_rows))
        if of_rows[best] < enough:
            break
        of_changes = [
            logsumexp([w + one.of_group(columns) for w, one in zip(weight, seen, strict=True)])
            for columns in changes
        ]
        if changes and max(of_changes) > of_rows[best]:
            known.append(changes.pop(int(np.argmax(of_changes))))
        elif len(rows) < max(MOST * n, 6):
            rows.append(best)
        else:
            return []
    slips = _slips(table) if rows else []
    found = []
    for row in rows:
        seen, weight = _seen(table, [*known, *(_error(n, other) for other in rows if other != row)])
        odds = [w + one.of_readings()[row] for w, one in zip(weight, seen, strict=True)]
        log_odds = float(logsumexp(odds)) - np.log(n)
        if log_odds >= enough:
            found.append(_classify(seen[int(np.argmax(odds))], row, slips, float(np.exp(-log_odds))))
    told = [m for m in found if m.off_rad is not None or m.sigma >= BEYOND_TAILS]
    return sorted(told, key=lambda m: -m.sigma)


def _seen(table: Table, known: Sequence[Floats]) -> tuple[list[ProjectedReadings], Floats]:
    """Return the readings beside `known` columns at each ratio of the noise sizes, and ln of the ratios' odds."""
    seen = [table.seen(ratio, known) for ratio in RATIOS]
    evidence = np.array([one.log_evidence for one in seen])
    return seen, evidence - logsumexp(evidence)


def _error(n: int, row: int) -> Floats:
    """Return the columns (n, 3, 3) of arbitrary errors of a reading."""
    return np.asarray((np.arange(n) == row)[:, None, None] * np.eye(3))


def _slips(table: Table) -> list[tuple[Floats, Floats]]:
    """Return for each kind of wrong setting the error of the angle (n,), rad, and of the signals (n, 3).

    The kinds are the slips `SLIPS_RAD`, an angle counted backwards, and the stop before or after in the pass.
    """
    problem, turn = table.problem, table.turn
    angle = problem.conditions.angle_rad
    offs = [np.full(len(angle), off) for off in SLIPS_RAD]
    step = np.where(turn[1:] == turn[:-1], np.diff(angle), 0.0)
    for off in (reflected_rad(angle), np.append(0.0, -step), np.append(step, 0.0)):
        offs.append(np.where(np.abs(off) < REFLECTED_RAD, np.nan, off))
    here = problem.predict(table.block, problem.prior_mean)
    slips = []
    for off in offs:
        moved = replace(problem.conditions, angle_rad=angle + np.nan_to_num(off))
        there = replace(problem, conditions=moved)
        slips.append((off, there.predict(table.block, problem.prior_mean) - here))
    return slips


def _classify(
    seen: ProjectedReadings, row: int, slips: Sequence[tuple[Floats, Floats]], p: float
) -> SingleMistake:
    """Return a wrong reading as a wrong setting if one explains the three signals, else as an outlier."""
    table, block, pull = seen.table, seen.blocks[row], seen.pulls[row]
    shift = np.linalg.solve(block, pull)
    free = len(seen.pull) - float(np.sum(seen.basis**2)) - 3.0
    noise = float(np.sqrt((seen.square - pull @ shift) / free))
    precision = block / noise**2
    channels, outlier_p = _outlier(shift, precision)
    off, least = None, float(special.chdtri(3, HARDLY_EVER))
    for offs, moved in slips:
        expected = moved[row] / table.unit
        size = float(np.linalg.norm(expected))
        known = SLIP_PART * size
        missed = shift - expected
        chi2 = float(missed @ np.linalg.solve(np.linalg.inv(precision) + known**2 * np.eye(3), missed))
        if np.isfinite(offs[row]) and chi2 < least:
            off, least = float(offs[row]), chi2
    as_outlier = len(channels) == 1 and outlier_p > HARDLY_EVER
    if off is not None:
        channels = tuple(
            c for c, of in zip(CHANNELS, np.abs(shift), strict=True) if of > SLIP_PART * np.max(np.abs(shift))
        )
    largest = max(abs(shift[CHANNELS.index(c)]) for c in channels)
    return SingleMistake(row, channels, off, as_outlier, table.unit * shift, p, float(largest) / noise)


def _outlier(shift: Floats, precision: Floats) -> tuple[tuple[str, ...], float]:
    """Return the fewest channels whose errors explain a reading, and the p-value of the remaining difference."""
    pull = precision @ shift
    for number in (1, 2):
        left = {}
        for chosen in combinations(range(3), number):
            own = list(chosen)
            explained = pull[own] @ np.linalg.solve(precision[np.ix_(own, own)], pull[own])
            left[chosen] = float(shift @ pull - explained)
        best = min(left, key=lambda chosen: left[chosen])
        p = float(special.chdtrc(3 - number, max(left[best], 0.0)))
        if p > HARDLY_EVER:
            return tuple(CHANNELS[i] for i in best), p
    return CHANNELS, 1.0
