"""A simulated Voltwerk 9 voltmeter."""

import re

from sim.wires.session import LineEnds, PlainDialect

from . import facts


class SimulatedVoltwerk9(PlainDialect):
    line_ends = LineEnds((b"\n",), reply=b"\r\n")

    def __init__(self, source, clock, *, interface, noise, accuracy, line_hz):
        self._source, self._clock, self._line_hz = source, clock, line_hz
        self.overloaded = False
        self.power_cycle()

    def handle(self, message, interrupted):
        text = message.decode("ascii", "replace")
        if re.fullmatch(r"R[0-2]N[1-3]", text):
            self._settings = text
        reply = {"V?": facts.IDENTITY, "S?": self._settings, "T": None}.get(text)
        if text == "T":
            reply = self._sample()
        return None if reply is None else reply.encode("ascii")

    def _sample(self):
        self._source.new_reading()
        self._clock.sleep(2.0 * facts.NPLC[int(self._settings[3]) - 1] / self._line_hz)
        signal_v, range_v = self._source.signal_v(), facts.RANGES_V[int(self._settings[1])]
        over = self.overloaded or abs(signal_v) > facts.OVER_RANGE * range_v
        return facts.OVERLOAD if over else f"{signal_v:+09.5f}E0"

    def power_cycle(self):
        self._settings = facts.SWITCHED_ON
