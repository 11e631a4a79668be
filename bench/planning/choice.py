"""Choice of the next points in an adaptive run, and the expected duration of such a run.

The choices depend on the readings only through the estimated noise, which has a chi-square distribution. A run
is therefore simulated with a few random numbers, and `Chooser` itself makes the simulated choices.
"""

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
"""Step of ln(noise) to which noise is rounded, so that draws with similar noise share one computation."""
QUANTILES: Final = (0.05, 0.5, 0.95)
_OF_ONE_MOUNTING: Final = 9
"""Number of coefficients that readings in one mounting determine; two mountings determine all."""


@dataclass(frozen=True)
class TimeOutlook:
    """Simulated runs, (draws,) each: bench time (s), number of settings, and whether the goals were reached.

    `whole_s` is the duration of the whole plan, `whole` its number of points. `learned` says whether the `Stand`
    has its noise from past runs of the bench. `has_goal` is False if only a time limit was given.
    """

    time_s: Floats
    settings: Floats
    reached: Floats
    whole_s: float
    whole: int
    has_goal: bool = True
    learned: bool = False

    def quantiles(self, values: Floats) -> list[float]:
        """Return the quantiles `QUANTILES` of `values` (draws,)."""
        return [float(q) for q in np.quantile(values, QUANTILES, method="inverted_cdf")]


def time_outlook(chooser: Chooser, draws: int = DRAWS) -> TimeOutlook:
    """Return the results of `draws` simulated runs with the noise of the chooser's `stand`."""
    rng = np.random.default_rng(1)
    known: dict[Any, NextPoints] = {}
    drawn = [_run(chooser, rng, known) for _ in range(draws)]
    columns = np.array(drawn, dtype=np.float64).T
    pool = chooser.pool
    has_goal = any(wanted.goal.asked > NO_GOAL for wanted in chooser.aim.wanted)
    return TimeOutlook(columns[0], columns[1], columns[2], pool.time_s, pool.count, has_goal)


def _run(
    chooser: Chooser, rng: np.random.Generator, known: dict[Any, NextPoints]
) -> tuple[float, float, bool]:
    """Simulate one run; return its time, s, its number of settings, and whether it reached the goals."""
    standing = Standing()
    repeated, other = np.zeros(2), np.zeros(2)  # each holds chi-square and degrees of freedom
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
                np.add(sums, (rng.chisquare(more), more), out=sums)
        standing = _after(chooser, standing, choice, done, (repeated, other), spent_s)


def _after(
    chooser: Chooser, before: Standing, choice: NextPoints, done: Counter[Site], sums: Any, spent_s: float
) -> Standing:
    """Return the simulated state of the run after the chosen points, with its noise rounded by `_grained`."""
    chi2, dof = sums[0] + sums[1]
    size = _grained(NoiseScale(float(chi2), int(dof)).size)
    taken = before.taken | {point.steps[0] for point in choice.points}
    standing = Standing(choice.visit, taken, done, spent_s, _scale_of(size, int(dof)))
    told = sums[0] if sums[0][1] >= 3 * LEAST_REPEATS else sums[0] + sums[1]
    stated = _grained(float(np.sqrt(told[0] / max(told[1], 1.0))))
    return replace(standing, reached=_reached(chooser, standing, stated))


def _reached(chooser: Chooser, standing: Standing, stated: float) -> tuple[Reached, ...]:
    """Return the progress towards the goals if the noise is `stated` times the stated noise.

    The result is empty if the readings do not determine the coefficients.
    """
    task = chooser.task(standing)
    goals = tuple(wanted.ahead for wanted in chooser.aim.wanted)
    rows = type(task.candidates)(task.grid.rows / stated)
    visits = Visits(rows, goals, task.done, task.done, task.done)
    if not visits.determined:
        return ()
    return chooser.aim.reached(visits.variances)


def _freedom(done: Counter[Site]) -> tuple[int, int]:
    """Return the degrees of freedom of the noise from repeats, and from all other residuals."""
    readings, groups = sum(done.values()), len(done)
    mounts = len({site.mount for site in done})
    unknown = min(_OF_ONE_MOUNTING * mounts, FIXED)
    return 3 * (readings - groups), max(3 * groups - unknown, 0)


def _grained(size: float) -> float:
    return float(np.exp(GRAIN * np.round(np.log(max(size, 1e-6)) / GRAIN)))


def _scale_of(size: float, dof: int) -> NoiseScale:
    """Return the `NoiseScale` whose ratio of the noise to the stated noise is `size`."""
    return NoiseScale(size**2 * (BELIEVED + dof) - BELIEVED, dof)


BELIEVED: Final = 6.0
"""Prior weight of the stated noise, in degrees of freedom; measured noise soon outweighs it."""

SURE: Final = 0.8
"""A run leaves a mounting once its visits suffice for the upper limit of the noise at this confidence level."""


@dataclass(frozen=True)
class NoiseScale:
    """The ratio of the noise to the stated noise, estimated from `chi2` with `dof` degrees of freedom."""

    chi2: float = 0.0
    dof: int = 0

    @property
    def size(self) -> float:
        """The estimated ratio of the noise to the stated noise.

        The stated noise counts as a prior with `BELIEVED` degrees of freedom.
        """
        return float(np.sqrt((BELIEVED + self.chi2) / (BELIEVED + self.dof)))

    @property
    def bound(self) -> float:
        """The upper confidence limit of the ratio at the level `SURE`."""
        freedom = BELIEVED + self.dof
        return float(self.size * np.sqrt(freedom / (2.0 * gammaincinv(0.5 * freedom, 1.0 - SURE))))


NOTHING_KNOWN: Final = NoiseScale()
"""The noise scale before the first reading, which is the noise stated in the bench file."""


def scale_of(stand: Stand, readings: Readings) -> NoiseScale:
    """Return the ratio of the noise of `readings` to the stated noise, by the residuals of a linear fit.

    The fit has the coefficients of the block and the angles of the stand. The readings need not determine all
    coefficients; readings of a single mounting leave residuals, too.
    """
    own = readings.oriented()
    if not len(own):
        return NoiseScale()
    rows, problem = whitened(stand, own.conditions())
    left = own.signal - problem.predict(stand.block, problem.prior_mean)
    slope = problem.slope(stand.block, problem.prior_mean)
    response = whiten(left[:, :, None], slope, stand.noise)[:, :, 0]
    matrix = rows.reshape(-1, rows.shape[2])
    prior = np.eye(rows.shape[2])[FIXED:]
    whole = np.vstack([matrix, prior])
    target = np.concatenate([response.ravel(), np.zeros(len(prior))])
    solution = np.linalg.lstsq(whole, target, rcond=1e-9)[0]
    misfit = target - whole @ solution
    rank = int(np.linalg.matrix_rank(matrix[:, :FIXED], tol=1e-9 * float(np.linalg.norm(matrix))))
    return NoiseScale(float(misfit @ misfit), max(matrix.shape[0] - rank, 0))


REACHED: Final = "reached"
USED_UP: Final = "used up"
TIME: Final = "time"


@dataclass(frozen=True)
class Standing:
    """The state of an adaptive run, as its record shows it.

    `visit` is the index of the present mounting among the pool's mountings, -1 before the first. A site is a
    setting of the head in a mounting (`Site`). `taken` holds the index of the first step of each measured
    point, `done` the number of visits to each site; `elapsed_s` is the bench time, s, `scale` the noise as a
    multiple of the stated noise. `refused` and `refused_mounts` are the sites and mountings that the operator
    skipped. After a remount of the block, `now` maps the planned mountings to those in use. `reached` is the
    progress towards the goals, empty until the readings determine the coefficients. Readings at the sites
    `apart` would distinguish possible causes of a misfit.
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
        """Return the site of a planned point in the mounting now in use."""
        mount = (self.now or {}).get(point.site.mount)
        return point.site if mount is None else point.site._replace(mount=mount)

    @property
    def worst(self) -> Reached | None:
        """The goal that is furthest from being reached; None if the progress is unknown."""
        return max(self.reached, key=lambda one: one.ratio, default=None)


@dataclass(frozen=True)
class NextPoints:
    """The next points to measure, in the mounting with index `visit`; none if `stop` gives a reason to stop.

    `left_out` are the steps that the run omits as unnecessary; `taken_up` are the steps of the next points in
    the present mounting, which may have been omitted before. `now`, `after` and `end` are the goals furthest
    from being reached: at present, and expected after these points and at the end of the run; None if the
    readings do not determine the coefficients. `settings` is the number of points measured so far, `repeats`
    the number of repeats among them. `next_s` is the time of the next points. `more` points and the time
    `more_s` are expected from now to the end. This time includes `rest_s`, the remaining time of the steps
    that no choice affects. `pool_end` is the step after the last point. `not_needed` is the number of points
    that a stopped run has not measured. `telling_apart` says that points were chosen to distinguish the
    possible causes of a misfit.
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
        """Return the choice as the data of a `chosen` event."""
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
    """Return the inclusive ranges of steps in rising order: {1, 2, 3, 7} -> [[1, 3], [7, 7]]."""
    ranges: list[list[int]] = []
    for step in sorted(steps):
        if ranges and ranges[-1][1] == step - 1:
            ranges[-1][1] = step
        else:
            ranges.append([step, step])
    return ranges


class Chooser:
    """Chooses the points of `pool` that reach the goals `aim` on the bench `stand`.

    At least `LEAST_REPEATS` of the chosen points repeat mounting, angle and direction of approach of another point.
    """

    def __init__(self, pool: Pool, aim: Aim, stand: Stand) -> None:
        self.pool = pool
        self.aim = aim
        self.stand = stand
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
        """Return the points of mounting `number` that the design still needs, one per site.

        Points that can no longer be measured are left out.
        """
        planned = zip(task.grid.sites, (design.counts - task.done).tolist(), strict=True)
        sites = {site for site, count in planned if count > 0}
        points = []
        for point in self.open_points(number, standing):
            if (site := standing.site_of(point)) in sites:
                sites.remove(site)
                points.append(point)
        return tuple(points)

    # --- available points ---------------------------------------------------------------------------

    def open_points(self, number: int, standing: Standing) -> list[PlannedPoint]:
        """Return the points of mounting `number` that can still be measured."""
        visit = self.pool.visits[number]
        if number < standing.visit or visit.mount in standing.refused_mounts:
            return []
        return [
            point
            for point in visit.points
            if point.steps[0] not in standing.taken and standing.site_of(point) not in standing.refused
        ]

    def task(self, standing: Standing) -> DesignTask:
        """Return the input of the design (`enough`) for the remainder of the run."""
        reads: dict[Site, int] = dict.fromkeys(standing.done, 1)
        seconds: dict[Site, float] = {}
        for point in self.pool.points:
            site = standing.site_of(point)
            reads[site] = len(point.reads)
            seconds[site] = point.time_s
        left = Counter(
            standing.site_of(point)
            for number in range(len(self.pool.visits))
            for point in self.open_points(number, standing)
        )
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
            LEAST_REPEATS,
            limit_s,
        )

    def _rest_s(self, standing: Standing) -> float:
        """Return the remaining time of the steps that no choice affects, s."""
        return self.pool.always_s if standing.visit < 0 else self.pool.after_s

    def _is_left_for_good(self, standing: Standing) -> bool:
        """Return whether the run leaves the present mounting for good: only later mountings have open points."""
        ahead = range(max(standing.visit, 0) + 1, len(self.pool.visits))
        return any(self.open_points(number, standing) for number in ahead)

    def _grid(self, reads: Mapping[Site, int]) -> Grid:
        key = frozenset(reads)
        if key not in self._grids:
            self._grids[key] = Grid.of(self.stand, dict(sorted(reads.items())))
        return self._grids[key]

    def _goals(self, standing: Standing, grid: Grid, done: Ints) -> tuple[Any, ...]:
        """Return the goals, scaled so that the u of the design agrees with the u in `standing.reached`."""
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

    # --- the choice ---------------------------------------------------------------------------------

    def _stop(self, standing: Standing, task: DesignTask) -> str:
        """Return the reason to stop, or an empty string."""
        if not np.any(task.left):
            return REACHED if self._is_reached(standing) else USED_UP
        enough_repeats = task.repeats_done >= task.least_repeats()
        return REACHED if self._is_reached(standing) and enough_repeats and not standing.apart else ""

    def _is_reached(self, standing: Standing) -> bool:
        return bool(standing.reached) and all(one.ratio <= 1.0 for one in standing.reached)

    def _design(self, standing: Standing, task: DesignTask) -> VisitDesign:
        """Return the design until the end of the run, with visits that distinguish possible causes of a misfit."""
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
            stop="",
            **self._so_far(standing, task),
            taken_up=kept if number == standing.visit else frozenset(),
            after=self._foreseen(expected, task.done + more),
            end=self._foreseen(expected, design.counts),
            more=int((design.counts - task.done).sum()),
            more_s=design.time_s + self._rest_s(standing),
            next_s=next_s,
            pool_end=self.pool.end,
            telling_apart=bool(standing.apart & {standing.site_of(point) for point in points}),
        )

    def _so_far(self, standing: Standing, task: DesignTask) -> dict[str, Any]:
        """Return the members of `NextPoints` that describe the points measured so far."""
        return {
            "now": standing.worst, "settings": int(task.done.sum()), "repeats": task.repeats_done,
            "rest_s": self._rest_s(standing),
        }  # fmt: skip

    def _passed_over(self, standing: Standing, number: int, last: int) -> frozenset[int]:
        """Return the unmeasured steps before step `last`, in the mountings up to index `number`."""
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
        """Return the goal furthest from being reached after visits `counts` (c,) to the sites.

        None if the visits do not determine the coefficients.
        """
        visits = Visits(task.candidates, task.goals, counts, counts, counts)
        if not visits.determined:
            return None
        return max(self.aim.reached(visits.variances), key=lambda one: one.ratio)

    def _no_more(self, standing: Standing, task: DesignTask, stop: str) -> NextPoints:
        left = self._passed_over(standing, len(self.pool.visits), self.pool.end)
        not_needed = self.pool.count - sum(standing.done.values())
        return NextPoints(
            standing.visit, (), left, stop, **self._so_far(standing, task), not_needed=not_needed
        )


MOST: Final = 4
"""Greatest number of settings chosen at once to distinguish effects."""
WORTH: Final = 0.5
"""A further setting is chosen only if its information exceeds this fraction of that of the first setting."""


def telling_apart(
    stand: Stand, done: Sequence[Setting], candidates: Sequence[Setting], effects: Sequence[Effect]
) -> list[int]:
    """Return the indices of at most `MOST` candidates, best first, that would best distinguish the effects.

    The candidates are compared by the information that they add to readings at the settings `done`.
    """
    model = replace(stand.model, effects=tuple(AppliedEffect(effect, {}) for effect in effects))
    problem = problem_of(model, conditions_of([*done, *candidates]), stand.sizes)
    linear = problem.linear(stand.block, problem.prior_mean)
    plausible = [problem.parameter(unknown).plausible for unknown in problem.effects]
    stated = [unknown.prior_u for unknown in problem.stand]
    rows = whiten(linear.jacobian, linear.slope, stand.noise) * np.array(
        [*[1.0] * FIXED, *stated, *plausible]
    )
    known = FIXED + len(stated)
    shown = np.isfinite(rows).all(axis=(0, 1))  # effects that depend on an unknown temperature are left out
    rows = rows[:, :, shown | (np.arange(rows.shape[2]) < known)]
    every = np.eye(rows.shape[2]) + np.einsum("nip,niq->pq", rows[: len(done)], rows[: len(done)])
    chosen: list[int] = []
    first = 0.0
    while len(chosen) < min(MOST, len(candidates)):
        told = _information_gain(every, rows[len(done) :], known)
        told[chosen] = -np.inf
        best = int(np.argmax(told))
        first = first or float(told[best])
        if told[best] <= WORTH * first and chosen:
            break
        chosen.append(best)
        every += rows[len(done) + best].T @ rows[len(done) + best]
    return chosen


def _information_gain(information: Floats, rows: Floats, known: int) -> Floats:
    """Return the information (c,) that each of c readings adds on the unknowns from index `known` on.

    `rows` (c, 3, p) are derivatives of the readings by the p unknowns. The measure is the increase of the log
    determinant of the information matrix for all p unknowns.
    """
    of_all = rows @ np.linalg.solve(information, np.swapaxes(rows, 1, 2))
    own = rows[:, :, :known]
    of_known = own @ np.linalg.solve(information[:known, :known], np.swapaxes(own, 1, 2))
    one = np.eye(3)
    return np.asarray(np.linalg.slogdet(one + of_all)[1] - np.linalg.slogdet(one + of_known)[1])
