"""A rotary stage with a Newport ESP301 motion controller."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import AfterValidator, Field, field_validator

from bench.config.devices.device import (
    Device,
    IdentityPattern,
    PortSection,
    any_resource,
    as_stated,
    usual_baud_rate,
)
from bench.config.devices.sections import HeadTruth, MotorisedHeadForm
from drivers.facts import newport_esp301 as newport

_BEYOND_DEG: Final = 5.0
"""How far a simulated stage can turn beyond the limits in the bench file, degrees."""


def _on_a_wire_it_has(resource: str) -> str:
    if not resource.startswith(("ASRL", "GPIB", "TCPIP")):
        raise ValueError(
            "expected a VISA resource such as 'ASRL/dev/ttyUSB0::INSTR', 'GPIB0::1::INSTR' or, behind a serial "
            f"gateway, 'TCPIP0::192.0.2.41::4001::SOCKET', got '{resource}'"
        )
    return any_resource(resource)


class NewportPort(PortSection):
    """The serial port: its RS-232, or the one that its USB is to the computer."""

    @field_validator("baud_rate")
    @classmethod
    def _usual(cls, baud_rate: int) -> int:
        return usual_baud_rate(baud_rate, newport.BAUD_RATES)


class NewportSection(MotorisedHeadForm):
    """A rotary stage on one axis of a Newport ESP301 that is set up in degrees, at 0° where it was homed.

    Homing turns the stage to its sensor, beyond any limit: it is done only with `allow_homing`.
    """

    facts: ClassVar = newport

    driver: Literal["newport-esp301"]
    resource: Annotated[str, AfterValidator(_on_a_wire_it_has)]
    axis: Annotated[int, Field(ge=1, le=newport.MOST_AXES)] = 1
    identity: IdentityPattern = newport.IDENTITY
    allow_homing: bool = False
    serial: NewportPort = NewportPort.model_validate({"baud_rate": newport.SERIAL["baud_rate"]})

    def driver_options(self) -> dict[str, Any]:
        """Return which axis it is, who it must be, and whether it may home."""
        return self.model_dump(include={"axis", "identity", "allow_homing"})

    def simulation_options(self, truth: HeadTruth) -> dict[str, Any]:
        """Return which axis it is, how far it can turn, and whether it is homed."""
        named = {"model": self.identity} if as_stated(self.identity) else {}
        return {
            **super().simulation_options(truth),
            "axis": self.axis,
            "lowest_deg": math.degrees(self.minimum) - _BEYOND_DEG,
            "highest_deg": math.degrees(self.maximum) + _BEYOND_DEG,
            "homed": truth.homed,
            **named,
        }


DEVICE = Device(
    "newport-esp301",
    NewportSection,
    driver="drivers.instruments.newport_esp301:NewportHead",
    simulation="sim.newport_esp301:Esp301",
    example={
        "resource": "ASRL/dev/ttyUSB0::INSTR",
        "minimum": "-5 deg",
        "maximum": "365 deg",
        "tolerance": "5 arcsec",
        "speed": "10 deg/s",
    },
    simulated=("homed",),
)
