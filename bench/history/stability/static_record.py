"""A static record: three signals of a block at rest, sampled at a steady rate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.base.numbers import read_number
from bench.base.visible import shortened
from bench.calibration.result import CalibrationError
from bench.readings.cells import OVERLOAD
from bench.readings.csv import LISTED_AT_ONCE, ReadingsError, split_table
from bench.readings.table import UNITS

LEAST_SAMPLES: Final = 32
EXAMPLE: Final = "time_s,ux_v,uy_v,uz_v"
STEADY: Final = 0.01
"""The rate in each tenth of a record may differ by this part: the Allan deviation hardly knows it."""


@dataclass(frozen=True)
class StaticRecord:
    """Signals (n, 3) in `unit`, one every `interval_s` seconds, as `source` has them."""

    source: str
    unit: str
    interval_s: float
    signal: Floats

    @property
    def duration_s(self) -> float:
        """Time over which it was taken, s."""
        return self.interval_s * len(self.signal)

    @property
    def mean(self) -> Floats:
        """Means of the three signals."""
        return np.asarray(self.signal.mean(axis=0), dtype=np.float64)

    @property
    def drift_per_s(self) -> Floats:
        """Slope of the straight line through each signal, unit/s."""
        time = self.interval_s * (np.arange(len(self.signal)) - (len(self.signal) - 1) / 2)
        return np.asarray(time @ (self.signal - self.mean) / (time @ time), dtype=np.float64)


def read_static(path: Path) -> StaticRecord:
    """Read a static record: a CSV file with `time_s` and three signal columns of one unit (`ux_v`, …).

    Further columns are left aside. Raises `ReadingsError` for a file that lacks a column or has cells that are
    no numbers (the first 20 are listed with line and column), `CalibrationError` as `from_columns` does.
    """
    header, body = split_table(path, EXAMPLE)
    suffixes = [s for s in UNITS if any(f"u{axis}_{s}" in header for axis in "xyz")]
    if len(suffixes) > 1:
        raise ReadingsError(
            f"{path}, line 1: signal columns in different units ({', '.join(suffixes)}); all three must be alike"
        )
    suffix = suffixes[0] if suffixes else "v"
    names = ["time_s", *(f"u{axis}_{suffix}" for axis in "xyz")]
    missing = [name for name in names if name not in header]
    if missing:
        raise ReadingsError(
            f"{path}, line 1: column {', '.join(missing)} is missing; a static record has {EXAMPLE} "
            f"(or _{', _'.join(s for s in UNITS if s != 'v')} for _v)"
        )
    places = [header.index(name) for name in names]
    bad: list[str] = []
    rows = [_row(path, line, cells, places, names, bad) for line, cells in body]
    if bad:
        more = [f"… and {len(bad) - LISTED_AT_ONCE} more"] if len(bad) > LISTED_AT_ONCE else []
        raise ReadingsError(
            "\n".join([*bad[:LISTED_AT_ONCE], *more, "nothing was used; a record has no holes: cut it there"])
        )
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return from_columns(str(path), UNITS[suffix], table[:, 0], table[:, 1:])


def from_columns(source: str, unit: str, time_s: Floats, signal: Floats) -> StaticRecord:
    """Make a record of times (n,) and signals (n, 3).

    Raises `CalibrationError` when there are fewer than 32 samples, a number is missing, or the times do not
    rise steadily: by one interval within half of it, at the same rate to 1 % throughout.
    """
    if len(time_s) < LEAST_SAMPLES:
        raise CalibrationError(
            f"{source}: {len(time_s)} samples; an Allan deviation needs {LEAST_SAMPLES} or more, and tells "
            "something of averaging over a quarter of the record at most"
        )
    whole = np.isfinite(time_s) & np.isfinite(signal).all(axis=1)
    if not np.all(whole):
        raise CalibrationError(
            f"{source}: sample {int(np.argmin(whole)) + 1} is not a number or has no time; cut the record there"
        )
    steps = np.diff(time_s)
    usual = float(np.median(steps))
    if usual <= 0 or np.any(steps <= 0):
        i = int(np.argmin(steps))
        raise CalibrationError(
            f"{source}: time_s does not rise after sample {i + 1} ({time_s[i]:g} s, then {time_s[i + 1]:g} s); "
            "a record is one stretch in order"
        )
    odd = np.abs(steps - usual) > 0.5 * usual
    if np.any(odd):
        i = int(np.argmax(odd))
        raise CalibrationError(
            f"{source}: time_s is not uniform: {steps[i]:g} s after sample {i + 1} (at {time_s[i]:g} s), "
            f"{usual:g} s elsewhere; cut the record there, or sample it anew at a steady rate"
        )
    rates = np.array([part.mean() for part in np.array_split(steps, 10)]) / steps.mean() - 1.0
    if np.max(np.abs(rates)) > STEADY:
        raise CalibrationError(
            f"{source}: the sampling interval changes by {100 * float(np.ptp(rates)):.1f} % along the record; "
            "sample it anew at a steady rate"
        )
    return StaticRecord(source, unit, float(steps.mean()), np.asarray(signal, dtype=np.float64))


def _row(
    path: Path, line: int, cells: list[str], places: list[int], names: list[str], bad: list[str]
) -> list[float]:
    """Return time and signals of a row; what is wrong with it is put into `bad`."""
    values = [math.nan] * 4
    for k, (place, name) in enumerate(zip(places, names, strict=True)):
        text = cells[place].strip() if place < len(cells) else ""
        try:
            values[k] = read_number(text)
        except ValueError:
            values[k] = math.nan
        if not abs(values[k]) < OVERLOAD:
            bad.append(f"{path}, line {line}, column {name}: expected a number, got {shortened(text)!r}")
    return values
