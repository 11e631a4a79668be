"""Monte Carlo on the exact geometry, beside the linear budget: angles turned, not made linear.

Each trial draws every error, gives it to the forward model, applies the estimator and the check to the
readings. What acts on a reading in proportion (meters, temperature, effects) adds to it; products of two such
errors are left out (parts of 1e-9). Source: JCGM 101:2008, clauses 7 and 8; JCGM 102:2011, clause 7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from bench.analysis.budget.acceleration import delta_g
from bench.analysis.budget.coefficients import Budget
from bench.analysis.budget.error_source import ErrorSource
from bench.analysis.budget.monte_carlo import (
    Distributed,
    Validation,
    batches,
    drawn,
    require_trials,
    summary,
    validate,
)
from bench.analysis.budget.patterns import influences
from bench.analysis.budget.propagation import Propagated
from bench.base.arrays import Floats
from bench.base.progress import tracked
from bench.model import STAND_ANGLES
from bench.model.block import COEFFICIENTS

BATCH: Final = 200
"""Trials at once: so few that their readings stay in the cache and that no product is shared out to threads."""
DIGITS: Final = 1
"""Significant digits of u that count as meaningful: the sizes of a bench's errors are known to no more."""


@dataclass(frozen=True)
class ExactResult:
    """Monte Carlo and linear result of 12 coefficients, then delta g at each verification point.

    `names` (m,) tells them; `verdict` is that of JCGM 101:2008, clause 8.
    """

    names: tuple[str, ...]
    linear: Propagated
    trials: Distributed
    verdict: Validation

    def to_json(self) -> dict[str, Any]:
        """Return the comparison as JSON has it."""
        outputs = {
            name: {
                "mean": float(self.trials.mean[i]),
                "u": float(self.trials.u[i]),
                "u_linear": float(self.linear.u[i]),
                "ratio": float(self.verdict.ratio[i]),
                "interval": self.trials.symmetric[i].tolist(),
                "shortest": self.trials.shortest[i].tolist(),
                "differences": [float(self.verdict.low[i]), float(self.verdict.high[i])],
                "tolerance": float(self.verdict.tolerance[i]),
                "validated": bool(self.verdict.validated[i]),
            }
            for i, name in enumerate(self.names)
        }
        return {
            "trials": self.trials.trials,
            "probability": self.trials.probability,
            "digits": DIGITS,
            "covariance": self.trials.covariance.tolist(),
            "outputs": outputs,
            "validated": bool(np.all(self.verdict.validated)),
        }


def exact_monte_carlo(budget: Budget, trials: int, seed: int = 1, digits: int = DIGITS) -> ExactResult:
    """Propagate the sources of a budget through the exact geometry and compare.

    Raises `CalibrationError` for fewer trials than a coverage interval needs.
    """
    require_trials(trials, budget.probability)
    rng = np.random.default_rng(seed)
    simulated = _Simulation(budget)
    sizes = tracked(list(batches(trials, BATCH)), "Monte Carlo trials")
    outputs = np.concatenate([simulated.outputs(count, rng) for count in sizes])
    found = summary(outputs, budget.probability)
    linear = _linear(budget)
    points = [f"Δg {np.degrees(a):g}°" for a in budget.setup.conditions.angle_rad[budget.setup.verification]]
    return ExactResult((*COEFFICIENTS, *points), linear, found, validate(linear, found, digits))


def exact_readings(budget: Budget, trials: int, rng: np.random.Generator) -> Floats:
    """Return simulated readings (trials, n, 3), V, with every source of the budget drawn."""
    return _Simulation(budget).readings(trials, rng)


def _linear(budget: Budget) -> Propagated:
    """Coefficients and delta g as the linear budget has them; covariances between the two are left out."""
    total = budget.combined
    points = delta_g(budget, np.inf)
    covariance = np.zeros((12 + len(points), 12 + len(points)))
    covariance[:12, :12] = total.covariance
    covariance[np.arange(12, len(covariance)), np.arange(12, len(covariance))] = [p.u**2 for p in points]
    return Propagated(
        np.concatenate([total.value, np.zeros(len(points))]),
        covariance,
        np.concatenate([total.dof, [p.dof for p in points]]),
    )


class _Simulation:
    """The bench of a budget, many trials at once."""

    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        self._setup = budget.setup
        sources = [c.source for c in budget.contributions if c.source.u > 0.0]
        self._angles = [s for s in sources if s.name in STAND_ANGLES or s.angles]
        self._setting = [s for s in sources if s.name == "setting_error"]
        still = np.zeros((len(self._setup.conditions.mounts), len(STAND_ANGLES)))
        self._plain = replace(self._setup.model, effects=())
        plain = self._plain.readings(self._setup.block, self._setup.conditions, still)
        self._effects = self._setup.signal - plain
        self._additive = [
            (s, influences(s, self._setup)) for s in sources if s not in self._angles + self._setting
        ]

    def outputs(self, trials: int, rng: np.random.Generator) -> Floats:
        """Return coefficients and delta g, shape (trials, 12 + v)."""
        setup, gain = self._setup, self._budget.gain
        readings = self.readings(trials, rng)
        coefficients = self._estimate(readings - setup.signal, gain)
        rows = readings[:, setup.verification]
        K, U0 = coefficients[:, :9].reshape(-1, 3, 3), coefficients[:, 9:]
        force = np.linalg.solve(K, np.swapaxes(rows - U0[:, None], 1, 2))
        return np.concatenate([coefficients, np.linalg.norm(force, axis=1) - 1.0], axis=1)

    def _estimate(self, excess: Floats, gain: Floats) -> Floats:
        """Apply the estimator to readings less those of a stand without errors, which it returns exactly."""
        flat = excess.reshape(len(excess), -1) @ gain.reshape(len(gain), -1).T
        return self._setup.block.vector + flat

    def readings(self, trials: int, rng: np.random.Generator) -> Floats:
        """Return readings (trials, n, 3), V."""
        setup = self._setup
        n, mounts = len(setup.conditions), len(setup.conditions.mounts)
        stand = np.zeros((trials, mounts, len(STAND_ANGLES)))
        for source in self._angles:
            kinds = [STAND_ANGLES.index(name) for name in source.angles or (source.name,)]
            drawn_angles = _draw(source, (trials, len(kinds) * mounts), rng).reshape(
                trials, len(kinds), mounts
            )
            stand[:, :, kinds] += np.swapaxes(drawn_angles, 1, 2)
        setting = sum((_draw(s, (trials, n), rng) for s in self._setting), np.zeros((trials, n)))
        signal = self._plain.readings(
            setup.block,
            setup.conditions.repeated(trials),
            stand.reshape(-1, len(STAND_ANGLES)),
            setting.reshape(-1),
        ).reshape(trials, n, 3)
        signal += self._effects
        for source, parts in self._additive:
            for part in parts:
                signal += part.on_readings(_draw(source, (trials, part.draws), rng))
        return signal


def _draw(source: ErrorSource, shape: tuple[int, ...], rng: np.random.Generator) -> Floats:
    if source.root is None:
        return drawn(source.distribution, shape, rng, source.dof)
    root = np.array(source.root)
    independent = drawn(source.distribution, (shape[0], root.shape[1]), rng, source.dof)
    return np.asarray(independent @ root.T)
