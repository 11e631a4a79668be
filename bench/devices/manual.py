"""A head and a chamber that a person works."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import model_validator

from bench.base.units import SizeRad, TemperatureC
from bench.devices.chambers import ChamberForm
from bench.devices.device import Device
from bench.devices.heads import HeadForm


class ManualHeadSection(HeadForm):
    """A head that a person turns: value of a division of its scale, how far a reading may be from its target.

    Where `enter_accepts_target`, Enter alone says that the head stands at the target; else the angle is typed.
    """

    by_hand: ClassVar = True

    driver: Literal["manual-head"]
    scale_division: SizeRad
    enter_accepts_target: bool = True

    @model_validator(mode="after")
    def _readable(self) -> ManualHeadSection:
        if self.tolerance < self.scale_division / 2:
            raise ValueError("the tolerance is less than half a division of the scale: no reading would pass")
        return self

    def driver_options(self) -> dict[str, Any]:
        """Return how far a reading may be from its target, and what Enter says."""
        return {"tolerance_rad": self.tolerance, "enter_accepts_target": self.enter_accepts_target}


class ManualChamberSection(ChamberForm):
    """A chamber that a person sets and reads. `safe` is what it is set to after a run, off where left out."""

    by_hand: ClassVar = True

    driver: Literal["manual-chamber"]
    safe: TemperatureC | None = None

    @model_validator(mode="after")
    def _can_be_safe(self) -> ManualChamberSection:
        if self.safe is not None:
            self.refuse_outside(self.safe, "the safe setting")
        return self

    def driver_options(self) -> dict[str, Any]:
        """Return its limits and the safe setting."""
        return {"minimum_c": self.minimum, "maximum_c": self.maximum, "safe_c": self.safe}


DEVICE = (
    Device(
        "manual-head",
        ManualHeadSection,
        driver="drivers.manual.head:ManualHead",
        simulation=None,
        example={"scale_division": "1 arcsec", "tolerance": "30 arcsec", "enter_accepts_target": False},
        place=0,
    ),
    Device(
        "manual-chamber",
        ManualChamberSection,
        driver="drivers.manual.chamber:ManualChamber",
        simulation=None,
        example={"minimum": "-60 degC", "maximum": "100 degC"},
        place=0,
    ),
)
