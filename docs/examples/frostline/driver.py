"""A Frostline 7 chamber. SET, RUN have no reply; ID?, SET?, RUN?, AIR? have one."""

from drivers.chambers import NUMBER, ControlledChamber
from drivers.interfaces import Identity, InstrumentRefused

from . import facts


class FrostlineChamber(ControlledChamber):
    resolution_c = facts.RESOLUTION_C

    def __init__(self, name, session, clock, limits):
        super().__init__(name, session, clock, limits, identity=facts.IDENTITY, write_gap_s=facts.BUSY_S)

    def _prove(self):
        maker, model, *_ = [*self._session.ask("ID?", r"[\x20-\x7e]+", "an identity").split(), "", ""]
        if maker != facts.IDENTITY:  # never the whole text: the firmware will change
            raise InstrumentRefused(self.name, f"it is a {maker} {model}, no Frostline", "check its address")
        self._identity = Identity("Frostline", model)

    def _refuse_unready(self, target_c): ...

    def _demand(self, target_c):
        self._session.write(f"SET {target_c:.1f}")

    def _set_point_c(self):
        return self._number("SET?")

    def _start(self):
        self._run("1")

    def _stop(self):
        self._run("0")

    def _air_c(self, target_c):
        if target_c is not None:  # a chamber that was switched off meanwhile has forgotten it
            self._refuse_other_set_point(self._set_point_c(), target_c)
        return self._number("AIR?")

    def _number(self, command):
        return float(self._session.ask(command, NUMBER, "a temperature such as 25.0"))

    def _run(self, state):
        self._session.write(f"RUN {state}")
        if self._session.ask("RUN?", "0|1", "0 or 1") != state:
            raise InstrumentRefused(self.name, f"RUN {state} was not taken", "see its display")
