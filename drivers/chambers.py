"""Base class of chambers with a controller: limits are checked before sending, and each reading is checked."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from drivers.interfaces import BadReading, InstrumentRefused, LimitExceeded
from drivers.wire.visa import ProvedInstrument

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

NUMBER: Final = r"[+-]?\d{1,5}(?:\.\d{1,6})?"
"""The pattern of a temperature in replies of controllers."""

_PLAUSIBLE_K: Final = 30.0
"""A reading further than this outside the limits, K, is implausible; room temperature may be outside them."""


@dataclass(frozen=True, slots=True)
class ChamberLimits:
    """The permitted set points of a chamber, °C, and the permitted deviation of the air from the set point.

    The air may deviate by `band_c`, K; if that is None, every plausible temperature is permitted. Raises
    `ValueError` unless `minimum_c` is below `maximum_c` and a stated `band_c` is positive.
    """

    minimum_c: float
    maximum_c: float
    band_c: float | None = None

    def __post_init__(self) -> None:
        """Raise `ValueError` for limits in the wrong order and for a band that is not positive."""
        if not self.minimum_c < self.maximum_c:
            raise ValueError(
                f"the chamber's minimum {self.minimum_c:g} °C must be below its maximum {self.maximum_c:g} °C"
            )
        if self.band_c is not None and not self.band_c > 0.0:
            raise ValueError(f"state a positive band for the chamber, not {self.band_c:g} °C")

    def check(self, name: str, target_c: float) -> None:
        """Raise `LimitExceeded` for a set point outside the limits; `name` is the name of the chamber."""
        if not (math.isfinite(target_c) and self.minimum_c <= target_c <= self.maximum_c):
            raise LimitExceeded(
                name,
                f"{target_c:g} °C is outside {self.minimum_c:g} to {self.maximum_c:g} °C",
                "change the temperature in the procedure or the limits in the bench file",
            )

    def plausible(self, name: str, temperature_c: float) -> float:
        """Return the sensor's temperature; raise `BadReading` if it is more than 30 K outside the limits."""
        low_c, high_c = self.minimum_c - _PLAUSIBLE_K, self.maximum_c + _PLAUSIBLE_K
        if low_c <= temperature_c <= high_c:
            return temperature_c
        raise BadReading(
            name,
            f"it shows {temperature_c:g} °C, which is not plausible ({low_c:g} to {high_c:g} °C)",
            "check its sensor, its unit (°C or °F) and the limits in the bench file",
        )

    def in_band(self, name: str, temperature_c: float, target_c: float | None) -> float:
        """Return the air's temperature; raise `InstrumentRefused` if it is over `band_c` from the set point.

        If the set point `target_c` or `band_c` is None, only plausibility is checked. Raises `BadReading` for
        an implausible temperature.
        """
        self.plausible(name, temperature_c)
        if target_c is None or self.band_c is None or abs(temperature_c - target_c) <= self.band_c:
            return temperature_c
        raise InstrumentRefused(
            name,
            f"the air is at {temperature_c:g} °C, more than {self.band_c:g} °C "
            f"from the {target_c:g} °C demanded",
            "lengthen the soak in the procedure, or repair the chamber",
        )


def refuse_other_set_point(name: str, shown_c: float, target_c: float, resolution_c: float) -> None:
    """Raise `InstrumentRefused` if the controller's set point `shown_c` is not the demanded `target_c`, °C.

    The two may differ by half the controller's resolution, plus a margin for floating-point rounding.
    """
    if not abs(shown_c - target_c) <= 0.51 * resolution_c:
        raise InstrumentRefused(
            name,
            f"its set point is {shown_c:g} °C, not the {target_c:g} °C demanded",
            "check that nobody else controls the chamber, and that it was not switched off",
        )


class ControlledChamber(ProvedInstrument):
    """The base class of chambers with a controller: a `ThermalChamber` that reads the temperature of the air.

    A subclass verifies, sets, reads, starts and stops its controller. `identity` is the pattern of the
    controller's name. The controller needs a pause of `write_gap_s`, s, after a command without reply.
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
        super().__init__(name, session, clock, write_gap_s=write_gap_s)
        self._limits = limits
        self._identity_pattern = identity
        self._target_c: float | None = None

    def make_safe(self) -> str:
        """Stop conditioning, as at the end of a run; return "", because nothing is left for a person to do.

        Raises `InstrumentRefused`, `InstrumentLost`, `BadReading`; `LimitExceeded` for a safe set point out
        of limits.
        """
        self._target_c = None
        self._stop()
        self._target_c = None
        return ""

    def set_temperature(self, target_c: float, key: str) -> None:
        """Send the set point, read it back, and start conditioning.

        Raises `LimitExceeded` for a set point outside the bench file's limits, before anything is sent, or
        outside the controller's limits, before anything is set. Raises `InstrumentRefused` if the chamber is
        not ready or the set point is not applied; `InstrumentLost`, `BadReading`.
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

        Raises `InstrumentRefused` for air outside the band (unless `settling`), for a fault that the controller
        reports, and if somebody changed the set point or the operating state; also `BadReading`, `InstrumentLost`.
        """
        air_c = self._air_c(self._target_c)
        return self._limits.in_band(self.name, air_c, None if settling else self._target_c)

    def _refuse_other_set_point(self, shown_c: float, target_c: float) -> None:
        refuse_other_set_point(self.name, shown_c, target_c, self.resolution_c)

    # --- implemented by each make -------------------------------------------------------------------

    @abstractmethod
    def _refuse_unready(self, target_c: float) -> None:
        """Raise an error if alarms, a running program or the controller's limits forbid this set point."""

    @abstractmethod
    def _demand(self, target_c: float) -> None:
        """Send the set point."""

    @abstractmethod
    def _set_point_c(self) -> float:
        """Return the set point read back, °C."""

    @abstractmethod
    def _start(self) -> None:
        """Start conditioning to the set point, and verify that it started."""

    @abstractmethod
    def _stop(self) -> None:
        """Stop conditioning, and verify that it stopped."""

    @abstractmethod
    def _air_c(self, target_c: float | None) -> float:
        """Return the temperature of the air, °C; verify first that a set point `target_c` is in force."""
