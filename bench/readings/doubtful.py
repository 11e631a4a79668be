"""What may stand in a readings file and hardly can be: said in a sentence each, for the reader to judge."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.base.arrays import CHANNELS
from bench.readings.table import Readings


def doubtful(readings: Readings, lines: Sequence[int]) -> tuple[str, ...]:
    """Return a sentence for each doubt about a table; `lines` (n,) are the lines of its rows in the file."""
    return (*_time(readings, lines), *_scatter(readings, lines))


def _time(readings: Readings, lines: Sequence[int]) -> list[str]:
    known = np.flatnonzero(np.isfinite(readings.time_s))
    back = known[1:][np.diff(readings.time_s[known]) < 0.0]
    if not len(back):
        return []
    where = f"line {lines[back[0]]}" + (f" and {len(back) - 1} more" if len(back) > 1 else "")
    return [
        f"time_s runs backwards ({where}): rows stand in the order of measurement; is the file sorted anew?"
    ]


def _scatter(readings: Readings, lines: Sequence[int]) -> list[str]:
    """Doubt a scatter within one reading that exceeds all that the readings differ by."""
    told = []
    for i, axis in enumerate(CHANNELS):
        sd, span = readings.signal_sd[:, i], float(np.ptp(readings.signal[:, i]))
        if len(readings) > 2 and np.nanmax(np.append(sd, 0.0)) > span > 0.0:
            worst = int(np.nanargmax(sd))
            told.append(
                f"the standard deviation of u{axis} in line {lines[worst]}, {sd[worst]:.3g} {readings.unit}, "
                f"is more than all readings of it differ by, {span:.3g} {readings.unit}: check its unit"
            )
    return told
