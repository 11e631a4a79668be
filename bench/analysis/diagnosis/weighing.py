"""Readings far out, as the tails of the noise are, are weighed down before anything is sought in them.

Huber's modified residuals: what a reading is off the fit beyond `CLIP` robust standard deviations of that residual
is taken off it, fit and clipping in turn until both agree. What remains is searched as if it had been read: it is
that which least squares then make of it, and chance gives it no more evidence than normal noise. The error of a
setting is part of the fit: what is far out is a reading beside the two others of its setting, and the limit shrinks
with what the fit leaves of it, so that no reading pulls the fit to itself.
Source: P. J. Huber, Robust Statistics (Wiley 1981), sections 7.8 and 7.9.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.analysis.diagnosis.candidates import Candidates
from bench.analysis.diagnosis.evidence import KNOWN_SIZE
from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.naming import Found, Naming
from bench.analysis.diagnosis.noise_grid import Whitener, make_whitener
from bench.analysis.diagnosis.posterior import NoiseSize
from bench.analysis.mistakes.tails import BEYOND_TAILS, LEAST_VALUES, odds_of_tails
from bench.base.arrays import Floats

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
