"""How zeros go between records: how far beyond their u, and how much of it is common to the sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from bench.analysis.calibration.design import UPPER
from bench.analysis.calibration.result import CalibrationError
from bench.analysis.calibration.verification import modulus_slopes
from bench.analysis.diagnosis.free_records import OWN, ZEROS, FreeRows, fit_sensor
from bench.base.arrays import CHANNELS, Floats
from bench.readings.table import Readings

MUCH: Final = 0.8
SOME: Final = 0.5
"""Parts of the variance of the changes that make them common to the sensors, or in part."""


@dataclass(frozen=True)
class BetweenRecords:
    """Zeros (sensors, records, 3) in g with their u, each record fitted by itself; NaN where it cannot be.

    `ratio` is the scatter of the zeros about their mean over the stated u; `scatter` (3,) in g; `common` (3,) is
    what part of the variance the sensors share, NaN for one sensor. `held_before`, `held_after` are that ratio for
    each record held out, by what the other records say: without, and with their scatter and what the other sensors
    show in the same record.
    """

    zero: Floats
    u: Floats
    ratio: float
    scatter: Floats
    common: Floats
    held_before: float
    held_after: float

    def in_words(self) -> str:
        """Return how far they go, what is common, what is held out."""
        sizes = ", ".join(f"{c} {size * 1e3:.2g} mg" for c, size in zip(CHANNELS, self.scatter, strict=True))
        text = f"scatter {sizes}, {self.ratio:.3g} times the stated u"
        shares = [c for c, part in zip(CHANNELS, self.common, strict=True) if part >= MUCH]
        partly = [c for c, part in zip(CHANNELS, self.common, strict=True) if SOME <= part < MUCH]
        if np.all(np.isnan(self.common)):
            text += "; of one sensor nothing says whether others would change alike"
        elif shares or partly:
            parts = [f"{c} {100 * self.common[CHANNELS.index(c)]:.0f} %" for c in (*shares, *partly)]
            text += f"; the change is common to the sensors ({', '.join(parts)} of its variance)"
        else:
            text += "; each sensor changes by itself"
        return (
            f"{text}; the cause is not determined; held out by record the ratio is {self.held_before:.3g} with "
            f"zeros that stay and {self.held_after:.2g} with zeros of each record"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers; NaN is null."""

        def plain(values: Floats) -> Any:
            return np.where(np.isfinite(values), values, None).tolist()  # type: ignore[call-overload]

        return {
            "ratio": self.ratio,
            "scatter_g": plain(self.scatter),
            "common_part": plain(self.common),
            "held_out": {"by": "record", "before": self.held_before, "after": self.held_after},
            "zeros_g": plain(self.zero),
            "u_g": plain(self.u),
        }


def between_records(rows: FreeRows, tables: Sequence[Readings]) -> BetweenRecords | None:
    """Return how zeros go between records; None where fewer than two records of any sensor determine them."""
    records = np.unique(rows.record)
    zero = np.full((rows.sensors, len(records), 3), np.nan)
    u = np.full_like(zero, np.nan)
    for sensor, table in enumerate(rows.tables):
        record = rows.record[rows.sensor == sensor]
        for number, one in enumerate(records):
            estimate = _zeros(table.signal[record == one])
            if estimate is not None:
                zero[sensor, number], u[sensor, number] = estimate
    full = np.isfinite(zero).all(axis=2)
    usable = full.sum(axis=1) > 1
    if not usable.any():
        return None
    change = zero - np.nanmean(zero, axis=1, keepdims=True)
    degrees = (full.sum(axis=1, keepdims=True) - 1)[:, :, None] / np.maximum(full.sum(axis=1), 1)[
        :, None, None
    ]
    ratio = float(np.sqrt(np.nanmean(change[usable] ** 2 / u[usable] ** 2 / degrees[usable])))
    scatter = np.sqrt(np.nanmean(change[usable] ** 2 / degrees[usable], axis=(0, 1)))
    common = _common(change, full)
    before, after = _held_out(zero, u, full)
    return BetweenRecords(zero, u, ratio, scatter, common, before, after)


def _zeros(signal: Floats) -> tuple[Floats, Floats] | None:
    """Return the zeros (3,) of a sensor in one record, g, with u; None where its positions do not tell them."""
    try:
        block = fit_sensor(signal)
    except CalibrationError:
        return None
    force = block.specific_force(signal)
    slopes, _ = modulus_slopes(force, block)
    freedom = len(signal) - OWN
    if freedom < 1:
        return None
    left = 1.0 - np.linalg.norm(force, axis=1)
    covariance = np.linalg.inv(slopes[:, UPPER].T @ slopes[:, UPPER]) * float(left @ left) / freedom
    scale = np.abs(np.diag(block.K))
    return block.U0 / scale, np.sqrt(np.diag(covariance)[list(ZEROS)]) / scale


def _common(change: Floats, full: Floats) -> Floats:
    """Return what part of the variance of the changes (sensors, records, 3) all sensors have in common, (3,)."""
    whole = full.all(axis=0)
    sensors = len(change)
    if sensors < 2 or whole.sum() < 2:
        return np.full(3, np.nan)
    own = change[:, whole]
    total = np.mean(own**2, axis=(0, 1))
    # the mean of independent changes would have 1/sensors of the variance
    mean = np.mean(np.mean(own, axis=0) ** 2, axis=0)
    part = (mean - total / sensors) / (total * (1.0 - 1.0 / sensors))
    return np.asarray(np.clip(part, 0.0, 1.0))


def _held_out(zero: Floats, u: Floats, full: Floats) -> tuple[float, float]:
    """Return how far a record's zeros lie off what the others say, over the u of that, before and after.

    Before, the zeros of a sensor stay, and the others' mean is known to its u. After, they scatter as they do in
    the other records, and where other sensors were measured in the same record, by what those have in common.
    """
    before, after = [], []
    for record in range(zero.shape[1]):
        others = np.arange(zero.shape[1]) != record
        for sensor in np.flatnonzero(full[:, record]).tolist():
            known = others & full[sensor]
            if known.sum() < 2:
                continue
            past = zero[sensor, known]
            mean, count = past.mean(axis=0), len(past)
            off = zero[sensor, record] - mean
            stated = u[sensor, record] ** 2 + np.sum(u[sensor, known] ** 2, axis=0) / count**2
            before.append(off**2 / stated)
            off, spread = _with_scatter(zero, full, sensor, record, known, off)
            after.append(off**2 / (stated + spread))
    if not before:
        return float("nan"), float("nan")
    return float(np.sqrt(np.mean(before))), float(np.sqrt(np.mean(after)))


def _with_scatter(
    zero: Floats, full: Floats, sensor: int, record: int, known: Floats, off: Floats
) -> tuple[Floats, Floats]:
    """Return what is left of `off` beside the other sensors' change in this record, and the variance of it."""
    past = zero[sensor, known]
    own = past - past.mean(axis=0)
    fellows = [s for s in range(len(zero)) if s != sensor and full[s, record] and np.all(full[s, known])]
    fellows = fellows if len(past) > 2 else []
    if not fellows:
        return off, own.var(axis=0, ddof=1) * (1.0 + 1.0 / len(past))
    means = zero[fellows][:, known].mean(axis=1, keepdims=True)
    theirs = (zero[fellows][:, known] - means).mean(axis=0)
    now = (zero[fellows, record] - means[:, 0]).mean(axis=0)
    slope = np.sum(own * theirs, axis=0) / np.maximum(np.sum(theirs**2, axis=0), 1e-300)
    left = own - slope * theirs
    variance = np.sum(left**2, axis=0) / (len(past) - 2)
    leverage = 1.0 + 1.0 / len(past) + now**2 / np.maximum(np.sum(theirs**2, axis=0), 1e-300)
    return off - slope * now, variance * leverage
