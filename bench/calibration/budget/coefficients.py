"""The uncertainty budget: each bench error's effect on the readings and, by an estimator, on the coefficients."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Ints, Mask
from bench.calibration import gls
from bench.calibration.budget.error_source import NAME as FOUNDATION
from bench.calibration.budget.error_source import ErrorSource, tilt_patterns
from bench.calibration.budget.meters import flicker_waves
from bench.calibration.budget.propagation import Propagated, effective_dof
from bench.calibration.design import FIXED, STEP_RAD, Problem, make_problem
from bench.calibration.estimators import GLS, in_a_budget
from bench.calibration.gls import WeightingTask
from bench.calibration.noise import KnownStand
from bench.calibration.observability import require_rank
from bench.calibration.result import CalibrationError, Noise
from bench.config.bench_file.file import STAND_ERRORS, BenchFile
from bench.config.procedure.plan import Plan, Read, SetTemperature
from bench.model.conditions import Conditions
from bench.model.effects.base import lagged
from bench.model.forward import ForwardModel
from bench.model.geometry import STAND_ANGLES, Block
from bench.readings.table import UNORIENTED, VERIFICATION, Readings, make_readings

_SAME_FORCE_G: Final = 1e-6
_SAME_READ_FORCE_G: Final = 5e-3
"""Measured specific forces at most this far from the first of an orientation are of it: the bracket has errors."""


@dataclass(frozen=True)
class Setup:
    """The readings that a budget is for, with the model of the bench and the block.

    `conditions` has n readings, verification points included. `meters` assigns the number of
    a voltmeter to each of the channels x, y, z: channels with the same number share a meter.
    """

    model: ForwardModel
    conditions: Conditions
    block: Block
    meters: tuple[int, int, int] = (0, 1, 2)

    @cached_property
    def verification(self) -> Mask:
        """Mask of the readings that are verification points, shape (n,)."""
        of = np.array([mount.installation == VERIFICATION for mount in self.conditions.mounts])
        return np.asarray(of[self.conditions.mount])

    @property
    def fitted(self) -> Mask:
        """Mask of the readings that the estimator uses, shape (n,)."""
        return ~self.verification

    @cached_property
    def force(self) -> Floats:
        """Specific forces on the block at a stand without errors, g, shape (n, 3)."""
        return self.model.specific_force(self.conditions, self._angles(), self.block)

    @cached_property
    def signal(self) -> Floats:
        """The readings at a stand without errors, V, shape (n, 3)."""
        return self.model.readings(self.block, self.conditions, self._angles())

    @cached_property
    def setting_slope(self) -> Floats:
        """Derivatives du/dphi of the signals by the head angle, V/rad, shape (n, 3)."""
        return self._slope(lambda step: (self._angles(), step))

    def stand_slope(self, name: str) -> Floats:
        """Return the derivatives of the readings by the stand angle `name`, V/rad, shape (n, 3).

        The derivative of a reading is by the angle in that reading's mounting.
        """
        if name not in self._stand_slopes:
            self._stand_slopes[name] = self._slope(lambda step: (self._angles(name, step), 0.0))
        return self._stand_slopes[name]

    @cached_property
    def _stand_slopes(self) -> dict[str, Floats]:
        """The derivatives by each stand angle, cached because `bench require` computes hundreds of budgets."""
        return {}

    def _slope(self, errors: Callable[[float], tuple[Floats, float]]) -> Floats:
        up, down = (
            self.model.readings(self.block, self.conditions, *errors(step)) for step in (STEP_RAD, -STEP_RAD)
        )
        return (up - down) / (2 * STEP_RAD)

    @cached_property
    def orientation(self) -> Ints:
        """Orientation number of each reading, shape (n,): equal for equal specific forces."""
        rounded = np.round(self.force / _SAME_FORCE_G) + 0.0
        _, numbers = np.unique(rounded, axis=0, return_inverse=True)
        return numbers.ravel()

    @cached_property
    def effect_problem(self) -> Problem:
        """The problem whose unknowns are the coefficients and the parameters of effects."""
        return make_problem(self.model, self.conditions, {})

    @cached_property
    def effect_columns(self) -> Floats:
        """Derivatives of the readings by the q parameters of effects, V per SI unit, shape (n, 3, q)."""
        problem = self.effect_problem
        return problem.jacobian(self.block, problem.prior_mean)[:, :, FIXED:]

    @property
    def calibrated_k(self) -> float:
        """The mean temperature of the fitted readings minus the reference temperature, K."""
        return float(self.conditions.warmth_k[self.fitted].mean())

    def _angles(self, name: str | None = None, size_rad: float = 0.0) -> Floats:
        angles = np.zeros((len(self.conditions.mounts), len(STAND_ANGLES)))
        if name is not None:
            angles[:, STAND_ANGLES.index(name)] = size_rad
        return angles

    def readings(self) -> Readings:
        """Return the readings to fit as a noise-free table, in the order of `conditions`."""
        own = self.conditions.select(self.fitted)
        return make_readings(
            [own.mounts[m].installation for m in own.mount],
            own.pass_number.tolist(),
            own.point.tolist(),
            own.angle_rad,
            self.signal[self.fitted],
            source="the plan",
            series=[own.mounts[m].series for m in own.mount],
            direction=own.direction.tolist(),
            time_s=own.time_s,
            temperature_c=own.temperature_c,
        )


def planned_conditions(plan: Plan, line_hz: float = 50.0) -> Conditions:
    """Return the conditions of a plan's readings at known orientations, in order.

    Times are expected for meters at the mains frequency `line_hz`; temperatures are the chamber's last set
    points. Raises `CalibrationError` if the plan has no such reading.
    """
    rows: list[tuple[Read, float, float, int]] = []
    time_s, temperature_c = 0.0, float("nan")
    for step, mounting in zip(plan.steps, plan.mountings, strict=True):
        time_s += plan.step_duration_s(step, line_hz)
        if isinstance(step, SetTemperature):
            temperature_c = step.target_c
        elif isinstance(step, Read) and step.target_rad is not None and step.installation not in UNORIENTED:
            rows.append((step, time_s, temperature_c, mounting))
    if not rows:
        raise CalibrationError(
            f"{plan.name}: has no reading at a known angle of the head; choose another procedure"
        )
    reads = [row[0] for row in rows]
    return Conditions.of(
        [read.installation for read in reads],
        np.array([read.target_rad for read in reads], dtype=np.float64),
        series=[read.series for read in reads],
        pass_number=[read.pass_number for read in reads],
        point=[read.point for read in reads],
        direction=[read.direction or 0 for read in reads],
        time_s=[row[1] for row in rows],
        temperature_c=[row[2] for row in rows],
        mounting=np.array([row[3] for row in rows], dtype=np.int64),
    )


def make_setup(
    plan: Plan, bench: BenchFile, model: ForwardModel | None = None, block: Block | None = None
) -> Setup:
    """Return the setup of a plan on a bench, for `block` or else the block of the bench file.

    Raises `CalibrationError` if the plan has an installation that the bench lacks, or no reading to fit.
    """
    conditions = planned_conditions(plan, bench.line_frequency)
    chain = ForwardModel(bench.installation_models()) if model is None else model
    strange = sorted({m.installation for m in conditions.mounts} - set(chain.installations))
    if strange:
        raise CalibrationError(
            f"{plan.name}: the bench file has no installation {', '.join(strange)} "
            f"(it has {', '.join(chain.installations)}); add it there"
        )
    about = bench.simulated_block() if block is None else block
    setup = Setup(chain, conditions, about, meters_of(bench))
    if not np.any(setup.fitted):
        raise CalibrationError(
            f"{plan.name}: the procedure has verification points only, but a calibration needs readings in "
            "installations of known orientation; choose another procedure"
        )
    return setup


def meters_of(bench: BenchFile) -> tuple[int, int, int]:
    """Return the numbers of the voltmeters that read x, y and z."""
    of = {
        channel: number
        for number, meter in enumerate(bench.instruments.voltmeters)
        for channel in meter.channels
    }
    return of["x"], of["y"], of["z"]


def estimator_map(
    estimator: str, setup: Setup, stated: Mapping[str, float], known: KnownStand | None = None
) -> Floats:
    """Return an estimator's linear map (12, n, 3) from readings to coefficients; zero at verification points.

    Generalised least squares weighs the readings by the standard uncertainties (rad, V) of stand errors, by name in
    `stated`; prior knowledge from other runs, `known`, replaces these. For an iterative estimator, the result is
    the map of its last step, for readings without outliers. Raises `CalibrationError` for an unknown estimator, and
    for readings that do not determine the coefficients or do not suit the closed form.
    """
    by = in_a_budget(estimator)
    require_rank(setup.force[setup.fitted])
    stand_u = {name: stated.get(name, 0.0) for name in STAND_ANGLES}
    if known is not None:
        # a known mean is subtracted from the readings: what remains has mean zero
        known = replace(known, mean=np.zeros_like(known.mean))
    problem = make_problem(setup.model, setup.conditions.select(setup.fitted), stand_u, known=known)
    whole = np.zeros((FIXED, len(setup.conditions), 3))
    if by.gain is not None:
        whole[:, setup.fitted] = by.gain(problem, setup.readings())
    else:
        whole[:, setup.fitted] = by.weigh(_task(problem, setup, stated, known)).gain[:FIXED]
    return whole


def _task(
    problem: Problem, setup: Setup, stated: Mapping[str, float], known: KnownStand | None
) -> WeightingTask:
    """Return an estimator's input for exact readings of `setup`, with noise `known` or `stated`.

    `fit` has the linear map of the last step of a fit to real readings.
    """
    signal = setup.signal[setup.fitted]
    floor = gls.LEAST_NOISE * float(np.max(np.abs(signal)))
    reading, setting = max(stated.get("voltmeter_error", 0.0), floor), stated.get("setting_error", 0.0)
    noise = Noise(reading, setting, np.inf, "given")
    if known is not None and known.noise is not None:
        noise = known.noise.given()
    fit = partial(gls.fit, problem, signal, setup.block, noise)
    return WeightingTask(problem, signal, fit(), lambda shifts: fit(shifts=shifts))


@dataclass(frozen=True)
class Influence:
    """The effect of one kind of error on the signals of n readings.

    `pattern` (n, 3) is in V per unit of the error. Entries with the same number in `group` (n, 3), from 0 to
    `draws` - 1, share one random draw.
    """

    pattern: Floats
    group: Ints
    draws: int

    @classmethod
    def of(cls, pattern: Floats, group: Ints) -> Influence:
        """Return the influence of a pattern (n, 3); readings with equal labels in `group` share one draw.

        `group` broadcasts to the shape of the pattern.
        """
        labels, numbers = np.unique(np.broadcast_to(group, pattern.shape), return_inverse=True)
        return cls(pattern, numbers.reshape(pattern.shape), len(labels))

    def through(self, functionals: Floats) -> Floats:
        """Return the change (m, draws) of m linear functionals (m, n, 3) of the readings, per unit of each draw."""
        m = len(functionals)
        flat: Floats = (functionals * self.pattern).reshape(m, -1)
        group = self.group.ravel()
        if self.draws == flat.shape[1] and np.array_equal(group, np.arange(self.draws)):
            return flat
        shared = np.zeros((flat.shape[1], self.draws))
        shared[np.arange(len(group)), group] = 1.0
        return flat @ shared

    def on_readings(self, drawn: Floats) -> Floats:
        """Return the errors (…, n, 3) of the readings for drawn errors (…, draws)."""
        return drawn[..., self.group] * self.pattern


@dataclass(frozen=True)
class MeasuredReadings:
    """Measured readings on which errors act; `block` converts their signals to forces.

    `calibrated_c` is the block's temperature, °C, at the calibration that gave the coefficients. It is None if it
    is unknown, or if that calibration used all these readings.
    """

    readings: Readings
    block: Block
    meters: tuple[int, int, int]
    setting_slope: Floats
    calibrated_c: float | None = None

    @cached_property
    def conditions(self) -> Conditions:
        """Mounting, angle, time and temperature of each reading."""
        return self.readings.conditions()

    @property
    def calibrated_k(self) -> float:
        """The temperature for which the coefficients hold, minus the reference temperature, K."""
        own = self.conditions
        return (
            float(own.warmth_k.mean()) if self.calibrated_c is None else self.calibrated_c - own.reference_c
        )

    @property
    def signal(self) -> Floats:
        """The signals, (n, 3), in the unit of the readings."""
        return self.readings.signal

    @cached_property
    def force(self) -> Floats:
        """The specific forces, g, (n, 3)."""
        return self.block.specific_force(self.readings.signal)

    @cached_property
    def orientation(self) -> Ints:
        """Orientation number of each reading, shape (n,).

        It is equal for readings with nearly equal specific forces, also in different installations. Each reading
        without an orientation has a number of its own.
        """
        alone = np.isin(self.readings.installation, list(UNORIENTED))
        found = np.where(alone, np.arange(len(alone)), -1)
        for first in np.flatnonzero(~alone):
            if found[first] < 0:
                near = np.max(np.abs(self.force - self.force[first]), axis=1) <= _SAME_READ_FORCE_G
                found[(found < 0) & near] = found[first] = first
        return found


AnyReadings = Setup | MeasuredReadings
"""The n readings on which error patterns act."""

_Patterns = Sequence[tuple[Floats, Ints]]
"""Patterns (n, 3), V per unit of a source, each with its labels of shared draws as in `Influence.of`."""

_SAME_ANGLE_RAD: Final = math.radians(0.05)
"""Settings at most this far apart share the error of one angle of the head."""

_EVERYTHING: Final = np.zeros((1, 1), dtype=np.int64)


def influences(source: ErrorSource, setup: AnyReadings) -> tuple[Influence, ...]:
    """Return the independent influences of a source on the readings, for an error of one unit.

    Stand angles and effects have influences on a `Setup` only: a fit to measured readings estimates them.
    """
    if isinstance(setup, Setup) and source.effect is not None:
        column = setup.effect_problem.effects.index(source.effect)
        patterns: _Patterns = [(setup.effect_columns[:, :, column], _EVERYTHING)]
    elif isinstance(setup, Setup) and (source.name in STAND_ANGLES or source.angles):
        clamped = setup.conditions.clamped
        alike = clamped if source.root is None else np.arange(len(clamped))
        mount = alike[setup.conditions.mount][:, None]
        patterns = [(setup.stand_slope(name), mount) for name in source.angles or (source.name,)]
    elif isinstance(setup, Setup) and source.name == FOUNDATION:
        tilts = tilt_patterns(setup.conditions, setup.block, setup.setting_slope, setup.model.installations)
        patterns = [(tilt, _EVERYTHING) for tilt in tilts]
    else:
        patterns = _PATTERNS[source.kind](source, setup)
    return tuple(Influence.of(pattern, group) for pattern, group in patterns)


def _linearity(source: ErrorSource, setup: AnyReadings) -> _Patterns:
    # equal voltages have equal errors, so that repeats do not average them; each channel has its own voltages
    return [(np.ones_like(setup.signal) * source.on_channels, 3 * setup.orientation[:, None] + np.arange(3))]


def _same_angle(setup: AnyReadings) -> Ints:
    """Return a number for each reading (n,) that is equal for equal angles on the head's scale."""
    angle_rad = np.mod(setup.conditions.angle_rad + _SAME_ANGLE_RAD, math.tau)
    order = np.argsort(angle_rad, kind="stable")
    numbers = np.empty(len(order), dtype=np.int64)
    numbers[order] = np.concatenate([[0], np.cumsum(np.diff(angle_rad[order]) > _SAME_ANGLE_RAD)])
    return numbers


def _temperature(source: ErrorSource, seen: AnyReadings) -> _Patterns:
    return _unknown_and_recorded(source, seen, seen.conditions.warmth_k - seen.calibrated_k)


def _room(source: ErrorSource, seen: AnyReadings) -> _Patterns:
    """Return the patterns of meter gains that follow the temperature of the room with a lag.

    Without a recorded temperature, the patterns are the principal components of an unknown temperature within its
    limits.
    """
    conditions, factors, on = seen.conditions, source.factors or {}, source.on_channels
    if conditions.meter_c is not None and source.u > 0:
        behind = lagged(conditions.meter_warmth_k, conditions.elapsed_s, source.correlation_s)
        courses = [(behind - behind.mean()) / source.u]
    else:
        courses = list(unknown_courses(conditions.elapsed_s, source.correlation_s).T)
    gain, meters = factors["scale"] * seen.signal * on, np.array(seen.meters)
    return [(gain * course[:, None], meters[None, :]) for course in courses]


def _unread(source: ErrorSource, seen: AnyReadings) -> _Patterns:
    """Return the patterns of an effect of the meters' temperature, for readings without this temperature.

    With a recorded temperature the patterns are zero: the model corrects the readings.
    """
    factors = source.factors or {}
    gain, offset = (np.array([factors[f"{of} {c}"] for c in CHANNELS]) for of in ("gain", "offset"))
    added = (gain * seen.signal + offset) * (seen.conditions.meter_c is None)
    courses = unknown_courses(seen.conditions.elapsed_s, source.correlation_s)
    return [(added * course[:, None], np.array(seen.meters)[None, :]) for course in courses.T]


def _reference(source: ErrorSource, seen: AnyReadings) -> _Patterns:
    # the mean over the run is an error of the gain, which "voltmeter_gain" contains
    on = seen.signal * source.on_channels
    waves = flicker_waves(seen.conditions.elapsed_s)
    return [(on * wave[:, None], np.array(seen.meters)[None, :]) for wave in waves.T]


def _supply(source: ErrorSource, seen: AnyReadings) -> _Patterns:
    rail, above_v = int((source.factors or {})["rail"]) - 1, seen.conditions.above_nominal_v
    recorded = above_v[:, rail] if rail < above_v.shape[1] else np.zeros(len(above_v))
    return _unknown_and_recorded(source, seen, recorded - recorded.mean())


def _unknown_and_recorded(source: ErrorSource, seen: AnyReadings, known: Floats) -> _Patterns:
    """Return the patterns of two variations in time: an unknown one within limits, and the `known` one (n,)."""
    courses = list(unknown_courses(seen.conditions.elapsed_s, source.correlation_s).T)
    if source.u > 0 and np.any(known):
        courses.append(known / source.u)
    return [pattern for course in courses for pattern in _warmed(source, seen, course)]


def _turn_on(source: ErrorSource, seen: AnyReadings) -> _Patterns:
    # constant throughout a run: the biases change each time the block is switched on
    return [
        (
            np.broadcast_to(np.diag(seen.block.K) * source.on_channels, seen.signal.shape),
            np.arange(3)[None, :],
        )
    ]


def _warmed(source: ErrorSource, seen: AnyReadings, course: Floats) -> _Patterns:
    # the signs of the coefficients are unknown, so bias and scale of each channel are independent
    factors = source.factors or {}
    group = np.arange(3)[None, :]
    sensed = seen.force @ seen.block.K.T
    sensed = sensed * source.on_channels
    bias = np.broadcast_to(np.diag(seen.block.K) * source.on_channels, sensed.shape)
    return [(factors[of] * acts * course[:, None], group) for of, acts in (("bias", bias), ("scale", sensed))]


HARDLY_ANY: Final = 1e-3
"""Principal components with less than this fraction of the total variance are left out."""


def unknown_courses(time_s: Floats, correlation_s: float) -> Floats:
    """Return the q principal components (n, q) of a stationary process of unit variance at times (n,).

    With an infinite correlation time the process is a constant, which averaging over passes does not reduce.
    A constant is assumed for limits that do not state how a quantity varies within them (GUM, 4.3.7).
    """
    if math.isinf(correlation_s):
        return np.ones((len(time_s), 1))
    apart = np.abs(time_s[:, None] - time_s)
    size, shapes = np.linalg.eigh(np.exp(-apart / correlation_s))
    kept = size > HARDLY_ANY * size.sum()
    return np.asarray(shapes[:, kept] * np.sqrt(size[kept]))


def _power(exponent: int) -> Callable[[ErrorSource, AnyReadings], _Patterns]:
    def act(source: ErrorSource, setup: AnyReadings) -> _Patterns:
        factor = np.diag(setup.block.K) * source.on_channels
        return [(factor * setup.force**exponent, np.arange(3)[None, :])]

    return act


_PATTERNS: Final[Mapping[str, Callable[[ErrorSource, AnyReadings], _Patterns]]] = {
    "voltmeter_error": lambda own, s: [
        (np.ones_like(s.signal) * own.on_channels, np.arange(s.signal.size).reshape(-1, 3))
    ],
    "setting_error": lambda _, s: [(s.setting_slope, np.arange(len(s.conditions))[:, None])],
    "voltmeter_gain": lambda own, s: [(s.signal * own.on_channels, np.array(s.meters)[None, :])],
    "voltmeter_offset": lambda own, s: [
        (np.ones_like(s.signal) * own.on_channels, np.array(s.meters)[None, :])
    ],
    "head_table": lambda _, s: [(s.setting_slope, _same_angle(s)[:, None])],
    "voltmeter_linearity": _linearity,
    "gravity": lambda _, s: [(s.force @ s.block.K.T, _EVERYTHING)],
    "temperature": _temperature,
    "room_temperature": _room,
    "meter_temperature": _unread,
    "reference_noise": _reference,
    "thermometer": lambda own, s: _warmed(own, s, np.ones(len(s.signal))),
    "supply_voltage": _supply,
    "turn_on": _turn_on,
    "K2": _power(2),
    "K3": _power(3),
}


@dataclass(frozen=True)
class Contribution:
    """The contribution of one error source to the uncertainty of the 12 coefficients.

    `parts` (12, q) has a column for each of q independent errors of the source: the change of the coefficients if
    that error equals its standard uncertainty. The columns are uncorrelated: their squares add up to the variances.
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
    """The uncertainty budget of an estimator for the n readings of a setup.

    `gain` (12, n, 3) is the estimator's linear map.
    """

    estimator: str
    setup: Setup
    gain: Floats
    contributions: tuple[Contribution, ...]

    @cached_property
    def combined(self) -> Propagated:
        """The coefficients with their joint covariance and effective degrees of freedom."""
        return self._sum(self.contributions)

    def of_group(self, group: str) -> Propagated:
        """Return the coefficients with the uncertainty of one group of sources, such as "stand"."""
        return self._sum([c for c in self.contributions if c.source.group == group])

    @property
    def per_local_g(self) -> Propagated:
        """The coefficients per local g, without the uncertainty of gravity, as `bench calibrate` gives them."""
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
    known: KnownStand | None = None,
) -> Budget:
    """Return the uncertainty budget of the estimator named `estimator`.

    The estimator weighs the readings by the standard uncertainties `stated` (rad, V), by default those of
    `sources`. Prior knowledge `known` from other runs replaces these. Raises the `CalibrationError` of
    `estimator_map`.
    """
    if stated is None:
        stated = {source.name: source.u for source in sources if source.name in STAND_ERRORS}
    gain = estimator_map(estimator, setup, stated, known)
    contributions = tuple(Contribution(source, parts_of(source, setup, gain)) for source in sources)
    return Budget(estimator, setup, gain, contributions)


def parts_of(source: ErrorSource, setup: AnyReadings, functionals: Floats) -> Floats:
    """Return the changes (m, q) of m linear functionals (m, n, 3) of the n readings due to a source.

    Column j is the change if draw j of the source equals one standard uncertainty.
    """
    parts = [influence.through(functionals) for influence in influences(source, setup)]
    return source.acting(np.concatenate(parts, axis=1))
