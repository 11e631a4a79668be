"""A thermometer at the block that a person reads."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from drivers.interfaces import BadReading, Identity, Prompt, PromptKind

if TYPE_CHECKING:
    from drivers.interfaces import Person

_NUMBER: Final = re.compile(r"([+-]?\d{1,4}(?:[.,]\d+)?)\s*°?\s*c?")
_MAX_ATTEMPTS: Final = 5


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
        low_c, high_c = self._minimum_c, self._maximum_c
        trouble = ""
        for attempt in range(1, _MAX_ATTEMPTS + 1):
            prompt = Prompt(
                id=f"{key}/thermometer#{attempt}",
                kind=PromptKind.NUMBER,
                text=f"{trouble} Read the thermometer at the block and type the temperature in °C.".lstrip(),
                unit="°C",
                minimum=low_c,
                maximum=high_c,
                action={"do": "read_temperature"},
            )
            answer = self._person.ask(prompt)
            match = _NUMBER.fullmatch(answer.text.strip().replace("−", "-").lower())
            if answer.prompt_id != prompt.id or match is None:
                trouble = "That was not a temperature such as 23.5."
                continue
            temperature_c = float(match[1].replace(",", "."))
            if low_c <= temperature_c <= high_c:
                return temperature_c
            trouble = f"{temperature_c:g} °C is outside the thermometer's {low_c:g} to {high_c:g} °C."
        raise BadReading(
            self.name,
            f"no temperature within its range in {_MAX_ATTEMPTS} attempts",
            "check the thermometer and its range in the bench file, then take this step again",
        )
