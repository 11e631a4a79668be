"""What the application may ask of a thermometer at the block."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from drivers.interfaces.instruments import Instrument


@runtime_checkable
class Thermometer(Instrument, Protocol):
    """A thermometer at the block, of its own: not that of the chamber's controller."""

    asks_person: bool
    """Whether a reading costs a person an answer: then it is read at each mounting only."""

    sensor: str
    """What measures, and where, as it stands in the record: "Pt100, four wires, channel 104"."""

    def block_c(self, key: str) -> float:
        """Return the temperature that it shows, °C; `key` names the step that asks.

        Raises `BadReading` for an open sensor or what no block has, `InstrumentRefused`, `InstrumentLost`,
        `NoAnswer`.
        """
        ...
