"""One reading, from the voltmeters to the record, the early warning, the person and the table of readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from math import isfinite
from typing import Any, Final, Literal

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.readings.columns import SINCE_POWER_ON_S, Rail, columns_of, since_power_on_cells
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
"""A number for each of x, y, z where there is one."""

_NONE: Final = (None, None, None)


@dataclass(frozen=True)
class Outlier:
    """The sample (from 1) that an outlier test names: its value, its distance from the mean and the critical one.

    Both distances are in standard deviations of the samples.
    """

    sample: int
    value: float
    sigma: float
    critical: float


@dataclass(frozen=True, kw_only=True)
class Reading:
    """One settled reading of the three channels, as the record holds it; signals in `unit`.

    `angle_deg` was read back from the head, `target_deg` asked for; both are None, and `direction` is 0, where
    the head means nothing (a shorted or a reference input, of `reference_v` volts). `time_s` counts from the
    beginning of the run. `mean`, `sd` and `drift` are those of the samples of x, y and z, `drift_p` the
    probability of as large a drift in samples that only scatter; None where there are too few samples for
    them. `scan_order` is the order in which the channels were read. `rails` is what the supply measured at each
    rail of the block, the mean of a look before the reading and one after it. Where a thermometer at the block told
    the temperature, `temperature_source` is its sensor and `chamber_c` the air of the chamber. What is left at its
    default was not recorded: records before these were kept lack `samples` and what is drawn from them, the
    reference and the scan order, and where nothing is known of the supply there are no rails.
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
    rails: Mapping[str, Rail] = field(default_factory=dict)

    @property
    def place(self) -> tuple[int, str, int, int]:
        """Which reading of a run it is; one taken again has the same place."""
        return self.series, self.installation, self.pass_number, self.point

    def __str__(self) -> str:
        return f"installation {self.installation}, pass {self.pass_number}, point {self.point}"

    def to_json(self) -> dict[str, Any]:
        """Return the reading as JSON for an event of the record."""
        own = {_KEYS.get(name, name): value for name, value in asdict(self).items()}
        return {
            name: value
            for name, value in own.items()
            if name not in _WHERE_KNOWN or value not in ("", None, {})
        }

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Reading:
        """Return the reading of an event, of older versions, too.

        Raises `KeyError`, `TypeError`, `ValueError` for what is none.
        """
        given: dict[str, Any] = {}
        for name, key in _RECORDED:
            if key in row:
                value = row[key]
                given[name] = tuple(value) if type(value) is list else value
        found = given.get("outlier", _NONE)
        given["outlier"] = _NONE if found == _NONE else tuple(one and Outlier(**one) for one in found)
        if _RAILS in given:
            given[_RAILS] = {str(name): Rail.from_json(rail) for name, rail in given[_RAILS].items()}
        reading = cls(**given)
        reading._check()
        return reading

    def _check(self) -> None:
        """Raise `ValueError` or `TypeError` for a wrong number of values, or one that is no number."""
        if not len(self.mean) == len(self.sd) == len(CHANNELS):
            raise ValueError("a reading has three channels")
        for count in (self.series, self.pass_number, self.point, self.samples_taken):
            if type(count) is not int or not 0 <= count < _LARGEST:
                raise ValueError("series, pass, point and samples of a reading are whole numbers")
        if self.direction not in (0, 1, -1):
            raise ValueError("a direction is 1, -1 or 0")
        for text in (self.installation, self.unit, self.scan_order, self.temperature_source):
            if type(text) is not str:
                raise ValueError("a text of a reading is none")
        may_be = (
            self.angle_deg,
            self.target_deg,
            self.time_s,
            self.temperature_c,
            self.reference_v,
            self.chamber_c,
            *self.sd,
        )
        for number in (*self.mean, self.direction, *may_be):
            if number is not None and (type(number) not in _NUMBERS or not isfinite(number)):
                raise ValueError("a number of a reading is none")
        if None in self.mean:
            raise ValueError("a reading without a mean is none")


_WHERE_KNOWN: Final = ("rails", "temperature_source", "chamber_c")
"""Written of a bench alone that has a supply, or a thermometer at the block."""

_KEYS: Final = {"pass_number": "pass"}
"""Fields that have another name in the record."""

_LARGEST: Final = 2**31

_RAILS: Final = "rails"
"""Fields that are left out of the record where they are empty."""

_RECORDED: Final = tuple((of.name, _KEYS.get(of.name, of.name)) for of in fields(Reading))
"""The fields of a reading with their names in the record."""

_NUMBERS: Final = frozenset({int, float})


def readings_of(taken: Sequence[Reading], source: str, power: Sequence[tuple[float, str]] = ()) -> Readings:
    """Make the table of readings. Scan order and reference are among its extra columns where any has them.

    So are voltage and current of each rail, and the time since the block was switched on; `power` is when it was
    (`since_power_on_cells`).
    """

    def column(name: str) -> Floats:
        return np.array([getattr(reading, name) for reading in taken], dtype=np.float64)  # None becomes NaN

    extra = {
        SCAN_ORDER: [reading.scan_order for reading in taken],
        REFERENCE_V: ["" if reading.reference_v is None else str(reading.reference_v) for reading in taken],
        TEMPERATURE_SOURCE: [reading.temperature_source for reading in taken],
        CHAMBER_C: ["" if reading.chamber_c is None else str(reading.chamber_c) for reading in taken],
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
