"""How long a run until it is good enough will take: its distribution over the noise, before the run.

A run's choices depend on its readings by the size of the noise alone, of which readings tell as chi-square does of
their degrees of freedom. So a run is drawn by a few numbers, and the choices are those of `Chooser` itself.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from bench.base.arrays import Floats
from bench.calibration.design import FIXED
from bench.calibration.noise import LEAST_REPEATS
from bench.planning.choice import BELIEVED, REACHED, Choice, Chooser, Scale, Standing
from bench.planning.pool import NO_GOAL, Reached, Site, Visits

DRAWS: Final = 100
GRAIN: Final = 0.1
"""Noise is drawn to so much of itself: choices are found once for all draws that agree in it."""
QUANTILES: Final = (0.05, 0.5, 0.95)
_OF_ONE_MOUNTING: Final = 9
"""Coefficients that readings in one mounting determine; in two and more all are."""


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
    known: dict[Any, Choice] = {}
    drawn = [_run(chooser, scale, rng, known) for _ in range(draws)]
    columns = np.array(drawn, dtype=np.float64).T
    pool = chooser.pool
    has_goal = any(wanted.goal.asked > NO_GOAL for wanted in chooser.aim.wanted)
    return TimeOutlook(columns[0], columns[1], columns[2], pool.time_s, pool.count, scale, has_goal)


def _run(
    chooser: Chooser, scale: float, rng: np.random.Generator, known: dict[Any, Choice]
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
    chooser: Chooser, before: Standing, choice: Choice, done: Counter[Site], sums: Any, spent_s: float
) -> Standing:
    """What the record says after a pass, the noise told to a grain."""
    chi2, dof = sums[0] + sums[1]
    size = _grained(Scale(float(chi2), int(dof)).size)
    taken = before.taken | {point.steps[0] for point in choice.points}
    standing = Standing(choice.visit, taken, done, spent_s, _scale_of(size, int(dof)))
    told = sums[0] if sums[0][1] >= 3 * LEAST_REPEATS else sums[0] + sums[1]
    stated = _grained(float(np.sqrt(told[0] / max(told[1], 1.0))))
    return replace(standing, reached=_reached(chooser, standing, stated))


def _reached(chooser: Chooser, standing: Standing, stated: float) -> tuple[Reached, ...]:
    """What a calibration would state at noise of that size; nothing where the coefficients are not determined."""
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
    """Degrees of freedom of the noise by repeats, and by what the model leaves beyond them."""
    readings, groups = sum(done.values()), len(done)
    mounts = len({site.mount for site in done})
    unknown = min(_OF_ONE_MOUNTING * mounts, FIXED)
    return 3 * (readings - groups), max(3 * groups - unknown, 0)


def _grained(size: float) -> float:
    return float(np.exp(GRAIN * np.round(np.log(max(size, 1e-6)) / GRAIN)))


def _scale_of(size: float, dof: int) -> Scale:
    """Return the scale whose size is this."""
    return Scale(size**2 * (BELIEVED + dof) - BELIEVED, dof)
