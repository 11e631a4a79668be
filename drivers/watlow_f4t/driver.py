"""A chamber with a Watlow F4T controller: SCPI over TCP port 5025.

There is no error queue: every setting is read back. The unit of all temperatures is asked each time: firmware
from 04:05:0007 (2019) on speaks °C or °F as it is set, older firmware °F only and does not say so; that is
refused, as a guess would be wrong by tens of degrees. Source: Watlow F4T User's Guide, "SCPI commands";
TestEquity F4T manuals.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from drivers.chambers import NUMBER, ChamberLimits, refuse_other_set_point
from drivers.interfaces import BadReading, Identity, InstrumentLost, InstrumentRefused
from drivers.wire.proving import ProvedSession

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

PORT: Final = 5025
"""SCPI; the port 502 that one edition of the guide prints is Modbus."""
READ_TERMINATION: Final = "\n"
WRITE_TERMINATION: Final = "\n"

_WRITE_GAP_S: Final = 1.0
_RESOLUTION_C: Final = 0.1
_FAHRENHEIT_PER_C: Final = 1.8
_FAHRENHEIT_AT_0_C: Final = 32.0


class WatlowF4TChamber:
    """A `ThermalChamber` on one control loop of an F4T; `temperature` is that of its air.

    `output` is the output that switches conditioning on, where the chamber has one: it is switched on with
    each demand and off by `make_safe`. Without it `make_safe` demands `safe_c`. `identity` is searched for in
    the reply to *IDN?, any case.
    """

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        limits: ChamberLimits,
        *,
        loop: int = 1,
        output: int | None = None,
        safe_c: float = 23.0,
        identity: str = r"F4T",
    ) -> None:
        self.name = name
        self.asks_person = False
        self._session = ProvedSession(session, clock, self._prove, write_gap_s=_WRITE_GAP_S)
        self._limits = limits
        self._loop = f":SOURCE:CLOOP{loop}"
        self._output = output
        self._safe_c = safe_c
        self._identity_pattern = identity
        self._identity = Identity("Watlow", "F4T")
        self._target_c: float | None = None

    def open(self) -> Identity:
        """Connect, prove the identity and that the unit is known; the chamber goes on as it is.

        Raises `InstrumentLost`, `BadReading`, `InstrumentRefused`.
        """
        self._session.open()
        return self._identity

    def close(self) -> None:
        """Let the chamber go; it holds its temperature. Never raises, may be called twice."""
        self._session.close()

    def make_safe(self) -> str:
        """Switch the output off, or where there is none demand `safe_c`, as at the end of a run.

        Nothing is left for a person to do. Raises as `set_temperature`.
        """
        if self._output is None:
            self.set_temperature(self._safe_c, "make safe")
        else:
            self._switch_output(self._output, on=False)
        self._target_c = None
        return ""

    def set_temperature(self, target_c: float, key: str) -> None:
        """Demand a temperature and read it back.

        Raises `LimitExceeded` before anything is sent, `InstrumentRefused` for an error of the loop or a
        demand not taken, `InstrumentLost`, `BadReading`.
        """
        self._limits.check(self.name, target_c)
        self._refuse_loop_error()
        self._target_c = None
        demand = target_c * _FAHRENHEIT_PER_C + _FAHRENHEIT_AT_0_C if self._fahrenheit() else target_c
        self._session.write(f"{self._loop}:SPOINT {demand:.2f}")
        refuse_other_set_point(self.name, self._temperature_c("SPOINT"), target_c, _RESOLUTION_C)
        if self._output is not None:
            self._switch_output(self._output, on=True)
        self._target_c = target_c

    def temperature(self, key: str, *, settling: bool = False) -> float:
        """Return the temperature of the air, °C.

        Raises `InstrumentRefused` for an error of the loop, an output switched off, a set point that
        somebody changed, air out of band; `BadReading`, `InstrumentLost`.
        """
        self._refuse_loop_error()
        if self._target_c is not None:
            shown_c = self._temperature_c("SPOINT")
            refuse_other_set_point(self.name, shown_c, self._target_c, _RESOLUTION_C)
            if self._output is not None:
                self._refuse_output(self._output, on=True)
        return self._limits.in_band(
            self.name, self._temperature_c("PVALUE"), None if settling else self._target_c
        )

    def _prove(self) -> None:
        reply = self._session.ask("*IDN?", r"[\x20-\x7e]+", "an identity")
        if re.search(self._identity_pattern, reply, re.IGNORECASE) is None:
            raise InstrumentRefused(
                self.name,
                f"{self._session.resource} is {reply!r}, not a {self._identity_pattern}",
                "check the address in the bench file",
            )
        fields = [*(field.strip(' "') for field in reply.split(",")), "", "", "", ""]
        self._identity = Identity(fields[0], fields[1] or "F4T", fields[2], fields[3])
        try:
            self._fahrenheit()
        except (InstrumentLost, BadReading) as error:
            raise InstrumentRefused(
                self.name,
                f"the controller does not say whether it speaks °C or °F ({error.cause})",
                "update its firmware to 04:05:0007 or later (older firmware speaks °F only), or, if it is "
                "new enough, check the cable",
            ) from error

    def _fahrenheit(self) -> bool:
        return self._session.ask(":UNIT:TEMPERATURE?", "[CF]", "C or F") == "F"

    def _temperature_c(self, what: str) -> float:
        """Return PVALUE or SPOINT of the loop in °C. The unit is asked first: somebody may change it."""
        fahrenheit = self._fahrenheit()
        value = float(self._session.ask(f"{self._loop}:{what}?", NUMBER, "a temperature such as 25.0"))
        return (value - _FAHRENHEIT_AT_0_C) / _FAHRENHEIT_PER_C if fahrenheit else value

    def _refuse_loop_error(self) -> None:
        state = self._session.ask(f"{self._loop}:ERROR?", r"[A-Za-z ]+", "NONE or ERROR")
        if state.strip().upper() != "NONE":
            raise InstrumentRefused(
                self.name,
                f"the control loop reports {state}",
                "see the controller's display (a sensor broken or not connected), mend it and reset it there",
            )

    def _switch_output(self, output: int, *, on: bool) -> None:
        self._session.write(f":OUTPUT{output}:STATE {'ON' if on else 'OFF'}")
        self._refuse_output(output, on=on)

    def _refuse_output(self, output: int, *, on: bool) -> None:
        state = self._session.ask(f":OUTPUT{output}:STATE?", r"ON|OFF|1|0", "ON or OFF")
        if (state in ("ON", "1")) != on:
            raise InstrumentRefused(
                self.name,
                f"its output {output} is {state}, not {'ON' if on else 'OFF'}",
                "check that nobody else controls the chamber and that its output is configured as an event",
            )
