"""What a person types where an instrument is read by eye: numbers, by one rule for each display."""

from __future__ import annotations

import math
import re
from typing import Final, Literal

_ARCSEC: Final = math.pi / 648000.0
_NUMBER: Final = r"([+-]?[0-9]{1,4}(?:[.,][0-9]+)?)\s*"
_TEMPERATURE: Final = re.compile(_NUMBER + r"°?\s*[cC]?")
_DIVISIONS: Final = re.compile(_NUMBER + r"(arcsec|sec|\"|''|″)?")
_SUPPLY: Final = re.compile(_NUMBER + r"(?:V|A)?", re.IGNORECASE)

SupplyUnit = Literal["V", "A"]


def typed_temperature(text: str) -> float:
    """Return the temperature, °C, that a person typed, such as `23.5` or `23,5 °C`. Raises `ValueError`."""
    match = _TEMPERATURE.fullmatch(_plain(text))
    if match is None:
        raise ValueError("That was not a temperature such as 23.5.")
    return _value(match)


def typed_bubble(text: str, division_rad: float, most_divisions: float) -> float:
    """Return by how much a bubble is off the middle, rad, typed in divisions or with `arcsec`.

    Raises `ValueError` for what is no number, or off the vial's scale of ± `most_divisions`.
    """
    typed = _plain(text).lower()
    match = _DIVISIONS.fullmatch(typed.removesuffix("divisions").strip())
    if match is None:
        raise ValueError("That was not a number of divisions such as -1.5.")
    read_rad = _value(match) * (_ARCSEC if match[2] else division_rad)
    if abs(read_rad) > (most_divisions + 1e-9) * division_rad:
        raise ValueError(
            f"{typed} is off the vial's scale of ±{most_divisions:g} divisions: level the platform, or read again."
        )
    return read_rad


def typed_supply(text: str, unit: SupplyUnit) -> float:
    """Return what a person read from a power supply, in `unit`. Raises `ValueError`."""
    match = _SUPPLY.fullmatch(_plain(text))
    if match is None:
        raise ValueError(f"That was not a number such as 15.0 {unit}.")
    return _value(match)


def _plain(text: str) -> str:
    return text.strip().replace("−", "-")


def _value(match: re.Match[str]) -> float:
    return float(match[1].replace(",", "."))
