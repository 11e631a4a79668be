"""The bench as planning sees it, and what a calibration of planned readings on it will sign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.calibration.budget.acceleration import delta_g
from bench.calibration.budget.coefficients import Budget, make_budget
from bench.calibration.budget.error_source import ErrorSource, learned_sources
from bench.calibration.budget.setup import Setup
from bench.calibration.budget.sources import effect_sources, stand_source
from bench.calibration.design import FIXED, Problem, make_problem
from bench.calibration.estimators import GLS
from bench.calibration.known import KnownStand
from bench.calibration.noise import LEAST_REPEATS, repeat_groups, whiten
from bench.calibration.result import CalibrationError, Noise
from bench.model import STAND_ANGLES, Block, Conditions, Distribution, ForwardModel
from bench.planning.optimal_design import Goal, widening
from bench.planning.settings import Setting, conditions_of

WITHOUT_NOISE: Final = 1e-4
"""The noise of endlessly many readings, as a part of that of one."""


@dataclass(frozen=True)
class Stand:
    """The bench as planning sees it: model, block, standard uncertainties of the stand errors, rad and V.

    `known` is what was learned of stand and noise in their place; `hidden` are the errors that no reading shows and
    that a calibration signs; `meters` numbers the voltmeter of each channel.
    """

    model: ForwardModel
    block: Block
    sizes: Mapping[str, float]
    known: KnownStand | None = None
    hidden: tuple[ErrorSource, ...] = ()
    meters: tuple[int, int, int] = (0, 1, 2)

    def __post_init__(self) -> None:
        if self.known is not None and self.known.noise is not None:
            return
        if not self.sizes.get("voltmeter_error", 0.0) > 0:
            raise CalibrationError(
                "the bench file states no voltmeter_error, so that one reading would be as good as many; "
                "state its size in the section 'stand'"
            )

    @property
    def noise(self) -> Noise:
        """What is fresh at each reading and at each setting of the head."""
        if self.known is not None and self.known.noise is not None:
            return self.known.noise.given()
        return Noise(self.sizes["voltmeter_error"], self.sizes.get("setting_error", 0.0), np.inf, "given")

    def unknowns(self, mounts: int) -> int:
        """Number of unknowns of a fit to readings in so many mountings."""
        return FIXED + mounts * sum(name in STAND_ANGLES and u > 0 for name, u in self.sizes.items())

    def covariance(self, settings: Sequence[Setting]) -> Floats:
        """Return the covariance (12, 12) that `bench calibrate` will state from readings at these settings.

        Raises `CalibrationError` where they do not determine the coefficients.
        """
        return self.promise(settings, ()).combined

    def promise(self, settings: Sequence[Setting], goals: Sequence[Goal]) -> Promise:
        """Return what `bench calibrate` will state from readings at these settings, and what that is for goals.

        By generalised least squares, the noise widened by how well the readings themselves will tell it. Raises
        `CalibrationError` where they do not determine the coefficients.
        """
        wider = widening(self._freedom(conditions_of(settings)))
        budget = self.budget([*settings, *checks_of(goals)], wider)
        combined = budget.combined.covariance
        of_readings = combined - sum(
            (budget.contribution(source.name).covariance for source in self.hidden), np.zeros((FIXED, FIXED))
        )
        floored = [
            replace(goal, floor=sum(parts.values()) - goal.variance(of_readings))
            for goal, parts in zip(goals, parts_of_goals(goals, budget), strict=True)
        ]
        return Promise(tuple(floored), of_readings, combined)

    def budget(self, settings: Sequence[Setting], noise: float = 1.0) -> Budget:
        """Return the budget of readings at these settings whose noise is `noise` times the stand's."""
        setup = Setup(self.model, conditions_of(settings), self.block, self.meters)
        sizes = {n: u * (1.0 if n in STAND_ANGLES else noise) for n, u in self.sizes.items() if u > 0}
        sources = [stand_source(name, Distribution(u)) for name, u in sizes.items()]
        beside = [*effect_sources(setup), *self.hidden]
        known = self.known
        if known is None:
            return make_budget(setup, [*sources, *beside], GLS, stated=sizes)
        if known.noise is not None:
            known = replace(known, noise=known.noise.times(noise))
        learned = learned_sources(sources, known, setup.conditions.mounts)
        return make_budget(setup, [*learned, *beside], GLS, stated=sizes, known=known)

    def _freedom(self, conditions: Conditions) -> int:
        """Degrees of freedom with which the noise will be told: by repeats where there are enough of them."""
        again = repeats(conditions)
        if again >= LEAST_REPEATS:
            return 3 * again
        return 3 * len(conditions) - self.unknowns(len(conditions.mounts))


def checks_of(goals: Sequence[Goal]) -> list[Setting]:
    """Return the verification points whose readings goals judge."""
    return [goal.judged for goal in goals if goal.judged is not None]


def parts_of_goals(goals: Sequence[Goal], budget: Budget) -> list[dict[str, float]]:
    """Return the variance of each goal by source; the budget has the verification points of `checks_of`."""
    points = iter(delta_g(budget, np.inf) if checks_of(goals) else ())
    return [
        {c.source.name: goal.variance(c.covariance) for c in budget.contributions}
        if goal.judged is None
        else {name: u**2 for name, u in next(points).by_source.items()}
        for goal in goals
    ]


@dataclass(frozen=True)
class Promise:
    """Covariances (12, 12) of the coefficients, of the readings alone and combined.

    What no reading shows is in the floors of `goals`, so that their u by the former is the combined one.
    """

    goals: tuple[Goal, ...]
    readings: Floats
    combined: Floats


def repeats(conditions: Conditions) -> int:
    """Return how many readings repeat an earlier one: same mounting, point and direction of approach."""
    return len(conditions) - (int(repeat_groups(conditions).max()) + 1)


def whitened(stand: Stand, conditions: Conditions) -> tuple[Floats, Problem]:
    """Return derivatives (n, 3, 12 + q) of readings in units of the stand's noise, and the problem that
    they are of.

    The q angles of the stand are in units of their prior standard uncertainty; where they hang together, their
    independent parts are.
    """
    problem = make_problem(stand.model, conditions, stand.sizes, known=stand.known)
    linear = problem.linear(stand.block, problem.prior_mean)
    rows = whiten(linear.jacobian, linear.slope, stand.noise)
    return np.concatenate([rows[:, :, :FIXED], problem.by_prior(rows[:, :, FIXED:])], axis=2), problem
