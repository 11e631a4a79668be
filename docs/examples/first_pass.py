"""Ordinary least squares on the first pass alone."""

from __future__ import annotations

import numpy as np

from bench.base.arrays import Floats
from bench.calibration.design import Problem
from bench.calibration.gls import Estimator
from bench.calibration.linear import least_squares_gain
from bench.readings.table import Readings


def first_pass_gain(problem: Problem, rows: Readings) -> Floats:
    """Return the map (12, n, 3): that of least squares on rows of pass 1, zero on all others."""
    first = rows.pass_number == 1
    weights = np.repeat(first, 3).astype(float)
    every = least_squares_gain(problem).reshape(12, -1)
    design = np.linalg.pinv(every)  # (3n, 12): what the readings would be, by the coefficients
    alone = np.linalg.pinv(design * weights[:, np.newaxis])
    return np.asarray((alone * weights).reshape(12, -1, 3), dtype=np.float64)


ESTIMATOR = Estimator("first-pass", "least squares on pass 1 alone", gain=first_pass_gain)
