"""From the budget of the coefficients to any measured acceleration, and to delta g at the verification points.

A measured acceleration is a = N (U - U0) from one reading U. Its error is N (dU - dK a - dU0): the errors of
the coefficients and those of the reading together, with the correlation of what acts on both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy import special

from bench.analysis.budget.coefficients import Budget, Contribution, parts_of
from bench.analysis.budget.error_source import ErrorSource
from bench.analysis.budget.propagation import coverage_factor, effective_dof
from bench.analysis.calibration.conformity import SIMPLE, DecisionRule, Known, Population
from bench.analysis.calibration.design import coefficient_columns
from bench.analysis.calibration.result import CalibrationError
from bench.analysis.calibration.verification import modulus_slopes
from bench.base.arrays import Floats
from bench.base.numbers import finite_or_none
from bench.model import Conditions, Stage
from bench.model.effects import Seen

DIRECTIONS: Final = 1000
MAGNITUDES_G: Final = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


@dataclass(frozen=True)
class Measured:
    """Uncertainty of measured accelerations `force` (d, 3), g.

    `by_source` holds the covariance (d, 3, 3) from each source in g², `dof` the degrees of freedom of each.
    """

    force: Floats
    by_source: dict[str, Floats]
    dof: dict[str, float]

    @property
    def covariance(self) -> Floats:
        """Covariance of the three components, g², shape (d, 3, 3)."""
        return sum(self.by_source.values(), np.zeros((len(self.force), 3, 3)))

    @property
    def u_vector(self) -> Floats:
        """Root of the sum of the three variances, g, shape (d,)."""
        return np.asarray(np.sqrt(np.trace(self.covariance, axis1=1, axis2=2)))

    @property
    def u_modulus(self) -> Floats:
        """Standard uncertainty of the modulus, g, shape (d,)."""
        return np.sqrt(self.modulus_variance(self.covariance))

    @property
    def dof_modulus(self) -> Floats:
        """Effective degrees of freedom of the modulus, shape (d,)."""
        variances = np.stack([self.modulus_variance(c) for c in self.by_source.values()], axis=1)
        return effective_dof(variances, list(self.dof.values()))

    def modulus_variance(self, covariance: Floats) -> Floats:
        """Return the variance of the modulus (d,) from covariances (d, 3, 3) of the components."""
        unit = self.force / np.linalg.norm(self.force, axis=1)[:, None]
        return np.asarray(np.einsum("di,dij,dj->d", unit, covariance, unit))


def measured(
    budget: Budget, force: Floats, *, reading: bool = True, same_voltmeters: bool = False
) -> Measured:
    """Return the uncertainty of accelerations `force` (d, 3), g, each from one reading.

    Without `reading` the errors of the coefficients stand alone. With `same_voltmeters` the block is read with
    those of the calibration, whose gain and offset cancel; else with others of the same accuracy. Temperature
    is that of the calibration. Raises `CalibrationError` for an acceleration of zero.
    """
    if not np.all(np.linalg.norm(force, axis=1) > 0.0):
        raise CalibrationError("an acceleration of zero has no direction; give one of a few micro g or more")
    inverse = np.linalg.inv(budget.setup.block.K)
    design = coefficient_columns(force)
    by_source, dof = {}, {}
    for contribution in budget.contributions:
        errors = -(design @ contribution.parts)
        apart = np.zeros((len(force), 3, 0))
        if reading:
            shared, apart = _of_reading(contribution, budget, force, same_voltmeters=same_voltmeters)
            errors = errors + shared
        parts = inverse @ np.concatenate([errors, apart], axis=2)
        by_source[contribution.source.name] = parts @ np.swapaxes(parts, 1, 2)
        dof[contribution.source.name] = contribution.source.dof
    return Measured(force, by_source, dof)


def _of_reading(
    contribution: Contribution, budget: Budget, force: Floats, *, same_voltmeters: bool
) -> tuple[Floats, Floats]:
    """What a source does to the reading, V per draw: (d, 3, q) by the calibration's draws, and by new ones."""
    source, block = contribution.source, budget.setup.block
    per_channel = np.eye(3)[None]
    alone = np.zeros((len(force), 3, 0))
    none = np.zeros((1, 3, 1))
    if source.kind in {"voltmeter_error", "voltmeter_linearity"}:
        own = source.u * per_channel * source.on_channels
        return none, np.broadcast_to(own, (len(force), 3, 3))
    if source.kind in {"voltmeter_gain", "voltmeter_offset"}:
        sensed = block.output(force) if source.kind == "voltmeter_gain" else np.ones_like(force)
        sensed = sensed * source.on_channels
        meters = np.unique(budget.setup.meters, return_inverse=True)[1]
        errors = source.acting(sensed[:, :, None] * np.eye(int(meters.max()) + 1)[meters][None])
        return (errors, alone) if same_voltmeters else (none, errors)
    if source.name in {"K2", "K3"}:
        power = force ** int(source.name[1]) * np.diag(block.K) * source.on_channels
        return source.u * power[:, :, None] * per_channel, alone
    if source.effect is not None:
        return _of_effect(source, budget, force), alone
    return none, alone


def _of_effect(source: ErrorSource, budget: Budget, force: Floats) -> Floats:
    """An effect of the block acts alike in use; what depends on time or temperature is at its reference."""
    unknown, setup = source.effect, budget.setup
    none = np.zeros((1, 3, 1))
    if unknown is None:
        return none
    applied = setup.model.effects[unknown.effect]
    if applied.effect.stage is not Stage.BLOCK_OUTPUT or applied.effect.needs_history:
        return none
    seen = Seen(force, Conditions.of(["1"] * len(force), np.zeros(len(force))), setup.block)
    values = applied.complete_values()
    step = 1e-3 * unknown.prior_u

    def addition(change: float) -> Floats:
        changed = np.array(values[unknown.parameter])
        changed[() if unknown.channel is None else unknown.channel] += change
        all_values = {**values, unknown.parameter: changed}
        return applied.effect.addition(all_values, seen)

    slope = (addition(step) - addition(-step)) / (2 * step)
    return source.u * slope[:, :, None]


def directions(count: int = DIRECTIONS) -> Floats:
    """Return unit vectors (count + 6, 3), even over the sphere (golden spiral), then the six axes."""
    i = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * i / count, np.pi * (1.0 + np.sqrt(5.0)) * i
    flat = np.sqrt(1.0 - z**2)
    spiral = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
    return np.concatenate([spiral, np.eye(3), -np.eye(3)])


def magnitudes(range_g: float) -> tuple[float, ...]:
    """Return the magnitudes to state up to a measuring range, g, the range among them."""
    return (*(m for m in MAGNITUDES_G if m < range_g), range_g)


@dataclass(frozen=True)
class AtMagnitude:
    """Uncertainties over all directions at one magnitude, g: mean and largest of vector and modulus.

    `U_modulus` is the largest expanded uncertainty of the modulus; `share` each source's part of the mean
    variance of the modulus.
    """

    magnitude_g: float
    u_vector_mean: float
    u_vector_max: float
    u_modulus_mean: float
    u_modulus_max: float
    U_modulus_max: float
    share: dict[str, float]

    def to_json(self) -> dict[str, Any]:
        """Return the values as JSON has them."""
        return dict(vars(self))


def over_directions(
    budget: Budget, magnitude_g: float, *, reading: bool = True, same_voltmeters: bool = False
) -> AtMagnitude:
    """Return the uncertainty of accelerations of one magnitude, mean and largest over directions."""
    found = measured(budget, magnitude_g * directions(), reading=reading, same_voltmeters=same_voltmeters)
    even = slice(0, DIRECTIONS)
    u, factor = found.u_modulus, coverage_factor(found.dof_modulus, budget.probability)
    parts = {n: float(np.mean(found.modulus_variance(c)[even])) for n, c in found.by_source.items()}
    total = sum(parts.values())
    return AtMagnitude(
        magnitude_g,
        float(found.u_vector[even].mean()),
        float(found.u_vector.max()),
        float(u[even].mean()),
        float(u.max()),
        float(np.max(factor * u)),
        {name: part / total if total > 0.0 else 0.0 for name, part in parts.items()},
    )


# --- delta g ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DeltaG:
    """What the check at one verification point will be worth: u, U of delta g in local g, by source, decision.

    `accepted_up_to` is the acceptance limit; `passes` the probability that a calibration without a mistake
    passes here; `capable` that U is within the acceptance limit.
    """

    angle_deg: float
    point: int
    u: float
    dof: float
    U: float
    by_source: dict[str, float]
    accepted_up_to: float
    passes: float

    @property
    def capable(self) -> bool:
        """Whether the check can be passed with the coverage probability of U."""
        return self.accepted_up_to >= self.U

    def to_json(self) -> dict[str, Any]:
        """Return the values as JSON has them."""
        return {**vars(self), "dof": finite_or_none(self.dof), "capable": self.capable}


def delta_g(
    budget: Budget,
    limit_g: float,
    rule: str | DecisionRule = SIMPLE,
    *,
    reading: bool = True,
    population: Population | None = None,
) -> tuple[DeltaG, ...]:
    """Return the uncertainty of delta g at each verification point of the setup, and the decision that it allows.

    Gain and gravity act on calibration and check alike and cancel; without `reading` the errors of the
    coefficients stand alone. Raises `CalibrationError` for an unknown rule.
    """
    setup, decision = budget.setup, DecisionRule.of(rule)
    rows = np.flatnonzero(setup.verification)
    if not len(rows):
        return ()
    by_coefficient, by_signal = modulus_slopes(setup.force[rows], setup.block)
    functionals = np.einsum("vp,pni->vni", by_coefficient, budget.gain)
    if reading:
        functionals[np.arange(len(rows)), rows] += by_signal
    parts = [parts_of(c.source, setup, functionals) for c in budget.contributions]
    variances = np.stack([np.sum(part**2, axis=1) for part in parts], axis=1)
    u, dof = (
        np.sqrt(variances.sum(axis=1)),
        effective_dof(variances, [c.source.dof for c in budget.contributions]),
    )
    expanded = coverage_factor(dof, budget.probability) * u
    limits = decision.acceptance_limit(limit_g, Known(u, expanded, dof, population)).tolist()
    found = []
    for i, row in enumerate(rows):
        found.append(
            DeltaG(
                angle_deg=float(np.degrees(setup.conditions.angle_rad[row])),
                point=int(setup.conditions.point[row]),
                u=float(u[i]),
                dof=float(dof[i]),
                U=float(expanded[i]),
                by_source=_named(budget.contributions, np.sqrt(variances[i])),
                accepted_up_to=limits[i],
                passes=_within(limits[i], float(u[i])),
            )
        )
    return tuple(found)


def _named(contributions: Sequence[Contribution], values: Floats) -> dict[str, float]:
    return {c.source.name: float(v) for c, v in zip(contributions, values, strict=True)}


def _within(limit: float, u: float) -> float:
    """Probability that a normal error stays within a limit."""
    if limit <= 0.0:
        return 0.0
    return float(special.erf(limit / (u * np.sqrt(2.0)))) if u > 0.0 else 1.0
