"""Everything that a budget says of a bench: coefficients, measured accelerations, the check, Monte Carlo."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.calibration.budget.acceleration import (
    AtMagnitude,
    DeltaG,
    ExactResult,
    delta_g,
    exact_monte_carlo,
    magnitudes,
    over_directions,
)
from bench.calibration.budget.coefficients import Budget, make_budget
from bench.calibration.budget.error_source import ErrorSource
from bench.calibration.budget.setup import Setup
from bench.calibration.budget.sources import ROLL_ORIGIN
from bench.calibration.conformity import DecisionRule, Population
from bench.calibration.known import KnownStand

DOMINATES: Final = 0.5
"""A source (or all of what the block has beside K and U0) dominates with more than this part of the variance."""
NAMED: Final = 0.01
"""Of those that dominate together, the ones with more than this part are named."""


@dataclass(frozen=True)
class Question:
    """What a budget is asked for: measuring range and limit of delta g (g), decision rule, trials, voltmeters.

    `population` is what is known of delta g over many blocks.
    """

    range_g: float
    limit_g: float
    rule: DecisionRule
    trials: int = 0
    same_voltmeters: bool = False
    population: Population | None = None


@dataclass(frozen=True)
class Assessment:
    """The budget with what follows from it; `exact` is None where no Monte Carlo was asked for.

    `beside` are further notes on where its sizes come from.
    """

    budget: Budget
    question: Question
    accelerations: tuple[AtMagnitude, ...]
    points: tuple[DeltaG, ...]
    exact: ExactResult | None
    beside: tuple[str, ...] = ()

    @property
    def capable(self) -> bool | None:
        """Whether every verification point can be passed with the coverage probability; None without points."""
        return all(point.capable for point in self.points) if self.points else None

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the numbers must know."""
        return (*self._notes(), *self.beside)

    def _notes(self) -> Iterator[str]:
        sources = [c.source for c in self.budget.contributions]
        priors = [s.name for s in sources if s.prior and s.u > 0.0 and s.origin != ROLL_ORIGIN]
        if priors:
            yield (
                f"{', '.join(priors)}: plausible sizes or makers' limits, not stated in the bench file; state "
                "what is known in its section 'uncertainty'"
            )
        setup = self.budget.setup
        temperatures = np.unique(setup.conditions.temperature_c[setup.fitted])
        if np.sum(np.isfinite(temperatures)) > 1:
            yield (
                f"the procedure has {len(temperatures)} temperatures, and the coefficients are taken as the same "
                "at all of them; for those at one temperature give a procedure without the others"
            )
        of_block = [c.source.name for c in self.budget.contributions if c.source.group == "block"]
        found = [a for a in self.accelerations if sum(a.share[name] for name in of_block) > DOMINATES]
        if found:
            share = found[0].share
            names = sorted((n for n in of_block if share[n] > NAMED), key=lambda n: "K3" in n)
            part = 100.0 * sum(share[name] for name in of_block)
            yield (
                f"from {found[0].magnitude_g:g} g on {' and '.join(names)} dominate{'s' * (len(names) == 1)} "
                f"({part:.0f} % of the variance of |a|): known as priors, since a calibration at 1 g shows such "
                "terms hardly or not; a centrifuge gives them"
            )
        if any(s.origin == ROLL_ORIGIN for s in sources):
            yield (
                "mounting_roll: not stated in the bench file, and counted as large as mounting_error; state "
                "what was measured in its section 'stand'"
            )
        if any(s.name == "gravity" and s.u > 0.0 for s in sources):
            yield (
                "gravity: coefficients per local g are free of it; it enters what is stated in m/s² or used "
                "at another place"
            )


def assess(
    setup: Setup,
    sources: Sequence[ErrorSource],
    estimator: str,
    question: Question,
    known: KnownStand | None = None,
) -> Assessment:
    """Return the budget of an estimator with what follows from it; `known` is what was learned.

    Raises `CalibrationError` as its parts do.
    """
    budget = make_budget(setup, sources, estimator, known=known)
    accelerations = tuple(
        over_directions(budget, size, same_voltmeters=question.same_voltmeters)
        for size in magnitudes(question.range_g)
    )
    points = delta_g(budget, question.limit_g, question.rule, population=question.population)
    exact = exact_monte_carlo(budget, question.trials) if question.trials else None
    return Assessment(budget, question, accelerations, points, exact)
