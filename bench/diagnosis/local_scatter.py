"""Places where readings scatter more than elsewhere: a channel, in an installation or in one of its passes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.posterior import NoiseSize, posterior, whiten_rows

SIGNIFICANT: Final = 1e-3
"""A place is named if its scatter has a probability by chance, corrected for all places, below this."""
LEAST_ROWS: Final = 4
EVERYWHERE: Final = "everywhere"
LARGER: Final = 1.5
"""Least ratio of the scatter in a place to the scatter elsewhere for which the place is named."""


@dataclass(frozen=True)
class LocalScatter:
    """Where readings scatter more: standard deviations there and elsewhere, unit of the signal."""

    channel: str
    where: str
    sd: float
    elsewhere: float
    p: float

    @property
    def words(self) -> str:
        """The place in words."""
        return f"channel {self.channel}, {self.where}"


def residuals(linear: LinearSystem, effects: Floats, noise: NoiseSize) -> Floats:
    """Return the residuals (N,) after a fit of effects' columns (N, m), without the setting error, in signal units.

    They are divided by the relative noise of their rows.
    """
    fitted = posterior(linear, effects, noise)
    left = linear.response - np.concatenate([linear.fixed, linear.random, effects], axis=1) @ fitted.mean
    return noise.reading * whiten_rows(linear, noise, left[:, None], np.ones(len(linear), dtype=bool))[:, 0]


def larger_scatter(linear: LinearSystem, left: Floats) -> LocalScatter | None:
    """Return the place whose residuals `left` (N,) scatter most in excess of the others; None if there is none."""
    return max(_larger(linear, left), key=lambda found: -found[0].p, default=(None, None))[0]


def relative_by_place(linear: LinearSystem, left: Floats) -> tuple[LocalScatter, Floats, float] | None:
    """Return the place in an installation that scatters most, the relative noise (N,) with it, and ln of its cost.

    The mean square of the relative noise is 1. The cost counts the choice of one place among all, and one more
    size. None if no place scatters significantly more.
    """
    places = (one for one in _larger(linear, left) if one[0].where != EVERYWHERE)
    found = max(places, key=lambda one: -one[0].p, default=None)
    if found is None:
        return None
    scatter, rows = found
    size = np.where(rows, scatter.sd / scatter.elsewhere, 1.0)
    cost = -np.log(len(list(_places(linear)))) - 0.5 * np.log(np.count_nonzero(rows))
    return scatter, size / np.sqrt(np.mean(size**2)), float(cost)


def _larger(linear: LinearSystem, left: Floats) -> Iterator[tuple[LocalScatter, Mask]]:
    """Yield the places that scatter significantly more than elsewhere, each with its rows (N,)."""
    places = list(_places(linear))
    oriented = linear.setting >= 0
    for channel, where, rows in places:
        others = oriented & ~rows
        inside, outside = int(rows.sum()), int(others.sum())
        if inside < LEAST_ROWS or outside < LEAST_ROWS:
            continue
        sd, elsewhere = (float(np.sqrt(np.mean(left[of] ** 2))) for of in (rows, others))
        if sd <= LARGER * elsewhere:
            continue
        p = float(special.fdtrc(inside, outside, (sd / elsewhere) ** 2)) * len(places)
        if p < SIGNIFICANT:
            yield LocalScatter(channel, where, sd, elsewhere, p), rows


def _places(linear: LinearSystem) -> Iterator[tuple[str, str, Mask]]:
    """Yield channel, words and rows (N,) of each place."""
    rows, readings = linear.rows, linear.readings
    oriented = linear.setting >= 0
    label = readings.installation[rows.reading]
    series = readings.series[rows.reading]
    mounts = np.array([i if s == 1 else f"{i}/{s}" for s, i in zip(series, label, strict=True)])
    passes = readings.pass_number[rows.reading]
    for c, channel in enumerate(CHANNELS):
        own = oriented & (rows.channel == c)
        yield channel, EVERYWHERE, own
        for mount in dict.fromkeys(mounts[own].tolist()):
            here = own & (mounts == mount)
            yield channel, f"installation {mount}", here
            for number in dict.fromkeys(passes[here].tolist()):
                yield channel, f"installation {mount}, pass {number}", here & (passes == number)
