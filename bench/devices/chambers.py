"""The form of the thermal chambers of a bench file: one that a person sets, or one with a controller."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Final

from pydantic import field_validator, model_validator

from bench.base.forms import FileModel
from bench.base.units import DIFFERENCE, QuantityKind, SpanS, TemperatureC, not_negative
from bench.devices.certificates import ChamberCertificate
from bench.devices.device import DeviceSection, Role
from bench.devices.wires import WiredForm

TEMPERATURE_RATE: Final = QuantityKind("a rate of temperature", "4 K/min", "K/s")

SizeK = Annotated[float, not_negative(DIFFERENCE)]
RateKS = Annotated[float, not_negative(TEMPERATURE_RATE)]

OF_THE_AIR: Final = ("rate", "lag", "off_lag")
"""What the simulated world does with the air of any chamber that is simulated."""


class ChamberTruth(FileModel):
    """A simulated chamber with a controller: how fast it takes its air along, how it drifts back when off.

    `lag` is how far the air is behind; `sensor_noise` the standard deviation of what its sensor shows.
    """

    rate: RateKS = 4.0 / 60.0
    lag: SpanS = 120.0
    off_lag: SpanS = 3600.0
    sensor_noise: SizeK = 0.0

    @field_validator("rate", "lag", "off_lag")
    @classmethod
    def _more_than_nothing(cls, size: float) -> float:
        if size == 0.0:
            raise ValueError("expected more than nothing: no chamber is at once where it is sent, nor never")
        return size


class TemperatureRange(FileModel):
    """Lowest and highest temperature, °C."""

    minimum: TemperatureC
    maximum: TemperatureC

    @model_validator(mode="after")
    def _in_order(self) -> TemperatureRange:
        if self.minimum >= self.maximum:
            raise ValueError(f"the minimum {self.minimum:g} °C is not below the maximum {self.maximum:g} °C")
        return self

    def refuse_outside(self, temperature_c: float, what: str) -> None:
        """Raise `ValueError` for a temperature outside."""
        if not self.minimum <= temperature_c <= self.maximum:
            raise ValueError(
                f"{what} of {temperature_c:g} °C is outside {self.minimum:g} to {self.maximum:g} °C"
            )


class ChamberForm(TemperatureRange, DeviceSection):
    """What every chamber is told: the temperatures that may be demanded.

    `certificate` is that of the thermometer by which the temperature is told.
    """

    role: ClassVar[Role] = "chamber"

    name: str = "chamber"
    certificate: ChamberCertificate | None = None


class ControlledChamberForm(ChamberForm, WiredForm):
    """A chamber with a controller; at a reading its air is within `band` of the demand, where one is stated.

    One that has not gone a fifth of its way `slow_after` a demand is told of.
    """

    band: SizeK | None = None
    slow_after: SpanS = 300.0

    @field_validator("band")
    @classmethod
    def _has_width(cls, band_k: float | None) -> float | None:
        if band_k == 0.0:
            raise ValueError("the band is more than nothing: no air keeps its temperature exactly")
        return band_k

    @field_validator("slow_after")
    @classmethod
    def _later(cls, slow_after_s: float) -> float:
        if slow_after_s == 0.0:
            raise ValueError("expected a while such as 5 min: at once no air has moved")
        return slow_after_s

    def limits(self) -> tuple[float, float, float | None]:
        """Return lowest and highest demand and the band (`drivers.chambers.ChamberLimits`), °C."""
        return self.minimum, self.maximum, self.band

    def simulation_options(self, truth: ChamberTruth) -> dict[str, Any]:
        """Return what every simulated chamber is given: what its own controller allows."""
        return {"lowest_c": self.minimum, "highest_c": self.maximum}
