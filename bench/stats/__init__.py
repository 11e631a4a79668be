"""Statistics without reference to a bench, such as adjusted p-values, chi-square, contrasts.

Source: S. Holm, "A simple sequentially rejective multiple test procedure", Scand. J. Statist. 6 (1979) 65.
"""

from __future__ import annotations

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
