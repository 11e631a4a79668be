"""Noise as benches have it: by channel, with tails, slow, and coarser than the last digit."""

from __future__ import annotations

from typing import Final

import numpy as np

from benchmarks.blind_trial.geometry import Floats

BY_CHANNEL: Final = np.array([9.0, 15.0, 33.0]) / 15.0
TAIL_DOF: Final = 4
SLOW_PART: Final = 0.5
COARSE: Final = 2.0
"""Last digit of the signals, in standard deviations of the noise."""

NOISES: Final = ("equal", "by channel", "t4", "1/f", "coarse")


def draw(rng: np.random.Generator, kind: str, n: int) -> Floats:
    """Return noise (n, 3) in units of the stated size: by channel 9/15, 15/15 and 33/15 of it; a t of 4 dof."""
    if kind == "t4":  # of the stated standard deviation
        return np.asarray(rng.standard_t(TAIL_DOF, (n, 3)) * np.sqrt((TAIL_DOF - 2) / TAIL_DOF))
    white = rng.normal(size=(n, 3))
    if kind == "by channel":
        return np.asarray(white * BY_CHANNEL)
    if kind == "1/f":
        return white + SLOW_PART * _slow(rng, n)
    return white


def _slow(rng: np.random.Generator, n: int) -> Floats:
    """1/f noise (n, 3) over the readings, rms 1 in each channel, from a course eight times as long."""
    long = 8 * n
    frequency = np.fft.rfftfreq(long)
    size = np.zeros(len(frequency))
    size[1:] = 1 / np.sqrt(frequency[1:])
    wave = rng.normal(size=(len(frequency), 3)) + 1j * rng.normal(size=(len(frequency), 3))
    course = np.fft.irfft(size[:, None] * wave, long, axis=0)[:n]
    course -= course.mean(axis=0)
    return np.asarray(course / np.sqrt(np.mean(course**2, axis=0)))
