"""A Thermotron chamber (8800, 8200, 3800, 2800): plain commands over TCP or a serial port.

A command has no reply, and the controller needs a pause of a second after each. A set point takes effect only with
RUNM. The controller has no query for its unit: it must be set to °C.
Sources: see `drivers.facts.thermotron`; IDEN, PVAR, SETP, RUNM, STOP, MODE.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from drivers.chambers import NUMBER, ChamberLimits, ControlledChamber
from drivers.facts import thermotron as facts
from drivers.interfaces import Identity, InstrumentRefused, message

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

_WRITE_GAP_S: Final = facts.BUSY_S + 0.1


class ThermotronChamber(ControlledChamber):
    """A `ThermalChamber` run in manual mode; the air temperature is process variable 1.

    `identity` is a pattern to search for in the reply to IDEN?.
    """

    resolution_c = facts.RESOLUTION_C

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        limits: ChamberLimits,
        *,
        identity: str = facts.IDENTITY,
    ) -> None:
        super().__init__(name, session, clock, limits, identity=identity, write_gap_s=_WRITE_GAP_S)

    def _refuse_unready(self, target_c: float) -> None:
        self._refuse_mode(facts.STOPPED | facts.MANUAL, message("stopped or manual"))

    def _demand(self, target_c: float) -> None:
        self._session.write(f"SETP1,{target_c:.1f}")

    def _set_point_c(self) -> float:
        return self._number("SETP1?")

    def _start(self) -> None:
        self._session.write("RUNM")
        self._refuse_mode(facts.MANUAL, "manual")

    def _stop(self) -> None:
        self._session.write("STOP")
        self._refuse_mode(facts.STOPPED, "stopped")

    def _air_c(self, target_c: float | None) -> float:
        if target_c is not None:
            self._refuse_mode(facts.MANUAL, "manual")
            self._refuse_other_set_point(self._set_point_c(), target_c)
        return self._number("PVAR1?")

    def _prove(self) -> None:
        reply = self._session.ask("IDEN?", r"[\x20-\x7e]+", message("an identity"))
        match = re.search(self._identity_pattern, reply)
        if match is None:
            raise InstrumentRefused(
                self.name,
                f"{self._session.resource} is {reply!r}, not a Thermotron {self._identity_pattern}",
                "check address and identity in the bench file",
            )
        self._identity = Identity(facts.MAKER, match[0], firmware=reply.replace(match[0], "").strip(" ,-"))

    def _number(self, command: str) -> float:
        return float(self._session.ask(command, NUMBER, message("a temperature such as 22.000")))

    def _refuse_mode(self, bits: int, wanted: str) -> None:
        """Raise `InstrumentRefused` unless the mode has one of the bits; `wanted` names them in the message."""
        mode = int(self._session.ask("MODE?", r"\d{1,5}", message("a mode such as 16")))
        if not mode & bits:
            raise InstrumentRefused(
                self.name,
                f"its mode is {mode}, not {wanted}",
                "end programs, check alarms and that nobody else controls the chamber, then repeat this step",
            )
