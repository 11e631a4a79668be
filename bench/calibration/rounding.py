"""Rounding of the signals to their last digit: whether repeats share its error, and what it adds to covariances."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import linalg

from bench.base.arrays import Floats, Ints
from bench.calibration.design import Problem
from bench.calibration.gls import Fit
from bench.calibration.noise import SharedRounding, repeat_groups, rounding_variance
from bench.calibration.result import Noise
from bench.model.conditions import Conditions

SMOOTHED: Final = 2.0
"""Above this multiple of the variance of rounding, repeats share less than 1 % of the noise variance."""
LEAST_ALONE: Final = 0.01
"""Least part of the noise variance that is independent in each reading if repeats share a rounding error.

Without it the covariance of repeats that round alike would be singular.
"""
MOST_SIGNALS: Final = 1500
"""Above this number of signals no shared errors are searched for: the matrices would take minutes."""


def is_rounded(noise: Noise, floor: float) -> bool:
    """Return whether noise, which is at least `floor`, the standard deviation of rounding, hardly exceeds it."""
    return bool(noise.by_channel.min() ** 2 <= SMOOTHED * floor**2)


def rounding_of(problem: Problem, fit: Fit, resolution: float) -> SharedRounding | None:
    """Return the error of rounding to `resolution` that repeats share; None if the noise smooths it away.

    Also None if the noise is not from repeats, or the signals are more than `MOST_SIGNALS`.
    """
    digit = resolution / np.sqrt(12.0)
    large = 3 * len(problem.conditions) > MOST_SIGNALS
    if large or fit.noise.source != "repeats" or not is_rounded(fit.noise, digit):
        return None
    noise = np.minimum(fit.noise.by_channel, _quiet(problem.conditions, fit))
    return SharedRounding(_orientations(problem.conditions), rounding_variance(noise, digit))


def _quiet(conditions: Conditions, fit: Fit) -> Floats:
    """Return the standard deviation (3,) of repeats at small signals, where noise that grows smooths least."""
    groups = repeat_groups(conditions)
    count = np.bincount(groups)
    power = np.abs(fit.system.jacobian[:, :, :9] @ fit.block.K.ravel())
    quiet = power <= np.max(power, axis=0) / 2
    mean = np.stack([np.bincount(groups, one) / count for one in fit.residuals.T], axis=1)
    squares = np.sum(quiet * (fit.residuals - mean[groups]) ** 2, axis=0)
    freedom = np.sum(quiet * (1.0 - 1.0 / count[groups])[:, None], axis=0)
    return np.asarray(np.sqrt(np.divide(squares, freedom, out=np.full(3, np.inf), where=freedom > 0)))


def rounded_alike(conditions: Conditions, noise: Floats, floor: float) -> Floats:
    """Return what the rounding errors that repeats share add to the covariance (N, N) of independent noise.

    `noise` (N,), which includes rounding, is that of the signals of n oriented readings and of N - 3n moduli.
    `floor` is the standard deviation of rounding.
    """
    n = 3 * len(conditions)
    size = np.sqrt(rounding_variance(noise[:n], floor))
    groups = _orientations(conditions)
    alike = np.kron(np.equal.outer(groups, groups), np.eye(3)) * np.outer(size, size)
    np.fill_diagonal(alike, LEAST_ALONE * np.diag(alike))
    return np.asarray(linalg.block_diag(alike, np.zeros((len(noise) - n,) * 2)))


def _orientations(conditions: Conditions) -> Ints:
    """Return a number per reading, equal for equal angles in a mounting: they have equal signals.

    So have those a whole turn later. The angle read back differs by arcseconds.
    """
    turn = np.round(np.degrees(conditions.angle_rad) * 100.0).astype(np.int64) % 36000
    return np.asarray(np.unique(conditions.mount * 36000 + turn, return_inverse=True)[1])
