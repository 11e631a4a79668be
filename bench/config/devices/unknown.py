"""Instruments of a recorded bench file that nobody here knows: kept as they are written, for evaluating alone."""

from __future__ import annotations

from typing import Any, Final

from pydantic import ConfigDict, Field, ValidationInfo, field_validator

from bench.base.units import SizeRad
from bench.config.devices.certificates import VoltmeterCertificate
from bench.config.devices.device import DeviceSection, Role
from bench.config.devices.sections import ChamberForm, HeadForm, LevelForm, SizeK, SupplyForm, ThermometerForm
from bench.config.devices.voltmeters import VoltmeterForm, VoltmeterKind
from drivers.interfaces import BenchError, Channel, SupplyLimits

KEPT: Final = ConfigDict(extra="allow")


class UnknownVoltmeter(VoltmeterForm):
    """A voltmeter of which only the signals that it carried and their range are known."""

    model_config = KEPT

    resource: str = ""
    stated_channels: tuple[Channel, ...] = Field((), alias="channels")
    inputs: Any = None

    @field_validator("range")
    @classmethod
    def _of_the_meter(cls, range_v: float, info: ValidationInfo) -> float:
        return range_v

    @field_validator("certificate")
    @classmethod
    def _of_its_ranges(cls, certificate: VoltmeterCertificate | None) -> VoltmeterCertificate | None:
        return certificate

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The signals, in the order of the inputs where these are numbers."""
        if isinstance(self.inputs, dict):
            return tuple(sorted(self.inputs, key=lambda signal: _number(self.inputs[signal])))
        return self.stated_channels

    @property
    def kind(self) -> VoltmeterKind:
        """Raise `BenchError`: what it can do and how exact it is, nobody here knows."""
        raise BenchError(
            self.name,
            f"the driver '{self.driver}' is not here, so nobody knows how exact its voltmeters are",
            "name the folder it is in with --devices or BENCH_DEVICES, or install its distribution",
        )


class UnknownHead(HeadForm):
    """A head of which nothing is known."""

    model_config = KEPT

    tolerance: SizeRad = 0.0


class UnknownChamber(ChamberForm):
    """A chamber of which the temperatures that could be demanded are known, and the band where it was stated."""

    model_config = KEPT

    band: SizeK | None = None


class UnknownLevel(LevelForm):
    """A level of which nothing is known."""

    model_config = KEPT


class UnknownThermometer(ThermometerForm):
    """A thermometer of which its certificate is known, if it has one."""

    model_config = KEPT

    @property
    def tolerance_k(self) -> float:
        """Nobody here knows; as of a plain one."""
        return 0.5


class UnknownSupply(SupplyForm):
    """A power supply of which nothing is known."""

    model_config = KEPT

    @property
    def limits(self) -> SupplyLimits | None:
        """Return None: what it can do, nobody here knows."""
        return None


OF_ROLE: Final[dict[Role, type[DeviceSection]]] = {
    "voltmeter": UnknownVoltmeter,
    "head": UnknownHead,
    "chamber": UnknownChamber,
    "level": UnknownLevel,
    "thermometer": UnknownThermometer,
    "power_supply": UnknownSupply,
}


def _number(text: object) -> float:
    try:
        return float(str(text))
    except ValueError:
        return 0.0
