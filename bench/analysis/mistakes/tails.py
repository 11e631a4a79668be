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
LEAST_VALUES: Final = 12
NONE: Final = np.zeros(0)


BEYOND_TAILS: Final = 17.0
"""Where the noise has heavy tails an outlier is so many times the noise off: a nearer one may be noise.

Student's t of 4 degrees of freedom, whose size is taken a fifth too small for its tails, goes there in 7 of 1,000
runs of the paper's length; and one of 20 times is beyond it though the noise be taken 15 % too large."""
OUTLIER_RATE: Final = 1e-3
"""So many of the values of a record are outliers, before it is looked at,"""
OUTLIER_DECADES: Final = 4.0
"""of any size over so many powers of ten."""


def odds_of_tails(values: Floats, outliers: Floats = NONE) -> float:
    """Return ln of how much likelier all are as noise with heavy tails than as normal noise with outliers in it.

    `values` (n,) are those that may be normal noise, `outliers` (m,) those that cannot, in the same unit; the scale
    of either noise is its best. Below 0 for a normal noise; 0 where there are too few values to tell.
    """
    if len(values) < LEAST_VALUES:
        return 0.0
    size = float(np.sqrt(np.mean(values**2)))
    if not size > 0.0:
        return 0.0
    normal = -len(values) * (0.5 + 0.5 * np.log(2 * np.pi))
    density = OUTLIER_RATE / (OUTLIER_DECADES * np.log(10.0) * np.maximum(np.abs(outliers / size), 1.0))
    z = np.concatenate([values, outliers]) / size
    half = 0.5 * (HEAVY_DOF + 1.0)
    constant = special.gammaln(half) - special.gammaln(0.5 * HEAVY_DOF) - 0.5 * np.log(HEAVY_DOF * np.pi)
    heavy = constant - half * np.log1p((z[:, None] / SCALES) ** 2 / HEAVY_DOF) - np.log(SCALES)
    return float(np.sum(heavy, axis=0).max() - normal - np.sum(np.log(density)))
