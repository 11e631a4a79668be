"""Aim-TTi PL-P and CPX."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import field_validator

from bench.config.devices.device import Device, PortSection, usual_baud_rate
from bench.config.devices.sections import OF_THE_UNIT, WiredSupplyForm
from drivers.facts import aim_tti as aim


class AimTtiPort(PortSection):
    """The serial port: its RS-232, or the one that its USB is to the computer."""

    @field_validator("baud_rate")
    @classmethod
    def _usual(cls, baud_rate: int) -> int:
        return usual_baud_rate(baud_rate, aim.BAUD_RATES)


class AimTtiSection(WiredSupplyForm):
    """A PL303QMD-P, CPX200DP or CPX400DP: outputs 1, 2, isolated; a CPX has an over-voltage protection."""

    facts: ClassVar = aim

    driver: Literal["aim-tti"]
    model: Literal["PL303QMD-P", "CPX200DP", "CPX400DP"]
    serial: AimTtiPort = AimTtiPort.model_validate({"baud_rate": aim.SERIAL["baud_rate"]})

    def driver_options(self) -> dict[str, Any]:
        """Return what it can do, and which one it must be."""
        return super().driver_options() | {"model": self.model}


DEVICE = Device(
    "aim-tti",
    AimTtiSection,
    driver="drivers.instruments.aim_tti:AimTti",
    simulation="sim.aim_tti:AimTti",
    example={"model": "CPX400DP", "resource": "TCPIP0::192.0.2.71::9221::SOCKET"},
    simulated=OF_THE_UNIT,
    place=3,
)
