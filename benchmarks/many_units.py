"""Many units measured at the same settings, calibrated at once: the default estimator, vectorised.

The steps are those of `gls.fit` for a model without effects; only the derivatives by the stand's angles are
evaluated at zero angles for all units. This changes the iterations, but not the solution.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Ints, unit_vectors
from bench.calibration import gls, mistakes
from bench.calibration.design import FIXED, Problem, make_problem
from bench.calibration.noise import LEAST_REPEATS, KnownNoise, KnownStand, repeat_groups, setting_limits
from bench.calibration.observability import require_rank
from bench.calibration.result import CalibrationError, Noise
from bench.model.conditions import Conditions
from bench.model.forward import ForwardModel
from bench.model.geometry import Block, linear_columns, specific_force_on_platform
from bench.stats.repeats_likelihood import LEAST_DOF, believed_sizes

CHUNK: Final = 200
"""Number of units calibrated in one batch, so that their matrices stay in the processor's cache."""
STEPS: Final = 2
"""Number of iterations from least squares: the second already changes less than a thousandth of u."""


@dataclass(frozen=True)
class Batch:
    """The results of the calibrations of many units.

    `coefficients` (units, 12) and `covariance` (units, 12, 12) in the order of `COEFFICIENTS`, per local g;
    `stand` (units, q) the estimates of the stand's angles, rad, named by `stand_names`; `reading` (units, 3) of
    the channels and `setting_rad` (units,) the sizes of the noise, `dof` their degrees of freedom.
    """

    coefficients: Floats
    covariance: Floats
    stand: Floats
    stand_names: tuple[str, ...]
    reading: Floats
    setting_rad: Floats
    dof: float

    @property
    def u(self) -> Floats:
        """Standard uncertainties of the coefficients, shape (units, 12)."""
        return np.asarray(np.sqrt(np.einsum("upp->up", self.covariance)))


def calibrate_batch(
    signals: Floats,
    conditions: Conditions,
    model: ForwardModel,
    stand_u: Mapping[str, float],
    noise: Noise | None = None,
    known: KnownStand | None = None,
) -> Batch:
    """Estimate the coefficients of many units from `signals` (units, n, 3) at the same conditions.

    `stand_u` holds the standard uncertainties of the stand's fixed angles by the names in `STAND_ANGLES`, rad;
    every unit has angles of its own. The sizes of the noise are estimated for each unit from its repeats
    unless given; `known` is the knowledge of stand and noise from other runs.
    Raises `CalibrationError` for a model with effects, for signals that are not numbers or are all equal,
    readings that do not determine the coefficients, and too few repeats.
    """
    if model.effects:
        raise CalibrationError(
            "many units at once: a model with effects is not for this; calibrate one by one"
        )
    if signals.ndim != 3 or signals.shape[1:] != (len(conditions), 3):
        raise CalibrationError(
            f"many units at once: signals of shape (units, {len(conditions)}, 3) are expected, not {signals.shape}"
        )
    bad = ~np.isfinite(signals).all(axis=(1, 2)) | (np.ptp(signals, axis=1) == 0).any(axis=1)
    if np.any(bad):
        raise CalibrationError(
            f"unit {int(np.argmax(bad)) + 1} of {len(signals)} has a signal that is not a number, or a channel "
            "that never changes; leave this unit out"
        )
    shared = _Shared.of(make_problem(model, conditions, stand_u, known=known))
    if noise is None and shared.freedom.sum() < LEAST_REPEATS:
        raise CalibrationError(
            f"many units at once: {int(shared.freedom.sum())} repeats tell too little of the noise; give its "
            "sizes, or calibrate one by one"
        )
    parts = [
        _calibrate(shared, signals[first : first + CHUNK], noise, known.noise if known else None)
        for first in range(0, len(signals), CHUNK)
    ]
    coefficients, covariance, stand, reading, setting = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    dof = noise.dof if noise is not None else 3.0 * float(shared.freedom.sum())
    names = tuple(shared.problem.names())
    return Batch(coefficients, covariance, stand, names, reading, setting, dof)


@dataclass(frozen=True)
class _Shared:
    """The data that all units share: the geometry at a stand without errors, and the groups of repeats.

    `force` (n, 3), `by_angle` (n, 3) its derivative by the head's angle, `by_stand` (n, 3, q) by the stand's;
    `means` (groups, n) averages the repeats, `groups` (n,) numbers the group of each reading, and `freedom`
    (groups,) is the number of readings of each group less one.
    """

    problem: Problem
    force: Floats
    by_angle: Floats
    by_stand: Floats
    means: Floats
    groups: Ints
    freedom: Ints

    @classmethod
    def of(cls, problem: Problem) -> _Shared:
        force, by_angle, columns = problem.forces(Block(np.eye(3), np.zeros(3)), problem.prior_mean)
        require_rank(force)
        by_stand = np.zeros((*force.shape, len(problem.stand)))
        for j, unknown in enumerate(problem.stand):
            own = problem.conditions.mount == unknown.mount
            by_stand[own, :, j] = columns[unknown.column][own]
        groups = repeat_groups(problem.conditions)
        count = np.bincount(groups)
        means = (groups[None, :] == np.arange(len(count))[:, None]) / count[:, None]
        return cls(problem, force, by_angle, by_stand, means, groups, count - 1)

    def forces(self, stand: Floats) -> Floats:
        """Return the exact specific forces (units, n, 3) at stand angles (units, q)."""
        conditions, units = self.problem.conditions, len(stand)
        angles = np.zeros((units, len(conditions), 5))
        for j, unknown in enumerate(self.problem.stand):
            angles[:, conditions.mount == unknown.mount, unknown.column] += stand[:, j, None]
        on_platform = specific_force_on_platform(
            np.tile(conditions.angle_rad, units), angles.reshape(-1, angles.shape[2])
        )
        installations = self.problem.model.installations
        turns = np.stack([installations[m.installation].block_from_platform for m in conditions.mounts])
        rows = on_platform.reshape(units, len(conditions), 3)
        return np.asarray(np.einsum("nij,unj->uni", turns[conditions.mount], rows))


def _calibrate(
    shared: _Shared, signals: Floats, noise: Noise | None, known: KnownNoise | None
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    columns = linear_columns(shared.force)
    start = np.einsum("pn,uni->uip", np.linalg.pinv(columns), signals)
    K, U0 = start[:, :, :3], start[:, :, 3]
    _refuse_singular(K)
    stand = np.tile(shared.problem.prior_mean, (len(signals), 1))
    floor = gls.LEAST_NOISE * np.abs(signals).max(axis=(1, 2))
    for _ in range(STEPS):
        force = shared.forces(stand)
        left = signals - force @ np.swapaxes(K, 1, 2) - U0[:, None, :]
        slope = shared.by_angle @ np.swapaxes(K, 1, 2)
        reading, setting, dof = _sizes(shared, left, slope, noise, floor)
        if known is not None and noise is None:
            reading, setting, dof = _joined(known, shared, slope, reading, setting, dof)
        wider, wider_setting = reading * _widening(dof), setting * _widening(dof.mean(axis=1))
        step, covariance = _step(shared, K, force, left, slope, wider, wider_setting, stand)
        K, U0 = K + step[:, :9].reshape(-1, 3, 3), U0 + step[:, 9:FIXED]
        stand = stand + step[:, FIXED:]
    coefficients = np.concatenate([K.reshape(-1, 9), U0], axis=1)
    return coefficients, covariance, stand, reading, setting


def _refuse_singular(K: Floats) -> None:
    """Raise `CalibrationError` for the unit with the most singular K, if `refuse_singular` does."""
    size = np.linalg.svd(unit_vectors(K)[0], compute_uv=False)[:, -1]
    mistakes.refuse_singular(Block(K[int(np.argmin(size))], np.zeros(3)))


def _sizes(
    shared: _Shared, left: Floats, slope: Floats, noise: Noise | None, floor: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return the sizes of the noise from the scatter of repeats, or as given.

    They are those of the channels (units, 3), of the setting (units,), and the channels' degrees of freedom
    (units, 3).
    """
    if noise is not None:
        given = np.tile(noise.by_channel, (len(left), 1)), np.full(len(left), noise.setting_rad)
        return *given, np.full((len(left), 3), noise.reading_dof)
    repeated = shared.freedom > 0
    deviation = left - (shared.means @ left)[:, shared.groups]
    products = np.einsum("uni,unj->unij", deviation, deviation).reshape(len(left), -1, 9)
    by_group = (shared.means > 0).astype(np.float64)[repeated]
    scatter = (by_group @ products).reshape(len(left), -1, 3, 3)
    of = shared.freedom[repeated], (shared.means @ slope)[:, repeated]
    found = believed_sizes(scatter, *of, floor)
    return np.sqrt(found.variances[:, :3]), np.sqrt(found.variances[:, 3]), found.dof


def _joined(
    known: KnownNoise, shared: _Shared, slope: Floats, reading: Floats, setting: Floats, dof: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return the sizes combined with those known from other runs, as a single calibration does."""
    settings = int(shared.freedom.sum())
    slope2 = np.einsum("uni,uni->u", slope, slope) / slope.shape[1]
    reading, setting, dof = reading.copy(), setting.copy(), dof.copy()
    for i, (size, angle, freedom) in enumerate(
        zip(reading.copy(), setting.tolist(), dof.copy(), strict=True)
    ):
        whole = float(np.sqrt(np.mean(size**2)))
        own = Noise(
            whole, angle, 3.0 * settings, "repeats", setting_limits(whole, angle, float(slope2[i]), settings),
            tuple(size.tolist()), tuple(freedom.tolist()),
        )  # fmt: skip
        both = known.joined(own)
        reading[i], setting[i] = both.by_channel, both.setting_rad
        dof[i] = both.channel_dof or freedom
    return reading, setting, dof


def _widening(dof: Floats) -> Floats:
    """Return the factors that widen estimated sizes of the noise, as `result.widening` does."""
    nu = np.maximum(dof, LEAST_DOF)
    return np.where(np.isinf(nu), 1.0, np.sqrt(nu / np.where(np.isinf(nu), 1.0, nu - 2.0)))


def _step(
    shared: _Shared, K: Floats, force: Floats, left: Floats, slope: Floats, reading: Floats, setting: Floats,
    stand: Floats,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Return the change of the unknowns (units, 12 + q) and the covariance of the coefficients (units, 12, 12).

    It solves the normal equations with each channel divided by its noise: R^-1 = I - w d d^T,
    w = sigma_phi^2/(1 + sigma_phi^2 |d|^2).
    """
    units, n = left.shape[:2]
    problem = shared.problem
    q = len(problem.prior_u)
    # the angles as independent parts of unit u of their priors
    root = problem.by_prior(np.eye(q))
    columns = np.zeros((units, n, 3, FIXED + q))
    for channel in range(3):
        columns[:, :, channel, 3 * channel : 3 * channel + 3] = force
        columns[:, :, channel, 9 + channel] = 1.0
    by_stand = (shared.by_stand.transpose(1, 0, 2) @ root).reshape(3, -1)
    columns[:, :, :, FIXED:] = (K @ by_stand).reshape(units, 3, n, q).transpose(0, 2, 1, 3)
    columns, left = columns / reading[:, None, :, None], left / reading[:, None, :]
    slope = slope / reading[:, None, :]
    weight = setting[:, None] ** 2 / (1.0 + setting[:, None] ** 2 * np.einsum("uni,uni->un", slope, slope))
    along = (slope[:, :, None, :] @ columns)[:, :, 0] * np.sqrt(weight)[:, :, None]
    along_left = np.einsum("uni,uni->un", slope, left) * np.sqrt(weight)
    flat = columns.reshape(units, 3 * n, FIXED + q)
    turned, turned_along = np.swapaxes(flat, 1, 2), np.swapaxes(along, 1, 2)
    normal = turned @ flat - turned_along @ along
    right = (turned @ left.reshape(units, 3 * n, 1) - turned_along @ along_left[:, :, None])[:, :, 0]
    places = np.arange(FIXED, FIXED + q)
    normal[:, places, places] += 1.0
    right[:, FIXED:] -= np.linalg.solve(root, (stand - problem.prior_mean).T).T if q else 0.0
    covariance = np.linalg.inv(normal)
    step = (covariance @ right[:, :, None])[:, :, 0]
    step[:, FIXED:] = step[:, FIXED:] @ root.T
    return step, covariance[:, :FIXED, :FIXED]
