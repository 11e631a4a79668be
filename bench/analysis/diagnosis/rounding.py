"""A last digit that is coarser than the noise: readings of one setting are rounded alike, pass after pass.

Noise of s last digits (1 sigma) leaves of the error of rounding a part that repeats with the setting; its
variance in squares of the digit is sum over k of exp(-4 pi^2 k^2 s^2) / (2 pi^2 k^2), nothing from s = 0.5 on, 1/12
without any. Where it is not negligible, what the repeats say of the noise is no guide: that of rounding counts.
Source: B. Widrow, I. Kollar, Quantization Noise (Cambridge 2008), chapter 4.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.noise_grid import NoiseGrid, make_noise_grid
from bench.analysis.diagnosis.repeats import cells_of
from bench.readings.table import Readings

HARDLY_ANY: Final = 0.1
"""A part of the noise so small that it may be left out."""
TERMS: Final = 30


def digit_of(readings: Readings) -> float:
    """Return the step of the signals' last digit, unit of the signal: 2e-5 where all are even at 1e-5; 0: none."""
    resolution = readings.resolution
    if not resolution > 0.0 or readings.resolution_read is not None:
        return resolution
    steps = np.round(readings.signal / resolution).astype(np.int64)
    return resolution * max(int(np.gcd.reduce(steps.ravel())), 1)


def is_coarse(digit: float, sigma: float) -> bool:
    """Whether the last digit is coarser than the noise `sigma`, rounding included."""
    return digit > sigma


def is_rounded(digit: float, sigma: float) -> bool:
    """Whether rounding repeats itself: the noise is then believed to be `sigma`, that of the digit at least."""
    return repeated(digit, sigma) > HARDLY_ANY * sigma


def with_rounding(linear: LinearSystem, digit: float, sigma: float) -> LinearSystem:
    """Return the system in which readings of a setting share an error of rounding, where that is not negligible.

    `sigma` is the noise as the repeats give it, never less than that of rounding.
    """
    if not is_rounded(digit, sigma):
        return linear
    size = repeated(digit, sigma)
    oriented = np.flatnonzero(linear.setting >= 0)
    key = 3 * np.repeat(cells_of(linear), 3) + linear.rows.channel[oriented]
    columns = np.zeros((len(linear), int(key.max()) + 1))
    columns[oriented, key] = size
    return linear.with_noise(columns)


def grid_with_rounding(linear: LinearSystem, sigma: float, setting_rad: float, digit: float) -> NoiseGrid:
    """Return the maps of `make_noise_grid`; the noise is believed where rounding repeats itself."""
    return replace(make_noise_grid(linear, sigma, setting_rad), known=is_rounded(digit, sigma))


def repeated(digit: float, sigma: float) -> float:
    """Return the standard deviation of the error of rounding that repeats, unit of the signal."""
    if not digit > 0.0:
        return 0.0
    s2 = max(sigma**2 / digit**2 - 1.0 / 12.0, 0.0)
    k2 = np.arange(1, TERMS + 1) ** 2
    return float(digit * np.sqrt(np.sum(np.exp(-4 * np.pi**2 * k2 * s2) / (2 * np.pi**2 * k2))))
