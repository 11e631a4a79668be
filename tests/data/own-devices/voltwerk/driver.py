"""A Voltwerk 9 voltmeter: V? answers its name, S? its settings such as R2N3, T one sample. R2N3 has no reply."""

from drivers.interfaces import (
    BadReading,
    Identity,
    InstrumentLost,
    InstrumentRefused,
    LimitExceeded,
    VoltmeterLimits,
)
from drivers.wire.visa import ProvedInstrument

from . import facts


class Voltwerk9(ProvedInstrument):
    limits = VoltmeterLimits.of(facts)

    def __init__(self, name, channel, session, clock, *, interface, line_hz):
        super().__init__(name, session, clock)
        self.channels = (channel,)
        self._settings, self._started = None, False

    def _prove(self):
        shown = self._session.ask("V?", r"[\x20-\x7e]+", "an identity")
        if shown != facts.IDENTITY:
            raise InstrumentRefused(self.name, f"it is a {shown}, no Voltwerk 9", "check its address")
        self._identity = Identity(*shown.split())

    def configure(self, settings):
        if wrong := self.limits.transgressions(settings):
            raise LimitExceeded(self.name, f"cannot do {', '.join(wrong)}", "change the procedure")
        self._settings, self._started = None, False
        self._session.write(self._wanted(settings))
        shown = self._shown()
        if shown != self._wanted(settings):
            raise InstrumentRefused(self.name, f"it is set to {shown}", "check that nobody else uses it")
        self._settings = settings

    def start(self):
        if self._settings is None:
            raise InstrumentRefused(self.name, "no range was set", "configure it before a reading")
        self._started = True  # it measures only while it is asked

    def fetch(self):
        if not self._started:
            raise BadReading(self.name, "no reading was started", "start the reading again")
        self._started = False
        samples = [self._sample() for _ in range(self._settings.samples)]
        if self._shown() != self._wanted(self._settings):
            raise InstrumentLost(
                self.name, "it lost its settings", "check its power, then repeat this reading"
            )
        return {self.channels[0]: tuple(samples)}

    def _sample(self):
        shown = self._session.command("T", f"{facts.READING}|[+-]99.99999E9", "a reading such as +01.23456E0")
        if shown[1:] == facts.OVERLOAD[1:]:
            range_v = self._settings.range_v
            raise BadReading(
                self.name, f"the signal overloads the {range_v:g} V range", "choose a higher range"
            )
        return float(shown)

    def _shown(self):
        return self._session.ask("S?", r"R\dN\d", "settings such as R2N3")

    def _wanted(self, settings):
        return f"R{facts.RANGES_V.index(settings.range_v)}N{1 + facts.NPLC.index(settings.nplc)}"
