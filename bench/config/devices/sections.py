"""Sections of a bench file for voltmeters, heads, chambers, levels, thermometers and power supplies."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from bench.base.arrays import ARCSEC
from bench.base.units import (
    DIFFERENCE,
    AngleRad,
    QuantityKind,
    Ratio,
    SizeA,
    SizeRad,
    SpanS,
    TemperatureC,
    VoltageV,
    above_zero,
    not_negative,
    reads,
)
from bench.base.yaml_files import FileModel
from bench.config.devices.device import (
    ChamberCertificate,
    DeviceSection,
    HeadCertificate,
    Role,
    Timeout,
    VoltmeterCertificate,
    WiredForm,
    any_resource,
    of_known_ranges,
    usual_baud_rate,
)
from drivers.interfaces import Channel, SupplyLimits, VoltmeterLimits

VOLTMETER_FACTS: Final = (
    "RANGES_V", "OVER_RANGE", "NPLC", "MEMORY_READINGS", "LEAST_SAMPLES", "ACCURACY_90_DAYS", "LINEARITY",
)  # fmt: skip
"""What the facts of a voltmeter must say (see those of a 34401A); with a serial port `BAUD_RATES`, too."""

DAYS_90: Final = 90.0 / 365.25
"""The validity of the 90-day limits of error, years."""


@dataclass(frozen=True)
class VoltmeterKind:
    """The abilities of a driver's voltmeters: limits for one channel, and accuracy.

    `over_range` is the part of a range up to which it reads. `accuracy` gives for each range the limits of error of
    DC volts within 90 days at 23 ± 5 °C, as parts of reading and of range; `accuracy_of_year` those within a year,
    for the ranges where they are known; `linearity` the limits of integral nonlinearity. `resolution`, where known,
    gives by integration time (NPLC and longer) the resolved part of the range.
    """

    limits: VoltmeterLimits
    over_range: float
    accuracy: Mapping[float, tuple[float, float]]
    linearity: tuple[float, float]
    resolution: Mapping[float, float] = field(default_factory=dict)
    accuracy_of_year: Mapping[float, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, facts: ModuleType) -> VoltmeterKind:
        """Return the kind that the facts of a voltmeter describe."""
        return cls(
            VoltmeterLimits.of(facts),
            facts.OVER_RANGE,
            facts.ACCURACY_90_DAYS,
            facts.LINEARITY,
            getattr(facts, "RESOLUTION", {}),
            getattr(facts, "ACCURACY_1_YEAR", {}),
        )

    def limits_after(self, years: float, range_v: float) -> tuple[float, float]:
        """Return the limits of error on a range some time after calibration, as parts of reading and of range.

        The limits of 90 days, then those of a year; after a year, or where these are unknown, in proportion to the
        time.
        """
        of_90_days = self.accuracy[range_v]
        if years <= DAYS_90:
            return of_90_days
        known = self.accuracy_of_year.get(range_v)
        limits, since = (of_90_days, DAYS_90) if known is None else (known, 1.0)
        times = max(1.0, years / since)
        return limits[0] * times, limits[1] * times


CERTIFICATE: Final = "certificate"
"""The word for simulated voltmeters that have the errors of their certificates."""


class VoltmeterTruth(FileModel):
    """The simulated voltmeters: with noise or not; without errors, with errors within the maker's limits of 90
    days, or with the errors of their certificates."""

    noise: bool = True
    accuracy: Literal["90 days", "certificate"] | None = None


class SerialSection(FileModel):
    """How a meter's serial port is set on its front panel; with a parity it has 7 data bits, without one 8."""

    baud_rate: int = 9600
    parity: Literal["none", "even", "odd"] = "none"

    @property
    def data_bits(self) -> Literal[7, 8]:
        """Data bits of a character."""
        return 8 if self.parity == "none" else 7

    def settings(self) -> dict[str, Any]:
        """Return what it says of the port."""
        return {"baud_rate": self.baud_rate, "parity": self.parity, "data_bits": self.data_bits}


class VoltmeterForm(WiredForm):
    """The settings of every voltmeter. The range is fixed, since a meter's errors differ between ranges.

    `interface` is the interface selected at the meter, independent of the wire that carries its messages.
    """

    role: ClassVar[Role] = "voltmeter"

    stated_name: str | None = Field(None, alias="name")
    resource: Annotated[str, AfterValidator(any_resource)]
    timeout: Timeout = 5.0
    range: VoltageV = 10.0
    interface: Literal["lan", "gpib", "rs232"] = "lan"
    certificate: VoltmeterCertificate | None = None

    if TYPE_CHECKING:

        @property
        def channels(self) -> tuple[Channel, ...]:
            """The signals in the order in which it reads them."""

    @property
    def name(self) -> str:
        """Name of the instrument: as stated, else "voltmeter.x"."""
        return self.stated_name or f"voltmeter.{''.join(self.channels)}"

    @property
    def kind(self) -> VoltmeterKind:
        """Its abilities."""
        return VoltmeterKind.of(self.facts)

    @property
    def inputs_used(self) -> Channel | dict[Channel, int]:
        """The signal at its input; of one with several, the number of the input of each."""
        raise NotImplementedError

    @field_validator("range")
    @classmethod
    def _of_the_meter(cls, range_v: float, info: ValidationInfo) -> float:
        known = cls.facts.RANGES_V
        if range_v not in known:
            listed = ", ".join(f"{r:g} V" for r in known)
            raise ValueError(f"the {info.data.get('driver')} has the ranges {listed}, not {range_v:g} V")
        return range_v

    @field_validator("certificate")
    @classmethod
    def _of_its_ranges(cls, certificate: VoltmeterCertificate | None) -> VoltmeterCertificate | None:
        if certificate is not None:
            of_known_ranges(certificate, cls.facts.RANGES_V)
        return certificate

    def simulation_options(self, truth: VoltmeterTruth) -> dict[str, Any]:
        """Return what every simulated voltmeter is given."""
        accuracy: str | dict[float, tuple[float, float]] | None = truth.accuracy
        if truth.accuracy == CERTIFICATE:
            accuracy = {} if self.certificate is None else self.certificate.errors()
        return {"interface": self.interface, "noise": truth.noise, "accuracy": accuracy}


class OneChannelForm(VoltmeterForm):
    """A voltmeter with one signal."""

    channels: Annotated[tuple[Channel, ...], Field(min_length=1, max_length=1)]

    @property
    def inputs_used(self) -> Channel:
        """The signal at its input."""
        return self.channels[0]


class SerialPortForm(VoltmeterForm):
    """A voltmeter that may have a serial port."""

    serial: SerialSection = SerialSection()

    @field_validator("serial")
    @classmethod
    def _speed_of_the_meter(cls, serial: SerialSection) -> SerialSection:
        usual_baud_rate(serial.baud_rate, cls.facts.BAUD_RATES)
        return serial


def written_channels(voltmeter: Any) -> tuple[str, list[Any]] | None:
    """Return the key of a voltmeter's signals as written, with the signals; None without them."""
    if not isinstance(voltmeter, dict):
        return None
    for key in ("channels", "inputs"):
        signals = voltmeter.get(key)
        if isinstance(signals, list | dict):
            return key, list(signals)
    return None


SPEED: Final = QuantityKind("a speed of turning", "10 deg/s", "rad/s")

SpeedRadS = Annotated[float, not_negative(SPEED)]


class HeadTruth(FileModel):
    """A simulated motorised head: homed when it is switched on or not, with an encoder to notice being stuck."""

    homed: bool = True
    encoder: bool = True


class HeadForm(DeviceSection):
    """The settings of every head: how far the angle at a reading may be from its target."""

    role: ClassVar[Role] = "head"
    scale_on_axis: ClassVar[bool] = False
    """Whether its scale is on the axis that turns the block, without gear or coupling between."""

    name: str = "head"
    tolerance: SizeRad
    certificate: HeadCertificate | None = None


_NO_HEAD: Final = "expected more than nothing: no head is exact, and none turns without a speed"


class MotorisedHeadForm(HeadForm, WiredForm):
    """A head with a motor, which always stays within `minimum` and `maximum` on its scale.

    It approaches an angle from at least `backoff` away, from the side that the procedure demands. It has arrived
    when every sample of its scale lies within `tolerance` for the time `settle`. `speed` limits the time of a turn.
    """

    tolerance: Annotated[SizeRad, above_zero(_NO_HEAD)]
    minimum: AngleRad
    maximum: AngleRad
    speed: Annotated[SpeedRadS, above_zero(_NO_HEAD)]
    backoff: SizeRad = math.radians(1.0)
    settle: SpanS = 2.0

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
        """Return the limits and criteria of its motion for its driver (`drivers.motion.Travel`)."""
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


TEMPERATURE_RATE: Final = QuantityKind("a rate of temperature", "4 K/min", "K/s")

SizeK = Annotated[float, not_negative(DIFFERENCE)]
RateKS = Annotated[float, not_negative(TEMPERATURE_RATE)]

OF_THE_AIR: Final = ("rate", "lag", "off_lag")
"""Keys that the simulated world heeds for any simulated chamber."""


_NO_CHAMBER: Final = "expected more than nothing: no chamber is at once where it is sent, nor never"


class ChamberTruth(FileModel):
    """A simulated chamber with a controller: how fast it takes its air along, how it drifts back when off.

    `lag` is how far the air is behind; `sensor_noise` the standard deviation of what its sensor shows.
    """

    rate: Annotated[RateKS, above_zero(_NO_CHAMBER)] = 4.0 / 60.0
    lag: Annotated[SpanS, above_zero(_NO_CHAMBER)] = 120.0
    off_lag: Annotated[SpanS, above_zero(_NO_CHAMBER)] = 3600.0
    sensor_noise: SizeK = 0.0


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
    """The settings of every chamber: the temperatures that may be demanded.

    `certificate` is that of its thermometer.
    """

    role: ClassVar[Role] = "chamber"

    name: str = "chamber"
    certificate: ChamberCertificate | None = None


class ControlledChamberForm(ChamberForm, WiredForm):
    """A chamber with a controller; at a reading its air is within the `band`, if any, around the set point.

    A warning is given if its air has not gone a fifth of the way by the time `slow_after`.
    """

    band: (
        Annotated[SizeK, above_zero("the band is more than nothing: no air keeps its temperature exactly")]
        | None
    ) = None
    slow_after: Annotated[SpanS, above_zero("expected a while such as 5 min: at once no air has moved")] = (
        300.0
    )

    def limits(self) -> tuple[float, float, float | None]:
        """Return lowest and highest demand and the band (`drivers.chambers.ChamberLimits`), °C."""
        return self.minimum, self.maximum, self.band

    def simulation_options(self, truth: ChamberTruth) -> dict[str, Any]:
        """Return what every simulated chamber is given: what its own controller allows."""
        return {"lowest_c": self.minimum, "highest_c": self.maximum}


class LevelTruth(FileModel):
    """A simulated level: how far its zero is off along the shaft and across, its noise (1 σ), its scale's error."""

    zero_along: AngleRad = 20.0 * ARCSEC
    zero_across: AngleRad = -12.0 * ARCSEC
    noise: SizeRad = 1.0 * ARCSEC
    scale: Ratio = 0.0


class LevelForm(DeviceSection):
    """The settings of every level. Its zero need not be known, since it is read in two positions."""

    role: ClassVar[Role] = "level"
    certificate: ClassVar[None] = None
    """None: at a few arcseconds the error of its scale is below its resolution."""

    name: str = "level"


class ThermometerTruth(FileModel):
    """A simulated thermometer at the block: what it is off by, its noise (1 σ), how much of the air it feels."""

    error: Annotated[float, reads(DIFFERENCE)] = 0.0
    noise: SizeK = 0.005
    air_share: Annotated[Ratio, Field(ge=0.0, le=1.0)] = 0.0


class ThermometerForm(DeviceSection):
    """The settings of every thermometer at the block; it shows the block's temperature of each reading.

    `gradient` is the largest temperature difference between thermometer and accelerometers, by default ±0.2 K.
    Without a `certificate` the tolerance of its kind holds.
    """

    role: ClassVar[Role] = "thermometer"

    name: str = "thermometer"
    gradient: SizeK | None = None
    certificate: ChamberCertificate | None = None

    @property
    def tolerance_k(self) -> float:
        """The limit of its error without a certificate, K."""
        raise NotImplementedError


SUPPLY_FACTS: Final = ("OUTPUTS", "SWITCHED_TOGETHER")
"""What the facts of a power supply must say (see those of an E3631A); with a serial port `BAUD_RATES`, too."""

OF_CURRENT: Final = QuantityKind("a rate of a current", "0.2 percent/K", "1/K")


class SupplyTruth(FileModel):
    """What the simulated unit takes from its supply, and how it is without.

    Each rail takes `current` at 23 degC (where it is left out the middle of its window), more by
    `current_by_temperature` for each kelvin, and `in_rush` times as much at switching on, dying away with the time
    constant `in_rush_time`. Below the part `brown_out` of a rail's voltage it works no more; `dead_offset` and
    `dead_noise` are the standard deviations, over channels and over readings, of what its signals then show.
    """

    current: SizeA | None = None
    current_by_temperature: Annotated[float, reads(OF_CURRENT)] = 2e-3
    in_rush: Annotated[Ratio, Field(ge=1.0)] = 3.0
    in_rush_time: Annotated[
        SpanS, above_zero("expected more than nothing: no capacitor is charged at once")
    ] = 0.05
    brown_out: Annotated[Ratio, Field(gt=0.0, lt=1.0)] = 0.8
    dead_offset: VoltageV = 2e-3
    dead_noise: VoltageV = 5e-4


OF_THE_UNIT: Final = tuple(SupplyTruth.model_fields)
"""What the simulated world does with the unit behind any supply."""


class SupplyForm(DeviceSection):
    """The settings of every power supply: its name alone; voltages and currents are in the unit's section."""

    role: ClassVar[Role] = "power_supply"

    certificate: ClassVar[None] = None
    """None: no reading depends on its display."""

    name: str = "power_supply"

    @property
    def limits(self) -> SupplyLimits | None:
        """Its abilities; None where they are unknown."""
        raise NotImplementedError


class WiredSupplyForm(SupplyForm, WiredForm):
    """A power supply with a wire; `interface` is the one selected at its front panel."""

    resource: Annotated[str, AfterValidator(any_resource)]

    @property
    def limits(self) -> SupplyLimits | None:
        """Its abilities by the facts of its model."""
        return SupplyLimits.of(self.facts, getattr(self, "model", None))

    def driver_options(self) -> dict[str, Any]:
        """Return what it can do."""
        return {"limits": self.limits}

    def simulation_options(self, truth: SupplyTruth) -> dict[str, Any]:
        """Return the model, where there are several."""
        model = getattr(self, "model", None)
        return {} if model is None else {"model": model}
