"""In what the noise is not the normal noise of one size that a search begins with: said, and reckoned with."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.posterior import NoiseSize
from bench.analysis.diagnosis.rounding import is_coarse
from bench.analysis.diagnosis.slow_noise import SlowNoise
from bench.analysis.diagnosis.weighing import WeighedDown
from bench.base.arrays import CHANNELS
from bench.base.numbers import quantity


@dataclass(frozen=True)
class NoiseKind:
    """What the noise is: unequal "channels" or "runs", with heavy "tails", "slow", of a coarse "resolution"."""

    what: str
    words: str


def noise_kinds(
    linear: LinearSystem,
    noise: NoiseSize,
    weighed: WeighedDown | None,
    digit: float,
    slow: Sequence[SlowNoise] = (),
) -> Iterator[NoiseKind]:
    """Yield what the noise is beside normal and of one size; `digit` is the step of the signals' last digit."""
    unit = linear.readings.unit
    if np.any(linear.by_channel != 1.0):
        sizes = noise.reading * linear.by_channel
        told = ", ".join(f"{quantity(size, unit)} in {c}" for c, size in zip(CHANNELS, sizes, strict=True))
        yield NoiseKind("channels", f"the channels have noise of different sizes: {told}")
    if linear.by_run is not None:
        own = ", ".join(
            f"{quantity(noise.reading * float(size), unit)} in series {', '.join(str(s) for s in series)}"
            for series, size in zip(_series(linear), linear.by_run.sizes, strict=True)
        )
        yield NoiseKind("runs", f"the runs have noise of different sizes, and each weighs by its own: {own}")
    if weighed is not None:
        yield NoiseKind(
            "tails",
            f"the noise has heavier tails than a normal one: {weighed.readings} readings are weighed down, and an "
            "outlier is named only where it is far beyond them",
        )
    if slow:
        told = ", ".join(f"{quantity(one.size, unit)} in {CHANNELS[one.channel]}" for one in slow)
        over = f"slow noise, over the run {told} (root mean square)"
        if all(one.sure for one in slow):
            there = f"beside the noise of a reading there is {over}"
        else:
            there = f"{over}, explains the readings as well as an effect does"
        yield NoiseKind(
            "slow",
            f"{there}: a drift that is no larger stays hidden in it, and the u of the coefficients holds it",
        )
    if is_coarse(digit, noise.reading):
        yield NoiseKind(
            "resolution",
            f"the signals' last digit is {quantity(digit, unit)}, coarser than their noise: readings of a setting "
            "are rounded alike, and what is smaller than the digit may stay hidden",
        )


def _series(linear: LinearSystem) -> list[list[int]]:
    """Return the series of each run."""
    readings = linear.readings
    return [np.unique(readings.series[readings.run == number]).tolist() for number in np.unique(readings.run)]
