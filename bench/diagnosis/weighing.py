"""Weights of readings: outlying ones, and channels whose noise differs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Ints, rms
from bench.diagnosis.candidates import Candidates
from bench.diagnosis.evidence import KNOWN_SIZE, Data, Whitened
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.mistakes.single_readings import BEYOND_TAILS, LEAST_VALUES, odds_of_tails
from bench.diagnosis.naming import Found, Naming
from bench.diagnosis.noise_grid import Whitener, make_whitener
from bench.diagnosis.posterior import NoiseSize, noise_size, posterior, whiten_rows
from bench.diagnosis.repeats import cells_of
from bench.stats.repeats_likelihood import believed_sizes

CLIP: Final = 2.5
"""Robust standard deviations beyond which a reading is weighed down."""
OF_READING: Final = 0.4
"""A row tells of the noise of readings where the fit, which has the error of its setting in it, leaves as much."""
FREEST: Final = 0.05
"""What the fit leaves of a reading is reckoned as no less than this."""
SURE: Final = -0.5
"""Tails count as heavy where ln of the odds for them is more: of normal noise it is about -5."""
CLEARLY: Final = 3.0
"""An effect in a few readings is there where ln of its odds is so much above that of the tails."""
ROUNDS: Final = 8
ROBUST: Final = 1.4826
"""Median of absolute values to standard deviation, of normal noise."""


@dataclass(frozen=True)
class WeighedDown:
    """By how much rows were changed, `pull` (N,), how many `readings` that concerns, ln of the `odds` of tails."""

    pull: Floats
    readings: int
    odds: float


def weigh_down(
    linear: LinearSystem, candidates: Candidates, naming: Naming, noise: NoiseSize
) -> WeighedDown | None:
    """Return how readings are weighed down beside what was found; None where the noise has no heavy tails.

    What shows in a few readings alone is what tails look like: single readings are among those that are weighed
    where tails reach as far, an effect too where its evidence is not clearly above that of the tails.
    """
    few = [found for found in naming.found if _in_few(candidates, found)]
    named = [found for found in few if found.variant.named]
    few = [found for found in few if found.variant.named or found.size < BEYOND_TAILS]
    weighed = _weighed(linear, candidates, [f for f in naming.found if f not in few], noise)
    if not named or weighed is None:
        return weighed
    if sum(found.total for found in named) < weighed.odds + CLEARLY:
        return weighed
    return _weighed(linear, candidates, [f for f in naming.found if f not in few or f in named], noise)


def _in_few(candidates: Candidates, found: Found) -> bool:
    """Whether what was found shows in fewer rows than tell of tails."""
    rows = np.any(candidates.columns[:, list(found.variant.columns)] != 0.0, axis=1)
    return bool(np.count_nonzero(rows) < LEAST_VALUES)


def _weighed(
    linear: LinearSystem, candidates: Candidates, beside: Sequence[Found], noise: NoiseSize
) -> WeighedDown | None:
    columns = [i for found in beside for i in found.variant.columns]
    fit = _Fit.of(linear, candidates.columns[:, columns], noise)
    spread = noise.reading * linear.relative * np.sqrt(np.maximum(fit.free, FREEST))
    size = (linear.response - fit @ linear.response) / spread
    telling = fit.free > OF_READING
    by_channel = [size[telling & (linear.rows.channel == c)] for c in range(4)]
    odds = odds_of_tails(np.concatenate(_alike(by_channel)))
    if odds < SURE:
        return None
    scale = np.array([_robust(of if len(of) >= LEAST_VALUES else size[telling]) for of in by_channel])
    limit = CLIP * spread * scale[linear.rows.channel]
    response = linear.response
    for _ in range(ROUNDS):
        fitted = fit @ response
        response = fitted + np.clip(linear.response - fitted, -limit, limit)
    pull = response - linear.response
    changed = np.abs(pull) > 0.1 * limit
    return WeighedDown(pull, len(set(linear.rows.reading[changed].tolist())), odds)


def _robust(values: Floats) -> float:
    """Return the standard deviation that a normal noise of the same median absolute value has."""
    return ROBUST * float(np.median(np.abs(values))) if len(values) else 1.0


def _alike(by_channel: list[Floats]) -> list[Floats]:
    """Return the values of each channel by their own root mean square; those of the moduli, few, as they are."""
    of_channels = [of / max(float(np.sqrt(np.mean(of**2))), 1e-300) for of in by_channel[:3] if len(of)]
    return [*of_channels, by_channel[3]]


@dataclass(frozen=True)
class _Fit:
    """What is fitted of responses (N,), each setting's error too; `free` (N,) is what it leaves of each row."""

    white: Whitener
    noise2: Floats
    free: Floats

    @classmethod
    def of(cls, linear: LinearSystem, effects: Floats, noise: NoiseSize) -> _Fit:
        """Fit the system with its stand angles and the effects' columns (N, m), all within their priors."""
        random = np.concatenate([linear.random, effects * KNOWN_SIZE], axis=1)
        white = make_whitener(replace(linear, random=random), noise.reading, noise.setting_rad)
        return cls(white, linear.relative**2, linear.relative**2 * white.diagonal)

    def __matmul__(self, response: Floats) -> Floats:
        # the noise of readings is what is left: its covariance by that of all, weighed
        return np.asarray(response - self.noise2 * self.white.weigh(response))


UNEQUAL_P: Final = 0.01
"""Channels have sizes of their own where chance alone makes them so different less often than this."""


@dataclass(frozen=True)
class ChannelSizes:
    """Sizes (3,) of the channels' noise, 1 on the average of squares, and all 1 where they are alike.

    `evidence` is ln odds that they have sizes of their own against one of all, no size of it more likely before.
    """

    sizes: Floats
    evidence: float


def by_channel(left: Floats, freedom: Floats, slope: Floats, cells: Ints, floor: float) -> ChannelSizes:
    """Return the sizes of the channels' noise.

    `left` (n, 3) is what a description leaves of each setting, `freedom` (n,) how much of it the description does
    not take up, `slope` (n, 3) du/dphi: what goes along it is the setting's. `cells` (n,) number settings with
    the same slope, `floor` is the least noise that is believed, unit of the signal.
    """
    count = int(cells.max()) + 1
    free = np.bincount(cells, freedom, count)
    products = (left[:, :, None] * left[:, None, :]).reshape(-1, 9)
    scatter = _by_cell(products, cells, count)
    mean = _by_cell(slope, cells, count) / np.bincount(cells, minlength=count)[:, None]
    used = free > 1e-6
    scatter, free = scatter[used].reshape(1, -1, 3, 3), free[used]
    found = believed_sizes(scatter, free, mean[used][None], floor)
    p_equal = float(found.p_equal[0])
    # of a chi-square with two degrees of freedom half is -ln p; two sizes more cost ln n (Schwarz's criterion)
    evidence = -math.log(max(p_equal, 1e-300)) - math.log(max(float(free.sum()), 1.0))
    if p_equal > UNEQUAL_P:
        return ChannelSizes(np.ones(3), evidence)
    sizes = np.sqrt(found.variances[0, :3])
    return ChannelSizes(np.asarray(sizes / rms(sizes)), evidence)


def _by_cell(columns: Floats, cells: Ints, count: int) -> Floats:
    sums = [np.bincount(cells, column, count) for column in columns.T]
    return np.asarray(np.stack(sums, axis=1), dtype=np.float64)


def sizes_left(
    linear: LinearSystem, candidates: Candidates, whitened: Whitened, data: Data, columns: Sequence[int]
) -> ChannelSizes:
    """Return the sizes of the channels' noise from what the model leaves with these columns of what was found."""
    noise = noise_size(whitened, data, tuple(columns))
    effects = candidates.columns[:, list(columns)]
    fitted = posterior(linear, effects, noise)
    design = np.concatenate([linear.fixed, linear.random, effects], axis=1)
    rows = np.ones(len(linear), dtype=bool)
    white = whiten_rows(linear, noise, design, rows)
    free = 1.0 - np.einsum("np,pq,nq->n", white, fitted.covariance, white, optimize=True)
    oriented = linear.setting >= 0
    of_run = linear.relative_of_run
    left = ((linear.response - design @ fitted.mean) / of_run)[oriented].reshape(-1, 3)
    slope = (linear.slope / of_run)[oriented].reshape(-1, 3)
    floor = 1e-11 * float(np.max(np.abs(linear.readings.signal)))
    return by_channel(left, free[oriented].reshape(-1, 3).mean(axis=1), slope, cells_of(linear), floor)
