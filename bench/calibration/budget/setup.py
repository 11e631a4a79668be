"""The readings that a budget is about, and the estimators as linear maps from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Ints, Mask
from bench.calibration import gls
from bench.calibration.assumptions import require_rank
from bench.calibration.design import FIXED, STEP_RAD, Problem, make_problem
from bench.calibration.estimator import Task
from bench.calibration.estimators import in_a_budget
from bench.calibration.known import KnownStand
from bench.calibration.result import CalibrationError, Noise
from bench.config.bench_file.file import BenchFile
from bench.config.procedure.plan import Plan, Read, SetTemperature
from bench.model.conditions import Conditions
from bench.model.forward import ForwardModel
from bench.model.geometry import STAND_ANGLES, Block
from bench.readings.table import UNORIENTED, VERIFICATION, Readings, make_readings

_SAME_FORCE_G: Final = 1e-6


@dataclass(frozen=True)
class Setup:
    """Readings, planned or taken, with the block and the model that they are of.

    `conditions` hold n readings, the verification points among them; `meters` numbers the voltmeter of each
    of the channels x, y, z: channels with the same number share one.
    """

    model: ForwardModel
    conditions: Conditions
    block: Block
    meters: tuple[int, int, int] = (0, 1, 2)

    @cached_property
    def verification(self) -> Mask:
        """Which readings are verification points, shape (n,)."""
        of = np.array([mount.installation == VERIFICATION for mount in self.conditions.mounts])
        return np.asarray(of[self.conditions.mount])

    @property
    def fitted(self) -> Mask:
        """Which readings the estimator uses, shape (n,)."""
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
        """du/dphi, V/rad, shape (n, 3)."""
        return self._slope(lambda step: (self._angles(), step))

    def stand_slope(self, name: str) -> Floats:
        """Return the derivatives of the readings by a stand angle of their mounting, V/rad, shape (n, 3)."""
        if name not in self._stand_slopes:
            self._stand_slopes[name] = self._slope(lambda step: (self._angles(name, step), 0.0))
        return self._stand_slopes[name]

    @cached_property
    def _stand_slopes(self) -> dict[str, Floats]:
        """Those that were asked for: a requirement goes through hundreds of budgets of one setup."""
        return {}

    def _slope(self, errors: Callable[[float], tuple[Floats, float]]) -> Floats:
        up, down = (
            self.model.readings(self.block, self.conditions, *errors(step)) for step in (STEP_RAD, -STEP_RAD)
        )
        return (up - down) / (2 * STEP_RAD)

    @cached_property
    def orientation(self) -> Ints:
        """A number for each reading, shape (n,): the same where the specific force is the same."""
        rounded = np.round(self.force / _SAME_FORCE_G) + 0.0
        _, numbers = np.unique(rounded, axis=0, return_inverse=True)
        return numbers.ravel()

    @cached_property
    def effect_problem(self) -> Problem:
        """The problem whose only unknowns beside the coefficients are the parameters of effects."""
        return make_problem(self.model, self.conditions, {})

    @cached_property
    def effect_columns(self) -> Floats:
        """Derivatives of the readings by the parameters of effects, V per SI, shape (n, 3, q)."""
        problem = self.effect_problem
        return problem.jacobian(self.block, problem.prior_mean)[:, :, FIXED:]

    def _angles(self, name: str | None = None, size_rad: float = 0.0) -> Floats:
        angles = np.zeros((len(self.conditions.mounts), len(STAND_ANGLES)))
        if name is not None:
            angles[:, STAND_ANGLES.index(name)] = size_rad
        return angles

    def readings(self) -> Readings:
        """Return the readings to fit as a table without noise, in the order of `conditions`."""
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
    """Return the conditions of the readings of a plan whose orientation is known, in order.

    Times are those that the plan expects, a temperature is that of the chamber's last demand.
    """
    rows: list[tuple[Read, float, float]] = []
    time_s, temperature_c = 0.0, float("nan")
    for step in plan.steps:
        time_s += plan.step_duration_s(step, line_hz)
        if isinstance(step, SetTemperature):
            temperature_c = step.target_c
        elif isinstance(step, Read) and step.target_rad is not None and step.installation not in UNORIENTED:
            rows.append((step, time_s, temperature_c))
    if not rows:
        raise CalibrationError(
            f"{plan.name}: has no reading at a known angle of the head; take another procedure"
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
    )


def make_setup(
    plan: Plan, bench: BenchFile, model: ForwardModel | None = None, block: Block | None = None
) -> Setup:
    """Set up the budget of a plan on a bench: about `block`, else the block that the bench file states.

    Raises `CalibrationError` when the plan has an installation that the bench lacks, or no reading to fit.
    """
    conditions = planned_conditions(plan, bench.line_frequency)
    chain = ForwardModel(bench.installation_models()) if model is None else model
    strange = sorted({m.installation for m in conditions.mounts} - set(chain.installations))
    if strange:
        raise CalibrationError(
            f"{plan.name}: the bench file has no installation {', '.join(strange)} "
            f"(it has {', '.join(chain.installations)}); state it there"
        )
    about = bench.simulated_block() if block is None else block
    setup = Setup(chain, conditions, about, meters_of([m.channels for m in bench.instruments.voltmeters]))
    if not np.any(setup.fitted):
        raise CalibrationError(
            f"{plan.name}: has verification points only; a calibration needs installations"
        )
    return setup


def meters_of(channels: Sequence[Sequence[str]]) -> tuple[int, int, int]:
    """Return the number of the voltmeter of x, y and z, from the channels that each voltmeter carries."""
    of = {channel: number for number, meter in enumerate(channels) for channel in meter}
    return of["x"], of["y"], of["z"]


def gain(
    estimator: str, setup: Setup, stated: Mapping[str, float], known: KnownStand | None = None
) -> Floats:
    """Return the map from readings to the 12 coefficients, shape (12, n, 3); zero at verification points.

    `stated` are the standard uncertainties of the stand errors by name (rad, V), from which generalised least
    squares weighs the readings, `known` what was learned in their place.
    An estimator that no fixed weighting is has the map at which it comes to rest
    where nothing is an outlier. Raises `CalibrationError` for another estimator, or when the readings do not
    determine the coefficients or are not those that the closed form knows.
    """
    by = in_a_budget(estimator)
    require_rank(setup.force[setup.fitted])
    stand_u = {name: stated.get(name, 0.0) for name in STAND_ANGLES}
    if known is not None:
        # a mean that is known is taken away: what is left of it lies about nothing
        known = replace(known, mean=np.zeros_like(known.mean))
    problem = make_problem(setup.model, setup.conditions.select(setup.fitted), stand_u, known=known)
    whole = np.zeros((FIXED, len(setup.conditions), 3))
    if by.gain is not None:
        whole[:, setup.fitted] = by.gain(problem, setup.readings())
    else:
        whole[:, setup.fitted] = by.weigh(_task(problem, setup, stated, known)).gain[:FIXED]
    return whole


def _task(problem: Problem, setup: Setup, stated: Mapping[str, float], known: KnownStand | None) -> Task:
    """The first step from the truth of noise-free readings has the gain of the last one from real readings."""
    signal = setup.signal[setup.fitted]
    floor = gls.LEAST_NOISE * float(np.max(np.abs(signal)))
    reading, setting = max(stated.get("voltmeter_error", 0.0), floor), stated.get("setting_error", 0.0)
    noise = Noise(reading, setting, np.inf, "given")
    if known is not None and known.noise is not None:
        noise = known.noise.given()
    fit = partial(gls.fit, problem, signal, setup.block, noise)
    return Task(problem, signal, fit(), lambda shifts: fit(shifts=shifts))
