"""What the supply measured at the block's rails around a reading: as it is recorded, and as columns of a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

from bench.readings.rails import current_column, nominal_column, rails_of, voltage_column


@dataclass(frozen=True, slots=True)
class Rail:
    """What a rail has, V with its sign, what it is to have, V, and what it gives, A."""

    voltage_v: float
    nominal_v: float
    current_a: float

    def to_json(self) -> dict[str, float]:
        """Return it as an event holds it."""
        return {"voltage_v": self.voltage_v, "nominal_v": self.nominal_v, "current_a": self.current_a}

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Rail:
        """Return the rail of an event. Raises `KeyError`, `TypeError`, `ValueError` for what is none."""
        values = (row["voltage_v"], row["nominal_v"], row["current_a"])
        if any(type(value) not in (int, float) or not isfinite(value) for value in values):
            raise ValueError("a number of a rail is none")
        return cls(*values)


def between(before: Mapping[str, Rail], after: Mapping[str, Rail]) -> dict[str, Rail]:
    """Return what is recorded of rails that were looked at before a reading and after it: the means."""
    return {
        name: Rail(
            (rail.voltage_v + after[name].voltage_v) / 2.0,
            rail.nominal_v,
            (rail.current_a + after[name].current_a) / 2.0,
        )
        for name, rail in before.items()
        if name in after
    }


def columns_of(taken: Sequence[Mapping[str, Rail]]) -> dict[str, list[str]]:
    """Return the columns of readings as text, by name: three of each rail that any of them has."""
    columns: dict[str, list[str]] = {}
    for name in dict.fromkeys(name for rails in taken for name in rails):
        rails = [row.get(name) for row in taken]
        columns[voltage_column(name)] = ["" if rail is None else repr(rail.voltage_v) for rail in rails]
        columns[nominal_column(name)] = ["" if rail is None else f"{rail.nominal_v:g}" for rail in rails]
        columns[current_column(name)] = ["" if rail is None else repr(rail.current_a) for rail in rails]
    return columns


def ranges_in_words(extra: Mapping[str, Sequence[str]]) -> str:
    """Say from which to which voltage and current each rail was at the readings; empty where there is no rail.

    `extra` are the text columns of a table.
    """
    told = []
    for rail in rails_of(extra):
        spans = [_span(extra[voltage_column(rail)], "V", 1.0)]
        if current_column(rail) in extra:
            spans.append(_span(extra[current_column(rail)], "mA", 1e3))
        told.append(f"{rail} {', '.join(span for span in spans if span) or 'not measured'}")
    return "; ".join(told)


def _span(cells: Sequence[str], unit: str, scale: float) -> str:
    values = [float(cell) * scale for cell in cells if cell.strip()]
    if not values:
        return ""
    low, high = f"{min(values):.5g}", f"{max(values):.5g}"
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"
