"""Slow noise: what wanders in a channel over a run, as noise of its own.

A course of 1/f is a sum of waves over the run whose squares fall with their frequency. How large it is the
restricted likelihood says, the size of the white noise free beside it; it is there where the ratio of the
likelihoods is larger than chance makes it. Source: H. D. Patterson, R. Thompson, Biometrika 58 (1971) 545; for a
variance that ends at zero S. G. Self, K.-Y. Liang, J. Am. Stat. Assoc. 82 (1987) 605.

Slow noise that is too small to show by itself still looks like an effect. So what hardly reaches the threshold must
hold beside it: the odds that anything is missing are taken with all sizes of slow noise and with none, each as
plausible as the readings leave it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import special

from bench.analysis.diagnosis.evidence import KNOWN_SIZE, Data, Search, Whitened
from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.threshold import total_evidence
from bench.base.arrays import Floats

WAVES: Final = 16
"""Half waves over a run, the slowest of them."""
SIZES: Final = tuple(np.geomspace(0.05, 20.0, 61))
"""Sizes that are tried, root mean squares in units of the noise of a reading."""
SURE: Final = 1e-3
"""Slow noise is there where chance alone makes its likelihood so much larger less often than this."""
BESIDE: Final = (0.25, 0.5, 1.0, 2.0)
"""Sizes of slow noise of all channels beside which what was found must hold, in units of the noise of a reading."""


@dataclass(frozen=True)
class SlowNoise:
    """Noise of a channel (0, 1, 2) that is slow: `size` its root mean square over a run, unit of the signal.

    `columns` (N, waves) are draws of unit variance of it, in the rows of the system; `odds` is ln of its
    evidence over that of none, of whatever size: its share, where it is of all channels alike. Where it is not
    `sure` it does not show by itself: it only explains the readings as well as an effect does.
    """

    channel: int
    size: float
    odds: float
    columns: Floats
    sure: bool = True


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
            yield SlowNoise(channel, size, odds, size * waves)


@dataclass(frozen=True)
class Beside:
    """What slow noise of all channels, of whatever size, leaves of the odds that anything is missing.

    `total` is their ln, over all sizes and none; `slow` is the noise of the likeliest size.
    """

    total: float
    slow: tuple[SlowNoise, ...]


def beside_all_sizes(
    linear: LinearSystem, whitened: Whitened, noise: float, plausible: float
) -> Beside | None:
    """Return the odds that anything is missing where slow noise may be there.

    `noise` is that of a reading, unit of the signal, `plausible` what the odds of slow noise are beforehand, of all
    its sizes together. None where readings are too few to tell of it.
    """
    own = {c: waves for c in range(3) if (waves := _waves(linear, c)) is not None}
    if not own:
        return None
    units = [noise * linear.by_channel[c] * waves for c, waves in own.items()]
    whole, models = _with_courses(whitened, np.column_stack(units))
    data = whole.reduce(linear.response[:, None])
    scored = np.array([_scored(whole, data, known) for known in models])
    weight = scored[:, 0] + np.log([1.0, *np.full(len(BESIDE), plausible / len(BESIDE))])
    total = float(special.logsumexp(weight + scored[:, 1]) - special.logsumexp(weight))
    size = BESIDE[int(np.argmax(weight[1:]))]
    odds = float(special.logsumexp(weight[1:]) - weight[0]) / len(own)
    slow = (
        SlowNoise(channel, size * noise * float(linear.by_channel[channel]), odds, size * columns, sure=False)
        for channel, columns in zip(own, units, strict=True)
    )
    return Beside(total, tuple(slow))


def _with_courses(whitened: Whitened, courses: Floats) -> tuple[Whitened, list[tuple[int, ...]]]:
    """Return candidates with courses (N, k) in each size beside them; the columns of no course and of each size.

    A column that a model has counts with the prior size of `KNOWN_SIZE`: as one of a course it has its own.
    """
    columns = whitened.candidates.columns
    sized = [size / KNOWN_SIZE * courses for size in BESIDE]
    grown = replace(whitened.candidates, columns=np.column_stack([columns, *sized]))
    first, many = columns.shape[1], courses.shape[1]
    starts = range(first, first + many * len(BESIDE), many)
    whole = Whitened.of(whitened.grid, grown, few_known=True)
    return whole, [(), *(tuple(range(start, start + many)) for start in starts)]


def _scored(whole: Whitened, data: Data, known: tuple[int, ...]) -> tuple[float, float]:
    """Return ln of the likelihood of a model with these columns, and ln odds that anything is missing beside it."""
    search, grid = Search.beside(whole, known), whole.grid
    square = search.left_over(data).square[:, 0]
    likelihood = special.logsumexp(
        grid.log_prior + grid.log_det + search.log_det + grid.log_likelihood(square)
    )
    return float(likelihood), float(total_evidence(search.score(data), whole)[0])


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
