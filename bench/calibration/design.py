"""The forward model made linear about a point, for any estimator: unknowns, their priors, derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bench.model.block import Block
from bench.model.conditions import Conditions
from bench.model.effects import CHANNELS, AppliedEffect
from bench.model.forward import ForwardModel
from bench.model.geometry import STAND_ANGLES

Floats = NDArray[np.float64]

FIXED = 12
"""The coefficients come first among the unknowns and have no prior."""

WEAK = 10.0
"""Prior of an effect's parameter whose size nobody stated, in plausible sizes: wide, so that data decide."""

SYMBOLS: Mapping[str, str] = {
    "axis_tilt": "alpha1",
    "zero_offset": "alpha2",
    "mounting_error": "alpha3",
    "mounting_offset": "mounting_offset",
    "mounting_roll": "alpha5",
}
"""The paper's symbols of the stand angles (alpha5 is the one that it leaves out)."""


@dataclass(frozen=True)
class StandUnknown:
    """A stand angle of one mounting, with the standard deviation of its prior, rad."""

    mount: int
    column: int
    prior_u: float


@dataclass(frozen=True)
class EffectUnknown:
    """A parameter of an effect (of one channel, or of all), with its prior, SI, `stated` or merely weak."""

    effect: int
    parameter: str
    channel: int | None
    prior_mean: float
    prior_u: float
    stated: bool


@dataclass(frozen=True)
class Problem:
    """The unknowns of a fit: 12 coefficients, then stand angles, then parameters of effects."""

    model: ForwardModel
    conditions: Conditions
    stand: tuple[StandUnknown, ...]
    effects: tuple[EffectUnknown, ...]

    @property
    def prior_mean(self) -> Floats:
        """Prior means of the unknowns after the coefficients, shape (q,)."""
        return np.array([0.0] * len(self.stand) + [e.prior_mean for e in self.effects])

    @property
    def prior_u(self) -> Floats:
        """Prior standard deviations of the unknowns after the coefficients, shape (q,)."""
        return np.array([*(s.prior_u for s in self.stand), *(e.prior_u for e in self.effects)])

    def names(self) -> list[str]:
        """Names of the unknowns after the coefficients: "alpha3[2]", "quadratic_nonlinearity.K2[y]"."""
        stand = [f"{SYMBOLS[STAND_ANGLES[s.column]]}[{self.conditions.mounts[s.mount]}]" for s in self.stand]
        effects = []
        for e in self.effects:
            channel = "" if e.channel is None else f"[{CHANNELS[e.channel]}]"
            effects.append(f"{self.model.effects[e.effect].effect.name}.{e.parameter}{channel}")
        return stand + effects

    def predict(self, block: Block, others: Floats, setting_rad: float = 0.0) -> Floats:
        """Return the readings (n, 3) that the model predicts for these values of the unknowns."""
        model = replace(self.model, effects=self._effects(others)) if self.effects else self.model
        return model.readings(block, self.conditions, self.stand_matrix(others), setting_rad)

    def stand_matrix(self, others: Floats) -> Floats:
        """Return the stand angles (mounts, 5) in rad."""
        matrix = np.zeros((len(self.conditions.mounts), len(STAND_ANGLES)))
        for value, unknown in zip(others, self.stand, strict=False):
            matrix[unknown.mount, unknown.column] = value
        return matrix

    def _effects(self, others: Floats) -> tuple[AppliedEffect, ...]:
        values = [applied.complete_values() for applied in self.model.effects]
        for value, unknown in zip(others[len(self.stand) :], self.effects, strict=True):
            if unknown.channel is None:
                values[unknown.effect][unknown.parameter] = np.float64(value) * np.ones(())
            else:
                changed = values[unknown.effect][unknown.parameter].copy()
                changed[unknown.channel] = value
                values[unknown.effect][unknown.parameter] = changed
        return tuple(replace(a, values=v) for a, v in zip(self.model.effects, values, strict=True))

    def slope(self, block: Block, others: Floats) -> Floats:
        """Return du/dphi (n, 3): how a setting error of the head shows in the three signals, unit/rad."""
        h = 1e-5
        forward, back = self.predict(block, others, h), self.predict(block, others, -h)
        return (forward - back) / (2 * h)

    def jacobian(self, block: Block, others: Floats) -> Floats:
        """Return the derivatives of the readings by all unknowns, shape (n, 3, 12 + q).

        Central differences of the forward model itself, so that there is no second formula to keep in step;
        exact for the coefficients, in which a model without effects is linear.
        """
        n = len(self.conditions)
        columns = np.empty((n, 3, FIXED + len(others)))
        columns[:, :, :FIXED] = self._coefficient_columns(block, others)
        for j in range(len(others)):
            step = np.zeros_like(others)
            step[j] = 1e-3 * self.prior_u[j] if j >= len(self.stand) else 1e-5
            difference = self.predict(block, others + step) - self.predict(block, others - step)
            columns[:, :, FIXED + j] = difference / (2 * step[j])
        return columns

    def _coefficient_columns(self, block: Block, others: Floats) -> Floats:
        if not self.effects:
            stand = self.stand_matrix(others)
            return coefficient_columns(self.model.specific_force(self.conditions, stand, block))
        columns = np.empty((len(self.conditions), 3, FIXED))
        step = 1e-3 * float(np.max(np.abs(block.K)))
        for j in range(FIXED):
            shift = np.zeros(FIXED)
            shift[j] = step
            up = self.predict(Block.from_vector(block.vector + shift), others)
            down = self.predict(Block.from_vector(block.vector - shift), others)
            columns[:, :, j] = (up - down) / (2 * step)
        return columns


def coefficient_columns(force: Floats) -> Floats:
    """Return the derivatives of U = K a + U0 by the 12 coefficients for forces (n, 3), shape (n, 3, 12)."""
    columns = np.zeros((len(force), 3, FIXED))
    for channel in range(3):
        columns[:, channel, 3 * channel : 3 * channel + 3] = force
        columns[:, channel, 9 + channel] = 1.0
    return columns


def make_problem(model: ForwardModel, conditions: Conditions, stand_u: Mapping[str, float]) -> Problem:
    """Set up the unknowns: a stand angle is one where its size is not zero, an effect's parameters all are.

    `stand_u` are standard uncertainties by the names in `STAND_ANGLES`, rad. The prior of an effect's
    parameter lies about the value in the model with the standard uncertainty stated there, which must come
    from other readings than those to be fitted; where none (or zero) is stated, with `WEAK` times the
    catalogue's plausible size.
    """
    stand = tuple(
        StandUnknown(mount, column, stand_u[name])
        for mount in range(len(conditions.mounts))
        for column, name in enumerate(STAND_ANGLES)
        if stand_u.get(name, 0.0) > 0
    )
    effects = [
        unknown for index, applied in enumerate(model.effects) for unknown in _effect_unknowns(index, applied)
    ]
    return Problem(model, conditions, stand, tuple(effects))


def _effect_unknowns(index: int, applied: AppliedEffect) -> list[EffectUnknown]:
    values = applied.complete_values()
    unknowns = []
    for p in applied.effect.parameters:
        given = np.broadcast_to(applied.u.get(p.name, 0.0), values[p.name].shape)
        rows = [CHANNELS.index(channel) for channel in applied.channels] if p.per_channel else [None]
        for row in rows:
            at = () if row is None else row
            u = float(given[at])
            mean = float(values[p.name][at])
            unknowns.append(EffectUnknown(index, p.name, row, mean, u or WEAK * p.plausible, u > 0))
    return unknowns
