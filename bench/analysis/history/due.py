"""When a block is due again: the day on which its expanded predicted error reaches the allowed one.

Until it is calibrated again, a block is used with the coefficients K, U0 found last. What they then make of an
acceleration of 1 g along a direction d is off by d K^-1 ((K' - K) d + U0' - U0), K' and U0' being those of the day.
Each earlier calibration tells this error as of its day; level, rate, random walk and scatter between calibrations
are found from them by weighted least squares with sizes by restricted likelihood (`bench.analysis.history.drift`),
for each of 26 directions: along the axes, between two, between three. The error expected on a day is |mean| + k u.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import numpy as np

from bench.analysis.calibration.conformity import COVERAGE_FACTOR
from bench.analysis.calibration.result import CalibrationError
from bench.analysis.history.drift import Dates, UnitDrift, history_drift
from bench.base.arrays import Floats

DIRECTIONS: Final[Floats] = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
"""Of specific force, shape (26, 3), not of length one."""
MOST_YEARS: Final = 20.0
"""A history does not foretell further."""
STEPS: Final = (92, 7, 1)
"""Days between looks for the day that is due, each within the one before."""
DAY: Final = np.timedelta64(1, "D")


@dataclass(frozen=True)
class Due:
    """When a block is due: `date`, by `basis`, "drift" or "interval", with `why`.

    `predicted_g` is the expanded error expected on that day, `now_g` on the day of the last calibration, in local
    g, None where only the interval speaks; `count` the calibrations that told it, `last` the day of the last.
    """

    date: np.datetime64
    basis: str
    why: str
    last: np.datetime64
    count: int
    limit_g: float
    now_g: float | None = None
    predicted_g: float | None = None
    simulated: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return the result."""
        return {
            "due": str(self.date.astype("datetime64[D]")),
            "basis": self.basis,
            "why": self.why,
            "last": str(self.last.astype("datetime64[D]")),
            "calibrations": self.count,
            "limit_g": self.limit_g,
            "error_at_last_g": self.now_g,
            "error_when_due_g": self.predicted_g,
            "simulated": self.simulated,
        }


def due(
    when: Dates,
    vector: Floats,
    covariance: Floats,
    limit_g: float,
    interval_days: float,
    u_meters: Floats | None = None,
    *,
    simulated: bool = False,
) -> Due:
    """Return when a block is due again that was calibrated at `when` (n,) with `vector` (n, 12) per one g.

    `covariance` (n, 12, 12) are the stated ones; `u_meters` (n, 12) is the part of u that the same meters bring
    again, None where other meters read. `limit_g` is the error allowed, in g, at 1 g in any direction.
    `interval_days` counts where there is no history to speak of, and is said to. Raises `CalibrationError` where
    there is no calibration, or the last has a K without inverse.
    """
    if len(when) == 0:
        raise CalibrationError("no calibration with a date tells when it is due")
    order = np.argsort(when, kind="stable")
    dates, values, known = when[order], vector[order], covariance[order]
    last = dates[-1]
    by_interval = last + np.timedelta64(round(interval_days * 86400), "s")
    seen = sensitivities(values[-1])
    errors = (values - values[-1]) @ seen.T
    common = None if u_meters is None else np.sqrt(np.min(u_meters[order] ** 2, axis=0) @ (seen.T**2))
    try:
        drift = history_drift(dates, errors, np.einsum("dj,njk,dk->nd", seen, known, seen), common)
    except CalibrationError as error:
        why = f"{error}: the interval of {interval_days:g} days counts"
        return Due(by_interval, "interval", why, last, len(dates), limit_g, simulated=simulated)
    now = float(_expanded(drift, np.array([last]))[0])
    if now >= limit_g:
        why = (
            f"the last calibration leaves an error of {now:.2g} g (k = {COVERAGE_FACTOR:g}), more than the "
            f"{limit_g:.2g} g allowed: no interval keeps it"
        )
        return Due(last, "drift", why, last, len(dates), limit_g, now, now, simulated)
    day, error_g = _first_day(drift, last.astype("datetime64[D]"), limit_g)
    why = (
        f"the error expected reaches {limit_g:.2g} g then (k = {COVERAGE_FACTOR:g})"
        if error_g >= limit_g
        else f"{MOST_YEARS:g} years on the error expected is still {error_g:.2g} g: no history foretells further"
    )
    return Due(day, "drift", why, last, len(dates), limit_g, now, error_g, simulated)


def _first_day(drift: UnitDrift, last: np.datetime64, limit_g: float) -> tuple[np.datetime64, float]:
    """Return the first day after the last on which the error reaches the limit, to within a step of `STEPS`."""
    begin, end = 0, round(MOST_YEARS * 365.25)
    for step in STEPS:
        days = np.unique(np.append(np.arange(begin + step, end, step), end))
        error_g = _expanded(drift, last + days * DAY)
        reached = int(np.argmax(error_g >= limit_g)) if np.any(error_g >= limit_g) else len(days) - 1
        begin, end = int(days[reached - 1]) if reached else begin, int(days[reached])
    return last + end * DAY, float(error_g[reached])


def sensitivities(vector: Floats) -> Floats:
    """Return what a change of each coefficient does to 1 g measured along each direction, shape (26, 12).

    Raises `CalibrationError` for a K without inverse.
    """
    along = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
    try:
        weights = along @ np.linalg.inv(vector[:9].reshape(3, 3))
    except np.linalg.LinAlgError:
        raise CalibrationError("the last calibration has a K without inverse") from None
    of_k = np.einsum("da,db->dab", weights, along).reshape(len(along), 9)
    return np.concatenate([of_k, weights], axis=1)


def _expanded(drift: UnitDrift, days: Dates) -> Floats:
    """Return |mean| + k u of the worst direction on each day, g."""
    mean, u = drift.predicted(days)
    return np.asarray(np.max(np.abs(mean) + COVERAGE_FACTOR * u, axis=-1))
