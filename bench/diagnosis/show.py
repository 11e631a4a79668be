"""Simulations of the bench with the models before and after a diagnosis, tested against the readings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.base.languages import message
from bench.calibration import Calibration, LackOfFit, calibrate, gls
from bench.calibration.calibrate import Posed, first_guess, pose, solve
from bench.calibration.design import FIXED, Problem
from bench.calibration.free import modulus_columns
from bench.calibration.mistakes import naming_deviating
from bench.calibration.noise import repeat_groups, whiten
from bench.diagnosis.levels import HARDLY_EVER, MOSTLY, NEGLIGIBLE
from bench.model import STAND_ANGLES, AppliedEffect, ForwardModel
from bench.model.forward import Stages
from bench.model.geometry import COEFFICIENTS
from bench.readings.table import VERIFICATION, Readings

SEED: Final = 1
"""Seed of the noise of the simulated readings."""


@dataclass(frozen=True)
class ModulusPoint:
    """The error of the modulus |a| at a verification point, `delta_g`, with its u, both in g."""

    angle_deg: float
    pass_number: int
    point: int
    delta_g: float
    u: float
    series: int = 1


@dataclass(frozen=True)
class Simulation:
    """A model fitted to readings, and the bench simulated with it at the same settings.

    `calibration` has the estimates; `effects` are those of the model, with values and u estimated here.
    `test` compares the readings with a simulation without noise. `points` are the errors at verification
    points. The fit includes these points (`joined`) only if they determine an effect that the others hardly
    determine; otherwise they are independent of it. `repeat` computes `repeated`.
    """

    model: ForwardModel
    calibration: Calibration
    test: LackOfFit
    effects: tuple[AppliedEffect, ...]
    points: tuple[ModulusPoint, ...]
    joined: bool
    repeat: Callable[[], Calibration]

    @cached_property
    def repeated(self) -> Calibration:
        """The calibration of one simulation with noise (seed `SEED`)."""
        return self.repeat()

    @property
    def tested(self) -> bool:
        """Whether there are enough repeats for a test of the fit."""
        return bool(np.isfinite(self.test.p))

    @property
    def worst_g(self) -> float | None:
        """The largest absolute error of the modulus at a verification point, g; None if there is none."""
        return max((abs(p.delta_g) for p in self.points if np.isfinite(p.delta_g)), default=None)


@dataclass(frozen=True)
class CoefficientChange:
    """A coefficient and its u, `before` with the given model and `after` with the effects found.

    `u_after` includes the change if effects that the readings do not exclude are present instead.
    """

    before: float
    u_before: float
    after: float
    u_after: float

    @property
    def in_u(self) -> float:
        """The change of the coefficient in units of `u_before`; 0 if that is 0."""
        return (self.after - self.before) / self.u_before if self.u_before else 0.0


@dataclass(frozen=True)
class ModelComparison:
    """Simulations with the given model (`before`), and with the effects found (`after`; None if there are none)."""

    before: Simulation
    after: Simulation | None

    @property
    def last(self) -> Simulation:
        """The simulation with the effects found, or that with the given model if no effect was added."""
        return self.after or self.before

    @property
    def coefficients(self) -> dict[str, CoefficientChange]:
        """The change of each of the twelve coefficients, by name."""
        before, after = self.before.calibration, self.last.calibration
        columns = np.stack([before.block.vector, before.u, after.block.vector, after.u], axis=1).tolist()
        return {name: CoefficientChange(*row) for name, row in zip(COEFFICIENTS, columns, strict=True)}


def show(
    readings: Readings,
    model: ForwardModel,
    added: tuple[AppliedEffect, ...],
    stand_u: Mapping[str, float],
    g_m_s2: float,
    in_part: tuple[AppliedEffect, ...] = (),
    slow: Floats | None = None,
    by_ties: Floats | None = None,
) -> ModelComparison:
    """Return simulations of the bench with the model, and with the effects `added` to it.

    `stand_u` is as in `diagnose`; `g_m_s2` is local gravity, m/s². The effects `added` are estimated again without
    their u as priors; sizes that they lack are 0 with their plausible size as prior u. `in_part`, their possible
    parts of other shapes, keep their u as priors. `slow` (n, 3, k) are signals of one standard deviation of slow
    noise; the u of the coefficients includes them, unless the calibration finds a drift itself. The u with the
    effects includes `by_ties` (k, 12), the result of `shifts_by_ties`. Raises `CalibrationError` if the readings do
    not determine the coefficients.
    """
    stand = {name: u for name, u in stand_u.items() if name != "setting_error"}
    before = _simulate(readings, model, stand, g_m_s2, slow, None)
    if not added:
        return ModelComparison(before, None)
    fresh = tuple(replace(one, u=dict(_lacking(one))) for one in added)
    names = " + ".join(dict.fromkeys(label(one) for one in added))
    extended = replace(model, effects=(*model.effects, *fresh, *in_part), name=f"{model.name} + {names}")
    return ModelComparison(before, _simulate(readings, extended, stand, g_m_s2, slow, by_ties))


def _lacking(found: AppliedEffect) -> Iterator[tuple[str, Floats]]:
    """Yield name and plausible size, SI, of each size that an effect found by the diagnosis lacks."""
    for p in found.effect.parameters:
        if p.is_size and p.name not in found.values:
            yield p.name, np.full(3 if p.per_channel else (), p.plausible)


def label(applied: AppliedEffect) -> str:
    """Return the name of an effect, with its channels if its values differ: "quadratic_nonlinearity[y]"."""
    of_channels = any(parameter.per_channel for parameter in applied.effect.parameters)
    return applied.effect.name + (f"[{''.join(applied.channels)}]" if of_channels else "")


def contradicted(stated: Sequence[AppliedEffect], estimated: Sequence[AppliedEffect]) -> Iterator[str]:
    """Yield a sentence for each value `stated` by a model that its new estimate contradicts, at `HARDLY_EVER`.

    `estimated` are the same effects, estimated again. The variance of each difference is the difference of the two
    variances.
    """
    for one, now in zip(stated, estimated, strict=True):
        for parameter in one.effect.parameters:
            if parameter.name not in one.u:
                continue
            value, u, new, u_new = (
                np.atleast_1d(source[parameter.name]) / parameter.si_per_unit
                for source in (one.values, one.u, now.values, now.u)
            )
            for i in np.flatnonzero((u > 0.0) & (u_new < u)):
                pull = abs(new[i] - value[i]) / np.sqrt(u[i] ** 2 - u_new[i] ** 2)
                if special.erfc(pull / np.sqrt(2.0)) < HARDLY_EVER:
                    of = f" of {CHANNELS[i]}" if parameter.per_channel else ""
                    yield message(
                        f"the model states {parameter.name}{of} of {one.effect.name} as {value[i]:.3g} with "
                        f"u {u[i]:.2g} {parameter.unit}; these readings contradict it by {pull:.1f} u: "
                        "diagnose them without this model"
                    )


def _simulate(
    readings: Readings,
    model: ForwardModel,
    stand_u: Mapping[str, float],
    g_m_s2: float,
    slow: Floats | None,
    by_ties: Floats | None,
) -> Simulation:
    posed, fit = _fitted(readings, model, stand_u, join_verification=False)
    joined, untold = False, _hardly_told(posed.problem, fit)
    if untold.any() and len(readings.verification()):
        with_points = _fitted(readings, model, stand_u, join_verification=True)
        joined = bool(np.any(untold & ~_hardly_told(with_points[0].problem, with_points[1])))
        posed, fit = with_points if joined else (posed, fit)
    problem, rows = posed.problem, posed.rows
    effects = tuple(
        replace(applied, u=_u_of(index, problem, fit))
        for index, applied in enumerate(problem.effects_at(fit.others))
    )
    bench = replace(model, effects=effects)
    stand = problem.stand_matrix(fit.others)
    still = bench.readings(fit.block, problem.conditions, stand)
    noisy = replace(rows, signal=_noisy(bench, problem, fit, stand))
    weak = replace(model, effects=tuple(replace(a, u={}) for a in effects))
    calibration = solve(posed, g_m_s2)
    more = np.zeros((FIXED, FIXED)) if by_ties is None else by_ties.T @ by_ties
    if slow is not None and calibration.drift is None:
        moved = np.einsum("pnc,nck->pk", calibration.gain, slow)
        more = more + moved @ moved.T
    calibration = replace(
        calibration,
        covariance=calibration.covariance + more,
        covariance_readings=calibration.covariance_readings + more,
    )
    return Simulation(
        model=bench,
        calibration=calibration,
        test=_test(problem, fit, rows.signal - still),
        effects=effects,
        points=_points(readings, problem, fit),
        joined=joined,
        # the simulated noise is independent in every reading, so repeats share no error
        repeat=partial(calibrate, noisy, weak, stand_u, g_m_s2, find_shared=False),
    )


def _fitted(
    readings: Readings, model: ForwardModel, stand_u: Mapping[str, float], *, join_verification: bool
) -> tuple[Posed, gls.Fit]:
    """Fit the problem of `calibrate`, and keep all estimates with their joint covariance."""
    posed = pose(readings, model, stand_u, join_verification=join_verification)
    signal, resolution = posed.rows.signal, posed.rows.resolution
    with naming_deviating(posed.problem, posed.rows):
        start = first_guess(posed.problem, signal, resolution)
        # one noise size for all channels, as in the null model and the thresholds of a diagnosis
        return posed, gls.fit(posed.problem, signal, start, None, resolution, one_size=True)


def _hardly_told(problem: Problem, fit: gls.Fit) -> Mask:
    """Return the mask of the parameters without a stated value whose prior u the fit hardly reduces."""
    u = np.sqrt(np.diag(fit.covariance))[FIXED + len(problem.stand) :]
    told = [
        unknown.stated or own <= MOSTLY * unknown.prior_u
        for own, unknown in zip(u, problem.effects, strict=True)
    ]
    return ~np.array(told, dtype=np.bool_)


def _u_of(index: int, problem: Problem, fit: gls.Fit) -> dict[str, Floats]:
    u: dict[str, Floats] = {}
    sizes = np.sqrt(np.diag(fit.covariance))[FIXED + len(problem.stand) :]
    for unknown, size in zip(problem.effects, sizes, strict=True):
        if unknown.effect == index:
            of = u.setdefault(unknown.parameter, np.zeros(() if unknown.channel is None else 3))
            of[() if unknown.channel is None else unknown.channel] = size
    return u


def _noisy(bench: ForwardModel, problem: Problem, fit: gls.Fit, stand: Floats) -> Floats:
    """Return simulated readings (n, 3) with noise and setting errors as large as those found."""
    rng = np.random.default_rng(SEED)
    n = len(problem.conditions)
    setting = fit.noise.setting_rad * rng.standard_normal(n)
    signal = bench.readings(fit.block, problem.conditions, stand, setting)
    return signal + fit.noise.by_channel * rng.standard_normal((n, 3))


def _test(problem: Problem, fit: gls.Fit, left: Floats) -> LackOfFit:
    """Compare `left` (n, 3), readings minus simulation, with the scatter of repeats."""
    slope = problem.slope(fit.block, fit.others)
    pulls = problem.pulls(fit.others)
    misfit = float(np.sum(whiten(left[:, :, None], slope, fit.noise) ** 2) + np.sum(pulls**2))
    unknowns = FIXED + gls.sizes_told(problem, fit)
    return gls.misfit_test(misfit, left, slope, fit.noise, repeat_groups(problem.conditions), unknowns)


# --- verification points ----------------------------------------------------------------------------


def _points(readings: Readings, problem: Problem, fit: gls.Fit) -> tuple[ModulusPoint, ...]:
    """Return |a| - 1 at the verification points with the effects; u includes that of all estimates."""
    chosen = readings.installation == VERIFICATION
    rows = readings.select(chosen)
    if not len(rows):
        return ()
    block, model = fit.block, replace(problem.model, effects=problem.effects_at(fit.others))
    conditions = readings.conditions()
    stand = np.zeros((len(conditions.mounts), len(STAND_ANGLES)))
    # if the force is unknown, the input voltage is that read: effects may depend on earlier rows
    unknown = ~np.isin(readings.installation, [VERIFICATION, *model.installations])
    voltage_v = np.where(unknown[:, None], readings.signal, np.nan)

    def at(acting: Floats) -> Stages:
        whole = np.full((len(readings), 3), np.nan)
        whole[chosen] = acting
        return Stages(model, block, conditions, stand, force=whole, voltage_v=voltage_v)

    force = block.specific_force(rows.signal)
    for _ in range(gls.MOST_ITERATIONS if model.effects else 0):
        step = np.linalg.solve(block.K, (rows.signal - at(force).readings[chosen]).T).T
        force = force + step
        if np.max(np.abs(step)) < NEGLIGIBLE:
            break
    size = np.linalg.norm(force, axis=1)
    columns = modulus_columns(problem, block, fit.others, at, force, chosen)
    by_signal = (force / size[:, None]) @ np.linalg.inv(block.K)
    variance = np.einsum("mp,pq,mq->m", columns, fit.covariance, columns)
    variance += np.sum((by_signal * fit.noise.by_channel) ** 2, axis=1)
    return tuple(
        ModulusPoint(
            float(np.degrees(angle)), int(number), int(point), float(g - 1.0), float(np.sqrt(v)), int(series)
        )
        for angle, number, point, series, g, v in zip(
            rows.angle_rad, rows.pass_number, rows.point, rows.series, size, variance, strict=True
        )
    )
