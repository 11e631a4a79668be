"""A Turnwell 3 head. ON, OFF, GO and STOP answer OK; ID?, POS? and BUSY? answer a value."""

import math

from drivers.interfaces import Identity, InstrumentRefused
from drivers.motion import MotorisedHead

from . import facts


class TurnwellHead(MotorisedHead):
    def __init__(self, name, session, clock, travel):
        super().__init__(name, session, clock, travel, identity=Identity("Turnwell", "3"))

    def _prove(self):
        maker, model, *_ = [*self._session.ask("ID?", r"[\x20-\x7e]+", "an identity").split(), "", ""]
        if maker != facts.IDENTITY:
            raise InstrumentRefused(self.name, f"it is a {maker} {model}, no Turnwell", "check its address")
        self._identity = Identity("Turnwell", model)

    def prepare(self):  # before each move, also after the controller was switched off
        self._session.repeating(self._session.ensure_proved)
        self._tell("ON")

    def position_rad(self):
        return math.radians(float(self._session.ask("POS?", r"-?\d+\.\d{4}", "degrees such as 45.0000")))

    def start(self, target_rad):  # returns at once; the base class waits and watches
        self._tell(f"GO {math.degrees(target_rad):.4f}")

    def moving(self):
        return self._session.ask("BUSY?", "0|1", "0 or 1") == "1"

    def stop(self):  # never waits for a proof
        self._tell("STOP", send=self._session.urgent)

    def _release(self, attempts):
        attempts.make(
            "switch its motor off at the controller", lambda: self._tell("OFF", send=self._session.urgent)
        )

    def _tell(self, command, send=None):  # once only: a command may have been carried out
        reply = (send or self._session.command)(command, "[ -~]+", "OK")
        if reply != "OK":
            raise InstrumentRefused(self.name, f"it answers {command} with {reply}", "see its display")
