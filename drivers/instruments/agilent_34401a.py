"""HP / Agilent / Keysight 34401A, or a Truevolt 34461A that emulates it, measuring DC volts into its memory.

Sources: see `drivers.facts.agilent_34401a`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from drivers.facts import agilent_34401a as facts
from drivers.interfaces import Identity, VoltmeterLimits, VoltmeterSettings
from drivers.scpi_voltmeter import ProvenSetting, ScpiVoltmeter

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class SingleChannelDialect:
    """What differs between a 34401A and related meters: two command headers and the limits of the settings."""

    autozero: str
    high_impedance: str
    limits: VoltmeterLimits


DIALECT_34401A: Final = SingleChannelDialect("ZERO:AUTO", "INP:IMP:AUTO", VoltmeterLimits.of(facts))


class Agilent34401A(ScpiVoltmeter):
    """A `Voltmeter` with one signal."""

    dialects: Mapping[str, SingleChannelDialect] = dict.fromkeys(facts.MODELS, DIALECT_34401A)
    """The accepted models, by the name in their identity; the first is assumed before `open`."""
    _dialect = DIALECT_34401A

    models: tuple[str, ...] = facts.MODELS
    called = "34401A"
    hint = "a 34461A must be told SYST:IDEN HP34401A once"

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls._dialect = next(iter(cls.dialects.values()))

    @property
    def limits(self) -> VoltmeterLimits:
        """The limits of the connected model; before `open`, the limits of the first model in `dialects`."""
        return self._dialect.limits

    def _accept(self, identity: Identity, reply: str) -> None:
        super()._accept(identity, reply)
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
