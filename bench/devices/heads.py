"""The dividing head of a bench file: one that a person turns, or one with a motor."""

from __future__ import annotations

import math
from typing import Annotated, Final, Literal

from pydantic import Field, field_validator, model_validator

from bench.base.forms import FileModel
from bench.base.units import AngleRad, QuantityKind, SizeRad, SpanS, not_negative
from bench.devices.wires import IdentityPattern, PortSection, WiredForm, driver_of, resource_on

SPEED: Final = QuantityKind("a speed of turning", "10 deg/s", "rad/s")

SpeedRadS = Annotated[float, not_negative(SPEED)]

_MOST_STEPS: Final = 2**31 - 1
_FINEST_DEMAND_RAD: Final = math.radians(0.0005)
"""An ACUTROL takes demands with three decimals of a degree."""


class ManualHeadSection(FileModel):
    """A head that a person turns: value of a division of its scale, how far a reading may be from its target."""

    driver: Literal["manual-head"]
    name: str = "head"
    scale_division: SizeRad
    tolerance: SizeRad

    @model_validator(mode="after")
    def _readable(self) -> ManualHeadSection:
        if self.tolerance < self.scale_division / 2:
            raise ValueError("the tolerance is less than half a division of the scale: no reading would pass")
        return self


class MotorisedHeadForm(WiredForm):
    """A head with a motor. It stays within `minimum` and `maximum` on its scale, also on the way.

    It comes to an angle from at least `backoff` away, on the side that the procedure demands, and has arrived
    when for the time `settle` every sample of its scale lies within `tolerance`. `speed` decides how long a
    turn may take.
    """

    name: str = "head"
    minimum: AngleRad
    maximum: AngleRad
    tolerance: SizeRad
    speed: SpeedRadS
    backoff: SizeRad = math.radians(1.0)
    settle: SpanS = 2.0

    @field_validator("tolerance", "speed")
    @classmethod
    def _more_than_nothing(cls, size: float) -> float:
        if size == 0.0:
            raise ValueError("expected more than nothing: no head is exact, and none turns without a speed")
        return size

    @model_validator(mode="after")
    def _can_turn(self) -> MotorisedHeadForm:
        low, high = (f"{math.degrees(angle_rad):g}°" for angle_rad in (self.minimum, self.maximum))
        if self.minimum + 2.0 * self.backoff >= self.maximum:
            raise ValueError(
                f"between the minimum {low} and the maximum {high} no angle can be come to from both sides, "
                f"backing off by {math.degrees(self.backoff):g}°"
            )
        if self.backoff <= self.tolerance:
            raise ValueError("the head must back off by more than its tolerance")
        return self


class ZaberSection(MotorisedHeadForm):
    """A rotary stage with a Zaber controller.

    `steps_per_degree` are microsteps at the setting `resolution`, negative where the scale falls with rising
    steps. Homing turns the stage to its sensor, beyond any limit: it is done only with `allow_homing`.
    """

    driver: Literal["zaber"]
    resource: Annotated[
        str,
        resource_on(
            "ASRL", "TCPIP", example="'ASRL/dev/ttyUSB0::INSTR' or 'TCPIP0::192.0.2.30::55550::SOCKET'"
        ),
    ]
    steps_per_degree: float
    resolution: Annotated[int, Field(ge=1, le=256)] = 64
    device: Annotated[int, Field(ge=1, le=99)] = 1
    axis: Annotated[int, Field(ge=1, le=9)] = 1
    identity: IdentityPattern = r"\d+"
    allow_homing: bool = False
    checksums: bool = False
    serial: PortSection = PortSection(baud_rate=115200)

    @model_validator(mode="after")
    def _steps_fit(self) -> ZaberSection:
        steps_per_degree = abs(self.steps_per_degree)
        if steps_per_degree == 0.0:
            raise ValueError("steps_per_degree is not zero: see the stage's data sheet")
        farthest_rad = max(abs(self.minimum), abs(self.maximum))
        if math.degrees(farthest_rad) * steps_per_degree > _MOST_STEPS:
            raise ValueError("the limits of the head are more steps than its controller counts")
        if 0.5 / steps_per_degree > math.degrees(self.tolerance):
            raise ValueError("a step of the head is coarser than its tolerance: no angle would pass")
        return self


class AcutrolSection(MotorisedHeadForm):
    """One axis of a rate table with an ACUTROL controller; below `still_rate` it stands."""

    driver: Literal["acutrol"]
    resource: Annotated[str, resource_on("TCPIP", example="'TCPIP0::192.0.2.40::9888::SOCKET'")]
    axis: Annotated[int, Field(ge=1, le=9)] = 1
    still_rate: SpeedRadS = math.radians(0.005)

    @field_validator("tolerance")
    @classmethod
    def _as_fine_as_a_demand(cls, tolerance_rad: float) -> float:
        if tolerance_rad < _FINEST_DEMAND_RAD:
            raise ValueError("the tolerance is finer than the 0.0005° (1.8 arcsec) to which it takes demands")
        return tolerance_rad


HeadSection = Annotated[
    Annotated[ManualHeadSection | ZaberSection | AcutrolSection, Field(discriminator="driver")],
    driver_of(ManualHeadSection, ZaberSection, AcutrolSection),
]
