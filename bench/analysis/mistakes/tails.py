"""Whether noise has heavier tails than a normal one: then a reading far out may be no mistake at all."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats

HEAVY_DOF: Final = 4.0
"""Tails are held against those of Student's t with as many degrees of freedom."""
SCALES: Final = np.geomspace(0.3, 2.0, 40)
"""Scales that are tried, in root mean squares."""
LEAST_VALUES: Final = 20


def odds_of_tails(values: Floats, beyond: float) -> float:
    """Return ln of how much likelier values (n,) are with heavy tails than normal, each at its best scale.

    Values further out than `beyond` were left out: both are cut off there. Below 0 for a normal noise; 0 where
    there are too few to tell.
    """
    if len(values) < LEAST_VALUES:
        return 0.0
    size = float(np.sqrt(np.mean(values**2)))
    if not size > 0.0:
        return 0.0
    z, end = values / size, max(beyond / size, float(np.max(np.abs(values))) / size)
    scaled, ends = z[:, None] / SCALES, end / SCALES
    normal = -0.5 * scaled**2 - 0.5 * np.log(2 * np.pi) - np.log(special.erf(ends / np.sqrt(2.0)))
    half = 0.5 * (HEAVY_DOF + 1.0)
    constant = special.gammaln(half) - special.gammaln(0.5 * HEAVY_DOF) - 0.5 * np.log(HEAVY_DOF * np.pi)
    inside = 1.0 - 2.0 * special.stdtr(HEAVY_DOF, -ends)
    heavy = constant - half * np.log1p(scaled**2 / HEAVY_DOF) - np.log(inside)
    by_scale = [np.sum(of, axis=0) - len(z) * np.log(SCALES) for of in (heavy, normal)]
    return float(by_scale[0].max() - by_scale[1].max())
