"""The form of the dividing heads of a bench file: one that a person turns, or one with a motor."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Final

from pydantic import field_validator, model_validator

from bench.base.forms import FileModel
from bench.base.units import AngleRad, QuantityKind, SizeRad, SpanS, not_negative
from bench.devices.certificates import HeadCertificate
from bench.devices.device import DeviceSection, Role
from bench.devices.wires import WiredForm

SPEED: Final = QuantityKind("a speed of turning", "10 deg/s", "rad/s")

SpeedRadS = Annotated[float, not_negative(SPEED)]


class HeadTruth(FileModel):
    """A simulated motorised head: homed when it is switched on or not, with an encoder to notice being stuck."""

    homed: bool = True
    encoder: bool = True


class HeadForm(DeviceSection):
    """What every head is told: how far the angle at a reading may be from its target."""

    role: ClassVar[Role] = "head"
    scale_on_axis: ClassVar[bool] = False
    """Whether what it reads sits on the axis that turns the block, with no gear or coupling between them."""

    name: str = "head"
    tolerance: SizeRad
    certificate: HeadCertificate | None = None


class MotorisedHeadForm(HeadForm, WiredForm):
    """A head with a motor. It stays within `minimum` and `maximum` on its scale, also on the way.

    It comes to an angle from at least `backoff` away, on the side that the procedure demands, and has arrived
    when for the time `settle` every sample of its scale lies within `tolerance`. `speed` decides how long a
    turn may take.
    """

    minimum: AngleRad
    maximum: AngleRad
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

    def travel(self) -> dict[str, float]:
        """Return how the head may move and when it has arrived, as its driver has it (`drivers.motion.Travel`)."""
        return {
            "minimum_rad": self.minimum,
            "maximum_rad": self.maximum,
            "tolerance_rad": self.tolerance,
            "speed_rad_s": self.speed,
            "backoff_rad": self.backoff,
            "settle_s": self.settle,
        }

    def simulation_options(self, truth: HeadTruth) -> dict[str, Any]:
        """Return what every simulated head is given."""
        return {"speed_deg_s": math.degrees(self.speed)}
