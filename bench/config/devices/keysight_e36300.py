"""Keysight E36311A, E36312A, E36313A."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from bench.config.devices.device import Device
from bench.config.devices.sections import OF_THE_UNIT, WiredSupplyForm
from drivers.facts import keysight_e36300 as keysight


class KeysightE36300Section(WiredSupplyForm):
    """A supply of the series: outputs 1, 2, 3, each with its switch and its over-voltage protection."""

    facts: ClassVar = keysight

    driver: Literal["keysight-e36300"]
    model: Literal["E36311A", "E36312A", "E36313A"]

    def driver_options(self) -> dict[str, Any]:
        """Return what it can do, and which one it must be."""
        return super().driver_options() | {"model": self.model}


DEVICE = Device(
    "keysight-e36300",
    KeysightE36300Section,
    driver="drivers.instruments.keysight_e36300:KeysightE36300",
    simulation="sim.keysight_e36300:KeysightE36300",
    example={"model": "E36312A", "resource": "TCPIP0::192.0.2.70::5025::SOCKET"},
    simulated=OF_THE_UNIT,
    place=2,
)
