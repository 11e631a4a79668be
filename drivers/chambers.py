"""What chambers with a controller share: limits before anything is sent, and what a reading must prove."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from drivers.interfaces import BadReading, InstrumentRefused, LimitExceeded

NUMBER: Final = r"[+-]?\d{1,5}(?:\.\d{1,6})?"
"""A temperature as controllers print it."""

_PLAUSIBLE_K: Final = 30.0
"""A sensor may show this much outside the limits: a room, a chamber that was just switched on."""


@dataclass(frozen=True, slots=True)
class ChamberLimits:
    """The temperatures that may be demanded, and how far the air may be from the demand at a reading.

    Without `band_c` a reading is taken at any temperature. Raises `ValueError` for what cannot be.
    """

    minimum_c: float
    maximum_c: float
    band_c: float | None = None

    def __post_init__(self) -> None:
        """Refuse limits in the wrong order and a band without width."""
        if not self.minimum_c < self.maximum_c:
            raise ValueError(
                f"the chamber's minimum {self.minimum_c:g} °C is not below its maximum {self.maximum_c:g} °C"
            )
        if self.band_c is not None and not self.band_c > 0.0:
            raise ValueError(f"the chamber's band must be positive, not {self.band_c:g} °C")

    def check(self, name: str, target_c: float) -> None:
        """Raise `LimitExceeded` for a demand outside the limits."""
        if not (math.isfinite(target_c) and self.minimum_c <= target_c <= self.maximum_c):
            raise LimitExceeded(
                name,
                f"{target_c:g} °C is outside {self.minimum_c:g} to {self.maximum_c:g} °C",
                "change the temperature in the procedure or the limits in the bench file",
            )

    def plausible(self, name: str, temperature_c: float) -> float:
        """Return a temperature of the sensor. Raises `BadReading` when the chamber cannot have it."""
        low_c, high_c = self.minimum_c - _PLAUSIBLE_K, self.maximum_c + _PLAUSIBLE_K
        if low_c <= temperature_c <= high_c:
            return temperature_c
        raise BadReading(
            name,
            f"it shows {temperature_c:g} °C, which is not plausible ({low_c:g} to {high_c:g} °C)",
            "check its sensor, its unit (°C or °F) and the limits in the bench file",
        )

    def in_band(self, name: str, temperature_c: float, target_c: float | None) -> float:
        """Return the air's temperature. Raises `InstrumentRefused` when it is out of band.

        `target_c` is what was demanded, None when nothing was.
        """
        self.plausible(name, temperature_c)
        if target_c is None or self.band_c is None or abs(temperature_c - target_c) <= self.band_c:
            return temperature_c
        raise InstrumentRefused(
            name,
            f"the air is at {temperature_c:g} °C, more than {self.band_c:g} °C from the {target_c:g} °C demanded",
            "let it settle (a longer soak in the procedure), or see why the chamber does not hold it",
        )


def refuse_other_set_point(name: str, shown_c: float, target_c: float, resolution_c: float) -> None:
    """Raise `InstrumentRefused` when the set point read back is not the one demanded.

    It may differ by half the controller's resolution and a little more, for the rounding.
    """
    if abs(shown_c - target_c) > 0.51 * resolution_c:
        raise InstrumentRefused(
            name,
            f"its set point is {shown_c:g} °C, not the {target_c:g} °C demanded",
            "check that nobody else controls the chamber, and that it was not switched off",
        )
