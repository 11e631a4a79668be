"""The difference of readings and prediction as a linear system, in which missing effects are searched."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bench.base.arrays import Floats, Ints, Mask
from bench.calibration.calibrate import first_guess
from bench.calibration.design import FIXED, STEP_RAD, Problem, coefficient_columns, make_problem
from bench.diagnosis.levels import FAR
from bench.model.conditions import Conditions
from bench.model.effects import AppliedEffect, Stage
from bench.model.effects.base import Seen, rows_of
from bench.model.forward import ForwardModel
from bench.model.geometry import STAND_ANGLES, Block, Installation, specific_force_on_platform
from bench.readings.table import FREE, REFERENCE, SHORTED, VERIFICATION, Readings

ONE_MOUNTING: Final = 0.01
"""Largest root mean square residual, in rad, of directions that belong to one mounting.

A rotation from the stated orientation by less changes no signature. A larger one is reported and used, if it is
beyond the limits of the stand.
"""
LEAST_APART: Final = 0.05
"""Least second singular value of the directions, per point, that determines an orientation."""


@dataclass(frozen=True)
class Orientation:
    """The orientation `block_from_platform` (3, 3) of the verification points, as the signals give it.

    `off_rad` is the rotation from the orientation in the bench file, about `axis` (3,) of the block. `contradicts`
    says whether the rotation is significant.
    """

    block_from_platform: Floats
    off_rad: float
    axis: Floats
    contradicts: bool

    def in_words(self) -> str:
        """Return a sentence on the contradiction to the bench file and its remedy."""
        axis = ", ".join(f"{part:+.2f}" for part in self.axis)
        return (
            f"the verification points contradict the bench file: by their signals the block is turned by "
            f"{np.degrees(self.off_rad):.2g}° about ({axis}) of its axes from the orientation that installation V "
            "states; correct 'installations: V', or name another file with --bench"
        )


def orientation_of(
    model: ForwardModel, readings: Readings, force: Floats, stand_u: Mapping[str, float]
) -> Orientation | None:
    """Return the orientation of the block at the verification points; None where they do not determine it.

    `force` (n, 3) is the specific force that the signals of the table give. Source of the fit: Wahba's
    problem, solved by singular values (Markley, 1988).
    """
    rows = np.flatnonzero((readings.installation == VERIFICATION) & np.isfinite(readings.angle_rad))
    if VERIFICATION not in model.installations or len(rows) < 2:
        return None
    platform = specific_force_on_platform(readings.angle_rad[rows], np.zeros((len(rows), len(STAND_ANGLES))))
    seen = force[rows] / np.linalg.norm(force[rows], axis=1, keepdims=True)
    left, sizes, right = np.linalg.svd(seen.T @ platform)
    if sizes[1] < LEAST_APART * len(rows):
        return None
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    if np.sqrt(np.mean(np.sum((seen - platform @ turn.T) ** 2, axis=1))) > ONE_MOUNTING:
        return None
    stated = model.installations[VERIFICATION].block_from_platform
    rotation = Rotation.from_matrix(turn @ stated.T).as_rotvec()
    off = float(np.linalg.norm(rotation))
    limits = float(np.linalg.norm([stand_u.get(name, 0.0) for name in STAND_ANGLES]))
    return Orientation(turn, off, rotation / max(off, 1e-300), off > max(ONE_MOUNTING, FAR * limits))


def as_measured(model: ForwardModel, orientation: Orientation | None) -> ForwardModel:
    """Return the model with the measured orientation of installation V where the bench file is wrong."""
    if orientation is None or not orientation.contradicts:
        return model
    measured = Installation(VERIFICATION, orientation.block_from_platform)
    return replace(model, installations={**model.installations, VERIFICATION: measured})


MODULUS: Final = 3
"""Channel number of a row that holds the modulus |a| instead of a single channel."""

REFERENCE_U: Final = 1e-4
"""Relative standard uncertainty of a reference voltage. Its drift matters more than its value."""


@dataclass(frozen=True)
class Rows:
    """The reading (index in the table) and the channel (0, 1, 2 or `MODULUS`) of each row of the system."""

    reading: Ints
    channel: Ints

    def __len__(self) -> int:
        return len(self.reading)


@dataclass(frozen=True)
class RunSizes:
    """Relative noise `sizes` of the runs (runs,), with the degrees of freedom of each (runs,).

    The mean square of the sizes over the rows is 1.
    """

    sizes: Floats
    freedom: Floats


@dataclass(frozen=True)
class LinearSystem:
    """y = X c + Z b + noise about a first guess of the block.

    `response` (N,) is measured less predicted. `fixed` (N, 12) has the derivatives by the coefficients. `random`
    (N, q) has those by stand angles and the model's own effects, times their prior standard deviations. `slope`
    (N,) is du/dphi in the rows of a setting, else zero. `setting` (N,) numbers the settings, else -1. `problem`
    has the unknowns of the settings: stand angles and the model's own effects. `orientation` is the orientation
    at the verification points, None where they do not determine it. Where it contradicts the bench file, `model`
    has installation V as measured. `by_channel` (3,) is the relative noise of the channels, with mean square 1.
    `by_run` is the relative noise of several runs, None where they are alike. `by_row` (N,) is the relative noise
    of rows with heavy tails, None for normal noise. `by_place` (N,) is the relative noise of rows where one place
    scatters more, None where none does. The last `of_noise` columns of `random` are noise that readings share,
    slow noise in `slow_channels`.
    """

    readings: Readings
    model: ForwardModel
    block: Block
    rows: Rows
    response: Floats
    fixed: Floats
    random: Floats
    slope: Floats
    setting: Ints
    moved: Conditions
    view: View
    problem: Problem
    orientation: Orientation | None
    by_channel: Floats = field(default_factory=lambda: np.ones(3), kw_only=True)
    by_run: RunSizes | None = field(default=None, kw_only=True)
    by_row: Floats | None = field(default=None, kw_only=True)
    by_place: Floats | None = field(default=None, kw_only=True)
    of_noise: int = field(default=0, kw_only=True)
    slow_channels: tuple[int, ...] = field(default=(), kw_only=True)

    def __len__(self) -> int:
        return len(self.response)

    def with_random(self, *columns: Floats) -> LinearSystem:
        """Return the system with more `random` columns (N, …) of unit variance."""
        return replace(self, random=np.column_stack([self.random, *columns]))

    def with_noise(self, *columns: Floats) -> LinearSystem:
        """Return the system with more `random` columns (N, …) that are noise, shared by readings."""
        system = self.with_random(*columns)
        return replace(system, of_noise=self.of_noise + system.random.shape[1] - self.random.shape[1])

    def design(self, effects: Floats) -> Floats:
        """Return the columns of coefficients, stand and own effects, and further `effects` (N, m)."""
        return np.concatenate([self.fixed, self.random, effects], axis=1)

    @property
    def own(self) -> slice:
        """Slice of the columns of `random` for the effects of the given model, `problem.effects`."""
        return slice(len(self.problem.stand), len(self.problem.stand) + len(self.problem.effects))

    @property
    def settings(self) -> int:
        """The number of settings."""
        return int(self.setting.max()) + 1

    @property
    def typical_slope(self) -> float:
        """Root mean square over the settings of the length of du/dphi, each channel in units of its noise."""
        return float(np.sqrt(np.sum((self.slope / self.relative) ** 2) / max(self.settings, 1)))

    @cached_property
    def relative(self) -> Floats:
        """Relative noise of each row, 1 for a channel and a run of average noise, shape (N,)."""
        relative = self.relative_of_channel
        if self.by_run is not None:
            relative = relative * self.by_run.sizes[self.readings.run[self.rows.reading]]
        for own in (self.by_row, self.by_place):
            relative = relative if own is None else relative * own
        return relative

    @property
    def relative_of_channel(self) -> Floats:
        """Relative noise of each row that is due to its channel, shape (N,)."""
        if np.all(self.by_channel == 1.0):
            return np.ones(len(self))
        size = self.by_channel[np.minimum(self.rows.channel, 2)].copy()
        modulus = self.rows.channel == MODULUS
        if modulus.any():
            by_signal = _modulus(self.block, self.readings.signal[self.rows.reading[modulus]])[1]
            size[modulus] = np.linalg.norm(by_signal * self.by_channel, axis=1)
        return size

    @property
    def g_per_signal(self) -> Floats:
        """Factors that convert the rows to g, shape (N,).

        A channel's row has 1/|scale factor of the channel|, a row of the modulus the length of d|a|/du.
        """
        of_channel = 1.0 / np.abs(np.diag(self.block.K))[np.minimum(self.rows.channel, 2)]
        modulus = self.rows.channel == MODULUS
        of_channel[modulus] = 1.0 / _modulus(self.block, self.readings.signal[self.rows.reading[modulus]])[2]
        return of_channel

    @property
    def conditions(self) -> Conditions:
        """The conditions of all readings, in the order of measurement."""
        return self.view.conditions

    def rows_in(self, mounts: Sequence[str]) -> Mask:
        """Return the mask (N,) of the rows in these mountings or passes."""
        return rows_of(mounts, self.conditions)[self.rows.reading]

    def rows_of(self, change: Floats) -> Floats:
        """Convert changes of the signals (n, 3) to changes of the rows (N,)."""
        return self.view.rows_of(change)

    @cached_property
    def _still(self) -> Floats:
        """The readings without any effect, shape (n, 3)."""
        return self.view.read(replace(self.model, effects=()), self.block)

    def _change(self, applied: AppliedEffect) -> Floats:
        return self.view.read(replace(self.model, effects=(applied,)), self.block) - self._still

    def stage_columns(
        self, of: AppliedEffect | Floats, stage: Stage, adds_to: str = "", *, of_force: bool = False
    ) -> Floats:
        """Return the change of the rows by one linearised stage of the model.

        `of` is an effect that needs no path, at the block's output or the voltmeter, or a time course, one value
        per reading (n,). At the stand the course is added to the angle `adds_to`. At the block's output it is in g,
        or with `of_force` a fraction of the specific force. The shape is (N, 1) for a course of the stand or the
        head, else (N, 3), a column for each channel.
        """
        force, by_angle = self._stand
        if stage in (Stage.STAND, Stage.HEAD_ANGLE):
            number = STAND_ANGLES.index(adds_to) if stage is Stage.STAND else -1
            return self.view.rows_of(by_angle[:, :, number] * np.asarray(of)[:, None])[:, None]
        of_block = stage is Stage.BLOCK_OUTPUT
        if isinstance(of, AppliedEffect):
            change = of.addition(Seen(force if of_block else self._still, self.conditions, self.block))
        else:
            change = np.repeat(of[:, None], 3, axis=1)
            if of_block:
                change = change * np.diag(self.block.K) * (force if of_force else 1.0)
        if of_block:
            change = np.where(np.isnan(self.view.voltage_v), change, 0.0)
        return self.view.rows_of(change[:, :, None] * np.eye(3))

    @cached_property
    def _stand(self) -> tuple[Floats, Floats]:
        """Specific force (n, 3) without effects; derivatives (n, 3, 6) of the readings by stand and head."""
        model, conditions = replace(self.model, effects=()), self.conditions
        still = np.zeros((len(conditions.mounts), len(STAND_ANGLES)))
        known = [mount.installation in model.installations for mount in conditions.mounts]
        turned = np.array(known, dtype=bool)[conditions.mount] & np.isnan(self.view.force[:, 0])

        def acting(stand: Floats, setting_rad: float = 0.0) -> Floats:
            own = model.readings_in_order(self.block, conditions, stand, setting_rad, force=self.view.force)
            return np.where(turned[:, None] & np.isnan(self.view.voltage_v), own, 0.0)

        steps = [STEP_RAD * (np.arange(len(STAND_ANGLES)) == i) for i in range(len(STAND_ANGLES))]
        differences = [acting(still + step) - acting(still - step) for step in steps]
        differences.append(acting(still, STEP_RAD) - acting(still, -STEP_RAD))
        force = np.asarray(self.block.specific_force(self.view.read(model, self.block)))
        return force, np.stack(differences, axis=2) / (2 * STEP_RAD)

    def effect_column(self, applied: AppliedEffect) -> Floats:
        """Return the change of the rows by an effect with these values, shape (N,)."""
        return self.view.rows_of(self._change(applied))

    def effect_columns(self, applied: AppliedEffect) -> Floats:
        """Return the change of the rows by an effect of the block, a column for each channel, (N, 3)."""
        change = self._change(applied)
        return np.stack([self.view.rows_of(change * (np.arange(3) == i)) for i in range(3)], axis=1)


@dataclass(frozen=True)
class View:
    """Conversion of changes of the three signals of a reading to the rows of the system.

    `conditions` covers all readings in the order of measurement, as effects may depend on earlier readings.
    Where `force` or `voltage_v` (n, 3) is not NaN, it replaces the input from the installation. `settings`,
    `moduli` and `inputs` index the readings of each kind. `by_signal` (m, 3) is d|a|/du over its norm.
    """

    conditions: Conditions
    force: Floats
    voltage_v: Floats
    settings: Ints
    moduli: Ints
    inputs: Ints
    by_signal: Floats

    def own(self, model: ForwardModel, effects: tuple[AppliedEffect, ...], block: Block) -> Floats:
        """Return the change of the signals of each reading by all `effects` together, shape (n, 3)."""
        if not effects:
            return np.zeros(self.force.shape)
        return self.read(replace(model, effects=effects), block) - self.read(
            replace(model, effects=()), block
        )

    def read(self, model: ForwardModel, block: Block) -> Floats:
        """Return the signals (n, 3) that a model predicts for all readings on a stand without errors."""
        still = np.zeros((len(self.conditions.mounts), len(STAND_ANGLES)))
        return model.readings_in_order(
            block, self.conditions, still, force=self.force, voltage_v=self.voltage_v
        )

    def rows_of(self, change: Floats) -> Floats:
        """Convert changes of the signals (n, 3, …) to rows of the system (N, …)."""
        modulus = np.einsum("mi,mi...->m...", self.by_signal, change[self.moduli])
        each = change.shape[2:]
        settings, inputs = (change[own].reshape(-1, *each) for own in (self.settings, self.inputs))
        return np.concatenate([settings, modulus, inputs])


def make_linear(readings: Readings, model: ForwardModel, stand_u: Mapping[str, float]) -> LinearSystem:
    """Return the readings minus the model's prediction as a system that is linear in all unknowns.

    The rows are, in this order: settings in installations, moduli (verification and free positions), inputs. Raises
    `CalibrationError` where the settings do not determine the coefficients.
    """
    label = readings.installation
    kind_of = np.where(label == VERIFICATION, 1, np.where(label == FREE, 1, 0))
    kind_of = np.where(np.isin(label, [SHORTED, REFERENCE]), 2, kind_of)
    settings, moduli, inputs = (np.flatnonzero(kind_of == kind) for kind in range(3))
    table = readings.select(kind_of == 0)
    problem = make_problem(model, table.conditions(), stand_u)
    block = first_guess(problem, table.signal)
    orientation = orientation_of(model, readings, block.specific_force(readings.signal), stand_u)
    model = as_measured(model, orientation)
    problem = replace(problem, model=model)

    force, by_signal, weight = _modulus(block, readings.signal[moduli])
    others = problem.prior_mean
    given = np.full((len(readings), 3), np.nan)
    given[moduli] = _unit(force)  # how the block stood there its signals say better than any bench file
    voltage_v, unstated = _references(readings)
    view = View(readings.conditions(), given, voltage_v, settings, moduli, inputs, by_signal)

    own = view.own(model, problem.effects_at(others), block)
    residual = table.signal - problem.predict(block, others)
    modulus_error = (np.linalg.norm(force, axis=1) - 1.0) * weight
    modulus_error -= np.einsum("mi,mi->m", by_signal, own[moduli])
    input_error = readings.signal[inputs] - voltage_v[inputs] - own[inputs]
    count = len(settings)
    slope = np.zeros(3 * count + len(moduli) + 3 * len(inputs))
    slope[: 3 * count] = problem.slope(block, others).ravel()
    setting = np.full(len(slope), -1)
    setting[: 3 * count] = np.repeat(np.arange(count), 3)
    fixed, random = _columns(problem, block, _unit(force), view, label, unstated)
    rows = Rows(
        np.concatenate([np.repeat(settings, 3), moduli, np.repeat(inputs, 3)]),
        np.concatenate(
            [np.tile([0, 1, 2], count), np.full(len(moduli), MODULUS), np.tile([0, 1, 2], len(inputs))]
        ).astype(np.int64),
    )
    response = np.concatenate([residual.ravel(), modulus_error, input_error.ravel()])
    return LinearSystem(
        readings,
        model,
        block,
        rows,
        response,
        fixed,
        random,
        slope,
        setting,
        problem.conditions,
        view,
        problem,
        orientation,
    )


def _modulus(block: Block, signal: Floats) -> tuple[Floats, Floats, Floats]:
    """Return a (m, 3), the unit vector along d|a|/du (m, 3), and the signal per unit of |a| (m,)."""
    if not len(signal):
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    force = block.specific_force(signal)
    by_signal = _unit(force) @ np.linalg.inv(block.K)
    size = np.linalg.norm(by_signal, axis=1)
    return force, by_signal / size[:, None], 1.0 / size


def _unit(vectors: Floats) -> Floats:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True) if len(vectors) else vectors


def _references(readings: Readings) -> tuple[Floats, Ints]:
    """Return the voltage (n, 3) of each input, NaN elsewhere, and the references of unstated value.

    The value of those is what the voltmeters read, its prior u that value itself.
    """
    volts = np.full((len(readings), 3), np.nan)
    volts[readings.installation == SHORTED] = 0.0
    unstated = []
    stated = readings.extra.get("reference_v", np.full(len(readings), ""))
    for i in np.flatnonzero(readings.installation == REFERENCE).tolist():
        text = str(stated[i]).strip()
        volts[i] = float(text) if text else float(np.mean(readings.signal[i]))
        unstated += [] if text else [i]
    return volts, np.array(unstated, dtype=np.int64)


def own_column(problem: Problem, block: Block, view: View, number: int) -> Floats:
    """Return the change (n, 3) of the signals by one prior standard deviation of a model parameter."""
    step = np.zeros_like(problem.prior_u)
    step[number] = 1e-3 * problem.prior_u[number]
    up, down = (problem.effects_at(problem.prior_mean + sign * step) for sign in (1, -1))
    return (view.own(problem.model, up, block) - view.own(problem.model, down, block)) / 2e-3


def _columns(
    problem: Problem, block: Block, unit: Floats, view: View, label: NDArray[np.str_], unstated: Ints
) -> tuple[Floats, Floats]:
    """Return the columns of the coefficients, and of stand angles and own effects times their prior u.

    A modulus does not depend on the angles of the stand. `unstated` indexes readings of unknown references.
    """
    jacobian = problem.jacobian(block, problem.prior_mean)
    jacobian[:, :, FIXED:] *= problem.prior_u
    whole = np.zeros((len(label), 3, jacobian.shape[2]))
    whole[view.settings] = jacobian
    whole[view.moduli, :, :FIXED] = coefficient_columns(unit) if len(unit) else 0.0
    beyond = np.concatenate([view.moduli, view.inputs])
    for j in range(len(problem.stand), len(problem.prior_u)):
        whole[beyond, :, FIXED + j] = own_column(problem, block, view, j)[beyond]
    columns = np.stack([view.rows_of(whole[:, :, j]) for j in range(whole.shape[2])], axis=1)
    random = columns[:, FIXED:]
    reference = label == REFERENCE
    if np.any(reference):
        wrong = np.where(reference[:, None], REFERENCE_U * np.nan_to_num(view.voltage_v), 0.0)
        unknown = [np.where(np.arange(len(label))[:, None] == i, 1.0, 0.0) for i in unstated]
        columns_of = [wrong, *(one * np.nan_to_num(view.voltage_v) for one in unknown)]
        random = np.column_stack([random, *(view.rows_of(one) for one in columns_of)])
    return columns[:, :FIXED], random
