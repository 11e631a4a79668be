"""The base of chambers with a controller: limits checked before anything is sent, checks of each reading."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from drivers.interfaces import BadReading, Identity, InstrumentRefused, LimitExceeded
from drivers.wire.visa import ProvedSession

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

NUMBER: Final = r"[+-]?\d{1,5}(?:\.\d{1,6})?"
"""The pattern of a temperature in replies of controllers."""

_PLAUSIBLE_K: Final = 30.0
"""Margin of the sensor's reading outside the limits, for a chamber at room temperature."""


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


class ControlledChamber(ABC):
    """The base of the chambers with a controller, a `ThermalChamber`; `temperature` is that of its air.

    A make says how its controller is proved, what is demanded and read back, and how it is stopped. `identity`
    is the pattern of its name; `write_gap_s` how long it wants to be left alone after a command without reply.
    """

    asks_person = False
    resolution_c: float = 0.1
    """The resolution to which the controller rounds a set point."""

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        limits: ChamberLimits,
        *,
        identity: str,
        write_gap_s: float = 0.0,
    ) -> None:
        self.name = name
        self._session = ProvedSession(session, clock, self._prove, write_gap_s=write_gap_s)
        self._limits = limits
        self._identity_pattern = identity
        self._identity = Identity("", "")
        self._target_c: float | None = None

    def open(self) -> Identity:
        """Connect and prove the identity; the chamber goes on as it is.

        Raises `InstrumentLost`, `BadReading`, `InstrumentRefused`.
        """
        self._session.open()
        return self._identity

    def close(self) -> None:
        """Release the connection; the chamber holds its temperature. Never raises, may be called twice."""
        self._session.close()

    def make_safe(self) -> str:
        """Stop conditioning, as at the end of a run; nothing is left for a person to do.

        Raises as `set_temperature`.
        """
        self._target_c = None
        self._stop()
        self._target_c = None
        return ""

    def set_temperature(self, target_c: float, key: str) -> None:
        """Demand a temperature, read it back, and have it conditioned.

        Raises `LimitExceeded` for the limits of the bench file before anything is sent, and for those of the
        controller before anything is set; `InstrumentRefused` for a chamber that is not ready or a demand not
        taken; `InstrumentLost`, `BadReading`.
        """
        self._limits.check(self.name, target_c)
        self._refuse_unready(target_c)
        self._target_c = None
        self._demand(target_c)
        self._refuse_other_set_point(self._set_point_c(), target_c)
        self._start()
        self._target_c = target_c

    def temperature(self, key: str, *, settling: bool = False) -> float:
        """Return the temperature of the air, °C.

        Raises `InstrumentRefused` for what the controller reports, for a state or set point that somebody
        changed, for air out of band; `BadReading`, `InstrumentLost`.
        """
        air_c = self._air_c(self._target_c)
        return self._limits.in_band(self.name, air_c, None if settling else self._target_c)

    def _refuse_other_set_point(self, shown_c: float, target_c: float) -> None:
        refuse_other_set_point(self.name, shown_c, target_c, self.resolution_c)

    # --- what a make says ---------------------------------------------------------------------------

    @abstractmethod
    def _prove(self) -> None:
        """Identify the controller and set `_identity`. Raises `InstrumentRefused`."""

    @abstractmethod
    def _refuse_unready(self, target_c: float) -> None:
        """Raise an error for alarms, programs or own limits that keep the chamber from a demand."""

    @abstractmethod
    def _demand(self, target_c: float) -> None:
        """Send the set point."""

    @abstractmethod
    def _set_point_c(self) -> float:
        """Return the set point read back, °C."""

    @abstractmethod
    def _start(self) -> None:
        """Start conditioning to the set point, and prove it."""

    @abstractmethod
    def _stop(self) -> None:
        """Stop conditioning, and prove it."""

    @abstractmethod
    def _air_c(self, target_c: float | None) -> float:
        """Return the temperature of the air, °C; with a demand prove first that it still stands."""
