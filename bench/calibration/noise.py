"""How large the noise really is: estimated from repeats, not believed.

A reading is the model plus a setting error common to its three channels, which acts along
d = du/dphi, plus noise fresh in each channel: its covariance is sigma_u^2 I + sigma_phi^2 d d^T.
Along d and across it the scatter separates, so the restricted likelihood is a sum of four closed forms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from bench.calibration.result import Noise
from bench.model.conditions import Conditions

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LEAST_REPEATS: Final = 12
"""Repeats (readings less groups) below which their scatter is too poor a guide."""


@dataclass(frozen=True)
class Scatter:
    """Scatter within groups of repeats: sums of squares along d and across it, per group.

    `along`, `across` (groups,) in unit^2, `freedom` (groups,) readings less one, `slope` (groups,) |d| in
    unit/rad.
    """

    along: Floats
    across: Floats
    freedom: Ints
    slope: Floats

    @property
    def settings(self) -> int:
        """Repeats in all, in settings of the head (each has three signals)."""
        return int(self.freedom.sum())


def repeat_groups(conditions: Conditions) -> Ints:
    """Return a group number per reading, shape (n,): same mounting, point and direction of approach."""
    key = np.stack([conditions.mount, conditions.point, conditions.direction], axis=1)
    _, groups = np.unique(key, axis=0, return_inverse=True)
    return groups.ravel()


def scatter_of_repeats(residuals: Floats, slope: Floats, groups: Ints) -> Scatter:
    """Return the scatter of residuals (n, 3) about their group's mean; `slope` (n, 3) is d = du/dphi.

    Residuals, not readings: the angle read back differs a little from repeat to repeat.
    """
    count = np.bincount(groups)
    mean = _group_sum(residuals, groups) / count[:, None]
    direction = _group_sum(slope, groups) / count[:, None]
    length = np.linalg.norm(direction, axis=1)
    unit = direction / np.where(length > 0, length, 1.0)[:, None]
    deviation = residuals - mean[groups]
    along = np.einsum("ni,ni->n", deviation, unit[groups]) ** 2
    total = np.einsum("ni,ni->n", deviation, deviation)
    repeated = count > 1
    return Scatter(
        along=_group_sum(along[:, None], groups)[repeated, 0],
        across=_group_sum((total - along)[:, None], groups)[repeated, 0],
        freedom=(count - 1)[repeated],
        slope=length[repeated],
    )


def _group_sum(values: Floats, groups: Ints) -> Floats:
    return np.stack([np.bincount(groups, column).astype(np.float64) for column in values.T], axis=1)


def noise_from_repeats(scatter: Scatter, floor: float) -> Noise:
    """Restricted maximum likelihood of the two noise sizes from repeats.

    `floor` (unit of the signal) is the least noise that is believed: the last digit of a reply.
    """
    across_freedom = 2 * scatter.freedom
    slope2 = scatter.slope**2

    def minus_two_log_likelihood(log_sizes: Floats) -> float:
        reading, setting = np.exp(2 * log_sizes)
        along = reading + setting * slope2
        return float(
            np.sum(across_freedom) * np.log(reading)
            + np.sum(scatter.across) / reading
            + np.sum(scatter.freedom * np.log(along) + scatter.along / along)
        )

    across = np.sqrt(max(scatter.across.sum() / across_freedom.sum(), floor**2))
    along_excess = scatter.along.sum() - across**2 * scatter.freedom.sum()
    spread = np.sqrt(max(along_excess, 0.0) / max(np.sum(scatter.freedom * slope2), 1e-300))
    least_setting = 1e-3 * across / max(float(np.sqrt(np.mean(slope2))), 1e-300)
    start = np.log([across, max(spread, 30 * least_setting)])
    bounds = _bounds((floor, across), (least_setting, max(spread, least_setting)))
    found = minimize(minus_two_log_likelihood, start, method="L-BFGS-B", bounds=bounds)
    reading, setting = np.exp(found.x)
    limits = setting_limits(float(reading), float(setting), float(np.mean(slope2)), scatter.settings)
    return Noise(float(reading), float(setting), 3.0 * scatter.settings, "repeats", limits)


def setting_limits(reading: float, setting_rad: float, slope2: float, freedom: float) -> tuple[float, float]:
    """Return limits of the setting error (about 95 %), rad, from the freedom of the scatter along d.

    The variance along d, sigma_u^2 + sigma_phi^2 |d|^2, is known to a part sqrt(2/freedom) of itself.
    """
    if slope2 <= 0.0:
        return 0.0, float("inf")
    u = np.sqrt(2.0 / max(freedom, 1.0)) * (reading**2 / slope2 + setting_rad**2)
    low, high = setting_rad**2 - 2 * u, setting_rad**2 + 2 * u
    return float(np.sqrt(max(low, 0.0))), float(np.sqrt(high))


def _bounds(*sizes: tuple[float, float]) -> list[tuple[float, float]]:
    """Bounds of the logarithms for (least, guess) of each size; without upper ones a line search overflows."""
    return [(float(np.log(least)), float(np.log(1e3 * guess))) for least, guess in sizes]


def noise_from_residuals(response: Floats, design: Floats, slope: Floats, fixed: int, floor: float) -> Noise:
    """Restricted maximum likelihood of the two noise sizes from what the model leaves.

    For data without enough repeats. `response` (n, 3), `design` (n, 3, p) whose columns from `fixed` on are
    random effects scaled to unit prior standard deviation, `slope` (n, 3).
    """
    n, _, p = design.shape
    length = np.linalg.norm(slope, axis=1)
    unit = slope / np.where(length > 0, length, 1.0)[:, None]
    columns = np.concatenate([design, response[:, :, None]], axis=2)
    gram = np.einsum("nip,niq->pq", columns, columns)
    along = np.einsum("nip,ni->np", columns, unit)
    prior = np.zeros(p)
    prior[fixed:] = 1.0

    def minus_two_log_likelihood(log_sizes: Floats) -> float:
        reading, setting = np.exp(2 * log_sizes)
        ratio = setting * length**2 / (reading + setting * length**2)
        whitened = (gram - (along * ratio[:, None]).T @ along) / reading
        normal = whitened[:p, :p] + np.diag(prior)
        scale = 1 / np.sqrt(np.diag(normal))
        cholesky = np.linalg.cholesky(normal * np.outer(scale, scale))
        projected = np.linalg.solve(cholesky, scale * whitened[:p, p])
        log_det = 3 * n * np.log(reading) - np.sum(np.log1p(-ratio))
        log_det += 2 * np.sum(np.log(np.diag(cholesky))) - 2 * np.sum(np.log(scale))
        return float(log_det + whitened[p, p] - projected @ projected)

    solution, *_ = np.linalg.lstsq(design.reshape(3 * n, p), response.ravel(), rcond=None)
    left = response.ravel() - design.reshape(3 * n, p) @ solution
    freedom = max(3 * n - p, 1)
    guess = max(float(np.sqrt(left @ left / freedom)), floor)
    steepness = max(float(np.sqrt(np.mean(length**2))), 1e-300)
    start = np.log([guess, 0.3 * guess / steepness])
    bounds = _bounds((floor, guess), (1e-3 * guess / steepness, guess / steepness))
    found = minimize(minus_two_log_likelihood, start, method="L-BFGS-B", bounds=bounds)
    reading, setting = np.exp(found.x)
    limits = setting_limits(float(reading), float(setting), float(np.mean(length**2)), freedom / 3)
    return Noise(float(reading), float(setting), float(freedom), "residuals", limits)


def whiten(columns: Floats, slope: Floats, noise: Noise) -> Floats:
    """Return R^(-1/2) times columns (n, 3, p), R = sigma_u^2 I + sigma_phi^2 d d^T of each reading."""
    length = np.linalg.norm(slope, axis=1)
    unit = slope / np.where(length > 0, length, 1.0)[:, None]
    shrink = 1.0 - noise.reading / np.hypot(noise.reading, noise.setting_rad * length)
    along = np.einsum("nip,ni->np", columns, unit) * shrink[:, None]
    result: Floats = (columns - unit[:, :, None] * along[:, None, :]) / noise.reading
    return result
