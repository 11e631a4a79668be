"""Readings over several temperatures, sorted: which mounting, which temperature, reached from which side.

A mounting is what has the same stand angles: it lasts while the installation stays the same, whatever the
temperature does meanwhile. Where the block is mounted anew at the same temperature, the column `series` tells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Ints, Mask
from bench.calibration import CalibrationError
from bench.readings.table import REFERENCE, SHORTED, UNORIENTED, VERIFICATION, JoinedPart, Readings, together

PLATEAU_K: Final = 2.0
"""Temperatures within so many kelvins are one plateau: chambers hold theirs to better than 1 K."""
RISING, FALLING, UNTOLD = 1, -1, 0


@dataclass(frozen=True)
class Plateau:
    """One temperature as reached from one side.

    `temperature_c` is the mean over its readings; `branch` is +1 when it was reached from below, -1 from above,
    0 when it was the first after mounting; `level` numbers the temperatures, both sides alike, from the
    lowest; `rows` is a mask over the readings.
    """

    temperature_c: float
    branch: int
    level: int
    rows: Mask


@dataclass(frozen=True)
class ThermalReadings:
    """The oriented rows of one table or several, and how they lie.

    `mounting` (n,) numbers the mountings from 1, `visit` (n,) the stays at one temperature within a mounting
    from 0, `branch` (n,) and `level` (n,) are those of the plateau of each row.
    """

    rows: Readings
    mounting: Ints
    visit: Ints
    branch: Ints
    level: Ints

    @property
    def plateaus(self) -> tuple[Plateau, ...]:
        """The plateaus, from the lowest temperature; at one temperature the rising side first."""
        found = []
        for level in range(int(self.level.max()) + 1):
            for branch in (RISING, UNTOLD, FALLING):
                rows = (self.level == level) & (self.branch == branch)
                if np.any(rows):
                    mean = float(np.mean(self.rows.temperature_c[rows]))
                    found.append(Plateau(mean, branch, level, rows))
        return tuple(found)

    @property
    def levels(self) -> int:
        """Number of separate temperatures."""
        return int(self.level.max()) + 1

    @property
    def both_sides(self) -> Mask:
        """Whether the temperature of a row was reached both rising and falling, shape (n,)."""
        sides = [set(self.branch[self.level == level].tolist()) for level in range(self.levels)]
        return np.array([{RISING, FALLING} <= sides[level] for level in self.level])


def separate_temperatures(readings: Readings) -> list[float]:
    """Return the separate temperatures of a table's oriented rows, °C, rising; none where one is unknown."""
    rows = readings.oriented()
    if not len(rows) or not np.isfinite(rows.temperature_c).all():
        return []
    found = sort_readings([readings])
    return [float(np.mean(found.rows.temperature_c[found.level == i])) for i in range(found.levels)]


def sort_readings(tables: Sequence[Readings]) -> ThermalReadings:
    """Sort the oriented rows of tables that belong together, each in the order of measurement.

    Raises `CalibrationError` when the tables differ in unit, or an oriented row has no temperature.
    """
    units = sorted({table.unit for table in tables})
    if len(units) > 1:
        raise CalibrationError(
            f"the readings are in different units ({', '.join(units)}); give files of one unit"
        )
    parts, mountings, visits, branches, means = [], [], [], [], []
    last_mounting = last_visit = 0
    for table in tables:
        seen = table.select(~np.isin(table.installation, [SHORTED, REFERENCE]))
        mounting, visit, branch, mean = _walk(seen)
        kept = _oriented(seen)
        parts.append(seen.select(kept))
        mountings.append(mounting[kept] + last_mounting)
        visits.append(visit[kept] + last_visit)
        branches.append(branch[kept])
        means.append(mean[kept])
        last_mounting += int(mounting.max(initial=0))
        last_visit += int(visit.max(initial=-1)) + 1
    if not sum(len(part) for part in parts):
        raise CalibrationError(
            f"{', '.join(table.source for table in tables)}: no reading in an installation of known "
            "orientation; a calibration needs installations 1 and 2"
        )
    return ThermalReadings(
        parts[0] if len(parts) == 1 else together([JoinedPart(part) for part in parts]),
        np.concatenate(mountings),
        np.concatenate(visits),
        np.concatenate(branches),
        _levels(np.concatenate(means)),
    )


def _walk(rows: Readings) -> tuple[Ints, Ints, Ints, Floats]:
    """Go through the rows in order: mounting, visit, branch and the mean temperature of the visit of each."""
    unknown = _oriented(rows) & ~np.isfinite(rows.temperature_c)
    if np.any(unknown):
        i = int(np.argmax(unknown))
        raise CalibrationError(
            f"{rows.source}: {int(unknown.sum())} readings have no temperature_c (the first: installation "
            f"{rows.installation[i]}, series {rows.series[i]}, pass {rows.pass_number[i]}, point {rows.point[i]}); "
            "fill in the temperature of the block, or leave these readings out"
        )
    n = len(rows)
    mounting, visit, branch = (np.zeros(n, dtype=np.int64) for _ in range(3))
    mean = np.full(n, np.nan)
    mounts, start, total = 0, 0, -1
    for i in range(n):
        t = rows.temperature_c[i]
        remounted = i == 0 or rows.installation[i] != rows.installation[i - 1]
        here = float(np.mean(rows.temperature_c[start:i])) if i > start else t
        moved = bool(abs(t - here) > PLATEAU_K)
        again = i > 0 and rows.series[i] != rows.series[i - 1]
        remounted = remounted or (again and not moved)
        if remounted or moved:
            side = UNTOLD if remounted else RISING if t > here else FALLING
            mounts += remounted
            start, total = i, total + 1
        mounting[i], visit[i], branch[i] = mounts, total, side
    for number in range(total + 1):
        mean[visit == number] = np.mean(rows.temperature_c[visit == number])
    return mounting, visit, branch, mean


def _oriented(rows: Readings) -> Mask:
    return ~np.isin(rows.installation, [VERIFICATION, *UNORIENTED])


def _levels(temperature_c: Floats) -> Ints:
    """Number the separate temperatures (n,) from the lowest; none is wider than `PLATEAU_K`."""
    level = np.zeros(len(temperature_c), dtype=np.int64)
    number, lowest = -1, -np.inf
    for i in np.argsort(temperature_c, kind="stable"):
        if temperature_c[i] - lowest > PLATEAU_K:
            number, lowest = number + 1, temperature_c[i]
        level[i] = number
    return level
