"""How long a run until it is good enough will take: its distribution over the noise, before the run.

The choices of a run depend on its readings only through the estimated noise, which has a chi-square
distribution. So a few random numbers simulate a run, and `Chooser` itself makes the choices."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from scipy.special import gammaincinv

from bench.base.arrays import Floats, Ints
from bench.calibration.design import FIXED
from bench.calibration.design import make_problem as problem_of
from bench.calibration.noise import LEAST_REPEATS, whiten
from bench.model.conditions import Mounting
from bench.model.effects import AppliedEffect, Effect
from bench.planning.optimal_design import Stand, whitened
from bench.planning.pool import (
    NO_GOAL,
    Aim,
    DesignTask,
    Grid,
    PlannedPoint,
    Pool,
    Reached,
    Site,
    VisitDesign,
    Visits,
    enough,
)
from bench.planning.requirements import Setting, conditions_of
from bench.readings.table import Readings

DRAWS: Final = 100
GRAIN: Final = 0.1
"""Relative step to which noise is rounded: choices are computed once for all draws with the same step."""
QUANTILES: Final = (0.05, 0.5, 0.95)
_OF_ONE_MOUNTING: Final = 9
"""Number of coefficients that readings in one mounting determine; two mountings determine all."""


@dataclass(frozen=True)
class TimeOutlook:
    """Bench time, s, and readings of the pool in each draw, (draws,); whether the goals were reached in it.

    `whole_s` is what the plan would take as it stands, `whole` its points to choose from, `scale` the noise
    in units of what the bench file states; `has_goal` is whether more than a time was asked for, `learned` whether
    that noise was learned of the bench.
    """

    time_s: Floats
    settings: Floats
    reached: Floats
    whole_s: float
    whole: int
    scale: float
    has_goal: bool = True
    learned: bool = False

    def quantiles(self, values: Floats) -> list[float]:
        """Return the quantiles `QUANTILES` of values (draws,)."""
        return [float(q) for q in np.quantile(values, QUANTILES, method="inverted_cdf")]


def time_outlook(chooser: Chooser, scale: float = 1.0, draws: int = DRAWS, seed: int = 1) -> TimeOutlook:
    """Draw runs at a noise of `scale` times what the bench file states."""
    rng = np.random.default_rng(seed)
    known: dict[Any, NextPoints] = {}
    drawn = [_run(chooser, scale, rng, known) for _ in range(draws)]
    columns = np.array(drawn, dtype=np.float64).T
    pool = chooser.pool
    has_goal = any(wanted.goal.asked > NO_GOAL for wanted in chooser.aim.wanted)
    return TimeOutlook(columns[0], columns[1], columns[2], pool.time_s, pool.count, scale, has_goal)


def _run(
    chooser: Chooser, scale: float, rng: np.random.Generator, known: dict[Any, NextPoints]
) -> tuple[float, float, bool]:
    """Draw a run; return its time, its settings, and whether it reached the goals."""
    standing = Standing()
    repeated, other = np.zeros(2), np.zeros(2)  # chi-square and degrees of freedom
    spent_s = chooser.pool.always_s - chooser.pool.after_s
    while True:
        key = (
            standing.visit,
            standing.taken,
            frozenset(standing.done.items()),
            standing.scale,
            standing.reached,
            round(standing.elapsed_s) if chooser.aim.limit_s is not None else 0,
        )
        if key not in known:
            known[key] = chooser.choose(standing)
        choice = known[key]
        if choice.stop:
            return spent_s + chooser.pool.after_s, float(choice.settings), choice.stop == REACHED
        done = Counter(standing.done)
        done.update(point.site for point in choice.points)
        spent_s += choice.next_s
        for sums, dof in zip((repeated, other), _freedom(done), strict=True):
            if (more := dof - sums[1]) > 0:
                np.add(sums, (scale**2 * rng.chisquare(more), more), out=sums)
        standing = _after(chooser, standing, choice, done, (repeated, other), spent_s)


def _after(
    chooser: Chooser, before: Standing, choice: NextPoints, done: Counter[Site], sums: Any, spent_s: float
) -> Standing:
    """Return the state of the run after a pass, with the noise rounded to its grain."""
    chi2, dof = sums[0] + sums[1]
    size = _grained(NoiseScale(float(chi2), int(dof)).size)
    taken = before.taken | {point.steps[0] for point in choice.points}
    standing = Standing(choice.visit, taken, done, spent_s, _scale_of(size, int(dof)))
    told = sums[0] if sums[0][1] >= 3 * LEAST_REPEATS else sums[0] + sums[1]
    stated = _grained(float(np.sqrt(told[0] / max(told[1], 1.0))))
    return replace(standing, reached=_reached(chooser, standing, stated))


def _reached(chooser: Chooser, standing: Standing, stated: float) -> tuple[Reached, ...]:
    """Return the progress of the goals at noise `stated`; empty for undetermined coefficients."""
    task = chooser.task(standing)
    goals = tuple(wanted.ahead for wanted in chooser.aim.wanted)
    rows = type(task.candidates)(task.grid.rows / stated)
    visits = Visits(rows, goals, task.done, task.done, task.done)
    if not visits.determined:
        return ()
    return tuple(
        Reached(w.name, float(np.sqrt(v)), w.goal.asked, w.goal.unit)
        for w, v in zip(chooser.aim.wanted, visits.variances, strict=True)
    )


def _freedom(done: Counter[Site]) -> tuple[int, int]:
    """Return the degrees of freedom of the noise from repeats, and from the other residuals of the model."""
    readings, groups = sum(done.values()), len(done)
    mounts = len({site.mount for site in done})
    unknown = min(_OF_ONE_MOUNTING * mounts, FIXED)
    return 3 * (readings - groups), max(3 * groups - unknown, 0)


def _grained(size: float) -> float:
    return float(np.exp(GRAIN * np.round(np.log(max(size, 1e-6)) / GRAIN)))


def _scale_of(size: float, dof: int) -> NoiseScale:
    """Return the noise scale whose estimate is `size`."""
    return NoiseScale(size**2 * (BELIEVED + dof) - BELIEVED, dof)


BELIEVED: Final = 6.0
"""Weight of the stated noise, in signals: little, but enough before there are readings."""

SURE: Final = 0.8
"""Before a mounting is left for good, its visits must be enough for the noise at this upper confidence level."""


@dataclass(frozen=True)
class NoiseScale:
    """Ratio of the noise to that stated in the bench file, from `chi2` with `dof` degrees of freedom."""

    chi2: float = 0.0
    dof: int = 0

    @property
    def size(self) -> float:
        """The estimate, which weighs the bench file by `BELIEVED`."""
        return float(np.sqrt((BELIEVED + self.chi2) / (BELIEVED + self.dof)))

    @property
    def bound(self) -> float:
        """Upper limit of the noise with the probability `SURE`."""
        freedom = BELIEVED + self.dof
        return float(self.size * np.sqrt(freedom / (2.0 * gammaincinv(0.5 * freedom, 1.0 - SURE))))


NOTHING_KNOWN: Final = NoiseScale()
"""The scale of the noise before the first reading: the noise stated in the bench file."""


def scale_of(stand: Stand, readings: Readings) -> NoiseScale:
    """Return the noise in readings, from the residuals of a fit of block and stand.

    The readings need not determine the coefficients: those of one mounting have residuals, too.
    """
    own = readings.oriented()
    if not len(own):
        return NoiseScale()
    rows, problem = whitened(stand, own.conditions())
    left = own.signal - problem.predict(stand.block, problem.prior_mean)
    response = whitened_response(stand, left, problem.slope(stand.block, problem.prior_mean))
    matrix = rows.reshape(-1, rows.shape[2])
    prior = np.eye(rows.shape[2])[FIXED:]
    whole = np.vstack([matrix, prior])
    target = np.concatenate([response.ravel(), np.zeros(len(prior))])
    solution = np.linalg.lstsq(whole, target, rcond=1e-9)[0]
    misfit = target - whole @ solution
    rank = int(np.linalg.matrix_rank(matrix[:, :FIXED], tol=1e-9 * float(np.linalg.norm(matrix))))
    return NoiseScale(float(misfit @ misfit), max(matrix.shape[0] - rank, 0))


def whitened_response(stand: Stand, left: Floats, slope: Floats) -> Floats:
    """Return residuals (n, 3) in units of the noise, as the derivatives are."""
    return np.asarray(whiten(left[:, :, None], slope, stand.noise)[:, :, 0])


REACHED: Final = "reached"
USED_UP: Final = "used up"
TIME: Final = "time"


@dataclass(frozen=True)
class Standing:
    """The state of a run by its record.

    `visit` is the number of the mounting that the block is in, of those of the pool; `taken` are the first
    steps of the points that were measured, `done` counts the visits to each site, `elapsed_s` is the bench
    time. `refused` are sites that somebody skipped, `refused_mounts` mountings likewise, `now` how
    mountings are called since the block was taken off and mounted again. `reached` is empty as long as the
    readings do not determine the coefficients; `apart` are sites that would tell apart what may explain a
    misfit, where there is one.
    """

    visit: int = -1
    taken: frozenset[int] = frozenset()
    done: Mapping[Site, int] = field(default_factory=Counter)
    elapsed_s: float = 0.0
    scale: NoiseScale = NOTHING_KNOWN
    reached: tuple[Reached, ...] = ()
    refused: frozenset[Site] = frozenset()
    refused_mounts: frozenset[Mounting] = frozenset()
    now: Mapping[Mounting, Mounting] | None = None
    apart: frozenset[Site] = frozenset()

    def site_of(self, point: PlannedPoint) -> Site:
        """Return the site of a point as the block is mounted now."""
        mount = (self.now or {}).get(point.site.mount, point.site.mount)
        return point.site._replace(mount=mount)

    @property
    def worst(self) -> Reached | None:
        """The goal that is furthest from reached, by now."""
        return max(self.reached, key=lambda one: one.ratio, default=None)


@dataclass(frozen=True)
class NextPoints:
    """The next points to measure: `points` of the mounting number `visit`; none where `stop` says why.

    `left_out` are steps that are passed over and not needed, as it stands; a later choice may take some of
    them up, as long as the block stays on, which are then `taken_up`. `now` is the goal that is furthest
    from reached, `after` what it is expected to be at after these points, `end` at the end; `more` and
    `more_s` are the readings and the time that are expected until then, these points among them, `settings`
    and `repeats` what was done. `rest_s` is the time of what is done whatever is chosen, `not_needed` how
    many points of the pool are not taken in all.
    """

    visit: int
    points: tuple[PlannedPoint, ...]
    left_out: frozenset[int]
    stop: str
    now: Reached | None
    settings: int
    repeats: int
    rest_s: float
    taken_up: frozenset[int] = frozenset()
    after: Reached | None = None
    end: Reached | None = None
    more: int = 0
    more_s: float = 0.0
    next_s: float = 0.0
    pool_end: int = 0
    not_needed: int = 0
    telling_apart: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return the choice as JSON for an event of the record."""
        told: dict[str, Any] = {
            "visit": self.visit,
            "settings": self.settings,
            "repeats": self.repeats,
            "now": _told(self.now),
            "stop": self.stop,
            "left_out": _ranges(self.left_out),
        }
        if self.stop:
            return {**told, "not_needed": self.not_needed}
        mount = self.points[0].site.mount
        told["taken_up"] = _ranges(self.taken_up)
        told["next"] = {
            "installation": mount.installation,
            "series": mount.series,
            "points": [[point.pass_number, point.site.point] for point in self.points],
            "first": self.points[0].steps[0],
            "last": self.points[-1].last,
            "takes_s": round(self.next_s, 1),
            "then": _told(self.after),
            "tells_apart": self.telling_apart,
        }
        told["in_all"] = {"settings": self.more, "takes_s": round(self.more_s, 1), "then": _told(self.end)}
        takes_s = round(max(self.more_s - self.next_s - self.rest_s, 0.0), 1)
        told["undecided"] = {"first": self.points[-1].last + 1, "last": self.pool_end - 1, "takes_s": takes_s}
        return told


def _told(reached: Reached | None) -> dict[str, Any] | None:
    if reached is None:
        return None
    asked = reached.asked if reached.asked > NO_GOAL else None
    return {"goal": reached.name, "u": reached.u, "asked": asked, "unit": reached.unit}


def _ranges(steps: frozenset[int]) -> list[list[int]]:
    """Return ranges [first, last] of steps in rising order."""
    ranges: list[list[int]] = []
    for step in sorted(steps):
        if ranges and ranges[-1][1] == step - 1:
            ranges[-1][1] = step
        else:
            ranges.append([step, step])
    return ranges


class Chooser:
    """Chooses from a pool on a stand, for an aim."""

    def __init__(self, pool: Pool, aim: Aim, stand: Stand, repeats: int = LEAST_REPEATS) -> None:
        self.pool = pool
        self.aim = aim
        self.stand = stand
        self.repeats = repeats
        self._grids: dict[frozenset[Site], Grid] = {}

    def choose(self, standing: Standing) -> NextPoints:
        """Return the next points to measure, or the reason to stop."""
        task = self.task(standing)
        if stop := self._stop(standing, task):
            return self._no_more(standing, task, stop)
        design = self._design(standing, task)
        here = max(standing.visit, 0)
        points = self._batch(standing, task, design, here)
        if not points and self._is_left_for_good(standing):
            task = replace(task, scale=standing.scale.bound)
            design = self._design(standing, task)
            points = self._batch(standing, task, design, here)
        while not points and here + 1 < len(self.pool.visits):
            here += 1
            points = self._batch(standing, task, design, here)
        if points:
            return self._going_on(standing, task, design, here, points)
        return self._no_more(standing, task, USED_UP if self.aim.limit_s is None else TIME)

    def _batch(
        self, standing: Standing, task: DesignTask, design: VisitDesign, number: int
    ) -> tuple[PlannedPoint, ...]:
        """Return the points of a visit to measure next: one for each site of the design."""
        planned = zip(task.grid.sites, (design.counts - task.done).tolist(), strict=True)
        sites = {site for site, count in planned if count > 0}
        points = []
        for point in self.open_points(number, standing):
            if (site := standing.site_of(point)) in sites:
                sites.remove(site)
                points.append(point)
        return tuple(points)

    # --- what there is ------------------------------------------------------------------------------

    def open_points(self, number: int, standing: Standing) -> list[PlannedPoint]:
        """Return the points of a visit that can still be measured."""
        visit = self.pool.visits[number]
        if number < standing.visit or visit.mount in standing.refused_mounts:
            return []
        return [
            point
            for point in visit.points
            if point.steps[0] not in standing.taken and standing.site_of(point) not in standing.refused
        ]

    def task(self, standing: Standing) -> DesignTask:
        """Return the task of a design for the present state of the run."""
        reads: dict[Site, int] = dict.fromkeys(standing.done, 1)
        seconds: dict[Site, float] = {}
        for point in self.pool.points:
            site = standing.site_of(point)
            reads[site] = len(point.reads)
            seconds[site] = point.time_s
        ahead = [number for number in range(len(self.pool.visits)) if self.open_points(number, standing)]
        left = Counter(standing.site_of(p) for number in ahead for p in self.open_points(number, standing))
        grid = self._grid(reads)
        done = grid.counts(standing.done)
        limit_s = float("inf")
        if self.aim.limit_s is not None:
            limit_s = max(self.aim.limit_s - standing.elapsed_s - self._rest_s(standing), 0.0)
        visits = self.pool.visits[standing.visit + 1 :]
        return DesignTask(
            grid,
            self._goals(standing, grid, done),
            done,
            grid.counts(left),
            standing.scale.size,
            np.array([seconds.get(site, 0.0) for site in grid.sites]),
            {visit.mount: visit.time_s for visit in visits},
            self.repeats,
            limit_s,
        )

    def _rest_s(self, standing: Standing) -> float:
        """Return the remaining time of the steps that are done whatever is chosen, s."""
        return self.pool.always_s if standing.visit < 0 else self.pool.after_s

    def _is_left_for_good(self, standing: Standing) -> bool:
        """Return whether further mountings follow, so that the present one is not returned to."""
        ahead = range(max(standing.visit, 0) + 1, len(self.pool.visits))
        return any(self.open_points(number, standing) for number in ahead)

    def _grid(self, reads: Mapping[Site, int]) -> Grid:
        key = frozenset(reads)
        if key not in self._grids:
            self._grids[key] = Grid.of(self.stand, dict(sorted(reads.items())))
        return self._grids[key]

    def _goals(self, standing: Standing, grid: Grid, done: Ints) -> tuple[Any, ...]:
        """Return the goals, each scaled to the u that a calibration of the readings so far states."""
        ahead = tuple(wanted.ahead for wanted in self.aim.wanted)
        if not standing.reached:
            return ahead
        task = DesignTask(grid, ahead, done, done * 0, standing.scale.size, np.zeros(len(done)), {}, 0)
        foreseen = Visits(task.candidates, ahead, done, done, done).variances
        found = []
        for wanted, goal, model, now in zip(self.aim.wanted, ahead, foreseen, standing.reached, strict=True):
            rest = goal.floor if wanted.combined else wanted.goal.floor
            part = max(now.u**2 - rest, 0.0) / max(model - goal.floor, 1e-300)
            found.append(replace(goal, functionals=goal.functionals * np.sqrt(part)))
        return tuple(found)

    # --- what is chosen -----------------------------------------------------------------------------

    def _stop(self, standing: Standing, task: DesignTask) -> str:
        """Return the reason to stop; empty where the run goes on."""
        if not np.any(task.left):
            return REACHED if self._is_reached(standing) else USED_UP
        repeats = int(np.sum(np.maximum(task.done - 1, 0)))
        if self._is_reached(standing) and repeats >= task.least_repeats() and not standing.apart:
            return REACHED
        return ""

    def _is_reached(self, standing: Standing) -> bool:
        return bool(standing.reached) and all(one.ratio <= 1.0 for one in standing.reached)

    def _design(self, standing: Standing, task: DesignTask) -> VisitDesign:
        """The visits until the end; first those that distinguish possible explanations of a misfit."""
        if not standing.apart:
            return enough(task)
        first = task.grid.counts(Counter(standing.apart))
        first = np.minimum(first, task.left)
        over = replace(task, done=task.done + first, left=task.left - first)
        design = enough(over)
        return replace(design, time_s=task.time_s(design.counts))

    def _going_on(
        self,
        standing: Standing,
        task: DesignTask,
        design: VisitDesign,
        number: int,
        points: tuple[PlannedPoint, ...],
    ) -> NextPoints:
        more = task.grid.counts(Counter(standing.site_of(point) for point in points))
        expected = replace(task, scale=standing.scale.size)
        next_s = sum(point.time_s for point in points)
        next_s += self.pool.visits[number].time_s if number > standing.visit else 0.0
        kept = frozenset(step for point in points for step in point.steps)
        return NextPoints(
            number,
            points,
            self._passed_over(standing, number, points[-1].last) - kept,
            "",
            standing.worst,
            int(task.done.sum()),
            int(np.sum(np.maximum(task.done - 1, 0))),
            self._rest_s(standing),
            kept if number == standing.visit else frozenset(),
            self._foreseen(expected, task.done + more),
            self._foreseen(expected, design.counts),
            int((design.counts - task.done).sum()),
            design.time_s + self._rest_s(standing),
            next_s,
            self.pool.end,
            telling_apart=bool(standing.apart & {standing.site_of(point) for point in points}),
        )

    def _passed_over(self, standing: Standing, number: int, last: int) -> frozenset[int]:
        """Return the steps before the last chosen one that are not measured."""
        steps: set[int] = set()
        for other, visit in enumerate(self.pool.visits[: number + 1]):
            steps.update(
                step
                for point in visit.points
                if point.steps[0] not in standing.taken and point.last < last
                for step in point.steps
            )
            if standing.visit < other < number:
                steps.update(visit.steps)
        return frozenset(steps)

    def _foreseen(self, task: DesignTask, counts: Ints) -> Reached | None:
        """Return the worst goal after visits to the sites; None where the coefficients are not determined."""
        visits = Visits(task.candidates, task.goals, counts, counts, counts)
        if not visits.determined:
            return None
        u: Floats = np.sqrt(visits.variances)
        return max(
            (
                Reached(w.name, float(size), w.goal.asked, w.goal.unit)
                for w, size in zip(self.aim.wanted, u, strict=True)
            ),
            key=lambda one: one.ratio,
        )

    def _no_more(self, standing: Standing, task: DesignTask, stop: str) -> NextPoints:
        left = {s for p in self.pool.points if p.steps[0] not in standing.taken for s in p.steps}
        for visit in self.pool.visits[standing.visit + 1 :]:
            left.update(visit.steps)
        return NextPoints(
            standing.visit,
            (),
            frozenset(left),
            stop,
            standing.worst,
            int(task.done.sum()),
            int(np.sum(np.maximum(task.done - 1, 0))),
            self._rest_s(standing),
            not_needed=self.pool.count - sum(standing.done.values()),
        )


MOST: Final = 4
"""Settings that are chosen at once to distinguish effects."""
WORTH: Final = 0.5
"""A setting with less than this fraction of the first one's information is not chosen."""


def telling_apart(
    stand: Stand, done: Sequence[Setting], candidates: Sequence[Setting], effects: Sequence[Effect]
) -> list[int]:
    """Return the candidates (by number, best first) that show most of the effects after readings at `done`."""
    model = replace(stand.model, effects=tuple(AppliedEffect(effect, {}) for effect in effects))
    problem = problem_of(model, conditions_of([*done, *candidates]), stand.sizes)
    linear = problem.linear(stand.block, problem.prior_mean)
    plausible = [problem.parameter(unknown).plausible for unknown in problem.effects]
    stated = [unknown.prior_u for unknown in problem.stand]
    rows = whiten(linear.jacobian, linear.slope, stand.noise) * np.array(
        [*[1.0] * FIXED, *stated, *plausible]
    )
    known = FIXED + len(stated)
    shown = np.isfinite(rows).all(axis=(0, 1))  # what hangs on a temperature that nobody knows is not
    rows = rows[:, :, shown | (np.arange(rows.shape[2]) < known)]
    every = np.eye(rows.shape[2]) + np.einsum("nip,niq->pq", rows[: len(done)], rows[: len(done)])
    chosen: list[int] = []
    first = 0.0
    while len(chosen) < min(MOST, len(candidates)):
        told = _told_apart(every, rows[len(done) :], known)
        told[chosen] = -np.inf
        best = int(np.argmax(told))
        first = first or float(told[best])
        if told[best] <= WORTH * first and chosen:
            break
        chosen.append(best)
        every += rows[len(done) + best].T @ rows[len(done) + best]
    return chosen


def _told_apart(information: Floats, rows: Floats, known: int) -> Floats:
    """Information (c,) that each of rows (c, 3, p) adds on the unknowns from `known` on, the others being free."""
    of_all = rows @ np.linalg.solve(information, np.swapaxes(rows, 1, 2))
    own = rows[:, :, :known]
    of_known = own @ np.linalg.solve(information[:known, :known], np.swapaxes(own, 1, 2))
    one = np.eye(3)
    return np.asarray(np.linalg.slogdet(one + of_all)[1] - np.linalg.slogdet(one + of_known)[1])
