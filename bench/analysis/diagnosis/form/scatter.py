"""What has no mean form: readings that scatter more in one place than elsewhere, as a variance and where."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from bench.analysis.diagnosis.linear import LinearSystem
from bench.base.arrays import CHANNELS, Floats, Mask

SIGNIFICANT: Final = 1e-3
"""Chance of so much scatter somewhere, all places counted, below which it is said."""
LEAST_ROWS: Final = 4
LARGER: Final = 1.5
"""By how much the scatter must be larger than elsewhere to be worth a word."""


@dataclass(frozen=True)
class Scatter:
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


def larger_scatter(linear: LinearSystem, left: Floats) -> Scatter | None:
    """Return the place whose residuals `left` (N,) scatter most beyond the others, None where none does."""
    places = list(_places(linear))
    best: Scatter | None = None
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
        if p < SIGNIFICANT and (best is None or p < best.p):
            best = Scatter(channel, where, sd, elsewhere, p)
    return best


def _places(linear: LinearSystem) -> Iterator[tuple[str, str, Mask]]:
    rows, readings = linear.rows, linear.readings
    oriented = linear.setting >= 0
    label = readings.installation[rows.reading]
    series = readings.series[rows.reading]
    mounts = np.array([i if s == 1 else f"{i}/{s}" for s, i in zip(series, label, strict=True)])
    passes = readings.pass_number[rows.reading]
    for c, channel in enumerate(CHANNELS):
        own = oriented & (rows.channel == c)
        yield channel, "everywhere", own
        for mount in dict.fromkeys(mounts[own].tolist()):
            here = own & (mounts == mount)
            yield channel, f"installation {mount}", here
            for number in dict.fromkeys(passes[here].tolist()):
                yield channel, f"installation {mount}, pass {number}", here & (passes == number)
