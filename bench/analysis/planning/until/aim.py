"""What is to be reached, stated before the run and never changed by it; and what no reading can lower."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.analysis.budget.coefficients import Budget, make_budget
from bench.analysis.budget.error_source import ErrorSource
from bench.analysis.budget.learned import learned_sources
from bench.analysis.budget.setup import Setup
from bench.analysis.budget.sources import effect_sources, stand_source
from bench.analysis.calibration.estimators import GLS
from bench.analysis.planning.goals import Goal
from bench.analysis.planning.points import Stand
from bench.analysis.planning.settings import conditions_of
from bench.analysis.planning.until.pool import Pool
from bench.base.arrays import Floats
from bench.model import STAND_ANGLES, Distribution
from bench.model.block import COEFFICIENTS

_WITHOUT_NOISE: Final = 1e-4
"""The noise of endlessly many readings, as a part of that of one."""
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


def floors(aim: Aim, stand: Stand, pool: Pool, hidden: Sequence[ErrorSource]) -> list[Floor]:
    """Return the goals below what endlessly many readings at the points of the pool would leave.

    `hidden` are the sources of the combined uncertainty beyond those of the stand. Raises `CalibrationError` where
    the pool does not determine the coefficients.
    """
    budget = _endless(stand, pool, hidden)
    found = []
    for wanted in aim.wanted:
        own = {
            c.source.name: _variance(wanted.goal, c.covariance)
            for c in budget.contributions
            if wanted.combined or c.source not in hidden
        }
        if wanted.goal.floor > 0:
            own["the reading that is judged"] = wanted.goal.floor
        u = float(np.sqrt(sum(own.values())))
        if u >= wanted.goal.asked > NO_GOAL:
            parts = sorted(((name, float(np.sqrt(v))) for name, v in own.items()), key=lambda part: -part[1])
            found.append(Floor(wanted, u, tuple(p for p in parts if p[1] > _NO_PART * u)))
    return found


def with_hidden(aim: Aim, stand: Stand, pool: Pool, hidden: Sequence[ErrorSource]) -> Aim:
    """Return the aim with the part of each combined goal that no reading lowers."""
    if not any(wanted.combined for wanted in aim.wanted):
        return aim
    beyond = np.zeros((len(COEFFICIENTS), len(COEFFICIENTS)))
    for contribution in _endless(stand, pool, hidden).contributions:
        if contribution.source in hidden:
            beyond += contribution.covariance
    return replace(
        aim,
        wanted=tuple(replace(w, hidden=_variance(w.goal, beyond)) if w.combined else w for w in aim.wanted),
    )


def _variance(goal: Goal, covariance: Floats) -> float:
    return float(np.einsum("ki,ij,kj->", goal.functionals, covariance, goal.functionals))


def _endless(stand: Stand, pool: Pool, hidden: Sequence[ErrorSource]) -> Budget:
    """The budget of the whole pool with next to no noise: what is left of it endless repeats leave, too."""
    setup = Setup(stand.model, conditions_of(pool.settings()), stand.block)
    sizes = {
        name: u if name in STAND_ANGLES else _WITHOUT_NOISE * u for name, u in stand.sizes.items() if u > 0
    }
    sources = [stand_source(name, Distribution(u)) for name, u in sizes.items()]
    of_model = effect_sources(setup)
    if stand.known is None:
        return make_budget(setup, [*sources, *of_model, *hidden], GLS, stated=sizes)
    known = stand.known
    if known.noise is not None:
        known = replace(known, noise=known.noise.times(_WITHOUT_NOISE))
    learned = learned_sources(sources, known, setup.conditions.mounts)
    return make_budget(setup, [*learned, *of_model, *hidden], GLS, stated=sizes, known=known)
