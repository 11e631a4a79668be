"""Points from which an adaptive run chooses, and the selection that reaches the goals in the least time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np

from bench.base.arrays import Floats, Ints
from bench.base.languages import message
from bench.calibration.design import FIXED
from bench.calibration.noise import LEAST_REPEATS
from bench.calibration.result import CalibrationError
from bench.config.procedure.plan import Level, Mount, Plan, Read, SetTemperature, Settle, Turn, Wait
from bench.model.conditions import Mounting
from bench.planning.optimal_design import (
    WITHOUT_NOISE,
    ExchangeDesign,
    Goal,
    SettingPool,
    Stand,
    whitened,
    widening,
)
from bench.planning.requirements import Setting
from bench.readings.table import UNORIENTED, VERIFICATION

_LEFT_OUT_WITH_IT: Final = (Level, Mount, Wait, Settle)
"""Steps that belong to a mounting and are left out together with it."""


class Site(NamedTuple):
    """A site: mounting, head angle and direction of approach. Readings at the same site are repeats."""

    mount: Mounting
    point: int
    angle_rad: float
    direction: int

    def setting(self) -> Setting:
        """Return the site as a setting of the first pass."""
        return Setting(self.mount, 1, self.point, self.angle_rad, self.direction)


@dataclass(frozen=True)
class PlannedPoint:
    """A turn of the head with its readings.

    `steps` are the indices of all steps of the point, `reads` those of its readings. If there are several readings,
    `site` belongs to the first one. `time_s` is the expected time, s.
    """

    steps: tuple[int, ...]
    reads: tuple[int, ...]
    site: Site
    pass_number: int
    time_s: float

    @property
    def last(self) -> int:
        """The index of the last step of the point."""
        return self.steps[-1]


@dataclass(frozen=True)
class PlannedMounting:
    """A mounting of the block with its points in the order of the plan.

    `mount_step` is the index of the step that mounts the block, None if it stays mounted. `steps` are this
    step and others outside the points, such as levelling and soaking; they take `time_s` seconds in all.
    """

    mount: Mounting
    points: tuple[PlannedPoint, ...]
    mount_step: int | None
    steps: tuple[int, ...]
    time_s: float

    @property
    def first(self) -> int:
        """The index of the step at which the points of the mounting are chosen."""
        return min(self.steps[:1] + self.points[0].steps[:1])


@dataclass(frozen=True)
class Pool:
    """The mountings of a plan in order, with the points to choose from.

    `always_s` is the time of the steps that no choice affects; `after_s` is its part after the last point, s.
    """

    visits: tuple[PlannedMounting, ...]
    always_s: float
    after_s: float

    @property
    def points(self) -> tuple[PlannedPoint, ...]:
        """All points in the order of the plan."""
        return tuple(point for visit in self.visits for point in visit.points)

    @property
    def end(self) -> int:
        """The index of the step after the last point."""
        return self.visits[-1].points[-1].last + 1

    @property
    def count(self) -> int:
        """The number of points to choose from."""
        return len(self.points)

    @property
    def time_s(self) -> float:
        """Expected time of the whole plan, s."""
        return self.always_s + sum(p.time_s for p in self.points) + sum(visit.time_s for visit in self.visits)

    def settings(self) -> list[Setting]:
        """Return the settings of all points in the order of the plan."""
        return [
            Setting(p.site.mount, p.pass_number, p.site.point, p.site.angle_rad, p.site.direction)
            for p in self.points
        ]


def pool_of(plan: Plan, line_hz: float = 50.0) -> Pool:
    """Return the pool of a plan, that is, the points that a run may leave out; `line_hz` is the line frequency.

    Raises `CalibrationError` for a plan that sets temperatures or has no reading of known orientation.
    """
    if any(isinstance(step, SetTemperature) for step in plan.steps):
        raise CalibrationError(
            f"{plan.name}: the procedure sets temperatures, but this goal is for a calibration at one "
            "temperature; run the procedure whole, or choose one without temperatures"
        )
    found = _points(plan, line_hz)
    if not found:
        raise CalibrationError(
            f"{plan.name}: the procedure has no reading in an installation of known orientation; choose another "
            "procedure"
        )
    visits = _visits(plan, found, line_hz)
    chosen = {i for point in found for i in point.steps} | {i for visit in visits for i in visit.steps}
    other = {i: plan.step_duration_s(s, line_hz) for i, s in enumerate(plan.steps) if i not in chosen}
    end = found[-1].last + 1
    return Pool(visits, sum(other.values()), sum(s for i, s in other.items() if i >= end))


def _points(plan: Plan, line_hz: float) -> list[PlannedPoint]:
    """Return the points of a plan; each ends with the last reading before the next turn."""
    turns = [i for i, step in enumerate(plan.steps) if isinstance(step, Turn)]
    found = []
    for turn, following in zip(turns, [*turns[1:], len(plan.steps)], strict=True):
        reads = []
        for index in range(turn + 1, following):
            step = plan.steps[index]
            if isinstance(step, Read):
                if _is_oriented(step):
                    reads.append((index, step))
            elif not isinstance(step, Wait | Settle):
                break
        if not reads:
            continue
        steps = tuple(range(turn, reads[-1][0] + 1))
        mount = Mounting(reads[0][1].series, reads[0][1].installation)
        first = reads[0][1]
        site = Site(mount, first.point, float(first.target_rad or 0.0), first.direction or 0)
        time_s = sum(plan.step_duration_s(plan.steps[i], line_hz) for i in steps)
        found.append(PlannedPoint(steps, tuple(i for i, _ in reads), site, first.pass_number, time_s))
    return found


def _is_oriented(read: Read) -> bool:
    known = read.installation not in UNORIENTED and read.installation != VERIFICATION
    return known and read.target_rad is not None


def _visits(plan: Plan, found: Sequence[PlannedPoint], line_hz: float) -> tuple[PlannedMounting, ...]:
    visits = []
    for mount in dict.fromkeys(point.site.mount for point in found):
        own = tuple(point for point in found if point.site.mount == mount)
        first, last = own[0].steps[0], own[-1].last
        mounted = next(
            (
                i
                for i, step in enumerate(plan.steps[:first])
                if isinstance(step, Mount) and (step.series, step.installation) == mount
            ),
            None,
        )
        taken = {i for point in own for i in point.steps}
        begins = first if mounted is None else mounted
        if mounted is not None and mounted and isinstance(plan.steps[mounted - 1], Level):
            begins = mounted - 1
        steps = tuple(
            i
            for i in range(begins, last + 1)
            if i not in taken and isinstance(plan.steps[i], _LEFT_OUT_WITH_IT)
        )
        time_s = sum(plan.step_duration_s(plan.steps[i], line_hz) for i in steps)
        visits.append(PlannedMounting(mount, own, mounted, steps, time_s))
    return tuple(visits)


_NO_PART: Final = 1e-6
NO_GOAL: Final = 1e-12
"""The required uncertainty if only a time limit is given; it can never be reached."""


@dataclass(frozen=True)
class UntilGoal:
    """A goal for the uncertainty from the readings alone, or for the `combined` standard uncertainty.

    `hidden` is the variance in the combined uncertainty that no reading lowers.
    """

    goal: Goal
    combined: bool = False
    hidden: float = 0.0

    @property
    def ahead(self) -> Goal:
        """The goal for a covariance from the readings alone; its floor includes `hidden`."""
        return replace(self.goal, floor=self.goal.floor + self.hidden)

    @property
    def name(self) -> str:
        """Name of the goal with the kind of its uncertainty, such as "combined u of Kxy"."""
        if self.combined:
            return message(f"combined u of {self.goal.name}")
        return message(f"u of {self.goal.name}")


@dataclass(frozen=True)
class Aim:
    """The goals of a run, and the limit of its bench time, s; None is no limit."""

    wanted: tuple[UntilGoal, ...]
    limit_s: float | None = None

    def reached(self, variances: Iterable[float]) -> tuple[Reached, ...]:
        """Return the progress towards each goal from the goals' `variances`."""
        return tuple(
            Reached(one.name, float(np.sqrt(variance)), one.goal.asked, one.goal.unit)
            for one, variance in zip(self.wanted, variances, strict=True)
        )


@dataclass(frozen=True)
class Reached:
    """The progress towards a goal: present or expected uncertainty `u` and the required uncertainty, in `unit`."""

    name: str
    u: float
    asked: float
    unit: str

    @property
    def ratio(self) -> float:
        """The uncertainty divided by the required one; at most 1 if the goal is reached."""
        return self.u / self.asked


def reached_by(aim: Aim, readings: Floats, combined: Floats) -> tuple[Reached, ...]:
    """Return the progress of all goals from two covariances (12, 12): of the readings alone, and combined."""
    return tuple(
        Reached(w.name, w.goal.u(combined if w.combined else readings), w.goal.asked, w.goal.unit)
        for w in aim.wanted
    )


@dataclass(frozen=True)
class Floor:
    """The standard uncertainty `u` of a goal for infinitely many readings, and its largest parts by source."""

    wanted: UntilGoal
    u: float
    parts: tuple[tuple[str, float], ...]


def floors(aim: Aim, stand: Stand, whole: Stand, pool: Pool) -> list[Floor]:
    """Return the goals that even infinitely many readings at the points of the pool would not reach.

    `stand` contains the error sources of the uncertainty from the readings alone, `whole` the sources of the
    combined uncertainty. Raises `CalibrationError` if the pool does not determine the coefficients.
    """
    readings, combined = (one.budget(pool.settings(), WITHOUT_NOISE) for one in (stand, whole))
    found = []
    for wanted in aim.wanted:
        budget = combined if wanted.combined else readings
        own = {c.source.name: wanted.goal.variance(c.covariance) for c in budget.contributions}
        if wanted.goal.floor > 0:
            own["the reading that is judged"] = wanted.goal.floor
        u = float(np.sqrt(sum(own.values())))
        if u >= wanted.goal.asked > NO_GOAL:
            parts = sorted(((name, float(np.sqrt(v))) for name, v in own.items()), key=lambda part: -part[1])
            found.append(Floor(wanted, u, tuple(p for p in parts if p[1] > _NO_PART * u)))
    return found


def with_hidden(aim: Aim, stand: Stand, whole: Stand, pool: Pool) -> Aim:
    """Return the aim with `hidden` set in its combined goals; unchanged if it has no combined goal.

    Loose goals are relaxed (`Goal.relaxed`), so that a run can reach them.
    """
    if not any(wanted.combined for wanted in aim.wanted):
        return aim
    readings, combined = (
        one.budget(pool.settings(), WITHOUT_NOISE).combined.covariance for one in (stand, whole)
    )
    relaxed = (replace(w, goal=w.goal.relaxed(w.goal.variance(combined))) for w in aim.wanted)
    wanted = (replace(w, hidden=w.goal.variance(combined - readings)) if w.combined else w for w in relaxed)
    return replace(aim, wanted=tuple(wanted))


_DETERMINED: Final = 1e-2
MOST_SUBSETS: Final = 5
"""Greatest number of mountings ahead whose subsets are compared; with more, all mountings are visited."""


@dataclass(frozen=True)
class Grid:
    """Sites that were or may be visited, and the derivatives `rows` (c, 3, p) of their readings.

    The rows are whitened by the stated noise, divided by the square root of the number of readings per visit.
    """

    sites: tuple[Site, ...]
    rows: Floats

    @classmethod
    def of(cls, stand: Stand, reads: Mapping[Site, int]) -> Grid:
        """Return the grid of the sites in `reads`, which states the number of readings per visit to each site."""
        rows, _ = whitened(stand, stand.conditions([site.setting() for site in reads]))
        often = np.sqrt(np.array(list(reads.values()), dtype=np.float64))
        return cls(tuple(reads), rows * often[:, None, None])

    def counts(self, of: Mapping[Site, int]) -> Ints:
        """Return the number of visits to each site, (c,), from a mapping by site."""
        return np.array([of.get(site, 0) for site in self.sites], dtype=np.int64)


class Visits(ExchangeDesign):
    """Numbers of visits to sites: at least the visits already made, at most the visits that the plan allows.

    As in a calibration, at least `LEAST_REPEATS` repeats are needed to estimate the noise from repeats.
    """

    _known: tuple[bytes, Floats] | None = None

    def covariance(self, counts: Floats | Ints | None = None) -> Floats:
        """Return the covariance (p, p) as the base class does, cached for the present counts."""
        if counts is not None:
            return super().covariance(counts)
        key = self.counts.tobytes()
        if self._known is None or self._known[0] != key:
            self._known = key, super().covariance()
        return self._known[1]

    def _variances(self, covariance: Floats) -> Floats:
        """Return the variances as in the base class, with a fixed order of products."""
        own = covariance[:FIXED, :FIXED]
        each = np.sum((self._functionals @ own) * self._functionals, axis=1)
        return np.asarray(np.bincount(self._goal, each) + self._floor)

    @property
    def repeats(self) -> int:
        """The number of visits that repeat an earlier one."""
        return int(np.sum(np.maximum(self.counts - 1, 0)))

    @property
    def determined(self) -> bool:
        """Whether the readings of the visits, and not just a weak prior, determine the coefficients."""
        return bool(np.max(np.diag(self.coefficient_covariance)) < _DETERMINED)

    @property
    def wider(self) -> float:
        """The factor on u because the noise is estimated from a limited number of readings."""
        return widening(self._freedom)

    @property
    def _freedom(self) -> float:
        """Degrees of freedom of the reading noise; one of each three signals counts for the setting error."""
        if self.repeats >= LEAST_REPEATS:
            return 2.0 * self.repeats
        return 2.0 * (3 * self.settings - len(self._prior)) / 3.0

    @property
    def largest(self) -> float:
        """The largest ratio of an uncertainty to the required one; at most 1 if all goals are reached."""
        return self._largest(self.variances)

    @property
    def variances(self) -> Floats:
        """The variance of each goal, (goals,), with widened noise."""
        own = self._variances(self.covariance()) - self._floor
        return np.asarray(self.wider**2 * own + self._floor)

    def is_enough(self, repeats: int) -> bool:
        """Return whether all goals are reached, with at least `repeats` repeats."""
        return self.repeats >= repeats and self.largest <= 1.0

    @property
    def is_full(self) -> bool:
        """Whether every site already has the greatest number of visits that the plan allows."""
        return bool(np.all(self.counts >= self._most))

    def add_repeat(self) -> bool:
        """Add a visit to the visited site whose repeat helps most; return False if no repeat is possible."""
        gain = self._after(self.covariance(), 1.0, 8.0)
        able = (self.counts > 0) & (self.counts < self._most)
        if able.any():
            self.counts[int(np.argmin(np.where(able, gain, np.inf)))] += 1
        return bool(able.any())

    def drop_needless(self, repeats: int) -> None:
        """Remove unnecessary visits, least important first, while the goals stay reached with `repeats` repeats."""
        dropped = True
        while dropped:
            dropped = False
            loss = self._after(self.covariance(), -1.0, 40.0)
            able = self.counts > self._least
            if self.repeats == repeats:  # only sites visited once can lose a visit without losing a repeat
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
class DesignTask:
    """The input of a design: the grid, and the numbers of visits done and still possible, (c,).

    `scale` is the ratio of the noise to the stated noise. `site_s` (c,) is the time of a visit to each site,
    `mount_s` the time of each mounting ahead, s. `repeats` is the least number of repeats, `limit_s` the time left.
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
        """The sites as candidates, with derivatives in units of the noise; the stand's angles keep their priors."""
        return SettingPool(self.grid.rows / self.scale)

    @property
    def repeats_done(self) -> int:
        """The number of visits done that repeat an earlier one."""
        return int(np.sum(np.maximum(self.done - 1, 0)))

    def time_s(self, counts: Ints) -> float:
        """Return the time of the visits in `counts` (c,) that are not done yet, including mountings, s."""
        more = counts - self.done
        mounts = {self.grid.sites[i].mount for i in np.flatnonzero(more)}
        return float(more @ self.site_s) + sum(self.mount_s.get(mount, 0.0) for mount in mounts)

    def least_repeats(self) -> int:
        """Return the required number of repeats, reduced to the greatest number that is still possible."""
        return min(self.repeats, int(np.sum(np.maximum(self.done + self.left - 1, 0))))


@dataclass(frozen=True)
class VisitDesign:
    """A design: all visits (c,) to each site, whether they reach the goals, and the time of new ones, s."""

    counts: Ints
    reached: bool
    time_s: float


def enough(task: DesignTask) -> VisitDesign:
    """Return the visits that reach the goals in the least time found.

    If the goals cannot be reached, return all visits that the time allows.
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


def _within(task: DesignTask, ahead: Sequence[Mounting], chosen: Sequence[Mounting]) -> VisitDesign | None:
    """Return the design restricted to the mountings `chosen` among those `ahead`; None if none can suffice."""
    left = task.left.copy()
    for mount in ahead:
        if mount not in chosen:
            left[_of(task.grid, mount)] = 0
    most, repeats = task.done + left, task.least_repeats()
    if not Visits(task.candidates, task.goals, most, task.done, most).is_enough(repeats):
        return None
    design = _greedy(task, most, repeats, wide=True)
    if design.repeats == repeats:  # the repeats set the number of visits; fewer sites may do
        design = min(
            design, _greedy(task, most, repeats, wide=False), key=lambda one: task.time_s(one.counts)
        )
    time_s = task.time_s(design.counts)
    return None if time_s > task.limit_s else VisitDesign(design.counts, True, time_s)


def _greedy(task: DesignTask, most: Ints, repeats: int, *, wide: bool) -> Visits:
    """Add the most useful visits until the goals are reached, then remove unnecessary ones.

    With `wide`, new sites are added until the goals are reached or no site helps, and then repeats. Otherwise
    repeats are added as soon as the coefficients are determined.
    """
    design = Visits(task.candidates, task.goals, task.done, task.done, most)
    while not design.is_enough(repeats):
        first = design.largest > 1.0 if wide else not design.determined
        if first or design.repeats >= repeats or not design.add_repeat():
            design.add_best()
    design.drop_needless(repeats)
    return design


def _all_of(task: DesignTask) -> VisitDesign:
    """Return all remaining visits or, if time is short, the best visits and repeats that it allows."""
    most = task.done + task.left
    if task.time_s(most) <= task.limit_s:
        return VisitDesign(most, False, task.time_s(most))
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
    return VisitDesign(design.counts, False, task.time_s(design.counts))
