"""The instruments of a bench file: what each may be told, and what its kind can do."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Final, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from bench.units import ANGLE, DurationS, TemperatureC, VoltageV, not_negative
from bench.yaml_file import FileModel
from drivers.interfaces import Channel

SizeRad = Annotated[float, not_negative(ANGLE)]


@dataclass(frozen=True)
class VoltmeterKind:
    """What voltmeters of a driver can do: their ranges, integration times, samples in one reading."""

    ranges_v: tuple[float, ...]
    nplc: tuple[float, ...]
    most_samples: int


VOLTMETERS: Final = {
    "agilent-34401a": VoltmeterKind((0.1, 1.0, 10.0, 100.0, 1000.0), (0.02, 0.2, 1.0, 10.0, 100.0), 512),
}
"""By the name of the driver. Source: 34401A User's Guide, chapters 8 (DC characteristics), 4 (INITiate)."""

_RESOURCE: Final = re.compile(r"(ASRL|GPIB|PRLGX|TCPIP|USB)[^\s]*::[^\s]+")


_BAUD_RATES: Final = (300, 600, 1200, 2400, 4800, 9600)


class SerialSection(FileModel):
    """How the meter's serial port is set on its front panel (I/O MENU); with a parity it has 7 data bits."""

    baud_rate: int = 9600
    parity: Literal["none", "even", "odd"] = "none"

    @field_validator("baud_rate")
    @classmethod
    def _of_the_meter(cls, baud_rate: int) -> int:
        if baud_rate not in _BAUD_RATES:
            raise ValueError(f"expected one of {', '.join(map(str, _BAUD_RATES))}, got '{baud_rate}'")
        return baud_rate


class VoltmeterSection(FileModel):
    """One voltmeter: the channels it carries, where it is, what it is like.

    `interface` says how the meter is set, apart from the wire that carries its messages.
    """

    driver: Literal["agilent-34401a"]
    channels: Annotated[tuple[Channel, ...], Field(min_length=1, max_length=1)]
    resource: str
    stated_name: str | None = Field(None, alias="name")
    interface: Literal["lan", "gpib", "rs232"] = "lan"
    serial: SerialSection = SerialSection()
    timeout: DurationS = 5.0
    range: VoltageV = 10.0

    @property
    def name(self) -> str:
        """Name of the instrument: as stated, else "voltmeter.x"."""
        return self.stated_name or f"voltmeter.{''.join(self.channels)}"

    @field_validator("resource")
    @classmethod
    def _visa(cls, resource: str) -> str:
        if _RESOURCE.fullmatch(resource) is None:
            raise ValueError(
                f"expected a VISA resource such as 'GPIB0::22::INSTR', 'ASRL/dev/ttyUSB0::INSTR' or "
                f"'TCPIP0::192.168.1.22::5025::SOCKET', got '{resource}'"
            )
        return resource

    @field_validator("timeout")
    @classmethod
    def _positive(cls, timeout_s: float) -> float:
        if timeout_s <= 0.0:
            raise ValueError(f"expected a duration longer than nothing such as '5 s', got {timeout_s:g} s")
        return timeout_s

    @field_validator("range")
    @classmethod
    def _of_the_meter(cls, range_v: float, info: ValidationInfo) -> float:
        driver = info.data.get("driver")
        if driver is not None and range_v not in VOLTMETERS[driver].ranges_v:
            listed = ", ".join(f"{r:g} V" for r in VOLTMETERS[driver].ranges_v)
            raise ValueError(f"the {driver} has the ranges {listed}, not {range_v:g} V")
        return range_v


class HeadSection(FileModel):
    """The dividing head: value of a division of its scale, how far a reading may be from its target."""

    driver: Literal["manual-head"]
    name: str = "head"
    scale_division: SizeRad
    tolerance: SizeRad

    @model_validator(mode="after")
    def _readable(self) -> HeadSection:
        if self.tolerance < self.scale_division / 2:
            raise ValueError("the tolerance is less than half a division of the scale: no reading would pass")
        return self


class TemperatureRange(FileModel):
    """Lowest and highest temperature, °C."""

    minimum: TemperatureC
    maximum: TemperatureC

    @model_validator(mode="after")
    def _in_order(self) -> TemperatureRange:
        if self.minimum >= self.maximum:
            raise ValueError(f"the minimum {self.minimum:g} °C is not below the maximum {self.maximum:g} °C")
        return self


class ChamberSection(TemperatureRange):
    """The thermal chamber and the temperatures it can hold."""

    driver: Literal["manual-chamber"]
    name: str = "chamber"


class InstrumentsSection(FileModel):
    """Everything that is opened for a run."""

    voltmeters: Annotated[tuple[VoltmeterSection, ...], Field(min_length=1)]
    head: HeadSection
    chamber: ChamberSection | None = None
