"""What a level showed of the platform, beside the readings of the mountings that it was levelled for.

In a readings file it stands in columns of every row of the mounting: α1 and α2 with their standard uncertainties,
and, where the platform was read again later, how fast it moved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import ARCSEC, HOUR
from bench.model.distribution import Distribution
from bench.readings.level_columns import ANGLES, DRIFTS
from bench.readings.table import Readings

DAY: Final = 24.0 * HOUR

FOUNDATION: Final = Distribution(2.0 * ARCSEC / DAY, "rectangular")
"""How fast a foundation may tilt where nobody measured it, rad/s: the paper's moves 1 to 2 arcseconds a day."""
FOUNDATION_ARCSEC_H: Final = FOUNDATION.u * HOUR / ARCSEC
REFUTED: Final = 3.0
"""Two readings that are further apart than so many standard uncertainties have a platform that moved more."""


@dataclass(frozen=True)
class Seen:
    """What the level showed at a bench time: α1 and α2 with their u, arcsec; `levelled` just before it."""

    time_s: float
    mounting: tuple[int, str]
    levelled: bool
    alpha_arcsec: tuple[float, float]
    u_arcsec: tuple[float, float]


def with_levels(readings: Readings, seen: Sequence[Seen]) -> Readings:
    """Return the readings with the columns of what was seen, in the order of time; as they are for nothing seen."""
    found = {mounting: of for mounting in {s.mounting for s in seen} if (of := _course(seen, mounting))}
    if not found:
        return readings
    drifts = [of.drift for of in found.values() if of.drift is not None]
    columns: dict[str, list[str]] = {name: [] for name in (*ANGLES, *(DRIFTS if drifts else ()))}
    for place in zip(readings.series.tolist(), readings.installation.tolist(), strict=True):
        known = found.get(place)
        for k, name in enumerate(ANGLES):
            columns[name].append("" if known is None else f"{(*known.alpha, *known.u)[k]:.4f}")
        for k, name in enumerate(DRIFTS if drifts else ()):
            columns[name].append(f"{math.sqrt(sum(drift[k] ** 2 for drift in drifts) / len(drifts)):.5f}")
    cells = {name: np.array(column, dtype=np.str_) for name, column in columns.items()}
    return replace(readings, extra={**readings.extra, **cells})


@dataclass(frozen=True)
class _Course:
    """α1, α2 and their u in the middle of a mounting, arcsec; how fast they moved, arcsec/h, root mean square."""

    alpha: tuple[float, float]
    u: tuple[float, float]
    drift: tuple[float, float] | None = None


def _course(seen: Sequence[Seen], mounting: tuple[int, str]) -> _Course | None:
    """Return what is known of the platform in a mounting; None where it was not levelled for it."""
    own = [s for s in seen if s.mounting == mounting]
    last = max((k for k, s in enumerate(own) if s.levelled), default=None)
    if last is None:
        return None
    first, again = own[last], own[-1]
    hours = (again.time_s - first.time_s) / HOUR
    if again is first or hours <= 0.0:
        return _Course(first.alpha_arcsec, first.u_arcsec)
    along, across = (
        _line((first.alpha_arcsec[k], again.alpha_arcsec[k]), (first.u_arcsec[k], again.u_arcsec[k]), hours)
        for k in (0, 1)
    )
    return _Course((along[0], across[0]), (along[1], across[1]), (along[2], across[2]))


def _line(alpha: tuple[float, float], u: tuple[float, float], hours: float) -> tuple[float, float, float]:
    """Return an angle in the middle between two readings of it, its u, and the root mean square of its rate.

    It goes straight from one to the other. Of its rate it is known before that no foundation moves more than
    `FOUNDATION`; where the two readings are too far apart for that, as much as they say.
    """
    moved = alpha[1] - alpha[0]
    rate_u = FOUNDATION_ARCSEC_H
    if abs(moved) > REFUTED * math.hypot(*u, rate_u * hours):
        rate_u = abs(moved) / hours
    rows = np.array(
        [[1.0 / u[0], -hours / (2.0 * u[0])], [1.0 / u[1], hours / (2.0 * u[1])], [0.0, 1.0 / rate_u]]
    )
    covariance = np.linalg.inv(rows.T @ rows)
    middle, rate = covariance @ rows.T @ np.array([alpha[0] / u[0], alpha[1] / u[1], 0.0])
    u_middle, u_rate = np.sqrt(np.diag(covariance))
    return float(middle), float(u_middle), float(math.hypot(rate, u_rate))
