"""A rotary stage with a Zaber controller."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import Field, model_validator

from bench.config.devices.device import Device, IdentityPattern, PortSection, resource_on
from bench.config.devices.sections import HeadTruth, MotorisedHeadForm
from drivers.facts import zaber

_BEYOND_DEG: Final = 5.0
"""How far a simulated stage can turn beyond the limits in the bench file, degrees."""


class ZaberSection(MotorisedHeadForm):
    """A rotary stage with a Zaber controller.

    `steps_per_degree` are microsteps at the setting `resolution`, negative where the scale falls with rising
    steps. Homing turns the stage to its sensor, beyond any limit: it is done only with `allow_homing`.
    """

    facts: ClassVar = zaber

    driver: Literal["zaber"]
    resource: Annotated[
        str,
        resource_on(
            "ASRL", "TCPIP", example="'ASRL/dev/ttyUSB0::INSTR' or 'TCPIP0::192.0.2.30::55550::SOCKET'"
        ),
    ]
    steps_per_degree: float
    resolution: Annotated[int, Field(ge=1, le=256)] = zaber.RESOLUTION
    device: Annotated[int, Field(ge=1, le=zaber.MOST_DEVICES)] = 1
    axis: Annotated[int, Field(ge=1, le=zaber.MOST_AXES)] = 1
    identity: IdentityPattern = zaber.IDENTITY
    allow_homing: bool = False
    checksums: bool = False
    serial: PortSection = PortSection.of(zaber)

    @model_validator(mode="after")
    def _steps_fit(self) -> ZaberSection:
        steps_per_degree = abs(self.steps_per_degree)
        if steps_per_degree == 0.0:
            raise ValueError("steps_per_degree is not zero: see the stage's data sheet")
        farthest_rad = max(abs(self.minimum), abs(self.maximum))
        if math.degrees(farthest_rad) * steps_per_degree > zaber.MOST_STEPS:
            raise ValueError("the limits of the head are more steps than its controller counts")
        if 0.5 / steps_per_degree > math.degrees(self.tolerance):
            raise ValueError("a step of the head is coarser than its tolerance: no angle would pass")
        return self

    def driver_options(self) -> dict[str, Any]:
        """Return which device it is, and how its steps are counted."""
        own = {"steps_per_degree", "resolution", "device", "axis", "identity", "allow_homing", "checksums"}
        return self.model_dump(include=own)

    def simulation_options(self, truth: HeadTruth) -> dict[str, Any]:
        """Return which device it is, how far it can turn, and what is true of it."""
        named = {"device_id": int(self.identity)} if self.identity.isdecimal() else {}
        return {
            **super().simulation_options(truth),
            **self.model_dump(include={"steps_per_degree", "resolution", "device", "axis"}),
            "lowest_deg": math.degrees(self.minimum) - _BEYOND_DEG,
            "highest_deg": math.degrees(self.maximum) + _BEYOND_DEG,
            "homed": truth.homed,
            "encoder": truth.encoder,
            **named,
        }


DEVICE = Device(
    "zaber",
    ZaberSection,
    driver="drivers.instruments.zaber:ZaberHead",
    simulation="sim.zaber:ZaberStage",
    example={
        "resource": "TCPIP0::192.0.2.30::55550::SOCKET",
        "steps_per_degree": "4266.6667",
        "minimum": "-5 deg",
        "maximum": "365 deg",
        "tolerance": "5 arcsec",
        "speed": "10 deg/s",
    },
    simulated=("homed", "encoder"),
    place=1,
)
