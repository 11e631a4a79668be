"""A Leica Nivel210 or Nivel220 inclination sensor."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from bench.base.units import DurationS
from bench.config.devices.device import Device, PortSection, WiredForm, resource_on
from bench.config.devices.sections import LevelForm, LevelTruth
from drivers.facts import leica_nivel as nivel

Axis = Literal["+X", "-X", "+Y", "-Y"]


class LeicaNivelSection(LevelForm, WiredForm):
    """A Leica Nivel210 (RS-232) or Nivel220 (RS-485), at a serial port or behind a terminal server.

    `sensor` is its address without the N. `along` and `across` say which of its axes points along the shaft, away
    from whoever looks at the end of the shaft, and which to the right, in the first of its two positions.
    """

    facts: ClassVar = nivel

    driver: Literal["leica-nivel"]
    resource: Annotated[
        str,
        resource_on(
            "ASRL", "TCPIP", example="'ASRL/dev/ttyUSB0::INSTR' or 'TCPIP0::192.0.2.50::4001::SOCKET'"
        ),
    ]
    timeout: DurationS = 5.0
    sensor: Annotated[str, Field(pattern=r"^[1-9A-Z]$")] = "1"
    along: Axis = "+Y"
    across: Axis = "+X"
    averages: Annotated[int, Field(ge=1, le=nivel.MOST_AVERAGES)] = nivel.AVERAGES
    serial: PortSection = PortSection.of(nivel)

    @model_validator(mode="after")
    def _two_axes(self) -> LeicaNivelSection:
        if self.along[1] == self.across[1]:
            raise ValueError(f"along and across are both axis {self.along[1]}; one of them is the other axis")
        return self

    def driver_options(self) -> dict[str, Any]:
        """Return its address, how its axes lie, and its averages."""
        return self.model_dump(include={"sensor", "along", "across", "averages"})

    def simulation_options(self, truth: LevelTruth) -> dict[str, Any]:
        """Return its address, and how its axes lie."""
        return self.model_dump(include={"sensor", "along", "across"})


DEVICE = Device(
    "leica-nivel",
    LeicaNivelSection,
    driver="drivers.instruments.leica_nivel:LeicaNivel",
    simulation="sim.leica_nivel:LeicaNivel",
    example={"resource": "ASRL/dev/ttyUSB1::INSTR"},
    simulated=("zero_along", "zero_across", "noise", "scale"),
    place=1,
)
