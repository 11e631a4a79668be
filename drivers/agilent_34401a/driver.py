"""HP / Agilent / Keysight 34401A, and a Truevolt 34461A set to emulate it: DC volts into memory.

Sources: 34401A User's Guide (34401-90004), chapter 4, "SCPI command summary", "Output data formats",
"Triggering", "RS-232 interface configuration"; chapter 8, "DC characteristics".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from drivers.interfaces import Channel, Identity, InstrumentRefused, VoltmeterSettings
from drivers.scpi_voltmeter import READING_CHARACTERS, Interface, Limits, ProvenSetting, ScpiVoltmeter, is_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

RANGES_V: Final = (0.1, 1.0, 10.0, 100.0, 1000.0)
NPLC: Final = (0.02, 0.2, 1.0, 10.0, 100.0)
MEMORY_SAMPLES: Final = 512

_SAMPLE_OVERHEAD_S: Final = 0.01


@dataclass(frozen=True, slots=True)
class SingleChannelDialect:
    """Where the meters of the 34401A's line differ: two headers, and how much the memory holds."""

    autozero: str
    high_impedance: str
    limits: Limits


DIALECT_34401A: Final = SingleChannelDialect(
    "ZERO:AUTO", "INP:IMP:AUTO", Limits(RANGES_V, NPLC, MEMORY_SAMPLES)
)


def reading_time_s(settings: VoltmeterSettings, line_hz: float, character_time_s: float = 0.0) -> float:
    """Return the time from INIT until the last character of FETC? has come, s.

    Autozero takes a second integration for each sample; `character_time_s` is that of a slow line.
    """
    sample_s = 2.0 * settings.nplc / line_hz + _SAMPLE_OVERHEAD_S
    return settings.samples * (sample_s + READING_CHARACTERS * character_time_s)


class Agilent34401A(ScpiVoltmeter):
    """A `Voltmeter` with one signal (see `ScpiVoltmeter` for `interface`, `clock` and `line_hz`)."""

    dialects: Mapping[str, SingleChannelDialect] = {"34401A": DIALECT_34401A}
    """The models that are taken, by the name in their identity; the first is assumed before `open`."""

    _called = "a 34401A"
    _hint = "a 34461A must be told SYST:IDEN HP34401A once"

    def __init__(
        self,
        name: str,
        channel: Channel,
        session: MessageSession,
        clock: Clock,
        *,
        interface: Interface = "lan",
        line_hz: float = 50.0,
    ) -> None:
        super().__init__(name, (channel,), session, clock, interface=interface, line_hz=line_hz)
        self._dialect = next(iter(self.dialects.values()))

    @property
    def limits(self) -> Limits:
        """What the model can do; before `open` that of the model that this driver is named after."""
        return self._dialect.limits

    def _accept(self, identity: Identity, reply: str) -> None:
        if not is_of(identity, tuple(self.dialects)):
            raise InstrumentRefused(
                self.name,
                f"{self._session.resource} is {reply!r}, not {self._called}",
                f"check the address in the bench file ({self._hint})",
            )
        self._dialect = self.dialects[identity.model]

    def _setup(self, settings: VoltmeterSettings) -> list[ProvenSetting]:
        autozero, impedance = self._dialect.autozero, self._dialect.high_impedance
        return [
            # CONF presets the trigger and the input to 10 MOhm, so it comes first.
            ProvenSetting(f"CONF:VOLT:DC {settings.range_v:g}", "FUNC?", '"VOLT"'),
            ProvenSetting(None, "VOLT:DC:RANG?", settings.range_v),
            ProvenSetting(None, "VOLT:DC:RANG:AUTO?", 0.0),
            ProvenSetting(f"VOLT:DC:NPLC {settings.nplc:g}", "VOLT:DC:NPLC?", settings.nplc),
            ProvenSetting(f"{autozero} ON", f"{autozero}?", 1.0),
            ProvenSetting(f"{impedance} ON", f"{impedance}?", 1.0),
            ProvenSetting("TRIG:SOUR IMM", "TRIG:SOUR?", "IMM"),
            ProvenSetting("TRIG:COUN 1", "TRIG:COUN?", 1.0),
            ProvenSetting(f"SAMP:COUN {settings.samples}", "SAMP:COUN?", float(settings.samples)),
        ]

    def _reading_time_s(self, settings: VoltmeterSettings, character_time_s: float) -> float:
        return reading_time_s(settings, self._line_hz, character_time_s)
