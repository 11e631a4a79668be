"""What is to be reached, stated before the run and never changed by it; and what no reading can lower."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.analysis.planning.goals import Goal
from bench.analysis.planning.stand import WITHOUT_NOISE, Stand
from bench.analysis.planning.until.pool import Pool
from bench.base.arrays import Floats

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
