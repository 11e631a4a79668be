"""The linearised forward model that all estimators use: unknowns, their priors, derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, TypeVar

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Ints
from bench.calibration.noise import KnownNoise, KnownStand
from bench.model.conditions import Conditions
from bench.model.effects import AppliedEffect, Parameter
from bench.model.effects.base import InPart
from bench.model.forward import ForwardModel, Stages
from bench.model.geometry import STAND_ANGLES, Block

T = TypeVar("T")

FIXED = 12
"""Number of coefficients: they come first among the unknowns and have no prior."""

UPPER = np.array([0, 1, 2, 4, 5, 8, 9, 10, 11])
"""Indices of the coefficients that remain unknown if K is upper triangular by convention."""

STEP_RAD = 1e-5
"""Step of the central differences: truncation and rounding error are both about 1e-11 of the derivative."""

SAME: Final = 1.0 - 1e-6
"""Correlation of the errors of one angle in series of one mounting; below 1, so that it has a Cholesky factor."""

WEAK = 10.0
"""Prior u of an effect parameter without stated u, in plausible sizes: wide, so that the data decide."""

SYMBOLS: Mapping[str, str] = {
    "axis_tilt": "alpha1",
    "zero_offset": "alpha2",
    "mounting_error": "alpha3",
    "mounting_offset": "mounting_offset",
    "mounting_roll": "alpha5",
}
"""Symbols of the stand angles, after the paper (which has no alpha5)."""


MOST_KEPT: Final = 8
"""Largest number of results that a problem keeps."""


@dataclass(frozen=True)
class StandUnknown:
    """An unknown stand angle of one mounting, with mean and standard deviation of its prior, rad.

    `mount` is the index of the mounting, `column` the index of the angle in `STAND_ANGLES`. If `measured`, a
    level gave the prior.
    """

    mount: int
    column: int
    prior_u: float
    prior_mean: float = 0.0
    measured: bool = False


@dataclass(frozen=True)
class EffectUnknown:
    """An unknown parameter of an effect, with its prior in SI units.

    `effect` is the index of the effect in the model. `channel` is None for a parameter common to all channels.
    `stated` is false if nobody stated a prior: a weak one is then used.
    """

    effect: int
    parameter: str
    channel: int | None
    prior_mean: float
    prior_u: float
    stated: bool


@dataclass(frozen=True)
class FreeRows:
    """Readings `signal` (m, 3) in unknown orientations, which enter a fit only by their modulus |a| = 1 g."""

    signal: Floats
    conditions: Conditions


@dataclass(frozen=True)
class Linearisation:
    """The model linearised about a point: the readings `predicted` (n, 3) and their derivatives.

    `jacobian` (n, 3, 12 + q) are the derivatives by the 12 coefficients and the q other unknowns. `slope` (n, 3) is
    du/dphi, the derivative by a setting error of the head, unit/rad.
    """

    predicted: Floats
    jacobian: Floats
    slope: Floats


@dataclass(frozen=True)
class Problem:
    """The unknowns of a fit: 12 coefficients, then stand angles, then parameters of effects.

    `free` are readings of which only the modulus |a| = 1 g is used. `upper` constrains K to be upper triangular, as
    a fit to free readings alone requires. `hang` (p, p) is the lower Cholesky factor of the correlation matrix of
    the priors of the p stand angles, None if all priors are independent. `noise` is prior knowledge of the noise,
    or None. `growth` (3,) is the noise per signal without bias, divided by the noise at zero signal.
    """

    model: ForwardModel
    conditions: Conditions
    stand: tuple[StandUnknown, ...]
    effects: tuple[EffectUnknown, ...]
    free: FreeRows | None = None
    upper: bool = False
    hang: Floats | None = None
    noise: KnownNoise | None = None
    growth: Floats | None = None

    @property
    def active(self) -> Ints:
        """Indices, from 0 to 11, of the coefficients that are unknown."""
        return UPPER if self.upper else np.arange(FIXED)

    @property
    def prior_mean(self) -> Floats:
        """Prior means of the unknowns after the coefficients, shape (q,)."""
        return np.array([*(s.prior_mean for s in self.stand), *(e.prior_mean for e in self.effects)])

    @property
    def prior_u(self) -> Floats:
        """Prior standard deviations of the unknowns after the coefficients, shape (q,)."""
        return np.array([*(s.prior_u for s in self.stand), *(e.prior_u for e in self.effects)])

    @property
    def prior_rows(self) -> Floats:
        """The matrix (q, q) that whitens the q unknowns after the coefficients, each in units of its prior u.

        By the prior, whitened unknowns are independent and have unit variance.
        """
        return np.asarray(np.linalg.inv(self._prior_root))

    @property
    def _prior_root(self) -> Floats:
        """The lower Cholesky factor (q, q) of the correlation matrix of all priors."""
        root = np.eye(len(self.stand) + len(self.effects))
        if self.hang is not None:
            root[: len(self.hang), : len(self.hang)] = self.hang
        return root

    def pulls(self, others: Floats) -> Floats:
        """Return the deviations (q,) of the unknowns `others` from their prior means, whitened by the prior."""
        off = (others - self.prior_mean) / self.prior_u
        return off if self.hang is None else np.asarray(np.linalg.solve(self._prior_root, off))

    def by_prior(self, columns: Floats) -> Floats:
        """Convert derivatives (..., q) by the q unknowns to derivatives by whitened unknowns (see `prior_rows`)."""
        scaled = columns * self.prior_u
        return scaled if self.hang is None else np.asarray(scaled @ self._prior_root)

    def names(self) -> list[str]:
        """Return names of the unknowns after the coefficients: "alpha3[2]", "quadratic_nonlinearity.K2[y]".

        The name of an effect limited to some installations ends with these: "turn_on_shift.step[y][2]". If an
        effect occurs more than once, its shape follows: "axis_wobble.sine(harmonic 2)". If the shape of an effect
        is uncertain, each further part of the effect is an unknown: "warm_up in other shapes (1)".
        """
        stand = [f"{SYMBOLS[STAND_ANGLES[s.column]]}[{self.conditions.mounts[s.mount]}]" for s in self.stand]
        effects = []
        for e in self.effects:
            applied = self.model.effects[e.effect]
            channel = "" if e.channel is None else f"[{CHANNELS[e.channel]}]"
            mounts = f"[{'+'.join(applied.installations)}]" if applied.installations else ""
            own = applied.effect
            title = own.title if isinstance(own, InPart) else f"{own.name}.{e.parameter}"
            effects.append(f"{title}{channel}{mounts}")
        shapes = [self.model.effects[e.effect].shapes_text() for e in self.effects]
        named = zip(effects, shapes, strict=True)
        return stand + [f"{name}({shape})" if effects.count(name) > 1 else name for name, shape in named]

    def parameter(self, unknown: EffectUnknown) -> Parameter:
        """Return the parameter, in the catalogue of effects, to which an unknown of an effect belongs."""
        parameters = self.model.effects[unknown.effect].effect.parameters
        return next(p for p in parameters if p.name == unknown.parameter)

    def predict(self, block: Block, others: Floats, setting_rad: float = 0.0) -> Floats:
        """Return the readings (n, 3) that the model predicts, with a setting error of the head `setting_rad`."""
        return self._model_at(others).readings(block, self.conditions, self.stand_matrix(others), setting_rad)

    def stand_matrix(self, others: Floats) -> Floats:
        """Return the stand angles (mounts, 5), rad, with the values in `others` (q,), zero if not fitted."""
        matrix = np.zeros((len(self.conditions.mounts), len(STAND_ANGLES)))
        for value, unknown in zip(others, self.stand, strict=False):
            matrix[unknown.mount, unknown.column] = value
        return matrix

    def effects_at(self, others: Floats) -> tuple[AppliedEffect, ...]:
        """Return the model's effects with the parameter values in `others` (q,)."""
        return tuple(self.effect_at(index, others) for index in range(len(self.model.effects)))

    def effect_at(self, index: int, others: Floats) -> AppliedEffect:
        """Return the model's effect at `index`, with the parameter values in `others` (q,)."""
        applied = self.model.effects[index]
        values = applied.complete_values()
        for place in self._places_of[index]:
            unknown, value = self.effects[place - len(self.stand)], others[place]
            if unknown.channel is None:
                values[unknown.parameter] = np.float64(value) * np.ones(())
            else:
                changed = values[unknown.parameter].copy()
                changed[unknown.channel] = value
                values[unknown.parameter] = changed
        return replace(applied, values=values)

    @cached_property
    def _places_of(self) -> list[list[int]]:
        """For each effect of the model, the indices of its unknowns among those after the coefficients."""
        places: list[list[int]] = [[] for _ in self.model.effects]
        for place, unknown in enumerate(self.effects, len(self.stand)):
            places[unknown.effect].append(place)
        return places

    def slope(self, block: Block, others: Floats) -> Floats:
        """Return the derivative of the signals with respect to the head angle, unit/rad, shape (n, 3).

        It is taken at the coefficients `block` and the other unknowns `others` (stand angles, then effect
        parameters). Its product with a setting error of the head, rad, is the error of the signals.
        """
        forward, back = (self.predict(block, others, step) for step in (STEP_RAD, -STEP_RAD))
        return (forward - back) / (2 * STEP_RAD)

    def jacobian(self, block: Block, others: Floats) -> Floats:
        """Return the derivatives (n, 3, 12 + q) of the readings by the coefficients, then `others` (q,)."""
        return self.linear(block, others).jacobian

    def linear(self, block: Block, others: Floats) -> Linearisation:
        """Return the model linearised about the point (`block`, `others`).

        The derivatives are central differences of the forward model, so that there is no second formula to
        maintain. For the coefficients they are exact if the model has no effects, because it is then linear in
        them.
        """
        if not len(self.conditions):
            nothing = np.zeros((0, 3))
            return Linearisation(nothing, np.zeros((0, 3, FIXED + len(others))), nothing)
        if self.model.effects:
            return self.kept(Problem._linear_with_effects, block, others)
        force, by_angle, by_stand = self.forces(block, others)
        columns = np.zeros((len(force), 3, FIXED + len(others)))
        columns[:, :, :FIXED] = coefficient_columns(force)
        for j, unknown in enumerate(self.stand):
            own = self.conditions.mount == unknown.mount
            columns[own, :, FIXED + j] = by_stand[unknown.column][own] @ block.K.T
        return Linearisation(block.output(force), columns, by_angle @ block.K.T)

    def forces(self, block: Block, others: Floats) -> tuple[Floats, Floats, dict[int, Floats]]:
        """Return the specific forces (n, 3), g, their derivatives by the head angle, and by the stand angles.

        The last item maps the index of each unknown angle in `STAND_ANGLES` to the derivatives (n, 3), g/rad,
        by this angle in the mounting of the row.
        """
        n, used = len(self.conditions), self._columns
        stand = self.stand_matrix(others)
        stands = np.repeat(stand[None], 3 + 2 * len(used), axis=0)
        for i, column in enumerate(used):
            stands[3 + 2 * i, :, column] += STEP_RAD
            stands[4 + 2 * i, :, column] -= STEP_RAD
        setting = np.zeros((len(stands), n))
        setting[1], setting[2] = STEP_RAD, -STEP_RAD
        force = self.model.specific_force(
            self._many_conditions, stands.reshape(-1, len(STAND_ANGLES)), block, setting.ravel()
        ).reshape(len(stands), n, 3)
        slopes = (force[1::2] - force[2::2]) / (2 * STEP_RAD)
        return force[0], slopes[0], {column: slopes[1 + i] for i, column in enumerate(used)}

    @cached_property
    def _columns(self) -> tuple[int, ...]:
        """Indices of the stand angles that are unknown in at least one mounting."""
        return tuple(sorted({unknown.column for unknown in self.stand}))

    @cached_property
    def _many_conditions(self) -> Conditions:
        """The conditions, repeated for each finite-difference step; each repetition has separate mountings."""
        return self.conditions.repeated(3 + 2 * len(self._columns))

    @cached_property
    def _last(self) -> dict[tuple[object, bytes, bytes], Any]:
        return {}

    def kept(self, what: Callable[[Problem, Block, Floats], T], block: Block, others: Floats) -> T:
        """Return `what(self, block, others)`; the latest results are kept, because fits share points."""
        point = what, block.vector.tobytes(), others.tobytes()
        if point not in self._last:
            self._last[point] = what(self, block, others)
            if len(self._last) > MOST_KEPT:
                del self._last[next(iter(self._last))]
        result: T = self._last[point]
        return result

    def _linear_with_effects(self, block: Block, others: Floats) -> Linearisation:
        here, stand = self._model_at(others), self.stand_matrix(others)
        stages = Stages(here, block, self.conditions, stand)
        columns = self.by_stages(stages, block, others)
        for j in range(len(self.stand)):
            step = self.other_step(j)
            stands = [self.stand_matrix(at) for at in (others + step, others - step)]
            up, down = (here.readings(block, self.conditions, at) for at in stands)
            columns[:, :, FIXED + j] = (up - down) / (2 * step[j])
        return Linearisation(stages.readings, columns, self.slope(block, others))

    def by_stages(self, stages: Stages, block: Block, others: Floats) -> Floats:
        """Return the derivatives (n, 3, 12 + q) of the readings of `stages`; columns of stand angles are zero.

        `stages` are those of the model at the point (`block`, `others`).
        """
        columns = np.zeros((len(stages.readings), 3, FIXED + len(others)))
        shift = 1e-3 * float(np.max(np.abs(block.K)))
        for j, step in enumerate(shift * np.eye(FIXED)):
            up, down = (stages.of(Block.from_vector(block.vector + way)) for way in (step, -step))
            columns[:, :, j] = (up - down) / (2 * shift)
        for j, unknown in enumerate(self.effects, len(self.stand)):
            i, step = unknown.effect, self.other_step(j)
            ways = (self.effect_at(i, at) for at in (others + step, others - step))
            up, down = (stages.instead(stages.model.effects[i], way) for way in ways)
            columns[:, :, FIXED + j] = (up - down) / (2 * step[j])
        return columns

    def _model_at(self, others: Floats) -> ForwardModel:
        """Return the model with the values `others` (q,) of the unknowns after the coefficients."""
        return replace(self.model, effects=self.effects_at(others)) if self.effects else self.model

    def other_step(self, j: int) -> Floats:
        """Return a vector (q,) with the difference step of unknown `j` after the coefficients, else zero."""
        step = np.zeros(len(self.stand) + len(self.effects))
        step[j] = 1e-3 * self.prior_u[j] if j >= len(self.stand) else STEP_RAD
        return step


def coefficient_columns(force: Floats) -> Floats:
    """Return the derivatives of U = K a + U0 by the 12 coefficients for forces (n, 3), shape (n, 3, 12)."""
    columns = np.zeros((len(force), 3, FIXED))
    for channel in range(3):
        columns[:, channel, 3 * channel : 3 * channel + 3] = force
        columns[:, channel, 9 + channel] = 1.0
    return columns


def make_problem(
    model: ForwardModel,
    conditions: Conditions,
    stand_u: Mapping[str, float],
    free: FreeRows | None = None,
    known: KnownStand | None = None,
) -> Problem:
    """Return the problem with its unknowns: stand angles with a non-zero u, and the parameters of effects.

    Shape parameters (`Parameter.is_shape`), and starting states (`Parameter.start_of`) without u, are no
    unknowns: they keep the values of the model. A level reading of a mounting replaces the u in `stand_u`.

    `stand_u` maps names in `STAND_ANGLES` to standard uncertainties, rad. It may also state the noise:
    "setting_error" (rad) and "voltmeter_error" (unit of the signals). The prior of an effect parameter has the mean
    and the u that the model states; they must come from readings other than those to be fitted. Without a stated u
    the prior u is `WEAK` times the catalogue's plausible size. `known` is prior knowledge from other runs. It
    replaces the stated noise, and `stand_u` for angles that no level measured. Series during which the block stayed
    mounted (`Conditions.clamped`) have the same angles, unless a level measured them.
    """
    levels = conditions.levels()
    stand = tuple(
        StandUnknown(mount, column, levels[mount, column][1], levels[mount, column][0], measured=True)
        if (mount, column) in levels
        else StandUnknown(mount, column, stand_u[name])
        for mount in range(len(conditions.mounts))
        for column, name in enumerate(STAND_ANGLES)
        if stand_u.get(name, 0.0) > 0 or (mount, column) in levels
    )
    effects = [
        unknown for index, applied in enumerate(model.effects) for unknown in _effect_unknowns(index, applied)
    ]
    noise = KnownNoise.of_bench(stand_u) if known is None or known.noise is None else known.noise
    upper = len(conditions) == 0
    problem = Problem(model, conditions, stand, tuple(effects), free, upper=upper, noise=noise)
    return _with_shared(problem, known)


def _with_shared(problem: Problem, known: KnownStand | None) -> Problem:
    """Return the problem with correlated priors of the stand angles, from shared mountings and from other runs.

    Angles that a level measured keep their independent priors.
    """
    stand, mounts = problem.stand, problem.conditions.mounts
    told = [j for j, unknown in enumerate(stand) if not unknown.measured]
    clamped = problem.conditions.clamped
    key = np.array([len(STAND_ANGLES) * clamped[stand[j].mount] + stand[j].column for j in told])
    shared = np.where(key[:, None] == key, SAME, 0.0) + (1.0 - SAME) * np.eye(len(told))
    if not told or (known is None and len(np.unique(key)) == len(key)):
        return problem
    stated_u = np.array([stand[j].prior_u for j in told])
    if known is None:
        mean, covariance = np.zeros(len(told)), shared * np.outer(stated_u, stated_u)
    else:
        pairs = [(STAND_ANGLES[stand[j].column], mounts[stand[j].mount].installation) for j in told]
        mean, covariance = known.prior(pairs, stated_u, shared)
    u = np.sqrt(np.diag(covariance))
    changed = list(stand)
    for j, m, size in zip(told, mean.tolist(), u.tolist(), strict=True):
        changed[j] = replace(stand[j], prior_u=size, prior_mean=m)
    correlation = np.eye(len(stand))
    correlation[np.ix_(told, told)] = covariance / np.outer(u, u)
    return replace(problem, stand=tuple(changed), hang=np.asarray(np.linalg.cholesky(correlation)))


def _effect_unknowns(index: int, applied: AppliedEffect) -> list[EffectUnknown]:
    values = applied.complete_values()
    unknowns = []
    for p in applied.effect.parameters:
        if p.is_shape or (p.start_of and p.name not in applied.u):
            continue
        given = np.broadcast_to(applied.u.get(p.name, 0.0), values[p.name].shape)
        rows = [CHANNELS.index(channel) for channel in applied.channels] if p.per_channel else [None]
        for row in rows:
            at = () if row is None else row
            u = float(given[at])
            mean = float(values[p.name][at])
            unknowns.append(EffectUnknown(index, p.name, row, mean, u or WEAK * p.plausible, u > 0))
    return unknowns
