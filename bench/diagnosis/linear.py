"""The differences of readings and prediction as a linear system, in which missing effects are searched."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bench.base.arrays import Floats, Ints, Mask
from bench.base.languages import message
from bench.calibration.calibrate import first_guess
from bench.calibration.design import FIXED, STEP_RAD, Problem, coefficient_columns, make_problem
from bench.diagnosis.levels import FAR, MARK_DEG, ONE_DIRECTION
from bench.model.conditions import Conditions
from bench.model.effects import AppliedEffect, Stage
from bench.model.effects.base import rows_of
from bench.model.forward import ForwardModel, Stages
from bench.model.geometry import STAND_ANGLES, Block, Installation, specific_force_on_platform
from bench.readings.table import FREE, REFERENCE, SHORTED, VERIFICATION, Readings


@dataclass(frozen=True)
class Orientation:
    """The rotation matrix (3, 3) from platform to block axes at verification points, from the signals.

    It differs from the bench file by the angle `off_rad`, rad, about the unit vector `axis` (3,) in block axes.
    `contradicts` says whether this angle is larger than the u of the stand angles permits. `head_rad` is the error
    of the head angle that would have the same effect; None if there is none.
    """

    block_from_platform: Floats
    off_rad: float
    axis: Floats
    contradicts: bool
    head_rad: float | None

    def in_words(self) -> str:
        """Return a sentence that says how far the orientation is from the bench file, and what to correct."""
        axis = ", ".join(f"{part:+.2f}" for part in self.axis)
        remedy = message("correct 'installations: V', or name another file with --bench")
        if self.head_rad is not None:
            remedy = message(
                f"if the head stood {np.degrees(self.head_rad):+.3g}° from where it says at these points, correct "
                f"their angles; otherwise {remedy}"
            )
        return message(
            f"the verification points contradict the bench file: by their signals the block is turned by "
            f"{np.degrees(self.off_rad):.3g}° about ({axis}) of its axes from the orientation that installation V "
            f"states; {remedy}"
        )


def orientation_of(
    model: ForwardModel, readings: Readings, force: Floats, stand_u: Mapping[str, float]
) -> Orientation | None:
    """Return the orientation of the block at the verification points; None if they do not determine it.

    `force` (n, 3), g, is the specific force on block axes; `stand_u` has the standard uncertainties of the
    stand angles, rad. Source: Wahba's problem, solved by singular values (Markley, 1988).
    """
    rows = np.flatnonzero((readings.installation == VERIFICATION) & np.isfinite(readings.angle_rad))
    if VERIFICATION not in model.installations or len(rows) < 2:
        return None
    platform = specific_force_on_platform(readings.angle_rad[rows], np.zeros((len(rows), len(STAND_ANGLES))))
    seen = force[rows] / np.linalg.norm(force[rows], axis=1, keepdims=True)
    left, sizes, right = np.linalg.svd(seen.T @ platform)
    if sizes[1] < np.sin(np.radians(MARK_DEG)) ** 2 * len(rows):
        return None  # all points are, in the mean, within a mark of one line, about which the block may be turned
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    if np.sqrt(np.mean(np.sum((seen - platform @ turn.T) ** 2, axis=1))) > ONE_DIRECTION:
        return None
    stated = model.installations[VERIFICATION].block_from_platform
    rotation = Rotation.from_matrix(turn @ stated.T).as_rotvec()
    off = float(np.linalg.norm(rotation))
    axis = rotation / max(off, 1e-300)
    quarter = specific_force_on_platform(np.array([0.0, np.pi / 2]), np.zeros((2, len(STAND_ANGLES))))
    about_head = float(axis @ stated @ np.cross(*quarter))
    head = off * np.sign(about_head) if abs(about_head) > np.cos(ONE_DIRECTION) else None
    limits = float(np.linalg.norm([stand_u.get(name, 0.0) for name in STAND_ANGLES]))
    return Orientation(turn, off, axis, off > max(ONE_DIRECTION, FAR * limits), head)


MODULUS: Final = 3
"""Channel number of a row that holds the modulus |a| instead of a single channel."""

REFERENCE_U: Final = 1e-4
"""Relative standard uncertainty of a reference voltage; a rough value, because only its drift matters."""


@dataclass(frozen=True)
class Rows:
    """The origin of each row of the system: `reading` (N,) is the index of its reading in the table.

    `channel` (N,) is 0, 1 or 2 for the signal of one channel, or `MODULUS` for the modulus |a|.
    """

    reading: Ints
    channel: Ints

    def __len__(self) -> int:
        return len(self.reading)


@dataclass(frozen=True)
class RunSizes:
    """The relative noise of each run, with its degrees of freedom.

    `sizes` (runs,) are relative standard deviations, of mean square 1 over all rows; `freedom` (runs,) are the
    degrees of freedom of each.
    """

    sizes: Floats
    freedom: Floats


@dataclass(frozen=True)
class LinearSystem:
    """N differences of readings and prediction, as a linear function of the unknowns plus noise.

    The model is response = fixed @ c + random @ b + noise, linearised at the coefficients of `block`. Here c are
    the changes of the 12 coefficients, without prior, and b are q other unknowns with standard normal priors.

    `response` (N,) is measured minus predicted. `fixed` (N, 12) has the derivatives by the coefficients. `random`
    (N, q) has the changes by one prior u of each other unknown: stand angles and effects of the model (both of
    `problem`), then unknown references. Its last `of_noise` columns are noise that readings share, such as slow
    noise in `slow_channels`, or noise of the meters' references if `slow_reference`.

    `slope` (N,) is the derivative by the head angle, or 0; `setting` (N,) is the number of the setting, or -1.
    `orientation` is that of the block at the verification points, None if not determined. If it contradicts the
    bench file, `model` has the measured orientation.

    The relative noise of a row is a product of factors: `by_channel` (3,) of mean square 1, `by_run`, `by_row` (N,)
    for heavy tails, and `by_place` (N,) for a place that scatters more. Each of the last three may be None.
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
    slow_reference: bool = field(default=False, kw_only=True)

    def __len__(self) -> int:
        return len(self.response)

    def with_random(self, *columns: Floats) -> LinearSystem:
        """Return the system with more unknowns; `columns` (N,) or (N, k) are changes by one prior u of each."""
        return replace(self, random=np.column_stack([self.random, *columns]))

    def with_noise(self, *columns: Floats) -> LinearSystem:
        """Return the system with more shared noise; `columns` (N,) or (N, k) are changes by 1 sigma of each."""
        system = self.with_random(*columns)
        return replace(system, of_noise=self.of_noise + system.random.shape[1] - self.random.shape[1])

    def design(self, effects: Floats) -> Floats:
        """Return the design matrix (N, 12 + q + m): `fixed`, `random`, and the columns `effects` (N, m)."""
        return np.concatenate([self.fixed, self.random, effects], axis=1)

    @property
    def own(self) -> slice:
        """The columns of `random` that belong to the effects of the given model, as a slice."""
        return slice(len(self.problem.stand), len(self.problem.stand) + len(self.problem.effects))

    @property
    def settings(self) -> int:
        """The number of settings of the head."""
        return int(self.setting.max()) + 1

    @property
    def typical_slope(self) -> float:
        """Root mean square of |du/dphi| over the settings, in the unit of the signal per rad.

        Each channel's derivative is divided by the relative noise of the channel.
        """
        return float(np.sqrt(np.sum((self.slope / self.relative) ** 2) / max(self.settings, 1)))

    @cached_property
    def relative(self) -> Floats:
        """The relative noise of each row, shape (N,): the product of all factors, such as that of the channel."""
        relative = self.relative_of_channel
        if self.by_run is not None:
            relative = relative * self.by_run.sizes[self.readings.run[self.rows.reading]]
        for own in (self.by_row, self.by_place):
            relative = relative if own is None else relative * own
        return relative

    @property
    def relative_of_channel(self) -> Floats:
        """The factor (N,) of `relative` due to the channel; for |a|, the channels are weighted by its gradient."""
        if np.all(self.by_channel == 1.0):
            return np.ones(len(self))
        size = self.by_channel[np.minimum(self.rows.channel, 2)].copy()
        for modulus, (_, by_signal, _) in self._moduli():
            size[modulus] = np.linalg.norm(by_signal * self.by_channel, axis=1)
        return size

    @property
    def g_per_signal(self) -> Floats:
        """Factors (N,) from the unit of the signal to g.

        The factor of a signal is 1 / |scale factor|; that of a modulus is the norm of the gradient of |a|.
        """
        size = np.empty(len(self))
        for block, mine in self.by_block():
            size[mine] = 1.0 / np.abs(np.diag(block.K))[np.minimum(self.rows.channel[mine], 2)]
        for modulus, (_, _, length) in self._moduli():
            size[modulus] = 1.0 / length
        return size

    def by_block(self) -> Iterator[tuple[Block, Mask]]:
        """Yield the coefficients at which each block is linearised, and the mask (N,) of the block's rows."""
        yield self.block, np.ones(len(self), dtype=bool)

    def _moduli(self) -> Iterator[tuple[Mask, tuple[Floats, Floats, Floats]]]:
        for block, mine in self.by_block():
            modulus = mine & (self.rows.channel == MODULUS)
            yield modulus, _modulus(block, self.readings.signal[self.rows.reading[modulus]])

    @property
    def conditions(self) -> Conditions:
        """The conditions of all readings, in the order of measurement."""
        return self.view.conditions

    def rows_in(self, mounts: Sequence[str]) -> Mask:
        """Return the mask (N,) of the rows that belong to the mountings or passes with these labels."""
        return rows_of(mounts, self.conditions)[self.rows.reading]

    @cached_property
    def _still(self) -> Stages:
        """The stages of the forward model without any effect."""
        return self.view.stages(replace(self.model, effects=()), self.block)

    def stage_columns(
        self, course: Floats, stage: Stage, adds_to: str = "", *, in_proportion: bool = False
    ) -> Floats:
        """Return the linearised changes of the rows by k time courses (n, k) at one stage.

        At the stand or the head, a course in rad is added to the angle `adds_to`; the result is (N, k, 1). At the
        output of the block, a course is in g; in the voltmeter, it is in the unit of the signal. With
        `in_proportion`, a course at these two stages is a fraction of the specific force or of the signal. Their
        result is (N, k, 3), by channel.
        """
        force, by_angle = self._stand
        if stage in (Stage.STAND, Stage.HEAD_ANGLE):
            number = STAND_ANGLES.index(adds_to) if stage is Stage.STAND else -1
            return self.view.rows_of(by_angle[:, :, number, None] * course[:, None])[:, :, None]
        of_block = stage is Stage.BLOCK_OUTPUT
        change = np.repeat(course[:, None], 3, axis=1)
        if of_block:
            unknown = np.isnan(self.view.voltage_v)
            change = np.where(unknown[..., None], change * np.diag(self.block.K)[:, None], 0.0)
        if in_proportion:
            change = change * (force if of_block else self._still.readings)[..., None]
        return self.view.by_channel(change)

    @cached_property
    def _stand(self) -> tuple[Floats, Floats]:
        """The specific force (n, 3) without effects; derivatives (n, 3, 6) of readings by stand and head angles."""
        model, conditions = replace(self.model, effects=()), self.conditions
        still = np.zeros((len(conditions.mounts), len(STAND_ANGLES)))
        known = [mount.installation in model.installations for mount in conditions.mounts]
        turned = np.array(known, dtype=bool)[conditions.mount] & np.isnan(self.view.force[:, 0])

        def acting(stand: Floats, setting_rad: float = 0.0) -> Floats:
            own = Stages(model, self.block, conditions, stand, setting_rad, force=self.view.force)
            return np.where(turned[:, None] & np.isnan(self.view.voltage_v), own.readings, 0.0)

        steps = [STEP_RAD * (np.arange(len(STAND_ANGLES)) == i) for i in range(len(STAND_ANGLES))]
        differences = [acting(still + step) - acting(still - step) for step in steps]
        differences.append(acting(still, STEP_RAD) - acting(still, -STEP_RAD))
        force = np.asarray(self.block.specific_force(self._still.readings))
        return force, np.stack(differences, axis=2) / (2 * STEP_RAD)

    def effect_column(self, applied: AppliedEffect) -> Floats:
        """Return the change (N,) of the rows that an effect with its values causes."""
        return np.asarray(self.effect_columns(applied).sum(axis=1))

    def effect_columns(self, applied: AppliedEffect) -> Floats:
        """Return the change (N, 3) of the rows that an effect with its values causes in each channel."""
        change = self._still.instead(None, applied) - self._still.readings
        return self.view.by_channel(change)


@dataclass(frozen=True)
class View:
    """The conversion of changes of the signals of n readings to changes of the N rows of the system.

    `conditions` are of all readings, because effects may need earlier ones. Where they are not NaN, `force` (n, 3),
    g, replaces the specific force of the installation, and `voltage_v` (n, 3), V, the output of the block.
    `settings`, `moduli` and `inputs` are indices of readings; `by_signal` (moduli, 3) is the unit gradient of |a|.
    """

    conditions: Conditions
    force: Floats
    voltage_v: Floats
    settings: Ints
    moduli: Ints
    inputs: Ints
    by_signal: Floats

    def own(self, model: ForwardModel, effects: tuple[AppliedEffect, ...], block: Block) -> Floats:
        """Return the change of the signals (n, 3) if all `effects` act together on the output of `block`."""
        if not effects:
            return np.zeros(self.force.shape)
        with_effects, without = (self.stages(replace(model, effects=of), block) for of in (effects, ()))
        return with_effects.readings - without.readings

    def stages(self, model: ForwardModel, block: Block) -> Stages:
        """Return the stages of the model for all readings; stand angles and setting errors are zero."""
        still = np.zeros((len(self.conditions.mounts), len(STAND_ANGLES)))
        return Stages(model, block, self.conditions, still, force=self.force, voltage_v=self.voltage_v)

    def rows_of(self, change: Floats) -> Floats:
        """Return the change of the rows, (N, …), that a change of the signals (n, 3, …) causes."""
        return np.asarray(self.by_channel(change).sum(axis=-1))

    def by_channel(self, change: Floats) -> Floats:
        """Return what `rows_of` returns, by the channel whose signal changes, (N, …, 3)."""
        reading, by_signal = self._rows
        return np.moveaxis(change[reading] * by_signal.reshape(-1, 3, *[1] * (change.ndim - 2)), 1, -1)

    @cached_property
    def _rows(self) -> tuple[Ints, Floats]:
        """The reading (N,) of each row, and the derivatives (N, 3) of the row by the signals of this reading."""
        places = [np.repeat(self.settings, 3), self.moduli, np.repeat(self.inputs, 3)]
        settings, inputs = (np.tile(np.eye(3), (len(own), 1)) for own in (self.settings, self.inputs))
        return np.concatenate(places), np.concatenate([settings, self.by_signal, inputs])


def make_linear(readings: Readings, model: ForwardModel, stand_u: Mapping[str, float]) -> LinearSystem:
    """Return the linear system of readings of one block, linearised at coefficients fitted to the readings.

    Rows are three signals for each oriented reading, one modulus for each verification point and free position,
    then three signals for each shorted or reference input. `stand_u` has the standard uncertainties of the stand
    angles, rad. Raises `CalibrationError` if the oriented readings do not determine the coefficients.
    """
    label = readings.installation
    kind_of = np.where(label == VERIFICATION, 1, np.where(label == FREE, 1, 0))
    kind_of = np.where(np.isin(label, [SHORTED, REFERENCE]), 2, kind_of)
    settings, moduli, inputs = (np.flatnonzero(kind_of == kind) for kind in range(3))
    table = readings.select(kind_of == 0)
    problem = make_problem(model, table.conditions(), stand_u)
    block = first_guess(problem, table.signal)
    orientation = orientation_of(model, readings, block.specific_force(readings.signal), stand_u)
    if orientation is not None and orientation.contradicts:
        measured = Installation(VERIFICATION, orientation.block_from_platform)
        model = replace(model, installations={**model.installations, VERIFICATION: measured})
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
    """Return, for m signals, the force a (m, 3), g, the unit gradients of |a| (m, 3), and the step per g (m,).

    The gradients are by the signals. The step is the change of the signals, along the gradient, for 1 g of |a|.
    """
    force = block.specific_force(signal)
    by_signal = _unit(force) @ np.linalg.inv(block.K)
    size = np.linalg.norm(by_signal, axis=1)
    return force, by_signal / size[:, None], 1.0 / size


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _references(readings: Readings) -> tuple[Floats, Ints]:
    """Return voltages (n, 3) of shorted and reference inputs (else NaN), and the references of unstated value.

    Such a reference has the mean that the voltmeters read, with a prior u as large.
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
    """Return the change (n, 3) of the signals by one prior u of the effect parameter with the index `number`."""
    step = np.zeros_like(problem.prior_u)
    step[number] = 1e-3 * problem.prior_u[number]
    ways = (problem.effects_at(problem.prior_mean + sign * step) for sign in (1, -1))
    up, down = (view.stages(replace(problem.model, effects=effects), block).readings for effects in ways)
    return (up - down) / 2e-3


def _columns(
    problem: Problem, block: Block, unit: Floats, view: View, label: NDArray[np.str_], unstated: Ints
) -> tuple[Floats, Floats]:
    """Return columns (N, 12) of the coefficients, and columns (N, q) of the other unknowns times their prior u.

    A modulus does not depend on the angles of the stand. The values of the references `unstated` are unknowns, too.
    """
    jacobian = problem.jacobian(block, problem.prior_mean)
    jacobian = np.concatenate([jacobian[:, :, :FIXED], problem.by_prior(jacobian[:, :, FIXED:])], axis=2)
    whole = np.zeros((len(label), 3, jacobian.shape[2]))
    whole[view.settings] = jacobian
    whole[view.moduli, :, :FIXED] = coefficient_columns(unit)
    beyond = np.concatenate([view.moduli, view.inputs])
    for j in range(len(problem.stand), len(problem.prior_u)):
        whole[beyond, :, FIXED + j] = own_column(problem, block, view, j)[beyond]
    columns = view.rows_of(whole)
    random = columns[:, FIXED:]
    reference = label == REFERENCE
    if np.any(reference):
        wrong = np.where(reference[:, None], REFERENCE_U * np.nan_to_num(view.voltage_v), 0.0)
        unknown = [np.where(np.arange(len(label))[:, None] == i, 1.0, 0.0) for i in unstated]
        columns_of = [wrong, *(one * np.nan_to_num(view.voltage_v) for one in unknown)]
        random = np.column_stack([random, *(view.rows_of(one) for one in columns_of)])
    return columns[:, :FIXED], random
