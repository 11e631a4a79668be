"""Keithley 2000, measuring DC volts into its buffer.

Starting a reading clears the buffer and fills it once. As the meter accepts commands while it measures, *WAI
delays the reply until the last sample. Sources: see `drivers.facts.keithley_2000`.
"""

from __future__ import annotations

from drivers.facts import keithley_2000 as facts
from drivers.interfaces import VoltmeterLimits, VoltmeterSettings
from drivers.scpi_voltmeter import ProvenSetting, ScpiVoltmeter


class Keithley2000(ScpiVoltmeter):
    """A `Voltmeter` with one signal. `interface` is "gpib" or "rs232"; there is no LAN."""

    makers = facts.MAKERS
    models = facts.MODELS
    called = "Keithley 2000"
    hint = "it must speak SCPI: GPIB, LANG on its front panel"
    start_command = "TRAC:CLE;:TRAC:FEED:CONT NEXT;:INIT"
    fetch_query = "*WAI;:TRAC:DATA?"
    reading = facts.READING
    reading_example = facts.READING_EXAMPLE
    reading_characters = facts.READING_CHARACTERS
    equally_long = True
    overload_v = facts.OVERLOAD_V
    sample_overhead_s = facts.SAMPLE_OVERHEAD_S
    errors_kept = facts.ERRORS_KEPT

    @property
    def limits(self) -> VoltmeterLimits:
        """The limits of the model."""
        return VoltmeterLimits.of(facts)

    def _setup(self, settings: VoltmeterSettings) -> list[ProvenSetting]:
        return [
            # After power-on the meter triggers continuously and filters; both would affect the readings.
            ProvenSetting("INIT:CONT OFF;:ABOR", "INIT:CONT?", 0.0),
            ProvenSetting("FUNC 'VOLT:DC'", "FUNC?", '"VOLT:DC"'),
            ProvenSetting(f"VOLT:DC:RANG {settings.range_v:g}", "VOLT:DC:RANG?", settings.range_v),
            ProvenSetting(None, "VOLT:DC:RANG:AUTO?", 0.0),
            ProvenSetting(f"VOLT:DC:NPLC {settings.nplc:g}", "VOLT:DC:NPLC?", settings.nplc),
            ProvenSetting("VOLT:DC:AVER:STAT OFF", "VOLT:DC:AVER:STAT?", 0.0),
            ProvenSetting("VOLT:DC:REF:STAT OFF", "VOLT:DC:REF:STAT?", 0.0),
            ProvenSetting("SYST:AZER:STAT ON", "SYST:AZER:STAT?", 1.0),
            ProvenSetting("FORM:DATA ASC", "FORM:DATA?", "ASC"),
            ProvenSetting("FORM:ELEM READ", "FORM:ELEM?", "READ"),
            ProvenSetting("TRIG:SOUR IMM", "TRIG:SOUR?", "IMM"),
            ProvenSetting("TRIG:DEL:AUTO ON", "TRIG:DEL:AUTO?", 1.0),
            ProvenSetting("TRIG:COUN 1", "TRIG:COUN?", 1.0),
            ProvenSetting(f"SAMP:COUN {settings.samples}", "SAMP:COUN?", float(settings.samples)),
            # The buffer's size cannot be changed while it fills, so stop that first (FEED:CONT NEV).
            ProvenSetting(
                f"TRAC:FEED:CONT NEV;:TRAC:FEED SENS;:TRAC:POIN {settings.samples}",
                "TRAC:POIN?",
                float(settings.samples),
            ),
        ]
