"""The goal of a run and the pool of points from which it may choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from bench.base.arrays import Floats
from bench.calibration.result import CalibrationError
from bench.config.procedure.plan import Level, Mount, Plan, Read, SetTemperature, Settle, Turn, Wait
from bench.model.conditions import Mounting
from bench.planning.optimal_design import WITHOUT_NOISE, Goal, Stand
from bench.planning.settings import Setting
from bench.readings.table import UNORIENTED, VERIFICATION

_LEFT_OUT_WITH_IT: Final = (Level, Mount, Wait, Settle)
"""Steps that nobody needs where nothing is measured on a mounting."""


class Site(NamedTuple):
    """Where the head stands in a mounting, from which side it came: readings of one site are repeats."""

    mount: Mounting
    point: int
    angle_rad: float
    direction: int

    def setting(self) -> Setting:
        """Return it as a setting of the first pass."""
        return Setting(self.mount, 1, self.point, self.angle_rad, self.direction)


@dataclass(frozen=True)
class Point:
    """A turn with its readings: the steps of the plan, the site, the pass, the expected time.

    Where it is read several times the site is that of the first reading, and stands for all.
    """

    steps: tuple[int, ...]
    reads: tuple[int, ...]
    site: Site
    pass_number: int
    time_s: float

    @property
    def last(self) -> int:
        """Its last step."""
        return self.steps[-1]


@dataclass(frozen=True)
class Visit:
    """A mounting of the block with its points in the order of the plan.

    `mount_step` mounts it (None where it stays on), `steps` are the visit's own beside the points, which take
    `time_s`.
    """

    mount: Mounting
    points: tuple[Point, ...]
    mount_step: int | None
    steps: tuple[int, ...]
    time_s: float

    @property
    def first(self) -> int:
        """The step at which it is decided what of it is done."""
        return min(self.steps[:1] + self.points[0].steps[:1])


@dataclass(frozen=True)
class Pool:
    """The visits of a plan in order, and what is done whatever is chosen.

    `always_s` is the time of all else, `after_s` that of what follows on the last point.
    """

    visits: tuple[Visit, ...]
    always_s: float
    after_s: float

    @property
    def points(self) -> tuple[Point, ...]:
        """All points in the order of the plan."""
        return tuple(point for visit in self.visits for point in visit.points)

    @property
    def end(self) -> int:
        """The step after the last point."""
        return self.visits[-1].points[-1].last + 1

    @property
    def count(self) -> int:
        """How many points there are to choose from."""
        return len(self.points)

    @property
    def time_s(self) -> float:
        """Expected time of the whole plan."""
        return self.always_s + sum(p.time_s for p in self.points) + sum(visit.time_s for visit in self.visits)

    def settings(self) -> list[Setting]:
        """Return all settings in order."""
        return [
            Setting(p.site.mount, p.pass_number, p.site.point, p.site.angle_rad, p.site.direction)
            for p in self.points
        ]


def pool_of(plan: Plan, line_hz: float = 50.0) -> Pool:
    """Return what of a plan may be left out.

    Raises `CalibrationError` for a plan that is no calibration at one temperature.
    """
    if any(isinstance(step, SetTemperature) for step in plan.steps):
        raise CalibrationError(
            f"{plan.name}: sets temperatures, and what is enough is told of a calibration at one temperature; "
            "run it whole, or take a procedure without them"
        )
    found = _points(plan, line_hz)
    if not found:
        raise CalibrationError(
            f"{plan.name}: has no reading in an installation of known orientation: nothing is to choose"
        )
    visits = _visits(plan, found, line_hz)
    chosen = {i for point in found for i in point.steps} | {i for visit in visits for i in visit.steps}
    other = {i: plan.step_duration_s(s, line_hz) for i, s in enumerate(plan.steps) if i not in chosen}
    end = found[-1].last + 1
    return Pool(visits, sum(other.values()), sum(s for i, s in other.items() if i >= end))


def _points(plan: Plan, line_hz: float) -> list[Point]:
    """Return the points; each ends with its last reading before the next turn."""
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
        found.append(Point(steps, tuple(i for i, _ in reads), site, first.pass_number, time_s))
    return found


def _is_oriented(read: Read) -> bool:
    known = read.installation not in UNORIENTED and read.installation != VERIFICATION
    return known and read.target_rad is not None


def _visits(plan: Plan, found: Sequence[Point], line_hz: float) -> tuple[Visit, ...]:
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
        visits.append(Visit(mount, own, mounted, steps, time_s))
    return tuple(visits)


_NO_PART: Final = 1e-6
NO_GOAL: Final = 1e-12
"""Asked for where nothing is but a time: never reached."""


@dataclass(frozen=True)
class Wanted:
    """A goal, of the readings' own uncertainty or of the `combined` one; `hidden` is the variance of the latter's
    rest, which no reading lowers."""

    goal: Goal
    combined: bool = False
    hidden: float = 0.0

    @property
    def ahead(self) -> Goal:
        """The goal as a design is judged by it, from the covariance of the readings alone."""
        return replace(self.goal, floor=self.goal.floor + self.hidden)

    @property
    def name(self) -> str:
        """What it is called, with what counts in it."""
        return f"combined u of {self.goal.name}" if self.combined else f"u of {self.goal.name}"


@dataclass(frozen=True)
class Aim:
    """All that is wanted, and the bench time at most, s."""

    wanted: tuple[Wanted, ...]
    limit_s: float | None = None


@dataclass(frozen=True)
class Reached:
    """How far a goal is reached: u by now (or to come) and what is asked, in `unit`."""

    name: str
    u: float
    asked: float
    unit: str

    @property
    def ratio(self) -> float:
        """The uncertainty in units of what is asked."""
        return self.u / self.asked


def reached_by(aim: Aim, readings: Floats, combined: Floats) -> tuple[Reached, ...]:
    """Return what covariances (12, 12) of the coefficients, of the readings alone and combined, reach."""
    return tuple(
        Reached(w.name, w.goal.u(combined if w.combined else readings), w.goal.asked, w.goal.unit)
        for w in aim.wanted
    )


@dataclass(frozen=True)
class Floor:
    """What no reading lowers: u of a goal that is asked for below it, and the largest parts by name."""

    wanted: Wanted
    u: float
    parts: tuple[tuple[str, float], ...]


def floors(aim: Aim, stand: Stand, whole: Stand, pool: Pool) -> list[Floor]:
    """Return the goals below what endlessly many readings at the points of the pool would leave.

    `stand` has what the readings' own uncertainty holds, `whole` what the combined one does. Raises
    `CalibrationError` where the pool does not determine the coefficients.
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
    """Return the aim with the part of each combined goal that no reading lowers."""
    if not any(wanted.combined for wanted in aim.wanted):
        return aim
    readings, combined = (
        one.budget(pool.settings(), WITHOUT_NOISE).combined.covariance for one in (stand, whole)
    )
    relaxed = (replace(w, goal=w.goal.relaxed(w.goal.variance(combined))) for w in aim.wanted)
    wanted = (replace(w, hidden=w.goal.variance(combined - readings)) if w.combined else w for w in relaxed)
    return replace(aim, wanted=tuple(wanted))
