"""A Voltwerk 9 voltmeter."""

from typing import ClassVar, Literal

from bench.config.devices.device import Device, PortSection
from bench.config.devices.sections import OneChannelForm

from . import facts as voltwerk


class VoltwerkSection(OneChannelForm):
    facts: ClassVar = voltwerk
    driver: Literal["voltwerk-9"]
    interface: Literal["gpib", "rs232"] = "gpib"
    serial: PortSection = PortSection.of(voltwerk)


DEVICE = Device(
    "voltwerk-9",
    VoltwerkSection,
    driver=".driver:Voltwerk9",
    simulation=".simulation:SimulatedVoltwerk9",
    example={"channels": ["x"], "resource": "GPIB0::5::INSTR", "range": "3 V"},
)
