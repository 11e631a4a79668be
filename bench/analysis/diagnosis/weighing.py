"""Readings far out, as the tails of the noise are, are weighed down before anything is sought in them.

Huber's modified residuals: what a reading is off the fit beyond `CLIP` robust standard deviations is taken off it,
fit and clipping in turn until both agree. What remains is searched as if it had been read: it is that which
least squares then make of it, and chance gives it no more evidence than normal noise.
Source: P. J. Huber, Robust Statistics (Wiley 1981), section 7.8.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.analysis.diagnosis.candidates import SINGLE_READING, SINGLE_SETTING, Candidates
from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.naming import Naming
from bench.analysis.diagnosis.posterior import NoiseSize, posterior, whiten_rows
from bench.analysis.mistakes.tails import odds_of_tails
from bench.base.arrays import Floats

CLIP: Final = 2.5
"""Robust standard deviations beyond which a reading is weighed down."""
OF_READING: Final = 0.4
"""A row tells of the noise of readings where as much of its variance is theirs, the rest that of the setting."""
SURE: Final = -0.5
"""Tails count as heavy where ln of the odds for them is more: of normal noise it is about -5."""
ROUNDS: Final = 6
ROBUST: Final = 1.4826
"""Median of absolute values to standard deviation, of normal noise."""


@dataclass(frozen=True)
class WeighedDown:
    """By how much rows were changed, `pull` (N,), and how many `readings` that concerns."""

    pull: Floats
    readings: int


def weigh_down(
    linear: LinearSystem, candidates: Candidates, naming: Naming, noise: NoiseSize
) -> WeighedDown | None:
    """Return how readings are weighed down beside what was found; None where the noise has no heavy tails.

    Single readings that were found are among those that are weighed: they are what tails look like.
    """
    singles = {SINGLE_READING, SINGLE_SETTING}
    columns = [i for f in naming.found if f.variant.family not in singles for i in f.variant.columns]
    effects = candidates.columns[:, columns]
    reading = noise.reading * linear.relative
    spread = np.sqrt(reading**2 + (noise.setting_rad * linear.slope) ** 2)
    left, free = _left(linear, effects, noise)
    size = left / (spread * np.sqrt(np.maximum(free, 0.05)))
    telling = (linear.setting >= 0) & ((reading / spread) ** 2 > OF_READING)
    by_channel = [size[telling & (linear.rows.channel == c)] for c in range(3)]
    if sum(odds_of_tails(of, np.inf) for of in by_channel) < SURE:
        return None
    robust = np.array([ROBUST * np.median(np.abs(of)) if len(of) else 1.0 for of in (*by_channel, size)])
    limit = CLIP * spread * np.minimum(robust, 1.0)[linear.rows.channel]
    response = linear.response
    for _ in range(ROUNDS):
        fitted = response - _left(replace(linear, response=response), effects, noise)[0]
        response = fitted + np.clip(linear.response - fitted, -limit, limit)
    pull = response - linear.response
    changed = np.abs(pull) > 0.1 * limit
    return WeighedDown(pull, len(set(linear.rows.reading[changed].tolist())))


def _left(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> tuple[Floats, Floats]:
    """Return what the fit leaves of each row (N,), and how much of its noise that is (N,)."""
    fitted = posterior(linear, effects, noise)
    design = np.concatenate([linear.fixed, linear.random, effects], axis=1)
    white = whiten_rows(linear, noise, design, np.ones(len(linear), dtype=bool))
    taken = np.einsum("np,pq,nq->n", white, fitted.covariance, white, optimize=True)
    return linear.response - design @ fitted.mean, 1.0 - taken
