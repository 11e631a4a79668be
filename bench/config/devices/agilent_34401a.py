"""HP / Agilent / Keysight 34401A."""

from __future__ import annotations

from typing import ClassVar, Literal

from bench.config.devices.device import Device
from bench.config.devices.sections import OneChannelForm, SerialPortForm
from drivers.facts import agilent_34401a as agilent


class Agilent34401ASection(OneChannelForm, SerialPortForm):
    """A 34401A."""

    facts: ClassVar = agilent

    driver: Literal["agilent-34401a"]


DEVICE = Device(
    "agilent-34401a",
    Agilent34401ASection,
    driver="drivers.instruments.agilent_34401a:Agilent34401A",
    simulation="sim.agilent_34401a:Agilent34401A",
    example={"channels": ["x"], "resource": "GPIB0::22::INSTR", "interface": "gpib"},
    simulated=("noise", "accuracy"),
)
