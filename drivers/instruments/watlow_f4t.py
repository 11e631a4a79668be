"""A chamber with a Watlow F4T controller: SCPI over TCP port 5025.

There is no error queue: every setting is read back. The unit of the temperatures is queried each time: firmware
from 04:05:0007 (2019) on uses °C or °F as set. Older firmware uses only °F and has no such query. The driver
refuses it, because a wrong guess of the unit would be off by tens of degrees. Sources: see
`drivers.facts.watlow_f4t`.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from drivers.chambers import NUMBER, ChamberLimits, ControlledChamber
from drivers.facts import watlow_f4t as facts
from drivers.interfaces import BadReading, Identity, InstrumentLost, InstrumentRefused, message

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession


class WatlowF4TChamber(ControlledChamber):
    """A `ThermalChamber` on one control loop of an F4T.

    `output` is the output that switches conditioning on, if the chamber has one: it is switched on with each
    set point and off by `make_safe`. Without an output, `make_safe` sends the set point `safe_c`, °C.
    `identity` is a case-insensitive pattern for the reply to *IDN?. `open` also verifies that the controller
    reports °C or °F.
    """

    resolution_c = facts.RESOLUTION_C

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        limits: ChamberLimits,
        *,
        loop: int = 1,
        output: int | None = None,
        safe_c: float = facts.SAFE_C,
        identity: str = facts.IDENTITY,
    ) -> None:
        super().__init__(name, session, clock, limits, identity=identity, write_gap_s=facts.BUSY_S)
        self._loop = f":SOURCE:CLOOP{loop}"
        self._output = output
        self._safe_c = safe_c

    def _refuse_unready(self, target_c: float) -> None:
        self._refuse_loop_error()

    def _refuse_loop_error(self) -> None:
        state = self._session.ask(f"{self._loop}:ERROR?", r"[A-Za-z ]+", "NONE or ERROR")
        if state.strip().upper() != "NONE":
            raise InstrumentRefused(
                self.name,
                f"the control loop reports {state}",
                "check the sensor and its cable, then reset the fault at the controller's display",
            )

    def _demand(self, target_c: float) -> None:
        demand = target_c
        if self._fahrenheit():
            demand = target_c * facts.FAHRENHEIT_PER_C + facts.FAHRENHEIT_AT_0_C
        self._session.write(f"{self._loop}:SPOINT {demand:.2f}")

    def _set_point_c(self) -> float:
        return self._temperature_c("SPOINT")

    def _start(self) -> None:
        if self._output is not None:
            self._switch_output(self._output, on=True)

    def _stop(self) -> None:
        """Switch the output off or, if there is none, set `safe_c`, even if the control loop reports an error."""
        if self._output is None:
            self._limits.check(self.name, self._safe_c)
            self._demand(self._safe_c)
            self._refuse_other_set_point(self._set_point_c(), self._safe_c)
        else:
            self._switch_output(self._output, on=False)

    def _air_c(self, target_c: float | None) -> float:
        self._refuse_loop_error()
        if target_c is not None:
            self._refuse_other_set_point(self._set_point_c(), target_c)
            if self._output is not None:
                self._refuse_output(self._output, on=True)
        return self._temperature_c("PVALUE")

    def _prove(self) -> None:
        reply = self._session.ask("*IDN?", r"[\x20-\x7e]+", message("an identity"))
        if re.search(self._identity_pattern, reply, re.IGNORECASE) is None:
            raise InstrumentRefused(
                self.name,
                f"{self._session.resource} identifies itself as {reply!r}, not as {self._identity_pattern}",
                "check the address in the bench file",
            )
        fields = [*(field.strip(' "') for field in reply.split(",")), "", "", "", ""]
        self._identity = Identity(fields[0], fields[1] or facts.MODEL, fields[2], fields[3])
        try:
            self._fahrenheit()
        except (InstrumentLost, BadReading) as error:
            raise InstrumentRefused(
                self.name,
                f"the controller does not say whether it speaks °C or °F ({error.cause})",
                "update its firmware to 04:05:0007 or later (older ones speak °F only), or check the cable",
            ) from error

    def _fahrenheit(self) -> bool:
        return self._session.ask(":UNIT:TEMPERATURE?", "[CF]", "C or F") == "F"

    def _temperature_c(self, what: str) -> float:
        """Return PVALUE or SPOINT (`what`) of the loop, °C; query the unit first, as somebody may change it."""
        fahrenheit = self._fahrenheit()
        value = float(
            self._session.ask(f"{self._loop}:{what}?", NUMBER, message("a temperature such as 25.0"))
        )
        return (value - facts.FAHRENHEIT_AT_0_C) / facts.FAHRENHEIT_PER_C if fahrenheit else value

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
