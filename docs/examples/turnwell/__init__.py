"""A Turnwell 3 dividing head."""

from typing import Annotated, ClassVar, Literal

from bench.config.devices.device import Device, resource_on
from bench.config.devices.sections import MotorisedHeadForm

from . import facts as turnwell


class TurnwellSection(MotorisedHeadForm):
    facts: ClassVar = turnwell
    driver: Literal["turnwell"]
    resource: Annotated[str, resource_on("TCPIP", example="'TCPIP0::192.0.2.61::4001::SOCKET'")]


DEVICE = Device(
    "turnwell",
    TurnwellSection,
    driver=".driver:TurnwellHead",
    simulation=".simulation:Turnwell3",
    example={
        "resource": "TCPIP0::192.0.2.61::4001::SOCKET",
        "minimum": "-5 deg",
        "maximum": "365 deg",
        "tolerance": "5 arcsec",
        "speed": "10 deg/s",
    },
)
