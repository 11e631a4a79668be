"""Keithley 2000."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import field_validator, model_validator

from bench.config.devices.device import Device, Port, PortSection, is_serial, usual_baud_rate
from bench.config.devices.sections import OneChannelForm, VoltmeterTruth
from drivers.facts import keithley_2000 as keithley


class Keithley2000Port(PortSection):
    """How the RS-232 of a Keithley 2000 is set on its front panel; `terminator` is its TX TERM."""

    baud_rate: int = PortSection.of(keithley).baud_rate
    terminator: Literal["lf", "cr", "crlf", "lfcr"] = "lf"

    @field_validator("baud_rate")
    @classmethod
    def _of_the_meter(cls, baud_rate: int) -> int:
        return usual_baud_rate(baud_rate, keithley.BAUD_RATES)


class Keithley2000Section(OneChannelForm):
    """A Keithley 2000, by GPIB or RS-232."""

    facts: ClassVar = keithley

    driver: Literal["keithley-2000"]
    interface: Literal["gpib", "rs232"] = "gpib"
    serial: Keithley2000Port = Keithley2000Port()

    @model_validator(mode="after")
    def _set_to_its_port(self) -> Keithley2000Section:
        if is_serial(self.resource) and self.interface != "rs232":
            raise ValueError("a serial port is an RS-232: say 'interface: rs232', and set the meter to it")
        return self

    @property
    def line_end(self) -> str:
        """What its lines end with."""
        serial = self.interface == "rs232"
        return keithley.TERMINATORS[self.serial.terminator] if serial else keithley.READ_TERMINATION

    def port(self) -> Port:
        """Return how its wire is set up; on RS-232 lines end as the section says."""
        return Port(self.line_end, self.line_end, super().port().serial)

    def simulation_options(self, truth: VoltmeterTruth) -> dict[str, Any]:
        """Return what every simulated voltmeter is given, and how its lines end."""
        return {**super().simulation_options(truth), "line_end": self.line_end}


DEVICE = Device(
    "keithley-2000",
    Keithley2000Section,
    driver="drivers.instruments.keithley_2000:Keithley2000",
    simulation="sim.keithley_2000:Keithley2000",
    example={"channels": ["x"], "resource": "GPIB0::16::INSTR"},
    simulated=("noise", "accuracy"),
)
