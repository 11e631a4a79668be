"""One settled reading of the three channels, its JSON form in the record, and the table of many readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from math import isfinite
from typing import Any, Final, Literal

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.readings.columns import (
    METER_C,
    ROOM_C,
    SINCE_POWER_ON_S,
    Rail,
    columns_of,
    since_power_on_cells,
)
from bench.readings.table import (
    CHAMBER_C,
    REFERENCE_V,
    SCAN_ORDER,
    TEMPERATURE_SOURCE,
    Readings,
    make_readings,
)

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
        """Raise `ValueError` or `TypeError` for a wrong number of values or a value of the wrong type."""
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


def readings_of(taken: Sequence[Reading], source: str, power: Sequence[tuple[float, str]] = ()) -> Readings:
    """Return the table of the readings `taken`, named `source`.

    Scan order, reference, further temperatures, rails and time since power-on become columns in `extra` if any
    reading has them. `power` lists the states of the supply, as for `since_power_on_cells`.
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
