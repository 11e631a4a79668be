"""HP / Agilent / Keysight E3631A."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import field_validator

from bench.config.devices.device import Device, usual_baud_rate
from bench.config.devices.sections import OF_THE_UNIT, SerialSection, SupplyTruth, WiredSupplyForm
from drivers.facts import keysight_e3631a as keysight


class KeysightE3631ASection(WiredSupplyForm):
    """An E3631A: outputs P6V, P25V, N25V (negative voltages), switched together, without over-voltage protection.

    `interface` is how it is set at its front panel; over "rs232" it is told to be remote first.
    """

    facts: ClassVar = keysight

    driver: Literal["keysight-e3631a"]
    interface: Literal["gpib", "rs232"] = "gpib"
    serial: SerialSection = SerialSection()

    @field_validator("serial")
    @classmethod
    def _speed_of_the_supply(cls, serial: SerialSection) -> SerialSection:
        usual_baud_rate(serial.baud_rate, keysight.BAUD_RATES)
        return serial

    def driver_options(self) -> dict[str, Any]:
        """Return what it can do, and how it is set."""
        return super().driver_options() | {"interface": self.interface}

    def simulation_options(self, truth: SupplyTruth) -> dict[str, Any]:
        """Return how it is set."""
        return {"interface": self.interface}


DEVICE = Device(
    "keysight-e3631a",
    KeysightE3631ASection,
    driver="drivers.instruments.keysight_e3631a:KeysightE3631A",
    simulation="sim.keysight_e3631a:KeysightE3631A",
    example={"resource": "GPIB0::5::INSTR", "interface": "gpib"},
    simulated=OF_THE_UNIT,
    place=1,
)
