"""How large the noise really is: estimated from repeats, not believed.

A reading is the model plus a setting error common to its three channels, which acts along
d = du/dphi, plus noise fresh in each channel and of a size of its own there: its covariance is
diag(sigma_x^2, sigma_y^2, sigma_z^2) + sigma_phi^2 d d^T. The sizes are those of the restricted likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.analysis.calibration.repeats_likelihood import believed_sizes
from bench.analysis.calibration.result import Noise
from bench.base.arrays import Floats, Ints, least_squares, rms, unit_vectors
from bench.model.conditions import Conditions

LEAST_REPEATS: Final = 12
"""Repeats (readings less groups) below which their scatter is too poor a guide."""


SAME_SCATTER: Final = 1e-3


@dataclass(frozen=True)
class Scatter:
    """Scatter within groups of repeats.

    `matrix` (groups, 3, 3) is the sum of d d^T over the deviations of a group from its mean, unit^2; `freedom`
    (groups,) readings less one, `slope` (groups, 3) the mean of du/dphi, unit/rad.
    """

    matrix: Floats
    freedom: Ints
    slope: Floats

    @property
    def settings(self) -> int:
        """Repeats in all, in settings of the head (each has three signals)."""
        return int(self.freedom.sum())

    def is_close_to(self, other: Scatter) -> bool:
        """Whether another scatter of the same groups would give the same sizes, to a part in a thousand."""
        return all(
            float(np.abs(a - b).sum()) <= SAME_SCATTER * float(np.abs(b).sum())
            for a, b in ((self.matrix, other.matrix), (self.slope, other.slope))
        )


def repeat_groups(conditions: Conditions) -> Ints:
    """Return a group number per reading, shape (n,): same mounting, point and direction of approach."""
    points = int(conditions.point.max(initial=0)) + 1
    key = (conditions.mount * points + conditions.point) * 3 + conditions.direction
    return np.asarray(np.unique(key, return_inverse=True)[1])


def scatter_of_repeats(residuals: Floats, slope: Floats, groups: Ints) -> Scatter:
    """Return the scatter of residuals (n, 3) about their group's mean; `slope` (n, 3) is d = du/dphi.

    Residuals, not readings: the angle read back differs a little from repeat to repeat.
    """
    count = np.bincount(groups)
    deviation = residuals - (_group_sum(residuals, groups) / count[:, None])[groups]
    products = (deviation[:, :, None] * deviation[:, None, :]).reshape(-1, 9)
    repeated = count > 1
    return Scatter(
        matrix=_group_sum(products, groups)[repeated].reshape(-1, 3, 3),
        freedom=(count - 1)[repeated],
        slope=(_group_sum(slope, groups) / count[:, None])[repeated],
    )


def _group_sum(values: Floats, groups: Ints) -> Floats:
    return np.stack([np.bincount(groups, column).astype(np.float64) for column in values.T], axis=1)


def noise_from_repeats(scatter: Scatter, floor: float, *, one_size: bool = False) -> Noise:
    """Restricted maximum likelihood of the sizes of the noise from repeats, of each channel its own if they differ.

    `floor` (unit of the signal) is the least noise that is believed: the last digit of a reply.
    """
    found = believed_sizes(
        scatter.matrix[None], scatter.freedom, scatter.slope[None], floor, one_size=one_size
    )
    channels, setting = np.sqrt(found.variances[0, :3]), float(np.sqrt(found.variances[0, 3]))
    slope2 = float(np.mean(np.sum(scatter.slope**2, axis=1)))
    reading = rms(channels)
    noise = Noise(
        reading,
        setting,
        3.0 * scatter.settings,
        "repeats",
        setting_limits(reading, setting, slope2, scatter.settings),
        p_equal=float(found.p_equal[0]),
    )
    if found.alike[0]:
        return noise
    return replace(noise, channels=_three(channels), channel_dof=_three(found.dof[0]))


def _three(values: Floats) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


class RepeatedNoise:
    """Noise from repeats in a fit that goes on: estimated anew only where their scatter has changed.

    Deviations of a repeat from its group hardly depend on the point of the fit, for the angles read back are
    nearly alike.
    """

    def __init__(self, floor: float, groups: Ints, *, one_size: bool = False) -> None:
        self._floor = floor
        self._one_size = one_size
        self._groups = groups
        self._known: tuple[Scatter, Noise] | None = None

    def sizes(self, residuals: Floats, slope: Floats) -> Noise | None:
        """Return the sizes for residuals (n, 3) and du/dphi (n, 3); None where there are too few repeats."""
        if not len(residuals):
            return None
        scatter = scatter_of_repeats(residuals, slope, self._groups)
        if scatter.settings < LEAST_REPEATS:
            return None
        if self._known is None or not scatter.is_close_to(self._known[0]):
            self._known = scatter, noise_from_repeats(scatter, self._floor, one_size=self._one_size)
        return self._known[1]


LEAST_SETTING: Final = 1e-3
"""Least setting error, as a part of the reading noise, both as they show in the signals."""


def setting_limits(reading: float, setting_rad: float, slope2: float, freedom: float) -> tuple[float, float]:
    """Return limits of the setting error (about 95 %), rad, from the freedom of the scatter along d.

    The variance along d, sigma_u^2 + sigma_phi^2 |d|^2, is known to a part sqrt(2/freedom) of itself.
    """
    if slope2 <= 0.0:
        return 0.0, float("inf")
    u = np.sqrt(2.0 / max(freedom, 1.0)) * (reading**2 / slope2 + setting_rad**2)
    low, high = setting_rad**2 - 2 * u, setting_rad**2 + 2 * u
    return float(np.sqrt(max(low, 0.0))), float(np.sqrt(high))


LEAST_PART: Final = 1e-4
"""Least reading noise that residuals can tell, as a part of what they are: below it the sums cancel."""
MOST_PART: Final = 10.0


def noise_from_residuals(
    response: Floats, design: Floats, slope: Floats, fixed: int, floor: float, free: Floats | None = None
) -> Noise:
    """Restricted maximum likelihood of the two noise sizes from what the model leaves.

    For data without enough repeats. `response` (n, 3), `design` (n, 3, p) whose columns from `fixed` on are
    random effects scaled to unit prior standard deviation, `slope` (n, 3). `free` (m, p + 1) are rows of
    moduli, the response last, in the unit of the signal: they have the reading noise alone.
    """
    n, _, p = design.shape
    further = np.zeros((0, p + 1)) if free is None else free
    if n == 0:
        return _noise_from_free(further, floor)
    count = 3 * n + len(further)
    unit, length = unit_vectors(slope)
    columns = np.concatenate([design, response[:, :, None]], axis=2)
    gram = np.einsum("nip,niq->pq", columns, columns) + further.T @ further
    along = np.einsum("nip,ni->np", columns, unit)
    prior = np.zeros(p)
    prior[fixed:] = 1.0

    def minus_two_log_likelihood(log_sizes: Floats) -> tuple[float, Floats]:
        """Return -2 log L and its derivatives by the logarithms of the sizes."""
        reading, setting = np.exp(2 * log_sizes)
        part = setting * length**2
        weight = part / (reading * (reading + part))
        whitened = gram / reading - (along * weight[:, None]).T @ along
        normal = whitened[:p, :p] + np.diag(prior)
        scale = 1 / np.sqrt(np.diag(normal))
        lower = np.linalg.inv(np.linalg.cholesky(normal * np.outer(scale, scale))) * scale
        inverse = lower.T @ lower
        solution = inverse @ whitened[:p, p]
        log_det = count * np.log(reading) + np.sum(np.log1p(part / reading))
        log_det -= 2 * np.sum(np.log(np.diag(lower)))
        # the derivative of log det + misfit is the trace of this matrix times that of the whitened Gram matrix
        ends = np.append(-solution, 1.0)
        trace = np.outer(ends, ends)
        trace[:p, :p] += inverse
        each = np.einsum("np,pq,nq->n", along, trace, along, optimize=True)
        by_reading = count - np.sum(part / (reading + part)) - np.sum(gram * trace) / reading
        by_reading += np.sum(each * weight * (2 * reading + part) / (reading + part))
        by_setting = np.sum(part / (reading + part)) - np.sum(each * part / (reading + part) ** 2)
        value = log_det + whitened[p, p] - solution @ whitened[:p, p]
        return float(value), 2 * np.array([by_reading, by_setting])

    whole = np.vstack([columns.reshape(3 * n, p + 1), further])
    _, left = least_squares(whole[:, :p], whole[:, p])
    freedom = max(count - p, 1)
    guess = max(float(np.sqrt(left @ left / freedom)), floor)
    steepness = max(float(np.sqrt(np.mean(length**2))), 1e-300)
    start = np.log([guess, 0.3 * guess / steepness])
    low = np.log([max(floor, LEAST_PART * guess), LEAST_SETTING * guess / steepness])
    high = np.log([MOST_PART * guess, MOST_PART * guess / steepness])
    bounds = list(zip(low.tolist(), high.tolist(), strict=True))
    from scipy.optimize import minimize

    found = minimize(minus_two_log_likelihood, start, method="L-BFGS-B", jac=True, bounds=bounds)
    reading, setting = np.exp(found.x)
    limits = setting_limits(float(reading), float(setting), float(np.mean(length**2)), freedom / 3)
    return Noise(float(reading), float(setting), float(freedom), "residuals", limits)


def _noise_from_free(rows: Floats, floor: float) -> Noise:
    """Noise of free positions alone: what is left over the degrees of freedom, no setting being known."""
    _, left = least_squares(rows[:, :-1], rows[:, -1])
    freedom = max(len(rows) - rows.shape[1] + 1, 1)
    return Noise(max(float(np.sqrt(left @ left / freedom)), floor), 0.0, float(freedom), "residuals")


def whiten(columns: Floats, slope: Floats, noise: Noise) -> Floats:
    """Return W times columns (n, 3, p), where W^T W is the inverse of the covariance of each reading.

    W = (I + s s^T)^(-1/2) D^(-1) with D = diag(sigma_x, sigma_y, sigma_z), s = sigma_phi D^(-1) d.
    """
    sizes = noise.by_channel
    return _shrunk(columns / sizes[:, None], slope / sizes, noise.setting_rad)


def whiten_back(columns: Floats, slope: Floats, noise: Noise) -> Floats:
    """Return W^T times columns (n, 3, p), W as in `whiten`: from whitened readings back to raw ones."""
    sizes = noise.by_channel
    return np.asarray(_shrunk(columns, slope / sizes, noise.setting_rad) / sizes[:, None])


def _shrunk(columns: Floats, slope: Floats, setting_rad: float) -> Floats:
    unit, length = unit_vectors(slope)
    shrink = 1.0 - 1.0 / np.hypot(1.0, setting_rad * length)
    along = np.einsum("nip,ni->np", columns, unit) * shrink[:, None]
    return np.asarray(columns - unit[:, :, None] * along[:, None, :])
