"""A Frostline 7 chamber."""

from typing import Annotated, ClassVar, Literal

from bench.config.devices.device import Device, resource_on
from bench.config.devices.sections import OF_THE_AIR, ControlledChamberForm

from . import facts as frostline


class FrostlineSection(ControlledChamberForm):
    facts: ClassVar = frostline
    driver: Literal["frostline"]
    resource: Annotated[str, resource_on("TCPIP", example="'TCPIP0::192.0.2.60::4001::SOCKET'")]


DEVICE = Device(
    "frostline",
    FrostlineSection,
    driver=".driver:FrostlineChamber",
    simulation=".simulation:Frostline7",
    example={"resource": "TCPIP0::192.0.2.60::4001::SOCKET", "minimum": "-40 degC", "maximum": "85 degC"},
    simulated=OF_THE_AIR,
)
