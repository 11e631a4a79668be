"""Statistics without reference to a bench; this module: adjusted p-values, chi-square, contrasts, 1/f noise.

Source: S. Holm, "A simple sequentially rejective multiple test procedure", Scand. J. Statist. 6 (1979) 65.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from bench.base.arrays import Floats, Ints, u_of


def holm(p: Floats) -> Floats:
    """Return Holm's adjusted p-values (m,) of m tests.

    The k-th smallest p-value (k from 0) is multiplied by m - k; the results are made non-decreasing and at most 1.
    """
    order = np.argsort(p)
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(stepped, 1.0)
    return adjusted


def contrasts_within(group: Ints) -> Floats:
    """Return an orthonormal basis (n, k) of the contrasts within groups, for group numbers (n,).

    A contrast is a weighted sum of n values whose weights sum to zero in each group.
    """
    left = np.eye(len(group))
    for number in np.unique(group):
        own = (group == number).astype(np.float64)
        left -= np.outer(own, own) / own.sum()
    size, vectors = np.linalg.eigh(left)
    return np.asarray(vectors[:, size > 0.5])


def chi_square(difference: Floats, covariance: Floats) -> float:
    """Return the chi-square of a difference (m,), computed from correlations so that units do not matter."""
    u = u_of(covariance)
    scaled = difference / u
    return float(scaled @ np.linalg.solve(covariance / np.outer(u, u), scaled))


HALF_WAVES: Final = 16
"""Largest number of half waves of 1/f noise over a run: faster ones resemble the noise of readings."""
FLICKER_RMS: Final = float(np.sqrt(np.sum(1.0 / np.arange(1, HALF_WAVES + 1)) / np.log(10.0)))
"""Root mean square of these waves for a standard deviation of 1 per decade of frequency."""


def flicker_waves(time_s: Floats) -> Floats:
    """Return 1/f noise of standard deviation 1 per decade of frequency at the times (n,), as waves (n, 16).

    The noise is the sum of the waves, each times an independent standard normal number. The waves have a half to
    eight periods over the times; slower parts are constant, faster ones resemble noise without correlation.
    """
    span = float(np.ptp(time_s))
    if not span > 0.0:
        return np.zeros((len(time_s), HALF_WAVES))
    k = np.arange(1, HALF_WAVES + 1)
    # a decade has the variance 1, so wave k of the mean square 1/2 has the variance 1/(k ln 10)
    wave = np.cos(np.pi * k * (time_s[:, None] - time_s.min()) / span)
    return np.asarray(np.sqrt(2.0 / (k * np.log(10.0))) * wave)
