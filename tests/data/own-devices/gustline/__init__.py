"""A Gustline 2 thermometer."""

from typing import Annotated, ClassVar, Literal

from bench.config.devices.device import Device, PortSection, WiredForm, serial_or_socket
from bench.config.devices.sections import ThermometerForm

from . import facts as gustline


class GustlineSection(ThermometerForm, WiredForm):
    facts: ClassVar = gustline
    driver: Literal["gustline"]
    resource: Annotated[str, serial_or_socket("ttyUSB1", "192.0.2.62::4001")]
    serial: PortSection = PortSection.of(gustline)

    @property
    def tolerance_k(self):
        return gustline.LIMIT_K


DEVICE = Device(
    "gustline",
    GustlineSection,
    driver=".driver:GustlineThermometer",
    simulation=".simulation:Gustline2",
    example={"resource": "ASRL/dev/ttyUSB1::INSTR"},
)
