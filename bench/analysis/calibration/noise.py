"""How large the noise really is: estimated from repeats, not believed.

A reading is the model plus a setting error common to its three channels, which acts along
d = du/dphi, plus noise fresh in each channel: its covariance is sigma_u^2 I + sigma_phi^2 d d^T.
Along d and across it the scatter separates, so the restricted likelihood is a sum of four closed forms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import minimize

from bench.analysis.calibration.result import Noise
from bench.base.arrays import Floats, Ints, least_squares, unit_vectors
from bench.model.conditions import Conditions

LEAST_REPEATS: Final = 12
"""Repeats (readings less groups) below which their scatter is too poor a guide."""


SAME_SCATTER: Final = 1e-3


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

    def is_close_to(self, other: Scatter) -> bool:
        """Whether another scatter of the same groups would give the same sizes, to a part in a thousand."""
        return all(
            float(np.abs(a - b).sum()) <= SAME_SCATTER * float(b.sum())
            for a, b in ((self.along, other.along), (self.across, other.across), (self.slope, other.slope))
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
    mean = _group_sum(residuals, groups) / count[:, None]
    unit, length = unit_vectors(_group_sum(slope, groups) / count[:, None])
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
    reading, setting = noise_sizes(
        scatter.along[None], scatter.across.sum(keepdims=True), scatter.freedom, scatter.slope[None], floor
    )
    slope2 = float(np.mean(scatter.slope**2))
    limits = setting_limits(float(reading[0]), float(setting[0]), slope2, scatter.settings)
    return Noise(float(reading[0]), float(setting[0]), 3.0 * scatter.settings, "repeats", limits)


class RepeatedNoise:
    """Noise from repeats in a fit that goes on: estimated anew only where their scatter has changed.

    Deviations of a repeat from its group hardly depend on the point of the fit, for the angles read back are
    nearly alike.
    """

    def __init__(self, floor: float, groups: Ints) -> None:
        self._floor = floor
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
            self._known = scatter, noise_from_repeats(scatter, self._floor)
        return self._known[1]


LEAST_SETTING: Final = 1e-3
"""Least setting error, as a part of the reading noise, both as they show in the signals."""
GRID: Final = np.linspace(2 * np.log(LEAST_SETTING), 36.0, 51)
"""Logarithms of the ratio of the two variances that are tried first: up to settings and hardly any noise."""
SECANTS: Final = 30
"""Most steps of regula falsi from a bracket of the grid."""
NO_SLOPE: Final = 1e-7
"""Derivative of the likelihood, over the degrees of freedom, that counts as none."""


def noise_sizes(
    along: Floats, across: Floats, freedom: Ints, slope: Floats, floor: float | Floats
) -> tuple[Floats, Floats]:
    """Return reading noise (runs,) and setting error (runs,), rad, of many runs from their scatter at once.

    `along` (runs, groups), `across` (runs,) summed over groups, `freedom` (groups,), `slope` (runs, groups).
    For a ratio of the two variances the likelihood gives the reading noise in closed form; the ratio is found
    on a grid, then by regula falsi (Illinois) where the derivative changes its sign.
    """
    scale = slope**2 @ freedom / freedom.sum()
    likelihood = _Profile(
        along,
        across,
        freedom.astype(np.float64),
        slope**2 / np.where(scale > 0, scale, 1.0)[:, None],
        np.broadcast_to(np.square(floor), across.shape),
    )
    best = np.argmin(likelihood.minus_two_log(GRID), axis=1)
    low, high = GRID[np.maximum(best - 1, 0)], GRID[np.minimum(best + 1, len(GRID) - 1)]
    ratio = np.exp(_root(likelihood.derivative, low, high, NO_SLOPE * float(freedom.sum())))
    reading = np.sqrt(likelihood.variance(1 / (1 + ratio[:, None] * likelihood.slope2)))
    return reading, np.where(scale > 0, reading * np.sqrt(ratio / np.where(scale > 0, scale, 1.0)), 0.0)


@dataclass(frozen=True)
class _Profile:
    """Restricted likelihood of the logarithm of the ratio of variances; arrays as in `noise_sizes`."""

    along: Floats
    across: Floats
    freedom: Floats
    slope2: Floats
    least: Floats

    def variance(self, rest: Floats) -> Floats:
        """Variance of the reading noise (runs,) that goes with `rest` (runs, groups), 1/(1 + ratio slope2)."""
        left = self.across + np.einsum("rg,rg->r", self.along, rest)
        return np.asarray(np.maximum(left / (3 * self.freedom.sum()), self.least))

    def minus_two_log(self, log_ratio: Floats) -> Floats:
        """Return -2 log L on a grid (k,), shape (runs, k)."""
        total = 1 + np.exp(log_ratio)[:, None] * self.slope2[:, None, :]
        left = self.across[:, None] + np.einsum("rg,rkg->rk", self.along, 1 / total)
        count = 3 * self.freedom.sum()
        variance = np.maximum(left / count, self.least[:, None])
        return np.asarray(count * np.log(variance) + left / variance + np.log(total) @ self.freedom)

    def derivative(self, log_ratio: Floats) -> Floats:
        """Return its derivative for a ratio of each run (runs,)."""
        part = np.exp(log_ratio)[:, None] * self.slope2
        rest = 1 / (1 + part)
        share = part * rest
        scatter = np.einsum("rg,rg->r", self.along, share * rest) / self.variance(rest)
        return np.asarray(share @ self.freedom - scatter)


def _root(function: Callable[[Floats], Floats], low: Floats, high: Floats, nothing: float) -> Floats:
    """Return where a function changes from negative to positive between `low` and `high`, else that end."""
    at_low, at_high = function(low), function(high)
    rising, falling = at_low >= 0, at_high <= 0
    best = np.where(rising, low, high)
    inside = ~rising & ~falling
    if not np.any(inside):
        return np.asarray(best)
    at_low, at_high = np.where(inside, at_low, -1.0), np.where(inside, at_high, 1.0)
    side = np.zeros(len(low), dtype=np.int64)
    for _ in range(SECANTS):
        middle = (low * at_high - high * at_low) / (at_high - at_low)
        value = function(middle)
        best = np.where(inside, middle, best)
        if np.all(np.abs(value[inside]) < nothing):
            break
        negative = value < 0
        # where the same end moves twice, the other's weight is halved: the Illinois rule
        at_high = np.where(negative, np.where(side < 0, at_high / 2, at_high), value)
        at_low = np.where(negative, value, np.where(side > 0, at_low / 2, at_low))
        low, high = np.where(negative, middle, low), np.where(negative, high, middle)
        side = np.where(negative, -1, 1)
        at_low, at_high = np.minimum(at_low, -1e-300), np.maximum(at_high, 1e-300)
    return np.asarray(best)


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
    """Return R^(-1/2) times columns (n, 3, p), R = sigma_u^2 I + sigma_phi^2 d d^T of each reading."""
    unit, length = unit_vectors(slope)
    shrink = 1.0 - noise.reading / np.hypot(noise.reading, noise.setting_rad * length)
    along = np.einsum("nip,ni->np", columns, unit) * shrink[:, None]
    return np.asarray((columns - unit[:, :, None] * along[:, None, :]) / noise.reading)
