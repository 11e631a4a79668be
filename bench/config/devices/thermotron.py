"""A chamber with a Thermotron controller."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from bench.config.devices.device import Device, IdentityPattern, PortSection, as_stated, resource_on
from bench.config.devices.sections import OF_THE_AIR, ChamberTruth, ControlledChamberForm
from drivers.facts import thermotron


class ThermotronSection(ControlledChamberForm):
    """A chamber with a Thermotron controller, set to °C; `identity` is the pattern of its name."""

    facts: ClassVar = thermotron

    driver: Literal["thermotron"]
    resource: Annotated[
        str,
        resource_on(
            "ASRL", "TCPIP", example="'ASRL/dev/ttyUSB1::INSTR' or 'TCPIP0::192.0.2.52::8888::SOCKET'"
        ),
    ]
    identity: IdentityPattern = thermotron.IDENTITY
    serial: PortSection = PortSection.of(thermotron)

    def driver_options(self) -> dict[str, Any]:
        """Return the pattern of its identity."""
        return {"identity": self.identity}

    def simulation_options(self, truth: ChamberTruth) -> dict[str, Any]:
        """Return its limits, and its name where the pattern is one."""
        named = {"identity": self.identity} if as_stated(self.identity) else {}
        return super().simulation_options(truth) | named


DEVICE = Device(
    "thermotron",
    ThermotronSection,
    driver="drivers.instruments.thermotron:ThermotronChamber",
    simulation="sim.chambers:Thermotron8800",
    example={"resource": "TCPIP0::192.0.2.52::8888::SOCKET", "minimum": "-40 degC", "maximum": "85 degC"},
    simulated=OF_THE_AIR,
    place=3,
)
