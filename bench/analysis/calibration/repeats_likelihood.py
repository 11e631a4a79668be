"""The restricted likelihood of repeats of readings, maximised for many runs at once.

Deviations of repeats from the mean of their group have a covariance R = diag(v_x, v_y, v_z) + v_phi d d^T each
group. Fisher scoring: information 1/2 tr(R^-1 R_k R^-1 R_l), score 1/2 tr(R^-1 R_k R^-1 (S - f R)).
Source: D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320, sections 4 and 5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, Ints, Mask

OWN: Final = np.eye(4)
"""Parameters are the variances of x, y, z and of the setting."""
COMMON: Final = np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
"""Parameters are one variance for all three channels, and that of the setting."""

LEAST_SETTING: Final = 1e-6
"""Least variance of the setting, as it shows in the signals, as a part of that of the reading."""
ROUNDS: Final = 60
EQUAL_P: Final = 0.2
"""Channels are of one size where a test of equality gives this or more: a wrong size would be in every u."""

DIGITS: Final = 4.0
"""A variance that is no more times that of the last digit tells of digits, not of channels."""

AT_REST: Final = 1e-4
"""No parameter moves by more than this part of itself."""
MOST_CHANGE: Final = 4.0
"""A step changes no parameter by more than this factor."""


def sizes_of(
    scatter: Floats, freedom: Ints, slope: Floats, floor: float | Floats, by: Floats = OWN
) -> Floats:
    """Return the variances of x, y, z (unit^2) and of the setting (rad^2) of many runs, shape (runs, 4).

    `scatter` (runs, groups, 3, 3) are sums of squares and products, `freedom` (groups,), `slope`
    (runs, groups, 3) du/dphi, unit/rad; `floor` (runs,) or one number the least noise believed; `by` one of
    `OWN`, `COMMON`. A run without any slope has a setting error of zero.
    """
    weight = freedom.astype(np.float64)
    total = float(weight.sum())
    slope2 = np.einsum("rgi,rgi,g->r", slope, slope, weight) / total
    least = np.broadcast_to(np.square(floor), slope2.shape)
    own = np.maximum(np.einsum("rgii->ri", scatter) / total, least[:, None])
    start = np.concatenate([own, _shown(own.mean(axis=1) / 3, slope2)[:, None]], axis=1)
    theta = start @ np.linalg.pinv(by).T
    bottom = np.repeat(least[:, None], theta.shape[1], axis=1)
    open_rows = np.arange(len(theta))
    for _ in range(ROUNDS):
        at = theta[open_rows]
        bottom[open_rows, -1] = LEAST_SETTING * _shown((at @ by.T)[:, :3].mean(axis=1), slope2[open_rows])
        moved = _step(scatter[open_rows], weight, slope[open_rows], at, bottom[open_rows], by)
        theta[open_rows] = moved
        open_rows = open_rows[(np.abs(moved - at) > AT_REST * at).any(axis=1)]
        if not len(open_rows):
            break
    found: Floats = theta @ by.T
    found[slope2 <= 0.0, 3] = 0.0
    return found


def minus_two_log(scatter: Floats, freedom: Ints, slope: Floats, variances: Floats) -> Floats:
    """Return -2 log L of runs (runs,) for variances (runs, 4); the other arrays as in `sizes_of`."""
    covariance = _covariance(variances, slope)
    misfit = np.einsum("rgij,rgji->r", np.linalg.inv(covariance), scatter)
    return np.asarray(np.linalg.slogdet(covariance)[1] @ freedom.astype(np.float64) + misfit)


@dataclass(frozen=True)
class Sizes:
    """Variances (runs, 4) of x, y, z and the setting, as they are believed; degrees of freedom (runs, 3).

    `p_equal` (runs,) is the probability of such a difference between the channels where all are of one size:
    a run has one size for all three where it is not below `EQUAL_P`.
    """

    variances: Floats
    dof: Floats
    p_equal: Floats

    @property
    def alike(self) -> Mask:
        """Which runs have one size for all three channels, shape (runs,)."""
        return np.asarray(self.p_equal >= EQUAL_P)


def believed_sizes(
    scatter: Floats, freedom: Ints, slope: Floats, floor: float | Floats, *, one_size: bool = False
) -> Sizes:
    """Return the sizes of many runs, of each channel its own where they are not of one size.

    They are of one size where that is asked for, and where all that is left is the last digit of the replies.
    """
    alike = sizes_of(scatter, freedom, slope, floor, COMMON)
    own = sizes_of(scatter, freedom, slope, floor, OWN)
    gained = minus_two_log(scatter, freedom, slope, alike) - minus_two_log(scatter, freedom, slope, own)
    p = special.chdtrc(2, np.maximum(gained, 0.0))
    p = np.where(one_size | (alike[:, 0] <= DIGITS * np.square(floor)), 1.0, p)
    equal = (p >= EQUAL_P)[:, None]
    variances = np.where(equal, alike, own)
    # two of three signals tell of a common size, the third of the setting
    dof = np.where(equal, 2.0 * float(freedom.sum()), freedom_of(freedom, slope, variances))
    return Sizes(variances, dof, p)


def freedom_of(freedom: Ints, slope: Floats, variances: Floats) -> Floats:
    """Return the degrees of freedom of the variances of x, y, z (runs, 3) for `variances` (runs, 4).

    2 v^2/var(v) with var(v) from the information on all four: what the setting error takes is left out.
    """
    inverse: Floats = np.linalg.inv(_covariance(variances, slope)).astype(np.float64)
    information = _information(inverse, slope, freedom.astype(np.float64))
    scaled = information * variances[:, :, None] * variances[:, None, :]
    places = np.arange(4)
    # what no slope shows, or lies at its lower end, takes nothing from the others
    scaled[:, places, places] += 1e-9 * scaled.max(axis=(1, 2))[:, None]
    inverted = np.linalg.inv(scaled)
    return np.asarray(1.0 / np.einsum("rii->ri", inverted)[:, :3])


def _information(inverse: Floats, slope: Floats, weight: Floats) -> Floats:
    """Return tr(R^-1 R_k R^-1 R_l) summed over groups, shape (runs, 4, 4): twice the information."""
    by_slope = np.einsum("rgij,rgj->rgi", inverse, slope)
    along = np.einsum("rgi,rgi->rg", slope, by_slope)
    information = np.empty((len(inverse), 4, 4))
    information[:, :3, :3] = np.einsum("rgij,g->rij", inverse**2, weight)
    information[:, :3, 3] = information[:, 3, :3] = np.einsum("rgi,g->ri", by_slope**2, weight)
    information[:, 3, 3] = along**2 @ weight
    return information


def _shown(variance: Floats, slope2: Floats) -> Floats:
    """Return the variance of a setting that shows as so much in the signals; 1 where nothing shows it."""
    return np.where(slope2 > 0.0, variance / np.where(slope2 > 0.0, slope2, 1.0), 1.0)


def _covariance(variances: Floats, slope: Floats) -> Floats:
    along = variances[:, None, 3, None, None] * slope[..., :, None] * slope[..., None, :]
    own = variances[:, None, :3, None] * np.eye(3)
    return np.asarray(along + own)


def _step(
    scatter: Floats, weight: Floats, slope: Floats, theta: Floats, bottom: Floats, by: Floats
) -> Floats:
    variances = theta @ by.T
    inverse: Floats = np.linalg.inv(_covariance(variances, slope)).astype(np.float64)
    excess = inverse @ (scatter - weight[:, None, None] * _covariance(variances, slope)) @ inverse
    score, information = np.empty_like(variances), _information(inverse, slope, weight)
    score[:, :3] = np.einsum("rgii->ri", excess)
    score[:, 3] = np.einsum("rgi,rgij,rgj->r", slope, excess, slope)
    # relative steps: variances of volts and of angles are many orders apart
    slopes = np.einsum("ri,ik->rk", score, by) * theta
    curvature = np.einsum("ik,rij,jl->rkl", by, information, by) * theta[:, :, None] * theta[:, None, :]
    held = (theta <= bottom) & (slopes <= 0.0)
    free = ~held
    curvature *= free[:, :, None] & free[:, None, :]
    places = np.arange(theta.shape[1])
    ridge = 1e-12 * curvature.max(axis=(1, 2))[:, None]
    curvature[:, places, places] += np.where(held, 1.0, ridge)
    change = np.linalg.solve(curvature, np.where(free, slopes, 0.0)[:, :, None])[:, :, 0]
    return np.asarray(np.maximum(theta * np.clip(1.0 + change, 1 / MOST_CHANGE, MOST_CHANGE), bottom))
