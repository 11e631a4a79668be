"""A chamber with an Espec P300 or SCP-220."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from bench.config.devices.device import Device, IdentityPattern, PortSection, as_stated, resource_on
from bench.config.devices.sections import OF_THE_AIR, ChamberTruth, ControlledChamberForm
from drivers.facts import espec


class EspecSection(ControlledChamberForm):
    """A chamber with an Espec P300 or SCP-220; `identity` is the pattern of the controller's name."""

    facts: ClassVar = espec

    driver: Literal["espec"]
    resource: Annotated[
        str,
        resource_on(
            "ASRL", "TCPIP", example="'ASRL/dev/ttyUSB1::INSTR' or 'TCPIP0::192.0.2.50::10001::SOCKET'"
        ),
    ]
    identity: IdentityPattern = espec.IDENTITY
    serial: PortSection = PortSection.of(espec)

    def driver_options(self) -> dict[str, Any]:
        """Return the pattern of its identity."""
        return {"identity": self.identity}

    def simulation_options(self, truth: ChamberTruth) -> dict[str, Any]:
        """Return its limits, its name where the pattern is one, and the noise of its sensor."""
        named = {"name": self.identity} if as_stated(self.identity) else {}
        return super().simulation_options(truth) | named | {"noise_c": truth.sensor_noise}


DEVICE = Device(
    "espec",
    EspecSection,
    driver="drivers.instruments.espec:EspecChamber",
    simulation="sim.chambers:EspecP300",
    example={"resource": "TCPIP0::192.0.2.50::10001::SOCKET", "minimum": "-40 degC", "maximum": "85 degC"},
    simulated=(*OF_THE_AIR, "sensor_noise"),
    place=1,
)
