"""Slow noise: what wanders in a channel over a run, as noise of its own.

A course of 1/f is a sum of waves over the run whose squares fall with their frequency. How large it is the
restricted likelihood says, the size of the white noise free beside it; it is there where the ratio of the
likelihoods is larger than chance makes it. Source: H. D. Patterson, R. Thompson, Biometrika 58 (1971) 545; for a
variance that ends at zero S. G. Self, K.-Y. Liang, J. Am. Stat. Assoc. 82 (1987) 605.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from bench.analysis.diagnosis.evidence import Whitened
from bench.analysis.diagnosis.linear import LinearSystem
from bench.base.arrays import Floats

WAVES: Final = 16
"""Half waves over a run, the slowest of them."""
SIZES: Final = tuple(np.geomspace(0.05, 20.0, 61))
"""Sizes that are tried, root mean squares in units of the noise of a reading."""
SURE: Final = 1e-3
"""Slow noise is there where chance alone makes its likelihood so much larger less often than this."""


@dataclass(frozen=True)
class SlowNoise:
    """Noise of a channel (0, 1, 2) that is slow: `size` its root mean square over a run, unit of the signal.

    `columns` (N, waves) are draws of unit variance of it, in the rows of the system; `odds` is ln of its
    evidence over that of none, of whatever size, `p` the chance of as much.
    """

    channel: int
    size: float
    odds: float
    p: float
    columns: Floats


def slow_noise(linear: LinearSystem, whitened: Whitened, ratio: int) -> tuple[SlowNoise, ...]:
    """Return the slow noise of each channel that has it, beside the coefficients and the stand's errors.

    `ratio` is the number of that of the two noise sizes in the grid of `whitened`.
    """
    return tuple(_found(linear, whitened, ratio))


def _found(linear: LinearSystem, whitened: Whitened, ratio: int) -> Iterator[SlowNoise]:
    white, sigma, freedom = whitened.grid.white[ratio], whitened.grid.sigma, whitened.grid.freedom
    left = white @ (linear.response / sigma)
    for channel in range(3):
        waves = _waves(linear, channel)
        if waves is None:
            continue
        inside = white @ waves  # those of a size of sigma
        values, vectors = np.linalg.eigh(inside.T @ inside)
        values = np.maximum(values, 0.0)
        square = (vectors.T @ (inside.T @ left)) ** 2
        variances = np.array(SIZES) ** 2
        weighed = 1.0 / (1.0 + variances[:, None] * values)
        rest = left @ left - np.sum(variances[:, None] * square * weighed, axis=1)
        likelihood = 0.5 * np.sum(np.log(weighed), axis=1) - 0.5 * freedom * np.log(rest)
        best = int(np.argmax(likelihood))
        none = -0.5 * freedom * np.log(left @ left)
        more = float(likelihood[best] - none)
        # of one channel in three, of any size alike: the price that names pay for their forms, too
        odds = float(special.logsumexp(likelihood - none) - np.log(3 * len(SIZES)))
        p = 0.5 * float(special.chdtrc(1, 2.0 * max(more, 0.0)))
        if p < SURE:
            # white noise beside it is smaller than what was found without it
            size = SIZES[best] * sigma * float(np.sqrt(rest[best] / freedom))
            yield SlowNoise(channel, size, odds, p, size * waves)


def _waves(linear: LinearSystem, channel: int) -> Floats | None:
    """Return draws of unit root mean square over the readings, (N, waves), of a course of 1/f of one channel."""
    own = np.flatnonzero((linear.setting >= 0) & (linear.rows.channel == channel))
    time = linear.conditions.elapsed_s[linear.rows.reading[own]]
    span = float(np.ptp(time))
    if len(own) < 2 * WAVES or not span > 0.0:
        return None
    k = np.arange(1, WAVES + 1)
    waves = np.cos(np.pi * k * (time[:, None] - time.min()) / span) / np.sqrt(k)
    columns = np.zeros((len(linear), WAVES))
    columns[own] = waves / np.sqrt(np.mean(np.sum(waves**2, axis=1)))
    return columns


def with_slow_noise(linear: LinearSystem, slow: Sequence[SlowNoise]) -> LinearSystem:
    """Return the system with slow noise among what is random."""
    return linear.with_noise(*(one.columns for one in slow))
