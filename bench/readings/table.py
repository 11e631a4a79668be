"""The table of readings that every analysis works on.

The same for a live run, a recorded run, a file of a laboratory that measured by hand, a simulation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bench.base.arrays import Floats, Ints, Labels
from bench.base.visible import shortened
from bench.model.conditions import Conditions
from bench.readings.columns import above_nominal_v, level_rad

VERIFICATION: Final = "V"
FREE: Final = "F"
SHORTED: Final = "S"
REFERENCE: Final = "R"
UNORIENTED: Final = frozenset({FREE, SHORTED, REFERENCE})
"""Rows whose head angle means nothing and may be empty."""

SCAN_ORDER: Final = "scan_order"
"""The extra column with the order in which the channels were read, such as "xyz"."""

REFERENCE_V: Final = "reference_v"
"""The extra column with the voltage at a reference input."""

TEMPERATURE_SOURCE: Final = "temperature_source"
"""The extra column with what told the temperature of the block, where that was a thermometer of its own."""

CHAMBER_C: Final = "chamber_c"
"""The extra column with the air of the chamber beside it, °C."""

MOST_DECIMALS: Final = 8
"""A 34401A's reply has so many: what is given to more is no reading as it came from a meter."""

UNITS: Final[Mapping[str, str]] = {"v": "V", "counts": "counts", "g": "g", "ms2": "m/s^2"}
"""Suffix of the signal columns (ux_v, ux_counts, ux_g, ux_ms2) to the unit as printed."""


@dataclass(frozen=True)
class Readings:
    """Columns over n settled readings, in the order of measurement.

    `signal` (n, 3) is in `unit`; `angle_rad` is read back from the scale, `target_rad` what was asked for;
    both, `time_s` and `temperature_c` are NaN where not given; `direction` is +1, -1 or 0 (not known);
    `signal_sd` (n, 3) is the standard deviation of a reading's samples, NaN where not given.
    `extra` keeps further columns as text; `notes` says what a reader of the table should know;
    `skipped` lists rows that were left out on request, with the reason; `verification_missing` counts the
    verification points that were planned or written but are not among the rows. `corrected` says that known
    errors of the instruments are taken away; `resolution_read` is then the last digit before, in `unit`.
    Where several runs are one table, `began_s` (n,) is when each row's run began on the clock of `time_s`, and
    `block` (n,) numbers the blocks that were measured; None is one run, one block.
    """

    source: str
    unit: str
    series: Ints
    installation: Labels
    pass_number: Ints
    point: Ints
    angle_rad: Floats
    target_rad: Floats
    direction: Ints
    time_s: Floats
    temperature_c: Floats
    signal: Floats
    signal_sd: Floats
    samples: Ints
    extra: Mapping[str, Labels] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    skipped: tuple[str, ...] = ()
    verification_missing: int = 0
    corrected: bool = False
    resolution_read: float | None = None
    began_s: Floats | None = None
    block: Ints | None = None

    @property
    def run(self) -> Ints:
        """Number of the run that a row is of, in the order of their beginnings, shape (n,)."""
        if self.began_s is None:
            return np.zeros(len(self), dtype=np.int64)
        return np.unique(self.began_s, return_inverse=True)[1].astype(np.int64)

    @property
    def resolution(self) -> float:
        """The last digit that the signals are given to, in `unit`; 0 where they have more than 8 decimals.

        Means of several samples have a digit more than the samples: it is theirs that counts here.
        """
        if self.resolution_read is not None:
            return self.resolution_read
        for decimals in range(MOST_DECIMALS + 1):
            scaled = self.signal * 10.0**decimals
            if np.all(np.abs(scaled - np.round(scaled)) <= 1e-6):
                return float(10.0**-decimals)
        return 0.0

    def __len__(self) -> int:
        return len(self.point)

    def select(self, rows: NDArray[np.bool_]) -> Readings:
        """Return the rows where the mask (n,) is true, in the same order."""
        columns = {
            f.name: getattr(self, f.name)[rows]
            for f in fields(self)
            if isinstance(getattr(self, f.name), np.ndarray)
        }
        return replace(self, **columns, extra={k: v[rows] for k, v in self.extra.items()})

    @property
    def is_oriented(self) -> NDArray[np.bool_]:
        """Where the block is mounted in an installation, and not for verification, shape (n,)."""
        return ~np.isin(self.installation, [VERIFICATION, *UNORIENTED])

    def oriented(self) -> Readings:
        """Return the rows that a calibration fits: mounted in an installation, not for verification."""
        return self.select(self.is_oriented)

    def verification(self) -> Readings:
        """Return the rows of the verification points."""
        return self.select(self.installation == VERIFICATION)

    def conditions(self) -> Conditions:
        """Return the conditions of the rows for the forward model, at the angles read back.

        The scan order is that of the column `scan_order`; raises `ValueError` where it is none.
        """
        return Conditions.of(
            self.installation.tolist(),
            self.angle_rad,
            series=self.series.tolist(),
            pass_number=self.pass_number.tolist(),
            point=self.point.tolist(),
            direction=self.direction.tolist(),
            time_s=self.time_s,
            temperature_c=self.temperature_c,
            scan_order=[scan_order(text) for text in self.extra[SCAN_ORDER]]
            if SCAN_ORDER in self.extra
            else None,
            began_s=self.began_s,
            level_rad=level_rad(self.extra, len(self)),
            supply_v=above_nominal_v(self.extra),
        )


def scan_order(text: str) -> tuple[int, ...]:
    """Return the channels 0, 1, 2 in the order of a text such as "zyx"; of an empty one, x, y, z.

    Raises `ValueError` for a text that is no order of the three.
    """
    order = tuple("xyz".find(letter) for letter in text.strip().lower())
    if order and sorted(order) != [0, 1, 2]:
        raise ValueError(
            f"expected the three channels in the order read, such as xyz or zyx, got {shortened(text)!r}"
        )
    return order or (0, 1, 2)


def make_readings(
    installation: list[str],
    pass_number: list[int],
    point: list[int],
    angle_rad: Floats,
    signal: Floats,
    *,
    source: str = "memory",
    unit: str = "V",
    target_rad: Floats | None = None,
    series: list[int] | None = None,
    direction: list[int] | None = None,
    time_s: Floats | None = None,
    temperature_c: Floats | None = None,
    signal_sd: Floats | None = None,
    samples: list[int] | None = None,
    scan_order: list[str] | None = None,
) -> Readings:
    """Build a table from columns; those left out take the values that stand for "not given"."""
    n = len(installation)
    unknown = np.full(n, np.nan)
    return Readings(
        source=source,
        unit=unit,
        series=np.array(series or [1] * n, dtype=np.int64),
        installation=np.array(installation, dtype=np.str_),
        pass_number=np.array(pass_number, dtype=np.int64),
        point=np.array(point, dtype=np.int64),
        angle_rad=np.asarray(angle_rad, dtype=np.float64),
        target_rad=unknown if target_rad is None else np.asarray(target_rad, dtype=np.float64),
        direction=np.array(direction or [0] * n, dtype=np.int64),
        time_s=unknown if time_s is None else np.asarray(time_s, dtype=np.float64),
        temperature_c=unknown if temperature_c is None else np.asarray(temperature_c, dtype=np.float64),
        signal=np.asarray(signal, dtype=np.float64).reshape(n, 3),
        signal_sd=np.full((n, 3), np.nan) if signal_sd is None else signal_sd.reshape(n, 3),
        samples=np.array(samples or [1] * n, dtype=np.int64),
        extra={} if scan_order is None else {SCAN_ORDER: np.array(scan_order, dtype=np.str_)},
    )
