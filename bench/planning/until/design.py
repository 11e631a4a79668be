"""What of the points that are left is to be measured, so that the goals are reached in the least time.

The information matrix is exact: the model is linear in what is unknown, so that the covariance after any further
readings is known before them, up to the size of the noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Ints
from bench.calibration.design import FIXED
from bench.calibration.noise import LEAST_REPEATS
from bench.model import Mounting
from bench.planning.optimal_design import ExchangeDesign, Goal, SettingPool, Stand, whitened, widening
from bench.planning.settings import conditions_of
from bench.planning.until.pool import Site

_DETERMINED: Final = 1e-2
MOST_SUBSETS: Final = 5
"""Of more mountings to come all are taken: their choices would be too many to weigh at each look."""


@dataclass(frozen=True)
class Grid:
    """The sites that were read or may be: whitened derivatives for the stand's noise as the bench file
    states it."""

    sites: tuple[Site, ...]
    rows: Floats

    @classmethod
    def of(cls, stand: Stand, reads: Mapping[Site, int]) -> Grid:
        """Make it of sites in their order, with how often each is read at a visit."""
        rows, _ = whitened(stand, conditions_of([site.setting() for site in reads]))
        often = np.sqrt(np.array(list(reads.values()), dtype=np.float64))
        return cls(tuple(reads), rows * often[:, None, None])

    def counts(self, of: Mapping[Site, int]) -> Ints:
        """Return how often each site is meant, (c,)."""
        return np.array([of.get(site, 0) for site in self.sites], dtype=np.int64)


class Visits(ExchangeDesign):
    """Visits to the sites, at least those that were made, at most those that the plan has.

    The noise is told by repeats as soon as there are enough of them, as a calibration has it.
    """

    _known: tuple[bytes, Floats] | None = None

    def covariance(self, counts: Floats | Ints | None = None) -> Floats:
        """As its base has it; that of the visits as they stand is kept until one changes."""
        if counts is not None:
            return super().covariance(counts)
        key = self.counts.tobytes()
        if self._known is None or self._known[0] != key:
            self._known = key, super().covariance()
        return self._known[1]

    def _variances(self, covariance: Floats) -> Floats:
        """As its base has it, without looking for an order of the products each time."""
        own = covariance[:FIXED, :FIXED]
        each = np.sum((self._functionals @ own) * self._functionals, axis=1)
        return np.asarray(np.bincount(self._goal, each) + self._floor)

    @property
    def repeats(self) -> int:
        """How many visits repeat an earlier one."""
        return int(np.sum(np.maximum(self.counts - 1, 0)))

    @property
    def determined(self) -> bool:
        """Whether these visits determine the coefficients, and not their weak prior alone."""
        return bool(np.max(np.diag(self.coefficient_covariance)) < _DETERMINED)

    @property
    def wider(self) -> float:
        """How much larger u is since the noise is an estimate."""
        return widening(self._freedom)

    @property
    def _freedom(self) -> float:
        """Degrees of freedom of the reading noise: two of three signals tell of it, the third of the setting."""
        if self.repeats >= LEAST_REPEATS:
            return 2.0 * self.repeats
        return 2.0 * (3 * self.settings - len(self._prior)) / 3.0

    @property
    def largest(self) -> float:
        """The largest ratio of an uncertainty to what is asked."""
        return self._largest(self.variances)

    @property
    def variances(self) -> Floats:
        """The variance of each goal, (goals,), the noise widened."""
        own = self._variances(self.covariance()) - self._floor
        return np.asarray(self.wider**2 * own + self._floor)

    def is_enough(self, repeats: int) -> bool:
        """Whether all goals are reached with at least so many repeats."""
        return self.repeats >= repeats and self.largest <= 1.0

    @property
    def is_full(self) -> bool:
        """Whether nothing is left to visit."""
        return bool(np.all(self.counts >= self._most))

    def add_repeat(self) -> bool:
        """Repeat the visited site that helps most; false where none can be."""
        gain = self._after(self.covariance(), 1.0, 8.0)
        able = (self.counts > 0) & (self.counts < self._most)
        if able.any():
            self.counts[int(np.argmin(np.where(able, gain, np.inf)))] += 1
        return bool(able.any())

    def drop_needless(self, repeats: int) -> None:
        """Leave out visits, those that matter least first, as long as all is reached without them."""
        dropped = True
        while dropped:
            dropped = False
            loss = self._after(self.covariance(), -1.0, 40.0)
            able = self.counts > self._least
            if self.repeats == repeats:  # a repeat cannot be spared
                able &= self.counts == 1
            for leave in sorted(np.flatnonzero(able & np.isfinite(loss)), key=loss.__getitem__):
                if loss[leave] > 1.0:
                    break
                self.counts[leave] -= 1
                if self.is_enough(repeats):
                    dropped = True
                    break
                self.counts[leave] += 1


@dataclass(frozen=True)
class Task:
    """What a design is made from: the grid, what was done and how often each site can still be visited.

    `scale` is the noise in units of what the bench file states, `site_s` (c,) the time of a visit to each site,
    `mount_s` what mounting takes where the block is not on yet, `repeats` the least number of repeats,
    `limit_s` the time that is left at most.
    """

    grid: Grid
    goals: tuple[Goal, ...]
    done: Ints
    left: Ints
    scale: float
    site_s: Floats
    mount_s: Mapping[Mounting, float]
    repeats: int
    limit_s: float = float("inf")

    @property
    def candidates(self) -> SettingPool:
        """The grid in units of the noise; the angles of the stand keep those of their priors."""
        return SettingPool(self.grid.rows / self.scale)

    def time_s(self, counts: Ints) -> float:
        """Return the time of what `counts` (c,) has beyond what was done."""
        more = counts - self.done
        mounts = {self.grid.sites[i].mount for i in np.flatnonzero(more)}
        return float(more @ self.site_s) + sum(self.mount_s.get(mount, 0.0) for mount in mounts)

    def least_repeats(self) -> int:
        """The least number of repeats, or all that there can be."""
        return min(self.repeats, int(np.sum(np.maximum(self.done + self.left - 1, 0))))


@dataclass(frozen=True)
class Design:
    """Visits (c,) to each site in the end, those done among them; whether the goals are reached then."""

    counts: Ints
    reached: bool
    time_s: float
    variances: Floats


def enough(task: Task) -> Design:
    """Return the visits that reach the goals in the least time found; all that there is where nothing does.

    What time allows is the most that is taken.
    """
    ahead = [mount for mount in task.mount_s if np.any(task.left[_of(task.grid, mount)])]
    subsets = [tuple(ahead)]
    if len(ahead) <= MOST_SUBSETS:
        subsets = [some for n in range(len(ahead) + 1) for some in combinations(ahead, n)]
    found = [design for some in subsets if (design := _within(task, ahead, some)) is not None]
    reached = [design for design in found if design.reached]
    if reached:
        return min(reached, key=lambda design: design.time_s)
    return _all_of(task)


def _of(grid: Grid, mount: Mounting) -> Ints:
    return np.flatnonzero(np.array([site.mount == mount for site in grid.sites], dtype=np.bool_))


def _within(task: Task, ahead: Sequence[Mounting], chosen: Sequence[Mounting]) -> Design | None:
    """The design that goes to some of the mountings ahead; None where that can never be enough."""
    left = task.left.copy()
    for mount in ahead:
        if mount not in chosen:
            left[_of(task.grid, mount)] = 0
    most, repeats = task.done + left, task.least_repeats()
    if not Visits(task.candidates, task.goals, most, task.done, most).is_enough(repeats):
        return None
    design = _greedy(task, most, repeats, wide=True)
    if design.repeats == repeats:  # these decide, and fewer sites have more of them
        design = min(
            design, _greedy(task, most, repeats, wide=False), key=lambda one: task.time_s(one.counts)
        )
    time_s = task.time_s(design.counts)
    return None if time_s > task.limit_s else Design(design.counts, True, time_s, design.variances)


def _greedy(task: Task, most: Ints, repeats: int, *, wide: bool) -> Visits:
    """Add what helps most until it is enough, then leave out what is not needed.

    Repeats are added last where the sites are to be as many as help (`wide`), else as soon as the coefficients are
    determined at all.
    """
    design = Visits(task.candidates, task.goals, task.done, task.done, most)
    while not design.is_enough(repeats):
        first = design.largest > 1.0 if wide else not design.determined
        if first or design.repeats >= repeats or not design.add_repeat():
            design.add_best()
    design.drop_needless(repeats)
    return design


def _all_of(task: Task) -> Design:
    """All that is left, or the best of it that the time allows: repeats are kept as far as it does."""
    most = task.done + task.left
    if task.time_s(most) <= task.limit_s:
        whole = Visits(task.candidates, task.goals, most, task.done, most)
        return Design(most, False, task.time_s(most), whole.variances)
    design = Visits(task.candidates, task.goals, task.done, task.done, most)
    needed = -(-(len(design.covariance()) + FIXED) // 3)
    while not design.is_full:
        before = design.counts.copy()
        short = task.least_repeats() - design.repeats
        if short <= 0 or design.settings < needed or not design.add_repeat():
            design.add_best()
        if task.time_s(design.counts) > task.limit_s:
            design.counts = before
            break
    return Design(design.counts, False, task.time_s(design.counts), design.variances)
