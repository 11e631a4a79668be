"""The section of a bench file on its simulation: what is true on the simulated bench, and what goes wrong there."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import Field, field_validator, model_validator

from bench.base.arrays import ARCSEC
from bench.base.forms import FileModel
from bench.base.units import Ratio, ScaleFactor, SizeRad, SpanS, TemperatureC, VoltageV
from bench.devices.chambers import ChamberTruth
from bench.devices.heads import HeadTruth
from bench.devices.levels import LevelTruth
from bench.devices.supplies import SupplyTruth
from bench.devices.thermometers import ThermometerTruth
from bench.devices.voltmeters import VoltmeterTruth

Row = Annotated[tuple[ScaleFactor, ...], Field(min_length=3, max_length=3)]


FaultWord = Literal[
    "drop", "refuse", "late", "twice", "cut", "garble", "silence", "hang", "power-cycle", "overload", "local",
    "error",
]  # fmt: skip
"""What can go wrong with a simulated instrument and its wire (`sim.wires.faults.FaultKind`)."""

_TAKE_SECONDS: Final = ("late", "refuse", "hang")


class BlockTruth(FileModel):
    """The simulated block as it is: K row by row (V/g) and U0 (V)."""

    K: Annotated[tuple[Row, ...], Field(min_length=3, max_length=3)]
    U0: Annotated[tuple[VoltageV, ...], Field(min_length=3, max_length=3)]


class OperatorTruth(FileModel):
    """The simulated operator.

    `setting_deviation` is the standard deviation of the angle left on the scale from its target, read to
    `resolution`; a turn takes between the two times of `turn_time`; `slip_probability` is how often the
    angle that is typed has a classic slip.
    """

    setting_deviation: SizeRad = 2 * ARCSEC
    resolution: SizeRad = ARCSEC
    slip_probability: Annotated[Ratio, Field(ge=0.0, lt=1.0)] = 0.01
    turn_time: Annotated[tuple[SpanS, ...], Field(min_length=2, max_length=2)] = (60.0, 180.0)
    mount_time: SpanS = 1200.0

    @field_validator("resolution")
    @classmethod
    def _has_steps(cls, resolution_rad: float) -> float:
        if resolution_rad == 0.0:
            raise ValueError("a scale has steps: expected a resolution such as '1 arcsec'")
        return resolution_rad

    @field_validator("turn_time")
    @classmethod
    def _in_order(cls, turn_time_s: tuple[float, ...]) -> tuple[float, ...]:
        if turn_time_s[0] > turn_time_s[1]:
            raise ValueError("the first is the shortest time, the second the longest")
        return turn_time_s


class FaultSection(FileModel):
    """What goes wrong, when, with which instrument (all that can have it, where it is left out).

    Of the commands that contain `matching`, each is struck with `probability`, or the `at`-th alone, or every
    one. `seconds` is how late a reply comes, how long connections are refused or the instrument hangs.
    """

    fault: FaultWord
    instrument: str | None = None
    probability: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    at: Annotated[int, Field(ge=1)] | None = None
    matching: str | None = None
    seconds: Annotated[float, Field(ge=0.0)] | None = None
    error: int | None = None

    @model_validator(mode="after")
    def _makes_sense(self) -> FaultSection:
        if self.probability is not None and self.at is not None:
            raise ValueError("a fault strikes with a probability or at an exchange, not both")
        if self.probability is None and self.at is None and self.matching is None:
            raise ValueError(f"say when '{self.fault}' strikes: give probability, at or matching")
        if self.seconds and self.fault not in _TAKE_SECONDS:
            raise ValueError(f"'{self.fault}' has no duration; leave out seconds")
        if self.fault == "late" and not self.seconds:
            raise ValueError("'late' needs seconds: by how much")
        if self.error is not None and self.fault != "error":
            raise ValueError(f"'{self.fault}' puts no error into the queue; leave out error")
        return self

    def to_plain(self) -> dict[str, Any]:
        """Return it as written, without what was left out."""
        return self.model_dump(exclude_none=True)


class SimulationSection(FileModel):
    """What the simulated bench is like; without a block it has the nominal scale factors alone."""

    block: BlockTruth | None = None
    operator: OperatorTruth = OperatorTruth()
    voltmeter: VoltmeterTruth = VoltmeterTruth()
    head: HeadTruth = HeadTruth()
    chamber: ChamberTruth = ChamberTruth()
    level: LevelTruth = LevelTruth()
    thermometer: ThermometerTruth = ThermometerTruth()
    power_supply: SupplyTruth = SupplyTruth()
    ambient_temperature: TemperatureC = 23.0
    faults: tuple[FaultSection, ...] = ()
