"""A Gustline 2 thermometer. ID? answers its name, T? the temperature and the pressure."""

import re

from drivers.interfaces import BadReading, Identity, InstrumentRefused
from drivers.wire.visa import ProvedInstrument

from . import facts


class GustlineThermometer(ProvedInstrument):
    asks_person = False
    sensor = "Gustline 2, Pt100"  # for the record

    def __init__(self, name, session, clock, *, line_hz):
        super().__init__(name, session, clock)

    def _prove(self):
        maker, model, *_ = [*self._session.ask("ID?", r"[\x20-\x7e]+", "an identity").split(), "", ""]
        if maker != facts.IDENTITY:
            raise InstrumentRefused(self.name, f"it is a {maker} {model}, no Gustline", "check its address")
        self._identity = Identity("Gustline", model)

    def block_c(self, key):
        wanted = "a line such as T=+23.00 C P=1013.2 hPa"
        reply = self._session.ask("T?", f"{facts.REPLY}|{re.escape(facts.NO_SENSOR)}.*", wanted)
        if reply.startswith(facts.NO_SENSOR):
            raise BadReading(self.name, "its sensor is open", "check the sensor's cable")
        return float(re.fullmatch(facts.REPLY, reply)[1])
