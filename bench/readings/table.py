"""The table of readings on which every analysis works, and one reading as a run records it.

A live run, a recorded run, a file of manual measurements and a simulation all give this table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from math import isfinite
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bench.base.arrays import CHANNELS, Floats, Ints, Labels
from bench.base.languages import message
from bench.base.text import shortened
from bench.model.conditions import Conditions
from bench.readings.columns import (
    METER_C,
    MOUNTING,
    ROOM_C,
    SINCE_POWER_ON_S,
    Rail,
    above_nominal_v,
    columns_of,
    level_rad,
    meter_c,
    mounting_cells,
    mountings,
    since_power_on_cells,
    since_power_on_s,
)

# --- one table --------------------------------------------------------------------------------------

VERIFICATION: Final = "V"
FREE: Final = "F"
SHORTED: Final = "S"
REFERENCE: Final = "R"
UNORIENTED: Final = frozenset({FREE, SHORTED, REFERENCE})
"""Labels of rows without a meaningful head angle, whose angle cell may be empty."""

SCAN_ORDER: Final = "scan_order"
"""The extra column with the order in which the channels were read, such as "xyz"."""

REFERENCE_V: Final = "reference_v"
REFERENCE_SD_V: Final = "reference_sd_v"
"""The extra columns with the voltage at a reference input and its standard deviation, V."""

TEMPERATURE_SOURCE: Final = "temperature_source"
"""The extra column with the sensor of the block's own thermometer, if there is one."""

CHAMBER_C: Final = "chamber_c"
"""The extra column with the chamber's air temperature, °C, if the block has its own thermometer."""

MOST_DECIMALS: Final = 8
"""Decimals in a 34401A's reply: a signal with more was computed, not read from a meter."""

UNITS: Final[Mapping[str, str]] = {"v": "V", "counts": "counts", "g": "g", "ms2": "m/s^2"}
"""The printed unit by suffix of the signal columns (ux_v, ux_counts, ux_g, ux_ms2)."""


@dataclass(frozen=True)
class Readings:
    """A table of n settled readings as columns, in the order of measurement.

    `signal` (n, 3) is in `unit`; `angle_rad` is read back from the scale, `target_rad` is the requested angle; both
    angles, `time_s` and `temperature_c` are NaN if not given; `direction` is +1, -1 or 0 (unknown); `signal_sd` (n,
    3) is the standard deviation of a reading's samples, NaN if not given. `extra` keeps further columns as text;
    `notes` are remarks for the user of the table; `skipped` lists rows that were left out on request, with the
    reason; `verification_missing` counts the planned verification points that are not among the rows. `corrected`
    says that known instrument errors are corrected; `resolution_read` is then the resolution before correction, in
    `unit`. In a table of several runs, `began_s` (n,) is the start of each row's run on the clock of `time_s`, and
    `block` (n,) the number of the block measured; None means a single run or block.
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
        """The run number of each row, shape (n,), from 0 in the order in which the runs began."""
        if self.began_s is None:
            return np.zeros(len(self), dtype=np.int64)
        return np.unique(self.began_s, return_inverse=True)[1].astype(np.int64)

    @property
    def resolution(self) -> float:
        """The value of the last digit of the signals, in `unit`; 0 if they have more than 8 decimals.

        The signals are means, which may have one more digit than their samples.
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
        """Mask of the rows with the block mounted in an installation, without verification rows, shape (n,)."""
        return ~np.isin(self.installation, [VERIFICATION, *UNORIENTED])

    def oriented(self) -> Readings:
        """Return the rows that a calibration fits: mounted in an installation, without verification rows."""
        return self.select(self.is_oriented)

    def verification(self) -> Readings:
        """Return the rows of the verification points."""
        return self.select(self.installation == VERIFICATION)

    def conditions(self) -> Conditions:
        """Return the conditions of the rows for the forward model, at the angles read back.

        A second call returns the same object. Raises `ValueError` if a cell of the column `scan_order` is invalid.
        """
        return self._conditions

    @cached_property
    def _conditions(self) -> Conditions:
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
            on_s=since_power_on_s(self.extra),
            level_rad=level_rad(self.extra, len(self)),
            supply_v=above_nominal_v(self.extra),
            meter_c=meter_c(self.extra),
            mounting=mountings(self.extra),
        )


def scan_order(text: str) -> tuple[int, ...]:
    """Return the channel numbers in the order of a text: "zyx" gives (2, 1, 0), an empty text (0, 1, 2).

    Raises `ValueError` if the text is not a permutation of "xyz".
    """
    order = tuple("xyz".find(letter) for letter in text.strip().lower())
    if order and sorted(order) != [0, 1, 2]:
        raise ValueError(
            f"expected the three channels in the order read, such as xyz or zyx, got {shortened(text)!r}"
        )
    return order or (0, 1, 2)


def make_readings(
    installation: Sequence[str],
    pass_number: Sequence[int] | Floats,
    point: Sequence[int] | Floats,
    angle_rad: Floats,
    signal: Floats,
    *,
    source: str = "memory",
    unit: str = "V",
    target_rad: Floats | None = None,
    series: Sequence[int] | Floats | None = None,
    direction: Sequence[int] | Floats | None = None,
    time_s: Floats | None = None,
    temperature_c: Floats | None = None,
    signal_sd: Floats | None = None,
    samples: Sequence[int] | Floats | None = None,
    scan_order: list[str] | None = None,
) -> Readings:
    """Return a table made of columns of length n; omitted columns get the values that mean "not given"."""
    n = len(installation)

    def whole(values: Sequence[int] | Floats | None, default: int) -> Ints:
        return np.full(n, default) if values is None else np.asarray(values).astype(np.int64)

    def real(values: Floats | None) -> Floats:
        return np.full(n, np.nan) if values is None else np.asarray(values, dtype=np.float64)

    return Readings(
        source=source,
        unit=unit,
        series=whole(series, 1),
        installation=np.array(installation, dtype=np.str_),
        pass_number=whole(pass_number, 1),
        point=whole(point, 1),
        angle_rad=real(angle_rad),
        target_rad=real(target_rad),
        direction=whole(direction, 0),
        time_s=real(time_s),
        temperature_c=real(temperature_c),
        signal=np.asarray(signal, dtype=np.float64).reshape(n, 3),
        signal_sd=np.full((n, 3), np.nan) if signal_sd is None else signal_sd.reshape(n, 3),
        samples=whole(samples, 1),
        extra={} if scan_order is None else {SCAN_ORDER: np.array(scan_order, dtype=np.str_)},
    )


# --- several tables as one --------------------------------------------------------------------------

BETWEEN_S: Final = 3600.0
"""Assumed time from the last reading of a table to the first of the next, s."""


@dataclass(frozen=True)
class JoinedPart:
    """A table to join; `began_s` is the start of its clock, s, on a clock common to all tables, or None if unknown.

    `block` is the number of the block measured, None if unknown.
    """

    readings: Readings
    began_s: float | None = None
    block: int | None = None


def together(parts: Sequence[JoinedPart]) -> Readings:
    """Return several tables joined into one, with all times on one clock.

    If every part has a `JoinedPart.began_s` and no tables overlap, they are joined in order of time at
    their real intervals. Otherwise they keep the order given, with `BETWEEN_S` between them. Rows without a
    time get one from `Conditions.elapsed_s`. The series numbers of each table continue those of the table
    before it, so that mountings stay apart. `Readings.began_s` holds the start of each run's clock; `notes`
    state the new series and start of each table. Raises `ValueError` for tables in different units.
    """
    units = {part.readings.unit: part.readings.source for part in parts}
    if len(units) > 1:
        each = ", ".join(f"{source} in {unit}" for unit, source in units.items())
        raise ValueError(
            f"the readings are in different units ({each}); evaluate the files of each unit separately"
        )
    ordered, starts, real = _starts(parts)
    tables: list[Readings] = []
    notes: list[str] = []
    last_series = 0
    for part, start_s in zip(ordered, starts, strict=True):
        table = part.readings
        shift = last_series - (int(table.series.min()) - 1) if tables else 0
        clock_s = _clock_s(table)
        began_s = np.zeros(len(table)) if table.began_s is None else table.began_s
        tables.append(
            replace(
                table,
                series=table.series + shift,
                time_s=start_s + clock_s - clock_s[0],
                began_s=start_s + began_s - clock_s[0],
                block=None if part.block is None else np.full(len(table), part.block),
            )
        )
        last_series = int(tables[-1].series.max())
        first_series = int(tables[-1].series.min())
        series = f"{first_series}" + (f" to {last_series}" if last_series > first_series else "")
        begun = message(f", begun {start_s / 3600.0:.2f} h after the first") if len(tables) > 1 else ""
        notes.append(
            message(
                f"{table.source} is series {series}{begun}{'' if real or not begun else ' (set, not measured)'}"
            )
        )
    return stacked(tables, tuple(notes))


def _clock_s(table: Readings) -> Floats:
    """Return the time, s, of each reading on the table's clock, estimated if not given."""
    return table.time_s if table.began_s is not None else table.conditions().elapsed_s


def _starts(parts: Sequence[JoinedPart]) -> tuple[list[JoinedPart], list[float], bool]:
    """Return the tables in order of time, the times of their first readings, s, and true.

    If a time is unknown or tables overlap, return the tables as given, assumed times, and false.
    """
    clocks = [(part, _clock_s(part.readings)) for part in parts]
    lasts = {id(part): float(np.max(clock_s) - clock_s[0]) for part, clock_s in clocks}
    known = [p.began_s + float(np.nan_to_num(p.readings.time_s[0])) for p in parts if p.began_s is not None]
    if len(known) == len(parts):
        order = np.argsort(known, kind="stable")
        ordered = [parts[i] for i in order]
        starts = [known[i] - min(known) for i in order]
        ends = [start + lasts[id(part)] for start, part in zip(starts, ordered, strict=True)]
        if all(later >= end for end, later in zip(ends, starts[1:], strict=False)):
            return ordered, starts, True
    starts = [0.0]
    for part in parts[:-1]:
        starts.append(starts[-1] + lasts[id(part)] + BETWEEN_S)
    return list(parts), starts, False


def is_record(table: Readings) -> bool:
    """Return whether a table is a record at a known input, that is, has rows of the reference input (R) only."""
    return len(table) > 0 and bool(np.all(table.installation == REFERENCE))


def all_free(tables: Sequence[Readings]) -> bool:
    """Return whether all readings of these tables are in free positions."""
    return bool(tables) and all(len(table) and np.all(table.installation == FREE) for table in tables)


def stacked(tables: Sequence[Readings], notes: tuple[str, ...] = ()) -> Readings:
    """Return the tables concatenated, with `notes` first; each table's own notes are prefixed with its name."""
    columns: dict[str, Any] = {
        of.name: np.concatenate([getattr(table, of.name) for table in tables])
        for of in fields(Readings)
        if isinstance(getattr(tables[0], of.name), np.ndarray)
    }
    extra = {
        name: np.concatenate(
            [table.extra.get(name, np.full(len(table), "", dtype=np.str_)) for table in tables]
        )
        for name in dict.fromkeys(name for table in tables for name in table.extra)
    }
    return replace(
        tables[0],
        source=" + ".join(table.source for table in tables),
        **columns,
        extra=extra,
        notes=(*notes, *(f"{table.source}: {note}" for table in tables for note in table.notes)),
        skipped=tuple(text for table in tables for text in table.skipped),
        verification_missing=sum(table.verification_missing for table in tables),
        corrected=any(table.corrected for table in tables),
        resolution_read=min(table.resolution for table in tables)
        if any(table.corrected for table in tables)
        else None,
    )


# --- one reading -------------------------------------------------------------------------------------

Triple = tuple[float, ...]
"""A number for each of the channels x, y, z."""

MaybeTriple = tuple[float | None, ...]
"""A number, or None if there is none, for each of the channels x, y, z."""

_NONE: Final = (None, None, None)


@dataclass(frozen=True)
class Outlier:
    """An outlier of a reading: the number of the sample (from 1), its value, its distance from the mean.

    `sigma` is the distance, `critical` the critical value for it, both in standard deviations of the samples.
    """

    sample: int
    value: float
    sigma: float
    critical: float


@dataclass(frozen=True, kw_only=True)
class Reading:
    """One settled reading of the three channels, as stored in the record; signals in `unit`.

    `angle_deg` was read back from the head, `target_deg` was requested. Without a head angle (a shorted input, or a
    reference input of `reference_v` volts) both are None and `direction` is 0. `time_s` counts from the start of
    the run. `mean`, `sd` and `drift` are statistics of the samples of x, y and z; `drift_p` is the p-value of the
    drift. With too few samples they are None. `scan_order` is the order in which the channels were read. `rails`
    holds the mean of two measurements of each supply rail, before and after the reading. With a separate
    thermometer at the block, `temperature_source` is its sensor and `chamber_c` the air temperature of the chamber.
    `meter_temperature_c` and `room_c` are the temperatures of the voltmeters and of the room, °C.
    A default means "not recorded": old records lack `samples` and their statistics, the reference and the scan
    order.
    """

    installation: str
    series: int
    pass_number: int
    point: int
    target_deg: float | None = None
    angle_deg: float | None
    direction: Literal[0, 1, -1] = 0
    time_s: float | None = None
    temperature_c: float | None = None
    unit: str = "V"
    mean: Triple
    sd: MaybeTriple = _NONE
    samples_taken: int = 1
    samples: Mapping[str, Sequence[float]] = field(default_factory=dict)
    drift: MaybeTriple = _NONE
    drift_p: MaybeTriple = _NONE
    outlier: tuple[Outlier | None, ...] = _NONE
    reference_v: float | None = None
    scan_order: str = ""
    temperature_source: str = ""
    chamber_c: float | None = None
    meter_temperature_c: float | None = None
    room_c: float | None = None
    rails: Mapping[str, Rail] = field(default_factory=dict)

    @property
    def place(self) -> tuple[int, str, int, int]:
        """The setting that was read: (series, installation, pass, point); a repeated reading has the same place."""
        return self.series, self.installation, self.pass_number, self.point

    def __str__(self) -> str:
        return f"installation {self.installation}, pass {self.pass_number}, point {self.point}"

    def to_json(self) -> dict[str, Any]:
        """Return the reading as a JSON object for an event of the record."""
        values = asdict(self)
        return {
            key: values[name]
            for name, key in _RECORDED
            if name not in _WHERE_KNOWN or values[name] not in ("", None, {})
        }

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Reading:
        """Return the reading from the JSON object of an event, also of an older version.

        Raises `KeyError`, `TypeError`, `ValueError` if the object is not a reading.
        """
        given: dict[str, Any] = {
            name: tuple(row[key]) if type(row[key]) is list else row[key]
            for name, key in _RECORDED
            if key in row
        }
        found = given.get("outlier", _NONE)
        given["outlier"] = _NONE if found == _NONE else tuple(one and Outlier(**one) for one in found)
        if "rails" in given:
            given["rails"] = {str(name): Rail.from_json(name, rail) for name, rail in given["rails"].items()}
        reading = cls(**given)
        reading._check()
        return reading

    def _check(self) -> None:
        if not len(self.mean) == len(self.sd) == len(CHANNELS):
            raise ValueError("a reading lacks a channel; give mean and sd of three channels")
        for name in ("series", "pass_number", "point", "samples_taken"):
            count = getattr(self, name)
            if type(count) is not int or not 0 <= count < 2**31:
                raise ValueError(
                    f"{name} of a reading is not a whole number of 0 or more; give such a number"
                )
        if self.direction not in (0, 1, -1):
            raise ValueError(f"the direction of a reading is {self.direction!r}; give 1, -1 or 0")
        for name in ("installation", "unit", "scan_order", "temperature_source"):
            if type(getattr(self, name)) is not str:
                raise ValueError(f"{name} of a reading is not a text; give a text")
        for number in (
            *self.mean, *self.sd, self.direction, self.angle_deg, self.target_deg, self.time_s, self.temperature_c,
            self.reference_v, self.chamber_c, self.meter_temperature_c, self.room_c,
        ):  # fmt: skip
            if number is not None and (type(number) not in (int, float) or not isfinite(number)):
                raise ValueError(
                    "a value of a reading is no finite number; give a number, or None if the value is unknown"
                )
        if None in self.mean:
            raise ValueError("a reading lacks the mean of a channel; give a number for each channel")


_WHERE_KNOWN: Final = ("rails", "temperature_source", "chamber_c", METER_C, ROOM_C)
"""Fields that are omitted from the record if empty, because most benches lack the instrument that fills them."""

_RECORDED: Final = tuple((of.name, of.name.removesuffix("_number")) for of in fields(Reading))
"""Each field of a reading with its name in the record."""


def readings_of(
    taken: Sequence[Reading],
    source: str,
    power: Sequence[tuple[float, str]] = (),
    mounted: Sequence[tuple[int, int] | None] = (),
) -> Readings:
    """Return the table of the readings `taken`, named `source`.

    Scan order, reference, further temperatures, rails and time since power-on become columns in `extra` if any
    reading has them. `power` lists the states of the supply, as for `since_power_on_cells`. `mounted` identifies
    the mounting of each reading, as for `mounting_cells`.
    """

    def column(name: str) -> Floats:
        # numpy converts None to NaN
        return np.array([getattr(reading, name) for reading in taken], dtype=np.float64)

    extra = {
        SCAN_ORDER: [reading.scan_order for reading in taken],
        REFERENCE_V: _cells(taken, REFERENCE_V),
        TEMPERATURE_SOURCE: [reading.temperature_source for reading in taken],
        **{name: _cells(taken, name) for name in (CHAMBER_C, METER_C, ROOM_C)},
        SINCE_POWER_ON_S: since_power_on_cells([reading.time_s for reading in taken], power),
        MOUNTING: mounting_cells([reading.place[:2] for reading in taken], mounted or [None] * len(taken)),
        **columns_of([reading.rails for reading in taken]),
    }
    table = make_readings(
        [reading.installation for reading in taken],
        [reading.pass_number for reading in taken],
        [reading.point for reading in taken],
        np.radians(column("angle_deg")),
        column("mean"),
        source=source,
        unit=taken[0].unit,
        target_rad=np.radians(column("target_deg")),
        series=[reading.series for reading in taken],
        direction=[reading.direction for reading in taken],
        time_s=column("time_s"),
        temperature_c=column("temperature_c"),
        signal_sd=column("sd"),
        samples=[reading.samples_taken for reading in taken],
    )
    given = {name: np.array(cells, dtype=np.str_) for name, cells in extra.items() if any(cells)}
    return replace(table, extra=given)


def _cells(taken: Sequence[Reading], name: str) -> list[str]:
    """Return a field of readings as cells of a text column; None becomes an empty cell."""
    values = [getattr(reading, name) for reading in taken]
    return ["" if value is None else str(value) for value in values]
