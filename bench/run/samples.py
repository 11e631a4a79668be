"""What the samples of one reading tell of it: scatter, drift, an outlier. All recorded, nothing applied.

Sources: drift is the slope of a straight line by least squares with Student's t test (NIST/SEMATECH
e-Handbook of Statistical Methods, 4.4.3 and 1.3.5); an outlier is looked for with Grubbs' two-sided test
(F. E. Grubbs, Technometrics 11 (1969) 1-21; e-Handbook 1.3.5.17.1).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.special import stdtr, stdtrit

from bench.base.arrays import Floats
from bench.readings.reading import Outlier

OUTLIER_LEVEL: Final = 0.01
"""Probability with which normal samples without an outlier are said to have one."""
OUTLIER_LEAST: Final = 7
"""Of fewer samples none is called an outlier.

The critical value is then within 5 % of the greatest deviation that can be, (n − 1)/√n: of three both are 1.155.
Whether a sample lies beyond it is a matter of how the others were rounded.
"""

_ROUNDING: Final = 1e-13
"""Relative size below which a scatter is the rounding of the computation."""


@lru_cache(maxsize=256)
def grubbs_critical(n: int, level: float = OUTLIER_LEVEL) -> float:
    """Return the critical value of Grubbs' two-sided test for n samples, in standard deviations.

    Raises `ValueError` for fewer than 3 samples, which cannot have an outlier.
    """
    if n < 3:
        raise ValueError(f"Grubbs' test needs 3 samples or more, not {n}")
    t2 = float(stdtrit(n - 2, level / (2 * n))) ** 2
    return (n - 1) / math.sqrt(n) * math.sqrt(t2 / (n - 2 + t2))


@dataclass(frozen=True)
class Statistics:
    """What the `n` samples of a channel tell, in their unit; None where a number does not exist.

    `sd` needs 2 samples, all of the drift 3, an outlier `OUTLIER_LEAST`. `drift` is the change from the first to
    the last sample by the fitted line, `drift_u` its standard uncertainty, `drift_p` the probability of as large
    a drift in samples that only scatter, `outlier` the sample that Grubbs' test at 1 % calls one.
    """

    n: int
    mean: float
    sd: float | None
    drift: float | None
    drift_u: float | None
    drift_p: float | None
    outlier: Outlier | None

    def drift_per_s(self, interval_s: float) -> float | None:
        """Return the drift in a second, where `interval_s` is the time from sample to sample."""
        return None if self.drift is None else self.drift / ((self.n - 1) * interval_s)


def describe(samples: Mapping[str, Sequence[float]], resolution: float = 0.0) -> dict[str, Statistics]:
    """Describe the samples of each channel.

    A sample no further than `resolution`, the last digit of the meter, from the median is no outlier.
    Raises `ValueError` for a channel without samples or with one that is not a finite number.
    """
    return {channel: _statistics(channel, values, resolution) for channel, values in samples.items()}


def _statistics(channel: str, samples: Sequence[float], resolution: float) -> Statistics:
    x = np.asarray(samples, dtype=np.float64)
    n = len(x)
    mean = float(x.sum()) / n if n else math.nan
    if not math.isfinite(mean):
        raise ValueError(f"channel {channel}: a reading is one or more finite numbers, not {list(samples)!r}")
    deviation = x - mean
    squares = float(deviation @ deviation)
    if squares <= n * (_ROUNDING * mean) ** 2:
        squares = 0.0  # equal samples: their mean is off by rounding
    sd = math.sqrt(squares / (n - 1)) if n > 1 else None
    drift, drift_u, drift_p = _drift(deviation, squares) if n > 2 else (None, None, None)
    outlier = _outlier(x, deviation, sd, resolution) if sd and n >= OUTLIER_LEAST else None
    return Statistics(n, mean, sd, drift, drift_u, drift_p, outlier)


def _drift(deviation: Floats, squares: float) -> tuple[float, float, float]:
    """Return the change over the reading, its standard uncertainty, and the p of the t test."""
    n = len(deviation)
    if squares == 0.0:
        return 0.0, 0.0, 1.0
    time, time_squares = _sample_times(n)
    drift = float(time @ deviation) / time_squares
    left = squares - drift**2 * time_squares
    if left <= _ROUNDING * squares:
        return drift, 0.0, 0.0  # samples exactly on a line
    u = math.sqrt(left / (n - 2) / time_squares)
    return drift, u, 2.0 * float(stdtr(n - 2, -abs(drift) / u))


@lru_cache(maxsize=64)
def _sample_times(n: int) -> tuple[Floats, float]:
    """Times of n samples about their middle, the whole reading being 1, and the sum of their squares."""
    time = np.arange(n) / (n - 1) - 0.5
    return time, float(time @ time)


def _outlier(x: Floats, deviation: Floats, sd: float, resolution: float) -> Outlier | None:
    worst = int(np.abs(deviation).argmax())
    sigma = abs(float(deviation[worst])) / sd
    critical = grubbs_critical(len(x))
    if sigma <= critical or abs(float(x[worst]) - float(np.median(x))) <= resolution * (1 + 1e-6):
        return None
    return Outlier(worst + 1, float(x[worst]), sigma, critical)
