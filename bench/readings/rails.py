"""What the supply measured at the block's rails around a reading: as recorded, and as columns of a table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, Final

import numpy as np

from bench.base.arrays import Floats
from bench.readings.table import Readings

_PREFIX: Final = "rail_"
_VOLTS: Final = "_v"
_AMPERES: Final = "_a"


@dataclass(frozen=True, slots=True)
class Rail:
    """Voltage (V, with the sign of the rail) and current (A) of a rail."""

    voltage_v: float
    current_a: float

    def to_json(self) -> dict[str, float]:
        """Return it as an event holds it."""
        return {"voltage_v": self.voltage_v, "current_a": self.current_a}

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Rail:
        """Return the rail of an event. Raises `KeyError`, `TypeError`, `ValueError` for what is none."""
        values = (row["voltage_v"], row["current_a"])
        if any(type(value) not in (int, float) or not isfinite(value) for value in values):
            raise ValueError("a number of a rail is none")
        return cls(*values)


def between(before: Mapping[str, Rail], after: Mapping[str, Rail]) -> dict[str, Rail]:
    """Return what is recorded of rails that were looked at before a reading and after it: the means."""
    return {
        name: Rail(
            (rail.voltage_v + after[name].voltage_v) / 2.0, (rail.current_a + after[name].current_a) / 2.0
        )
        for name, rail in before.items()
        if name in after
    }


def voltage_column(rail: str) -> str:
    """Return the name of the column with the voltage of a rail, V."""
    return f"{_PREFIX}{rail}{_VOLTS}"


def current_column(rail: str) -> str:
    """Return the name of the column with the current of a rail, A."""
    return f"{_PREFIX}{rail}{_AMPERES}"


def columns_of(taken: Sequence[Mapping[str, Rail]]) -> dict[str, list[str]]:
    """Return the columns of readings as text, by name: voltage and current of each rail that any of them has."""
    names = dict.fromkeys(name for rails in taken for name in rails)
    columns: dict[str, list[str]] = {}
    for name in names:
        rails = [row.get(name) for row in taken]
        columns[voltage_column(name)] = ["" if rail is None else repr(rail.voltage_v) for rail in rails]
        columns[current_column(name)] = ["" if rail is None else repr(rail.current_a) for rail in rails]
    return columns


def rails_in(columns: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the rails whose voltages are among the columns of a table."""
    return tuple(
        name.removeprefix(_PREFIX).removesuffix(_VOLTS)
        for name in columns
        if name.startswith(_PREFIX) and name.endswith(_VOLTS) and len(name) > len(_PREFIX + _VOLTS)
    )


def rail_voltages(readings: Readings) -> dict[str, Floats]:
    """Return the voltage of each rail at each reading, V, shape (n,), NaN where it was not recorded.

    Raises `ValueError` for a cell that is no number.
    """
    return {name: _numbers(readings, voltage_column(name)) for name in rails_in(readings.extra)}


def rail_currents(readings: Readings) -> dict[str, Floats]:
    """Return the current of each rail at each reading, A, as `rail_voltages`; those without one are left out."""
    return {
        name: _numbers(readings, current_column(name))
        for name in rails_in(readings.extra)
        if current_column(name) in readings.extra
    }


def _numbers(readings: Readings, column: str) -> Floats:
    cells = readings.extra[column].tolist()
    try:
        return np.array([float(cell) if cell.strip() else np.nan for cell in cells], dtype=np.float64)
    except ValueError:
        raise ValueError(f"{readings.source}: column {column} holds what is no number") from None
