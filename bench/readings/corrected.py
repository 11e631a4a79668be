"""Readings with known errors of the instruments taken away: the record holds what was read, analyses what is true.

A correction is what is added to a value that was read (JCGM 200:2012, 2.53).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.readings.table import Readings

Curve = tuple[tuple[float, float], ...]
"""Where corrections are known, rising, and the correction there; straight between."""

VOLTS: Final = "V"
AGAIN: Final = 4
"""A correction changes little within itself: so many rounds find from what value it was."""


@dataclass(frozen=True)
class Corrections:
    """What is added to readings: U (1 + `gain`) + `offset_v` for x, y, z; to the angle and the temperature read.

    `head` is in rad over a turn from 0 on, which it goes round; `thermometer` in K over °C, its ends hold beyond.
    """

    gain: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset_v: tuple[float, float, float] = (0.0, 0.0, 0.0)
    head: Curve = ()
    thermometer: Curve = ()

    @property
    def of_signals(self) -> bool:
        """Whether any signal is corrected."""
        return any(self.gain) or any(self.offset_v)

    def then(self, gain: tuple[float, float, float], offset_v: tuple[float, float, float]) -> Corrections:
        """Return these corrections with further ones of the signals after them: U (1 + `gain`) + `offset_v`."""
        both = [(1.0 + own) * (1.0 + more) - 1.0 for own, more in zip(self.gain, gain, strict=True)]
        sums = [own * (1.0 + more) + added
                for own, more, added in zip(self.offset_v, gain, offset_v, strict=True)]  # fmt: skip
        return replace(self, gain=(both[0], both[1], both[2]), offset_v=(sums[0], sums[1], sums[2]))

    def __bool__(self) -> bool:
        return self.of_signals or bool(self.head) or bool(self.thermometer)


def corrected(readings: Readings, by: Corrections) -> Readings:
    """Return readings with the corrections added, marked as such: those that are marked come back as they are.

    Signals are corrected where they are in volts. The last digit of the readings stays that of what was read.
    """
    if readings.corrected or not by:
        return readings
    signal, signal_sd = readings.signal, readings.signal_sd
    if by.of_signals and readings.unit == VOLTS:
        scale = 1.0 + np.array(by.gain)
        signal, signal_sd = signal * scale + np.array(by.offset_v), signal_sd * scale
    angle_rad, temperature_c = readings.angle_rad, readings.temperature_c
    if by.head:
        angle_rad = angle_rad + on_scale(by.head, angle_rad)
    if by.thermometer:
        known_c, added_k = np.array(by.thermometer).T
        temperature_c = temperature_c + np.interp(temperature_c, known_c, added_k)
    return replace(
        readings,
        signal=signal,
        signal_sd=signal_sd,
        angle_rad=angle_rad,
        temperature_c=temperature_c,
        corrected=True,
        resolution_read=readings.resolution,
    )


def as_read(readings: Readings, by: Corrections) -> Readings:
    """Return what the instruments showed: that which is `readings` once these corrections are added."""
    if not readings.corrected or not by:
        return readings
    signal, signal_sd = readings.signal, readings.signal_sd
    if by.of_signals and readings.unit == VOLTS:
        scale = 1.0 + np.array(by.gain)
        signal, signal_sd = (signal - np.array(by.offset_v)) / scale, signal_sd / scale
    angle_rad, temperature_c = readings.angle_rad, readings.temperature_c
    for _ in range(AGAIN if by.head else 0):
        angle_rad = readings.angle_rad - on_scale(by.head, angle_rad)
    if by.thermometer:
        known_c, added_k = np.array(by.thermometer).T
        for _ in range(AGAIN):
            temperature_c = readings.temperature_c - np.interp(temperature_c, known_c, added_k)
    return replace(
        readings,
        signal=signal,
        signal_sd=signal_sd,
        angle_rad=angle_rad,
        temperature_c=temperature_c,
        corrected=False,
        resolution_read=None,
    )


def on_scale(table: Curve, angle_rad: Floats) -> Floats:
    """Return the corrections of a head's table at angles of any size, rad; NaN for NaN."""
    known_rad, added_rad = np.array(table).T
    return np.asarray(np.interp(angle_rad, known_rad, added_rad, period=math.tau))
