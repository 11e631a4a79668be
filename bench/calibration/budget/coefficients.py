"""The budget: what each error of the bench contributes to each coefficient, correlations kept."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.base.arrays import Floats
from bench.calibration.budget.error_source import ErrorSource
from bench.calibration.budget.patterns import Seen, influences
from bench.calibration.budget.propagation import (
    COVERAGE,
    Propagated,
    effective_dof,
)
from bench.calibration.budget.setup import Setup
from bench.calibration.budget.setup import gain as gain_of
from bench.calibration.budget.sources import sizes_by_name
from bench.calibration.estimators import GLS
from bench.calibration.known import KnownStand


@dataclass(frozen=True)
class Contribution:
    """What a source contributes.

    `parts` (12, q) is what each independent draw of it, one u large, adds to the coefficients.
    """

    source: ErrorSource
    parts: Floats

    @property
    def covariance(self) -> Floats:
        """Covariance of the coefficients from this source alone, shape (12, 12)."""
        return self.parts @ self.parts.T

    @property
    def u(self) -> Floats:
        """Standard uncertainties from this source alone, shape (12,), V/g and V."""
        return np.asarray(np.sqrt(np.sum(self.parts**2, axis=1)))


@dataclass(frozen=True)
class Budget:
    """The budget of an estimator at the readings of a setup; `gain` (12, n, 3) is the estimator's map."""

    estimator: str
    setup: Setup
    gain: Floats
    contributions: tuple[Contribution, ...]
    probability: float = COVERAGE

    @cached_property
    def combined(self) -> Propagated:
        """The coefficients with their joint covariance and effective degrees of freedom."""
        return self._sum(self.contributions)

    def of_group(self, group: str) -> Propagated:
        """Return the same for the sources of one group: "stand" is what `bench calibrate` states."""
        return self._sum([c for c in self.contributions if c.source.group == group])

    @property
    def per_local_g(self) -> Propagated:
        """Return the same without local gravity: for coefficients per local g, as `bench calibrate` gives them."""
        return self._sum([c for c in self.contributions if c.source.name != "gravity"])

    def _sum(self, contributions: Sequence[Contribution]) -> Propagated:
        covariance = sum((c.covariance for c in contributions), np.zeros((12, 12)))
        dof = np.full(12, math.inf)
        if contributions:
            variances = np.stack([np.diag(c.covariance) for c in contributions], axis=1)
            dof = effective_dof(variances, [c.source.dof for c in contributions])
        return Propagated(self.setup.block.vector, covariance, dof)

    def contribution(self, name: str) -> Contribution:
        """Return the contribution of a source by its name. Raises `KeyError` when there is none."""
        found = {c.source.name: c for c in self.contributions}
        return found[name]


def make_budget(
    setup: Setup,
    sources: Sequence[ErrorSource],
    estimator: str = GLS,
    stated: Mapping[str, float] | None = None,
    probability: float = COVERAGE,
    known: KnownStand | None = None,
) -> Budget:
    """Return the budget of an estimator, one of `bench.calibration.estimators` by name.

    `stated` are the sizes that the estimator believes (see `estimators.gain`); left out, those of
    the sources; `known` is what was learned in their place.
    Raises `CalibrationError` when the readings do not determine the coefficients.
    """
    gain = gain_of(estimator, setup, sizes_by_name(sources) if stated is None else stated, known)
    contributions = tuple(Contribution(source, parts_of(source, setup, gain)) for source in sources)
    return Budget(estimator, setup, gain, contributions, probability)


def parts_of(source: ErrorSource, setup: Seen, functionals: Floats) -> Floats:
    """Return what each draw of a source, one u large, adds to linear functionals (m, n, 3), shape (m, q)."""
    parts = [influence.through(functionals) for influence in influences(source, setup)]
    return source.acting(np.concatenate(parts, axis=1))
