"""A thermometer at the block that a person reads."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drivers.interfaces import BadReading, Identity
from drivers.manual.temperature import ATTEMPTS, ask_temperature

if TYPE_CHECKING:
    from drivers.interfaces import Person


class ManualThermometer:
    """A `Thermometer` of the given range, °C, whose display a person reads; what is beyond is asked again."""

    asks_person = True

    def __init__(self, name: str, person: Person, *, minimum_c: float, maximum_c: float, sensor: str) -> None:
        self.name = name
        self.sensor = sensor
        self._person = person
        self._minimum_c = minimum_c
        self._maximum_c = maximum_c

    def open(self) -> Identity:
        """Return what stands in the record for a thermometer without an interface; nothing is asked."""
        return Identity(maker="manual", model="thermometer")

    def close(self) -> None:
        """Nothing to release."""

    def block_c(self, key: str) -> float:
        """Ask for the temperature at the block, °C.

        Raises `BadReading` when nothing within its range comes, `NoAnswer` when there is nobody to ask.
        """
        found_c = ask_temperature(
            self._person,
            f"{key}/thermometer",
            "Read the thermometer at the block",
            self._minimum_c,
            self._maximum_c,
            "is outside the thermometer's {low:g} to {high:g} °C",
        )
        if found_c is not None:
            return found_c
        raise BadReading(
            self.name,
            f"no temperature within its range in {ATTEMPTS} attempts",
            "check the thermometer and its range in the bench file, then take this step again",
        )
