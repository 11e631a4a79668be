"""Sections of a bench file for voltmeters, heads, chambers, levels, thermometers and power supplies."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from bench.base.arrays import ARCSEC
from bench.base.languages import message
from bench.base.units import (
    DIFFERENCE,
    RATIO,
    AngleRad,
    QuantityKind,
    Ratio,
    SizeA,
    SizeRad,
    SizeV,
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
    PortSection,
    Role,
    Timeout,
    VoltmeterCertificate,
    WiredForm,
    any_resource,
    of_known_ranges,
)
from drivers.interfaces import Channel, SupplyLimits, VoltmeterLimits

VOLTMETER_FACTS: Final = (
    "RANGES_V", "OVER_RANGE", "NPLC", "MEMORY_READINGS", "LEAST_SAMPLES", "ACCURACY_90_DAYS", "LINEARITY",
)  # fmt: skip
"""Names that the facts of a voltmeter define (example: 34401A); with a serial port, also `BAUD_RATES`.

A simulation with the `Converter` of `sim/voltmeters.py` needs `TEMPERATURE_COEFFICIENT`, `REFERENCE_C` and
`REFERENCE_WIDTH_C`, too. The driver is constructed as `Driver(name, channel, session, clock, *, interface,
line_hz)`, its simulation as `Simulation(source, clock, *, interface, noise, accuracy, line_hz)`. The section of a
voltmeter without a serial port states `interface: Literal["lan"]` or the like.
"""

DAYS_90: Final = 90.0 / 365.25
"""The time for which a data sheet's 90-day error limits hold, years."""


@dataclass(frozen=True)
class VoltmeterKind:
    """The limits and accuracy of a voltmeter type, for one channel.

    `accuracy` gives, by range, the error limits of DC volts within 90 days at 23 ± 5 °C, as fractions of reading
    and of range; `accuracy_of_year` gives the limits within a year where they are known. `linearity` gives the
    limits of integral nonlinearity in the same form. `resolution` maps an integration time (in NPLC) to the
    resolution at this and longer times, as a fraction of the range; it is empty if unknown.
    """

    limits: VoltmeterLimits
    accuracy: Mapping[float, tuple[float, float]]
    linearity: tuple[float, float]
    resolution: Mapping[float, float] = field(default_factory=dict)
    accuracy_of_year: Mapping[float, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, facts: ModuleType) -> VoltmeterKind:
        """Return the voltmeter type that a module of facts describes."""
        return cls(
            VoltmeterLimits.of(facts),
            facts.ACCURACY_90_DAYS,
            facts.LINEARITY,
            getattr(facts, "RESOLUTION", {}),
            getattr(facts, "ACCURACY_1_YEAR", {}),
        )

    def limits_after(self, years: float, range_v: float) -> tuple[float, float]:
        """Return the error limits some years after calibration, as fractions of reading and of range.

        The 90-day limits hold for 90 days, and the one-year limits from then until one year. Later limits grow in
        proportion to the time since calibration. Without one-year limits, the 90-day limits grow in this way.
        """
        of_90_days = self.accuracy[range_v]
        if years <= DAYS_90:
            return of_90_days
        known = self.accuracy_of_year.get(range_v)
        limits, since = (of_90_days, DAYS_90) if known is None else (known, 1.0)
        times = max(1.0, years / since)
        return limits[0] * times, limits[1] * times


CERTIFICATE: Final = "certificate"
"""The word in a bench file that gives simulated voltmeters the errors in their certificates."""


class VoltmeterTruth(FileModel):
    """The noise, the errors and the flaws of the simulated voltmeters.

    `noise` switches the noise on. `accuracy` selects random errors within the maker's 90-day limits, or the
    errors in the certificates; by default the meters have no errors. The other keys are flaws of a real
    meter. A source of `source_ohm` is loaded by 10 MΩ unless the meter's high impedance is on. `mains` is the
    amplitude of the mains voltage on the signal, which an integration over whole cycles cancels. `zero_drift`
    is the drift of the zero per hour with autozero off. `flicker` is the standard deviation of the input's
    1/f noise per decade of frequency, `reference_flicker` that of the reference's 1/f noise, as a fraction of
    the signal. `firmware` lists versions for the meters of x, y, z, repeated if fewer; "3-1-1" sends a comma
    after the last reading. `errors_at_start` are in the error queue at switch-on. With `real_port`, an RS-232
    meter loses messages sent between a query and its reply, and stops responding after ten idle minutes.
    """

    noise: bool = True
    accuracy: Literal["90 days", "certificate"] | None = None
    source_ohm: Annotated[float, Field(ge=0.0)] = 0.0
    mains: SizeV = 0.0
    zero_drift: SizeV = 0.0
    flicker: SizeV = 0.0
    reference_flicker: Annotated[float, not_negative(RATIO)] = 0.0
    firmware: tuple[Annotated[str, Field(pattern=r"^\d+(-\d+){2}$")], ...] = ()
    errors_at_start: tuple[Annotated[int, Field(ge=-499, le=-100)], ...] = ()
    real_port: bool = False

    def flaws(self) -> dict[str, float]:
        """Return the flaws: source (Ω), mains (V), zero drift (V/s), 1/f noise of input (V), reference (1)."""
        return {
            "source_ohm": self.source_ohm,
            "mains_v": self.mains,
            "zero_drift_v_s": self.zero_drift / 3600.0,
            "flicker_v": self.flicker,
            "reference_flicker": self.reference_flicker,
        }


class SerialSection(PortSection):
    """The serial port settings at a meter's front panel: 7 data bits if there is parity, else 8."""

    baud_rate: int = 9600
    parity: Literal["none", "even", "odd"] = "none"

    def settings(self) -> dict[str, Any]:
        """Return the baud rate, parity and number of data bits."""
        data_bits = 8 if self.parity == "none" else 7
        return {"baud_rate": self.baud_rate, "parity": self.parity, "data_bits": data_bits}


class VoltmeterForm(WiredForm):
    """The settings that all voltmeters have.

    The range is fixed, since a meter's errors differ between ranges. `interface` is the interface selected at the
    meter, regardless of the wire that carries its messages.
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
            """The signals in the order in which the meter reads them."""

    @property
    def name(self) -> str:
        """The name in the file, or else "voltmeter." with the meter's signals, as in "voltmeter.x"."""
        return self.stated_name or f"voltmeter.{''.join(self.channels)}"

    @property
    def kind(self) -> VoltmeterKind:
        """The limits and accuracy of the meter."""
        return VoltmeterKind.of(self.facts)

    @property
    def inputs_used(self) -> Channel | dict[Channel, int]:
        """The signal of a voltmeter with one input; for several inputs, the input number of each signal."""
        raise NotImplementedError

    @field_validator("range")
    @classmethod
    def _of_the_meter(cls, range_v: float, info: ValidationInfo) -> float:
        if hasattr(cls, "facts") and range_v not in cls.facts.RANGES_V:  # an unknown driver has no facts
            listed = ", ".join(f"{r:g} V" for r in cls.facts.RANGES_V)
            raise ValueError(
                f"the {info.data.get('driver')} has no range of {range_v:g} V; choose from {listed}"
            )
        return range_v

    @field_validator("certificate")
    @classmethod
    def _of_its_ranges(cls, certificate: VoltmeterCertificate | None) -> VoltmeterCertificate | None:
        if certificate is not None and hasattr(cls, "facts"):
            of_known_ranges(certificate, cls.facts.RANGES_V)
        return certificate

    def simulation_options(self, truth: VoltmeterTruth) -> dict[str, Any]:
        """Return the simulation's options: the interface, whether there is noise, and the errors to simulate."""
        accuracy: str | dict[float, tuple[float, float]] | None = truth.accuracy
        if truth.accuracy == CERTIFICATE:
            accuracy = {} if self.certificate is None else self.certificate.errors()
        own = {"interface": self.interface, "noise": truth.noise, "accuracy": accuracy}
        return super().simulation_options(truth) | own


class OneChannelForm(VoltmeterForm):
    """A voltmeter that reads one signal."""

    channels: Annotated[tuple[Channel, ...], Field(min_length=1, max_length=1)]

    @property
    def inputs_used(self) -> Channel:
        """The signal at the only input."""
        return self.channels[0]


class SerialPortForm(VoltmeterForm):
    """A voltmeter that may have a serial port."""

    serial: SerialSection = SerialSection()


def written_channels(voltmeter: Any) -> tuple[str, list[Any]] | None:
    """Return the key "channels" or "inputs" of a voltmeter section as written, with its signals; else None."""
    if not isinstance(voltmeter, dict):
        return None
    for key in ("channels", "inputs"):
        signals = voltmeter.get(key)
        if isinstance(signals, list | dict):
            return key, list(signals)
    return None


SPEED: Final = QuantityKind(message("a speed of turning"), "10 deg/s", "rad/s")

SpeedRadS = Annotated[float, not_negative(SPEED)]


class HeadTruth(FileModel):
    """A simulated head: its state at switch-on, and whether it detects stalling (`encoder`).

    `homed` means that a motorised head is homed, or the encoder of a head that a person turns is referenced.
    """

    homed: bool = True
    encoder: bool = True


class HeadForm(DeviceSection):
    """The settings that all heads have; `tolerance` is the largest deviation of an angle from its target."""

    role: ClassVar[Role] = "head"
    scale_on_axis: ClassVar[bool] = False
    """Whether the scale sits on the axis that turns the block, with no gear or coupling in between."""

    name: str = "head"
    tolerance: SizeRad
    certificate: HeadCertificate | None = None

    @property
    def turned_by_hand(self) -> bool:
        """Whether a person turns the head."""
        return self.by_hand


_NO_HEAD: Final = "state a value above 0: every head has a tolerance and a speed"


class MotorisedHeadForm(HeadForm, WiredForm):
    """A motorised head, which never leaves the range from `minimum` to `maximum` of its scale.

    It approaches an angle from at least `backoff` away, from the side that the procedure demands. It has arrived
    when all samples of its scale stay within `tolerance` of the angle for the time `settle`. A turn may take no
    longer than `speed` allows.
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
                f"between the minimum {low} and the maximum {high} no angle can be approached from both "
                f"sides; widen them, or shorten the back-off of {math.degrees(self.backoff):g}°"
            )
        if self.backoff <= self.tolerance:
            raise ValueError("the back-off is not above the tolerance; state a larger back-off")
        return self

    def travel(self) -> dict[str, float]:
        """Return the arguments of `drivers.motion.Travel`: the limits and criteria of a move."""
        return {
            "minimum_rad": self.minimum,
            "maximum_rad": self.maximum,
            "tolerance_rad": self.tolerance,
            "speed_rad_s": self.speed,
            "backoff_rad": self.backoff,
            "settle_s": self.settle,
        }

    def simulation_options(self, truth: HeadTruth) -> dict[str, Any]:
        """Return the options of the simulated head: values of the section, and the speed, deg/s."""
        return super().simulation_options(truth) | {"speed_deg_s": math.degrees(self.speed)}


class ReadOutHeadForm(HeadForm, WiredForm):
    """A head that a person turns, with an encoder that the program reads.

    The head approaches an angle from at least `backoff` away. It has arrived when it is within `tolerance` of the
    angle, and its reading has changed by no more than `rest` during the time `settle`. A change faster than `speed`
    counts as an error of the encoder. With `hands_free`, the angle is read as soon as the head rests, without a
    confirmation by the person. With `typed`, the person also types the angle on the scale. The encoder shows `zero`
    at 0° of the scale. If `falling`, its values fall as the angle rises.
    """

    tolerance: Annotated[SizeRad, above_zero(_NO_HEAD)]
    backoff: SizeRad = math.radians(1.0)
    rest: Annotated[SizeRad, above_zero("state a value above 0: no encoder stands still")] = 2 * ARCSEC
    settle: SpanS = 2.0
    speed: Annotated[SpeedRadS, above_zero(_NO_HEAD)] = math.radians(90.0)
    hands_free: bool = False
    typed: bool = False
    zero: AngleRad = 0.0
    falling: bool = False

    @model_validator(mode="after")
    def _can_be_come_to(self) -> ReadOutHeadForm:
        if self.backoff <= self.tolerance:
            raise ValueError("the back-off is not above the tolerance; state a larger back-off")
        if self.settle == 0.0:
            raise ValueError("'settle' is 0 s, but the head must rest for this time; state a time above 0 s")
        if self.hands_free and self.typed:
            raise ValueError("state 'hands_free' or 'typed', not both: typing needs a hand")
        return self

    @property
    def turned_by_hand(self) -> bool:
        """Whether a person turns the head: always."""
        return True

    def approach(self) -> dict[str, Any]:
        """Return the rules of arrival for the driver (`drivers.readout.Approach`)."""
        return {
            "tolerance_rad": self.tolerance,
            "backoff_rad": self.backoff,
            "rest_rad": self.rest,
            "settle_s": self.settle,
            "speed_rad_s": self.speed,
            "hands_free": self.hands_free,
            "typed": self.typed,
        }

    def scale(self) -> dict[str, Any]:
        """Return the relation between encoder and head for the driver (`drivers.readout.ScaleOfEncoder`)."""
        return {"zero_rad": self.zero, "falling": self.falling}

    def simulation_options(self, truth: HeadTruth) -> dict[str, Any]:
        """Return the simulated head's options: values of the section; the encoder's zero, sign, reference."""
        own = {"zero_deg": math.degrees(self.zero), "falling": self.falling, "referenced": truth.homed}
        return super().simulation_options(truth) | own


TEMPERATURE_RATE: Final = QuantityKind(message("a rate of temperature"), "4 K/min", "K/s")

SizeK = Annotated[float, not_negative(DIFFERENCE)]
RateKS = Annotated[float, not_negative(TEMPERATURE_RATE)]

OF_THE_AIR: Final = ("rate", "lag", "off_lag", "ringing", "room_share")
"""Keys of the simulation section that every simulated chamber uses."""


_NO_CHAMBER: Final = "state a value above 0: every chamber takes time"


class ChamberTruth(FileModel):
    """A simulated chamber with a controller.

    The set point of the air moves at `rate`, and the air follows with the time constant `lag`. When the chamber is
    off, the air returns to ambient with the time constant `off_lag`. `sensor_noise` is the standard deviation of
    the chamber's readings. With a period `ringing` the air overshoots the set point and rings. As the platform
    conducts heat, the block settles at air + `room_share` · (room − air).
    """

    rate: Annotated[RateKS, above_zero(_NO_CHAMBER)] = 4.0 / 60.0
    lag: Annotated[SpanS, above_zero(_NO_CHAMBER)] = 120.0
    off_lag: Annotated[SpanS, above_zero(_NO_CHAMBER)] = 3600.0
    sensor_noise: SizeK = 0.0
    ringing: Annotated[SpanS, Field(ge=0.0)] = 0.0
    room_share: Annotated[Ratio, Field(ge=0.0, lt=1.0)] = 0.0


class TemperatureRange(FileModel):
    """The lowest and the highest temperature, °C."""

    minimum: TemperatureC
    maximum: TemperatureC

    @model_validator(mode="after")
    def _in_order(self) -> TemperatureRange:
        if self.minimum >= self.maximum:
            raise ValueError(f"the minimum {self.minimum:g} °C must be below the maximum {self.maximum:g} °C")
        return self

    def refuse_outside(self, temperature_c: float, what: str) -> None:
        """Raise `ValueError` for a temperature outside the range; `what` names it in the message."""
        if not self.minimum <= temperature_c <= self.maximum:
            raise ValueError(
                f"{what} of {temperature_c:g} °C is outside the chamber's {self.minimum:g} to {self.maximum:g} °C; "
                "change it or the limits in the bench file"
            )


class ChamberForm(TemperatureRange, DeviceSection):
    """The settings that all chambers have: range of set points, and certificate of the thermometer."""

    role: ClassVar[Role] = "chamber"

    name: str = "chamber"
    certificate: ChamberCertificate | None = None


class ControlledChamberForm(ChamberForm, WiredForm):
    """A chamber with a controller.

    At a reading, the air must be within `band` (if stated) of the set point. The run warns if the air has covered
    less than a fifth of a temperature change after the time `slow_after`.
    """

    band: (
        Annotated[SizeK, above_zero("state a band above 0 K: no chamber keeps its temperature exactly")]
        | None
    ) = None
    slow_after: Annotated[SpanS, above_zero("state a time such as 5 min: air needs time")] = 300.0

    def limits(self) -> tuple[float, float, float | None]:
        """Return the lowest and highest set point, °C, and the band, K or None, for the driver."""
        return self.minimum, self.maximum, self.band

    def simulation_options(self, truth: ChamberTruth) -> dict[str, Any]:
        """Return the options of the simulated chamber: values of the section, set point limits (°C)."""
        return super().simulation_options(truth) | {"lowest_c": self.minimum, "highest_c": self.maximum}


class LevelTruth(FileModel):
    """A simulated level: its zero errors along and across the shaft, noise (1 σ) and relative scale error."""

    zero_along: AngleRad = 20.0 * ARCSEC
    zero_across: AngleRad = -12.0 * ARCSEC
    noise: SizeRad = 1.0 * ARCSEC
    scale: Ratio = 0.0


class LevelForm(DeviceSection):
    """The settings that all levels have; reading a level in two positions cancels its zero error."""

    role: ClassVar[Role] = "level"
    certificate: ClassVar[None] = None
    """Levels have no certificate: for tilts of a few arcseconds, the scale error is below the resolution."""

    name: str = "level"


class ThermometerTruth(FileModel):
    """A simulated thermometer on the block: its error, its noise (1 σ) and its response to the air.

    Apart from error and noise, it shows T(block) + `air_share` · (T(air) − T(block)).
    """

    error: Annotated[float, reads(DIFFERENCE)] = 0.0
    noise: SizeK = 0.005
    air_share: Annotated[Ratio, Field(ge=0.0, le=1.0)] = 0.0


class ThermometerForm(DeviceSection):
    """The settings that all thermometers have; each reading records the temperature shown.

    `gradient` is the largest temperature difference between thermometer and accelerometers, by default 0.2 K.
    Without a `certificate` the tolerance of the sensor type applies.
    """

    role: ClassVar[Role] = "thermometer"

    name: str = "thermometer"
    gradient: SizeK | None = None
    certificate: ChamberCertificate | None = None

    @property
    def tolerance_k(self) -> float:
        """The limit of the thermometer's error without a certificate, K."""
        raise NotImplementedError


SUPPLY_FACTS: Final = ("OUTPUTS", "SWITCHED_TOGETHER")
"""Names that the facts of a power supply define (example: E3631A); with a serial port, also `BAUD_RATES`."""

OF_CURRENT: Final = QuantityKind(message("a rate of a current"), "0.2 percent/K", "1/K")


class SupplyTruth(FileModel):
    """The load that the simulated unit presents to its supply, and its signals without power.

    Each rail draws `current` at 23 °C (default: the middle of its stated window), changing by the fraction
    `current_by_temperature` per kelvin. At switch-on it draws `in_rush` times this current, which decays with the
    time constant `in_rush_time`. Below the fraction `brown_out` of a rail's voltage the unit stops working. Its
    signals are then random: `dead_offset` is their standard deviation between channels, `dead_noise` between
    readings.
    """

    current: SizeA | None = None
    current_by_temperature: Annotated[float, reads(OF_CURRENT)] = 2e-3
    in_rush: Annotated[Ratio, Field(ge=1.0)] = 3.0
    in_rush_time: Annotated[SpanS, above_zero("state a value above 0: capacitors need time to charge")] = 0.05
    brown_out: Annotated[Ratio, Field(gt=0.0, lt=1.0)] = 0.8
    dead_offset: VoltageV = 2e-3
    dead_noise: VoltageV = 5e-4


OF_THE_UNIT: Final = tuple(SupplyTruth.model_fields)
"""Keys of the simulation section that describe the unit; they apply to every supply."""


class SupplyForm(DeviceSection):
    """The settings that all power supplies have; voltages and currents are in the section on the block."""

    role: ClassVar[Role] = "power_supply"

    certificate: ClassVar[None] = None
    """Supplies have no certificate: no reading depends on their display."""

    name: str = "power_supply"

    @property
    def limits(self) -> SupplyLimits | None:
        """The settings that the outputs support; None if unknown."""
        raise NotImplementedError


class WiredSupplyForm(SupplyForm, WiredForm):
    """A power supply with a wire."""

    resource: Annotated[str, AfterValidator(any_resource)]

    @property
    def limits(self) -> SupplyLimits | None:
        """The settings that the outputs support, from the facts of the model."""
        return SupplyLimits.of(self.facts, getattr(self, "model", None))

    def driver_options(self) -> dict[str, Any]:
        """Return the options of the driver: values of the section, and the limits of the outputs."""
        return super().driver_options() | {"limits": self.limits}
