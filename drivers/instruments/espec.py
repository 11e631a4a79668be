"""An Espec chamber with a P300 or SCP-220 controller: ASCII over a serial port or TCP port 10001.

Every command has one reply; the reply to a refused command begins with `NA:`.
Sources: see `drivers.facts.espec`; TEMP, MON, MODE, ALARM, TYPE, ROM.
"""

from __future__ import annotations

import contextlib
import re
from typing import TYPE_CHECKING, Final

from drivers.chambers import NUMBER, ChamberLimits, ControlledChamber
from drivers.facts import espec as facts
from drivers.interfaces import Identity, InstrumentRefused, LimitExceeded, message

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

_REFUSED: Final = r"NA: ?[\x20-\x7e]+"
_TEMPERATURES: Final = rf" ?{NUMBER}(?:, ?{NUMBER}){{3}}"
_MONITOR: Final = rf" ?{NUMBER}, ?(?:{NUMBER})?, ?(?:OFF|STANDBY|CONSTANT|RUN[^,]*), ?\d+"
_MODE: Final = r"OFF|STANDBY|CONSTANT|(?:RMT )?RUN.*"
_TYPE: Final = rf"(?:[^,]*,){{1,2}}[^,]+, ?{NUMBER}"
_MEANINGS: Final = {
    "CMD ERR": message("it does not know the command"),
    "ADDR ERR": message("the address is another chamber's"),
    "CONT NOT READY": message("it cannot do that in its present state"),
    "DATA NOT READY": message("it has no such data now"),
    "PARA ERR": message("it does not understand the value"),
    "DATA OUT OF RANGE": message("the value is outside its limits"),
    "PROTECT ON": message("its settings are protected"),
    "INVALID REQ": message("it has no such function"),
    "CHB NOT READY": message("the chamber is not ready"),
}


class EspecChamber(ControlledChamber):
    """A `ThermalChamber` in constant operation, with a resolution of 0.1 °C; its safe state is standby.

    `identity` is the pattern of the controller's name in the reply to TYPE?.
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
        super().__init__(name, session, clock, limits, identity=identity)

    def _refuse_unready(self, target_c: float) -> None:
        self._refuse_alarms()
        self._refuse_program()
        _, _, high_c, low_c = self._temperatures()
        if not low_c <= target_c <= high_c:
            raise LimitExceeded(
                self.name,
                f"{target_c:g} °C is outside the controller's own limits, {low_c:g} to {high_c:g} °C",
                "change the temperature in the procedure, or the limits on the controller",
            )

    def _demand(self, target_c: float) -> None:
        self._tell(f"TEMP, S{target_c:.1f}")

    def _set_point_c(self) -> float:
        return self._temperatures()[1]

    def _start(self) -> None:
        self._operate("CONSTANT")

    def _stop(self) -> None:
        self._operate("STANDBY")

    def _operate(self, mode: str) -> None:
        self._tell(f"MODE,{mode}")
        shown = self._ask("MODE?", _MODE, message("an operation such as CONSTANT"))
        if shown != mode:
            raise self._other_mode(shown, mode)

    def _air_c(self, target_c: float | None) -> float:
        reply = self._ask(
            "MON?", _MONITOR, message("temperature, humidity, mode and alarms such as 26.4,,CONSTANT,0")
        )
        *_, mode, alarms = (field.strip() for field in reply.split(","))
        if int(alarms):
            self._refuse_alarms()
        air_c, set_point_c, _, _ = self._temperatures()
        if target_c is not None:
            if mode != "CONSTANT":
                raise self._other_mode(mode, "CONSTANT")
            self._refuse_other_set_point(set_point_c, target_c)
        return air_c

    def _prove(self) -> None:
        fields = [
            field.strip()
            for field in self._ask("TYPE?", _TYPE, message("a type such as T,T,P300,150.0")).split(",")
        ]
        controller = fields[-2]
        if re.fullmatch(self._identity_pattern, controller) is None:
            raise InstrumentRefused(
                self.name,
                f"{self._session.resource} is a controller {controller!r}, "
                f"not one like {self._identity_pattern}",
                "check address and identity in the bench file",
            )
        firmware = ""
        with contextlib.suppress(InstrumentRefused):
            firmware = self._ask("ROM?", r"[\x20-\x7e]+", message("a firmware version"))
        self._identity = Identity(facts.MAKER, controller, firmware=firmware)

    def _temperatures(self) -> tuple[float, float, float, float]:
        """Return the reply to TEMP?: air, set point, upper and lower limit, °C."""
        reply = self._ask("TEMP?", _TEMPERATURES, message("four temperatures such as 26.4,25.0,140.0,-50.0"))
        air_c, set_point_c, high_c, low_c = (float(field) for field in reply.split(","))
        return air_c, set_point_c, high_c, low_c

    def _refuse_alarms(self) -> None:
        number, *codes = self._ask("ALARM?", r" ?\d+(?:, ?\d+)*", message("a number of alarms")).split(",")
        if int(number):
            raise InstrumentRefused(
                self.name,
                f"the chamber has the alarm {' and '.join(code.strip() for code in codes) or 'lamp on'}",
                "look it up in the chamber's manual, remove the cause and reset the alarm",
            )

    def _refuse_program(self) -> None:
        mode = self._ask("MODE?", _MODE, message("an operation such as CONSTANT"))
        if "RUN" in mode:
            raise self._other_mode(mode, message("one that leaves the set point to the bench"))

    def _other_mode(self, mode: str, wanted: str) -> InstrumentRefused:
        return InstrumentRefused(
            self.name,
            f"its operation is {mode}, not {wanted}",
            "end programs, check that nobody else controls the chamber, then repeat this step",
        )

    def _ask(self, command: str, pattern: str, expected: str) -> str:
        """Send a query and return its reply. Raises `InstrumentRefused` for a reply with NA."""
        return self._accepted(command, self._session.ask(command, f"{_REFUSED}|{pattern}", expected))

    def _tell(self, command: str) -> None:
        """Send a setting. Raises `InstrumentRefused` unless the reply is `OK:` and the setting."""
        wanted = f"OK:{command}".replace(" ", "")
        reply = self._session.command(command, rf"{_REFUSED}|OK:[\x20-\x7e]+", f"OK:{command}")
        if self._accepted(command, reply).replace(" ", "") != wanted:
            raise InstrumentRefused(
                self.name,
                f"it answers {command} with {reply!r}, not {wanted}",
                "check that no other program uses the chamber, then repeat this step",
            )

    def _accepted(self, command: str, reply: str) -> str:
        if not reply.startswith("NA:"):
            return reply
        reason = reply[3:].strip()
        meaning = _MEANINGS.get(re.sub(r"-\d+$", "", reason), message("see the controller's manual"))
        raise InstrumentRefused(
            self.name,
            f"it refused {command} with {reason} ({meaning})",
            "check the chamber's state and settings at its panel",
        )
