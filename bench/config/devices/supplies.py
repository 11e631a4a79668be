"""Power supplies: Aim-TTi, Keysight E36300 and E3631A."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import field_validator

from bench.config.devices.device import Device, PortSection, usual_baud_rate
from bench.config.devices.sections import OF_THE_UNIT, SerialSection, SupplyTruth, WiredSupplyForm
from drivers.facts import aim_tti as aim
from drivers.facts import keysight_e3631a
from drivers.facts import keysight_e36300 as keysight


class AimTtiPort(PortSection):
    """The supply's RS-232 port, or the serial port as which its USB appears on the computer."""

    known: ClassVar = aim.BAUD_RATES


class AimTtiSection(WiredSupplyForm):
    """A PL303QMD-P, CPX200DP or CPX400DP with isolated outputs 1 and 2; a CPX has over-voltage protection."""

    facts: ClassVar = aim

    driver: Literal["aim-tti"]
    model: Literal["PL303QMD-P", "CPX200DP", "CPX400DP"]
    serial: AimTtiPort = AimTtiPort.of(aim)

    def driver_options(self) -> dict[str, Any]:
        """Return the driver's options: the settings that the outputs support, and the model that must respond."""
        return super().driver_options() | {"model": self.model}


_AIM_TTI = Device(
    "aim-tti",
    AimTtiSection,
    driver="drivers.instruments.aim_tti:AimTti",
    simulation="sim.aim_tti:AimTti",
    example={"model": "CPX400DP", "resource": "TCPIP0::192.0.2.71::9221::SOCKET"},
    simulated=OF_THE_UNIT,
    place=3,
)


class KeysightE36300Section(WiredSupplyForm):
    """A Keysight E36311A to E36313A: outputs 1, 2, 3, each with a switch and over-voltage protection."""

    facts: ClassVar = keysight

    driver: Literal["keysight-e36300"]
    model: Literal["E36311A", "E36312A", "E36313A"]

    def driver_options(self) -> dict[str, Any]:
        """Return the driver's options: the settings that the outputs support, and the model that must respond."""
        return super().driver_options() | {"model": self.model}


_KEYSIGHT_E36300 = Device(
    "keysight-e36300",
    KeysightE36300Section,
    driver="drivers.instruments.keysight_e36300:KeysightE36300",
    simulation="sim.keysight_e36300:KeysightE36300",
    example={"model": "E36312A", "resource": "TCPIP0::192.0.2.70::5025::SOCKET"},
    simulated=OF_THE_UNIT,
    place=2,
)


class KeysightE3631ASection(WiredSupplyForm):
    """A Keysight E3631A with the outputs P6V, P25V and N25V (negative), which switch together.

    It has no over-voltage protection. `interface` is the one selected at its front panel; over "rs232" the driver
    first puts the supply into remote mode.
    """

    facts: ClassVar = keysight_e3631a

    driver: Literal["keysight-e3631a"]
    interface: Literal["gpib", "rs232"] = "gpib"
    serial: SerialSection = SerialSection()

    @field_validator("serial")
    @classmethod
    def _speed_of_the_supply(cls, serial: SerialSection) -> SerialSection:
        usual_baud_rate(serial.baud_rate, keysight_e3631a.BAUD_RATES)
        return serial

    def driver_options(self) -> dict[str, Any]:
        """Return the driver's options: the settings that the outputs support, and the selected interface."""
        return super().driver_options() | {"interface": self.interface}

    def simulation_options(self, truth: SupplyTruth) -> dict[str, Any]:
        """Return the simulation's option: the selected interface."""
        return {"interface": self.interface}


_KEYSIGHT_E3631A = Device(
    "keysight-e3631a",
    KeysightE3631ASection,
    driver="drivers.instruments.keysight_e3631a:KeysightE3631A",
    simulation="sim.keysight_e3631a:KeysightE3631A",
    example={"resource": "GPIB0::5::INSTR", "interface": "gpib"},
    simulated=OF_THE_UNIT,
    place=1,
)

DEVICE = (_AIM_TTI, _KEYSIGHT_E36300, _KEYSIGHT_E3631A)
