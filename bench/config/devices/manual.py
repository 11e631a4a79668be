"""Instruments that a person operates: head, chamber, level, thermometer, power supply."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from bench.base.units import Ratio, SizeA, SizeRad, TemperatureC, VoltageV, above_zero
from bench.base.yaml_files import FileModel
from bench.config.devices.device import Device
from bench.config.devices.sections import (
    OF_THE_UNIT,
    ChamberForm,
    HeadForm,
    LevelForm,
    SizeK,
    SupplyForm,
    TemperatureRange,
    ThermometerForm,
)
from drivers.interfaces import OutputLimits, SupplyLimits


class ManualHeadSection(HeadForm):
    """A head that a person turns; `scale_division` is the value of one division of its scale.

    With `enter_accepts_target`, an empty answer (Enter) reports the target angle; otherwise the angle must be
    typed.
    """

    by_hand: ClassVar = True
    for_driver: ClassVar = (("tolerance_rad", "tolerance"), "enter_accepts_target")

    driver: Literal["manual-head"]
    scale_division: SizeRad
    enter_accepts_target: bool = True

    @model_validator(mode="after")
    def _readable(self) -> ManualHeadSection:
        if self.tolerance < self.scale_division / 2:
            raise ValueError("the tolerance is below half a division of the scale; widen it")
        return self


class ManualChamberSection(ChamberForm):
    """A chamber that a person sets and reads; after a run it is set to `safe` or, without `safe`, switched off."""

    by_hand: ClassVar = True
    for_driver: ClassVar = (("minimum_c", "minimum"), ("maximum_c", "maximum"), ("safe_c", "safe"))

    driver: Literal["manual-chamber"]
    safe: TemperatureC | None = None

    @model_validator(mode="after")
    def _can_be_safe(self) -> ManualChamberSection:
        if self.safe is not None:
            self.refuse_outside(self.safe, "the safe setting")
        return self


class ManualLevelSection(LevelForm):
    """A bubble level that a person lays along and across the shaft, and reads.

    `division` is the angle of one graduation of the vial, which has `divisions` graduations on either side.
    `reading` is the standard uncertainty of a reading, in graduations. `scale` is the relative standard uncertainty
    of `division`. `turn` is the standard uncertainty of aligning the level with an axis, and of turning it by half
    a turn.
    """

    by_hand: ClassVar = True
    for_driver: ClassVar = (
        ("division_rad", "division"), ("reading_divisions", "reading"), ("most_divisions", "divisions"), "scale",
        ("turn_rad", "turn"),
    )  # fmt: skip

    driver: Literal["manual-level"]
    division: Annotated[SizeRad, above_zero("state the value of one division, such as '5 arcsec'")]
    reading: Annotated[float, Field(gt=0.0, le=1.0)] = 0.2
    divisions: Annotated[float, Field(gt=0.0, le=100.0)] = 10.0
    scale: Annotated[Ratio, Field(ge=0.0, lt=1.0)] = 0.05
    turn: SizeRad = math.radians(1.0)


class ManualThermometerSection(TemperatureRange, ThermometerForm):
    """A thermometer that a person reads at each mounting; `tolerance` is its error limit."""

    by_hand: ClassVar = True
    for_driver: ClassVar = (("minimum_c", "minimum"), ("maximum_c", "maximum"), "sensor")

    driver: Literal["manual-thermometer"]
    tolerance: SizeK = 0.5
    sensor: str = "read by a person"

    @property
    def tolerance_k(self) -> float:
        """The stated tolerance, K."""
        return self.tolerance


class ManualOutput(FileModel):
    """An output of a supply: its voltage range, highest current and display resolution.

    `over_voltage` is the highest setting of the over-voltage protection; omitted if the output has no protection.
    """

    minimum: VoltageV = 0.0
    maximum: VoltageV
    current: SizeA
    over_voltage: VoltageV | None = None
    voltage_digit: VoltageV = 0.01
    current_digit: SizeA = 0.001

    @model_validator(mode="after")
    def _can_be_set(self) -> ManualOutput:
        if self.minimum >= self.maximum:
            raise ValueError(f"the minimum {self.minimum:g} V must be below the maximum {self.maximum:g} V")
        for name in ("current", "voltage_digit", "current_digit"):
            if getattr(self, name) <= 0.0:
                raise ValueError(f"'{name}' is not above 0; state a value above 0")
        return self

    def limits(self) -> OutputLimits:
        """Return the settings that the output supports."""
        highest_v = self.over_voltage
        protection_v = None if highest_v is None else (min(0.0, highest_v), max(0.0, highest_v))
        return OutputLimits(
            (self.minimum, self.maximum),
            (0.0, self.current),
            self.voltage_digit,
            self.current_digit,
            protection_v,
            self.voltage_digit,
        )


class ManualSupplySection(SupplyForm):
    """A power supply that a person sets, reads and switches; the keys of `outputs` are front-panel names.

    `tolerance` is the largest deviation of an output voltage from its setting.
    """

    by_hand: ClassVar = True
    for_driver: ClassVar = ("limits", ("tolerance_v", "tolerance"))

    driver: Literal["manual-supply"]
    outputs: Annotated[dict[str, ManualOutput], Field(min_length=1)]
    tolerance: Annotated[VoltageV, above_zero("state a value above 0: no output is exact")] = 0.1

    @property
    def limits(self) -> SupplyLimits:
        """The settings that the outputs support."""
        return SupplyLimits({name: output.limits() for name, output in self.outputs.items()})


DEVICE = (
    Device(
        "manual-head",
        ManualHeadSection,
        driver="drivers.instruments.manual:ManualHead",
        simulation=None,
        example={"scale_division": "1 arcsec", "tolerance": "30 arcsec", "enter_accepts_target": False},
        place=0,
    ),
    Device(
        "manual-chamber",
        ManualChamberSection,
        driver="drivers.instruments.manual:ManualChamber",
        simulation=None,
        example={"minimum": "-60 degC", "maximum": "100 degC"},
        place=0,
    ),
    Device(
        "manual-level",
        ManualLevelSection,
        driver="drivers.instruments.manual:ManualLevel",
        simulation=None,
        example={"division": "5 arcsec"},
        simulated=("zero_along", "zero_across", "noise", "scale"),
        place=0,
    ),
    Device(
        "manual-thermometer",
        ManualThermometerSection,
        driver="drivers.instruments.manual:ManualThermometer",
        simulation=None,
        example={"minimum": "-60 degC", "maximum": "150 degC"},
        place=0,
    ),
    Device(
        "manual-supply",
        ManualSupplySection,
        driver="drivers.instruments.manual_supply:ManualSupply",
        simulation=None,
        example={
            "outputs": {
                "+": {"maximum": "30 V", "current": "3 A", "over_voltage": "33 V"},
                "-": {"minimum": "-30 V", "maximum": "0 V", "current": "3 A", "over_voltage": "-33 V"},
            }
        },
        simulated=OF_THE_UNIT,
        place=0,
    ),
)
