"""What test points are planned for: uncertainties of coefficients, of Delta g, of any measured acceleration.

Each goal is a variance tr(W C) + floor of the coefficients' covariance C, with the standard uncertainty that is
asked for; W is held as functionals l of the coefficients, W = sum l l^T.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.analysis.budget.acceleration import directions
from bench.analysis.calibration.result import CalibrationError
from bench.analysis.calibration.verification import modulus_slopes
from bench.analysis.planning.settings import Setting
from bench.base.arrays import Floats
from bench.model.block import COEFFICIENTS, Block

DIRECTIONS: Final = 128
"""Directions over which an acceleration is taken."""
WHOLE: Final = 10.0
LEAST_WHOLE_G: Final = 1e-3
"""How well the whole block is to be known beside the goals: so many times what they ask, never less than 1 mg."""


@dataclass(frozen=True)
class Goal:
    """Functionals (k, 12) of the coefficients, whose variances add up, and the u that is asked for.

    `floor` is what no calibration takes away, as a variance: the noise of the reading that is judged, at the
    verification point `judged`, and in a plan what no reading shows. A `loose` goal only keeps a plan a
    calibration of the whole block.
    """

    name: str
    functionals: Floats
    asked: float
    unit: str
    floor: float = 0.0
    judged: Setting | None = None
    loose: bool = False

    def variance(self, covariance: Floats) -> float:
        """Return the variance that a covariance (12, 12) of the coefficients gives, without the floor."""
        return float(np.einsum("ki,ij,kj->", self.functionals, covariance, self.functionals))

    def u(self, covariance: Floats) -> float:
        """Return the standard uncertainty that a covariance (12, 12) of the coefficients gives."""
        return float(np.sqrt(self.variance(covariance) + self.floor))

    def ratio(self, covariance: Floats) -> float:
        """Return the uncertainty in units of what is asked: at most 1 where the goal is reached."""
        return self.u(covariance) / self.asked

    def relaxed(self, endless: float) -> Goal:
        """Return a loose goal no tighter than twice what endlessly many readings leave, a variance `endless`."""
        return replace(self, asked=max(self.asked, 2.0 * float(np.sqrt(endless)))) if self.loose else self

    def tightened(self, wider2: float) -> Goal:
        """Return the goal that allows so many times less variance above the floor."""
        return replace(self, asked=float(np.sqrt(self.floor + (self.asked**2 - self.floor) / wider2)))


def coefficient_goals(asked: Mapping[str, float]) -> list[Goal]:
    """Return a goal for each coefficient by name, V/g and V; "all" stands for those not named, "K", "U0" likewise.

    Raises `CalibrationError` for another name or a size that is not positive.
    """
    sizes: dict[str, float] = {}
    for wanted in ("all", "K", "U0"):
        if wanted in asked:
            sizes |= {n: asked[wanted] for n in COEFFICIENTS if wanted == "all" or n.startswith(wanted)}
    for name, size in asked.items():
        if name not in {*COEFFICIENTS, "all", "K", "U0"}:
            known = ", ".join(COEFFICIENTS)
            raise CalibrationError(f"no coefficient {name!r}; there are {known}, and K, U0, all")
        _require_positive(name, size)
        if name in COEFFICIENTS:
            sizes[name] = size
    identity = np.eye(len(COEFFICIENTS))
    return [
        Goal(name, identity[[i]], sizes[name], "V" if name.startswith("U0") else "V/g")
        for i, name in enumerate(COEFFICIENTS)
        if name in sizes
    ]


def delta_g_goals(
    block: Block, force: Floats, reading_v: float, asked_g: float, at: Sequence[Setting]
) -> list[Goal]:
    """Return a goal for Delta g `at` each verification point, specific forces (n, 3) in g of modulus 1.

    The noise `reading_v` of the reading at the point counts. Raises `CalibrationError` where it alone is more
    than what is asked.
    """
    _require_positive("Δg", asked_g)
    functionals, by_signal = modulus_slopes(force, block)
    floors = reading_v**2 * np.sum(by_signal**2, axis=1)
    if np.max(floors) >= asked_g**2:
        raise CalibrationError(
            f"u(Δg) of {asked_g:.3g} g cannot be reached by any calibration: one reading at a verification "
            f"point has {np.sqrt(np.max(floors)):.2g} g by itself; lower voltmeter_error in the bench file "
            "(more samples a reading) or ask for less"
        )
    return [
        Goal(f"Δg at verification point {i + 1}", functionals[[i]], asked_g, "g", float(floors[i]), at[i])
        for i in range(len(force))
    ]


def modulus_goals(block: Block, magnitude_g: float, asked_g: float) -> list[Goal]:
    """Return goals for the modulus of any specific force up to a magnitude: over directions, and at zero.

    The variance is convex in the magnitude, so that it is largest at an end.
    """
    _require_positive("the modulus", asked_g)
    _require_positive("the magnitude", magnitude_g)
    # d|a| = -(a/|a|)^T N (dK a + dU0): its part by K grows with the magnitude, that by U0 does not
    slopes, _ = modulus_slopes(directions(DIRECTIONS), block)
    size = np.ones(len(COEFFICIENTS))
    goals = []
    for magnitude in (magnitude_g, 0.0):
        size[:9] = magnitude
        goals += [Goal(f"|a| at {magnitude:g} g", row[None] * size, asked_g, "g") for row in slopes]
    return goals


def vector_goal(block: Block, magnitude_g: float = 1.0, asked_g: float = 1.0) -> Goal:
    """Return the goal of the error vector of a measured specific force: root mean square over directions."""
    inverse = np.linalg.inv(block.K)
    force = magnitude_g * directions(DIRECTIONS)[:DIRECTIONS]  # the even ones
    weight = np.zeros((12, 12))
    for a in force:
        rows = np.concatenate([np.einsum("ki,j->kij", inverse, a).reshape(3, 9), inverse], axis=1)
        weight += rows.T @ rows / len(force)
    size, vectors = np.linalg.eigh(weight)
    name = f"rms error vector at {magnitude_g:g} g"
    return Goal(name, (vectors * np.sqrt(np.maximum(size, 0.0))).T, asked_g, "g")


def whole_goal(block: Block, goals: Sequence[Goal]) -> Goal:
    """Return the goal that keeps a plan a calibration of the whole block, loose beside what is asked.

    Readings that tell one coefficient alone would leave the others unknown.
    """
    typical = float(np.max(np.abs(block.K)))
    asked = max(goal.asked / (typical if goal.unit.startswith("V") else 1.0) for goal in goals)
    goal = vector_goal(block, 1.0, max(WHOLE * asked, LEAST_WHOLE_G))
    return replace(goal, name=f"whole block: {goal.name}", loose=True)


def worst(goals: Sequence[Goal], covariance: Floats) -> Goal:
    """Return the goal that is furthest from reached."""
    return max(goals, key=lambda goal: goal.ratio(covariance))


def _require_positive(name: str, size: float) -> None:
    if not (np.isfinite(size) and size > 0):
        raise CalibrationError(f"the uncertainty asked for {name} is a positive number, not {size:g}")
