"""Average run lengths (ARL) of control charts for a normal mean, and the limits that give one.

Sources: S. V. Crowder, "A simple method for studying run-length distributions of exponentially weighted moving
average charts", Technometrics 29 (1987), 401-407 (the integral equation of the EWMA); J. M. Lucas and
M. S. Saccucci, "Exponentially weighted moving average control schemes: properties and enhancements", Technometrics
32 (1990), 1-12 (its tables); S. E. Rigdon, "An integral equation for the in-control average run length of a
multivariate exponentially weighted moving average control chart", J. Statist. Comput. Simul. 52 (1995), 351-365;
S. Knoth, "ARL numerics for MEWMA charts", J. Quality Technology 49 (2017), 78-89 (the substitution that makes its
quadrature quick).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Final

import numpy as np
from scipy import optimize, special, stats

from bench.base.arrays import Floats

NODES: Final = 96
"""Points of the Gauss-Legendre quadrature: six digits of the ARL with smoothing from 0.03 on."""
LEAST_SMOOTHING: Final = 0.03
"""Below it the published tables end, and the quadrature wants more points."""


def shewhart_arl(k: float, shift: float = 0.0) -> float:
    """Return the ARL of a two-sided Shewhart chart with limits at k, after a shift, both in standard deviations."""
    return float(1.0 / (special.ndtr(shift - k) + special.ndtr(-shift - k)))


def ewma_arl(smoothing: float, k: float, shift: float = 0.0) -> float:
    """Return the ARL of a two-sided EWMA that begins at the centre, its limits at once where they end up.

    The limits are k sqrt(smoothing/(2 - smoothing)) standard deviations of one value from the centre; the mean is
    off by `shift` standard deviations from the first value on (Crowder 1987, equation 3).
    """
    if smoothing == 1.0:
        return shewhart_arl(k, shift)
    limit = k * np.sqrt(smoothing / (2.0 - smoothing))
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    places, weights = limit * nodes, limit * weights

    def kernel(start: Floats) -> Floats:
        value = (places - (1.0 - smoothing) * start[:, None]) / smoothing - shift
        return np.asarray(weights * stats.norm.pdf(value) / smoothing)

    lengths = np.linalg.solve(np.eye(NODES) - kernel(places), np.ones(NODES))
    return float(1.0 + (kernel(np.zeros(1)) @ lengths)[0])


def mewma_arl(smoothing: float, limit: float, dimensions: int) -> float:
    """Return the in-control ARL of a multivariate EWMA that begins at the centre.

    It signals where Z' V^-1 Z is above `limit`, V = smoothing/(2 - smoothing) times the covariance of one value
    (Rigdon 1995, equation 8, over the length of Z rather than its square, after Knoth 2017).
    """
    if smoothing == 1.0:
        return float(1.0 / special.chdtrc(dimensions, limit))
    radius = np.sqrt(limit * smoothing / (2.0 - smoothing))
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    places, weights = 0.5 * radius * (nodes + 1.0), 0.5 * radius * weights

    def kernel(start: Floats) -> Floats:
        from_there = (start[:, None] * (1.0 - smoothing) / smoothing) ** 2
        density = stats.ncx2.pdf((places / smoothing) ** 2, dimensions, from_there)
        return np.asarray(weights * 2.0 * places / smoothing**2 * density)

    lengths = np.linalg.solve(np.eye(NODES) - kernel(places), np.ones(NODES))
    return float(1.0 + (kernel(np.zeros(1)) @ lengths)[0])


def shewhart_k(arl: float) -> float:
    """Return the limit of a two-sided Shewhart chart, in standard deviations, that has an in-control ARL."""
    return float(-special.ndtri(0.5 / arl))


@cache
def ewma_k(smoothing: float, arl: float) -> float:
    """Return the limit of an EWMA, in its own standard deviations, that has an in-control ARL."""
    return _root(lambda k: ewma_arl(smoothing, k), arl, shewhart_k(arl))


@cache
def mewma_limit(smoothing: float, arl: float, dimensions: int) -> float:
    """Return the limit of a multivariate EWMA that has an in-control ARL."""
    most = float(special.chdtri(dimensions, 1.0 / arl))
    return _root(lambda limit: mewma_arl(smoothing, limit, dimensions), arl, most)


def _root(length: Callable[[float], float], arl: float, most: float) -> float:
    """Return where a run length, which rises with the limit, is `arl`: that without memory is the most."""
    return float(
        optimize.brentq(lambda limit: np.log(length(limit) / arl), 0.2 * most, 1.01 * most, xtol=1e-6)
    )
