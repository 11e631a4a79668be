"""Sections of a bench file on gravity, stand, block, block supply, and errors invisible in the readings."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any, ClassVar, Final, Literal, Self

from pydantic import AfterValidator, Discriminator, Field, Tag, field_validator, model_validator

from bench.base.languages import message
from bench.base.units import (
    ACCELERATION,
    GRAVITY,
    RATIO,
    AccelerationG,
    AccelerationMS2,
    AngleRad,
    DurationS,
    LengthM,
    QuantityKind,
    ScaleFactor,
    SizeA,
    SizeRad,
    SizeV,
    SpanS,
    VoltageV,
    above_zero,
    not_negative,
)
from bench.base.yaml_files import FileModel
from bench.config.devices.device import Day
from bench.config.devices.sections import SizeK, TemperatureRange
from bench.model.geometry import Distribution, Installation, normal_gravity_m_s2
from drivers.interfaces import OutputSettings

_NAME: Final = re.compile(r"[a-z][a-z0-9]{0,30}")


def _names_a_column(name: str) -> str:
    if _NAME.fullmatch(name) is None:
        raise ValueError(
            f"a rail's name is a small letter, then small letters and digits, such as 'p15', not '{name}'"
        )
    return name


class CurrentWindow(FileModel):
    """The range of a rail's current in operation, A."""

    minimum: SizeA
    maximum: SizeA


class RailLimits(FileModel):
    """The absolute limits of the block on a rail, from its data sheet."""

    minimum: VoltageV
    maximum: VoltageV
    current: SizeA


class RailSection(FileModel):
    """A rail of the block: the supply output that feeds it, its voltage with tolerance, and its current.

    `limits` are the limits of the block. `current_limit` and `over_voltage` are set at the supply's output before
    it is switched on. All voltages of a negative rail are negative. `bench.config.bench_file.crosschecks` checks
    these values against each other and against the supply.
    """

    name: Annotated[str, AfterValidator(_names_a_column)]
    output: str
    voltage: VoltageV
    tolerance: SizeV
    current: CurrentWindow
    limits: RailLimits
    current_limit: SizeA
    over_voltage: VoltageV | None = None

    @property
    def settings(self) -> OutputSettings:
        """The settings of the supply's output."""
        return OutputSettings(self.voltage, self.current_limit, self.over_voltage)

    @property
    def window_v(self) -> tuple[float, float]:
        """The lowest and the highest voltage within tolerance, V."""
        return self.voltage - self.tolerance, self.voltage + self.tolerance


MOST_SAMPLES: Final = 1_000_000
"""The most samples of one settling or warm-up."""


def can_come_about(
    what: str, size: float, span: str, span_s: float, interval_s: float, timeout_s: float
) -> None:
    """Raise `ValueError` if a criterion of settling cannot be met, or may take over `MOST_SAMPLES` samples.

    The criterion is that samples, one every `interval_s`, vary by at most `size` during the time `span_s`,
    before `timeout_s` has passed. In the message, `what` is the name of `size`, and `span` that of `span_s`.
    """
    if size <= 0.0:
        raise ValueError(f"the {what} is not above 0, but no two samples are equal; state one above 0")
    if not 0.0 < interval_s <= span_s:
        raise ValueError(f"the interval is not between 0 and {span}; state one above 0 and at most {span}")
    if timeout_s > MOST_SAMPLES * interval_s:
        raise ValueError(
            f"the interval would take more than {MOST_SAMPLES} samples until the timeout; change one of the two"
        )
    if timeout_s < span_s + interval_s:
        raise ValueError(f"the timeout is too short; state at least {span} plus one interval")


class DriftForm(FileModel):
    """Criterion of warm-up: each signal has moved by no more than `drift` within the time `per`.

    The signals are sampled every `interval`. Warm-up fails if the signals have not met the criterion by `timeout`.
    """

    drift: SizeV
    per: DurationS
    timeout: DurationS
    interval: DurationS = 10.0

    @model_validator(mode="after")
    def _can_come_about(self) -> DriftForm:
        can_come_about("drift", self.drift, "the time of the drift", self.per, self.interval, self.timeout)
        return self


def written_as(section: type[FileModel], tag: str, plain: str) -> Discriminator:
    """Return a discriminator between two forms of a written value.

    A mapping, or an instance of `section`, has the tag `tag`; a number or a list has the tag `plain`.
    """
    return Discriminator(lambda written: tag if isinstance(written, dict | section) else plain)


WarmUp = Annotated[
    Annotated[SpanS, Tag("time to warm up")] | Annotated[DriftForm, Tag("warm-up until settled")],
    written_as(DriftForm, "warm-up until settled", "time to warm up"),
]


class UnitSupplySection(FileModel):
    """The block's supply.

    The rails are switched on in the listed order, `pause` apart, and off in reverse. Once off, the block
    stays off for at least `least_off`. `warm_up` starts at switch-on; it is a fixed time, or ends when the
    signals have settled. With `when_unsafe` "off", a run that has switched the block, or has found
    it on and taken it over, switches it off at the end.
    """

    rails: Annotated[tuple[RailSection, ...], Field(min_length=1)]
    pause: SpanS = 0.0
    least_off: SpanS = 0.0
    warm_up: WarmUp
    when_unsafe: Literal["stay-on", "off"]

    @property
    def switching_s(self) -> float:
        """The time to switch all rails on, or off, s."""
        return self.pause * (len(self.rails) - 1)

    @property
    def warm_up_s(self) -> float:
        """The shortest possible warm-up, s."""
        return self.warm_up if isinstance(self.warm_up, float) else self.warm_up.per + self.warm_up.interval

    @property
    def longest_warm_up_s(self) -> float:
        """The longest possible warm-up, s."""
        return self.warm_up if isinstance(self.warm_up, float) else self.warm_up.timeout


LARGEST_RAD: Final = math.radians(2.0)
"""The largest accepted limit of a stand error, rad; for comparison, a tilt of 0.6° is 0.01 g on a level axis."""

SizeG = Annotated[float, not_negative(ACCELERATION)]


# --- gravity ----------------------------------------------------------------------------------------


class Location(FileModel):
    """The location of the bench, from which the WGS 84 formula gives gravity."""

    latitude: AngleRad
    height: LengthM = 0.0

    @field_validator("latitude")
    @classmethod
    def _on_earth(cls, latitude_rad: float) -> float:
        normal_gravity_m_s2(latitude_rad)
        return latitude_rad

    @field_validator("height")
    @classmethod
    def _on_the_ground(cls, height_m: float) -> float:
        if not -500.0 <= height_m <= 9000.0:
            raise ValueError(f"state a height between -500 m and 9000 m, not {height_m:g} m")
        return height_m


def _plausible_gravity(g_m_s2: float) -> float:
    if not 9.75 <= g_m_s2 <= 9.85:
        raise ValueError(f"state local gravity between 9.75 and 9.85 m/s^2, not {g_m_s2:g} m/s^2")
    return g_m_s2


class MeasuredGravity(FileModel):
    """A measured value of local gravity with its source, date and expanded uncertainty U = k u."""

    value: Annotated[AccelerationMS2, AfterValidator(_plausible_gravity)]
    source: str
    date: Day
    U: Annotated[float, not_negative(GRAVITY)]
    k: Annotated[float, Field(gt=0.0)]
    dof: Annotated[float, Field(gt=0.0)] = float("inf")


def _form_of_gravity(written: Any) -> str:
    if isinstance(written, MeasuredGravity) or (isinstance(written, dict) and "value" in written):
        return "gravity with its source"
    return "location of gravity" if isinstance(written, dict | Location) else "value of gravity"


Gravity = Annotated[
    Annotated[AccelerationMS2, AfterValidator(_plausible_gravity), Tag("value of gravity")]
    | Annotated[Location, Tag("location of gravity")]
    | Annotated[MeasuredGravity, Tag("gravity with its source")],
    Discriminator(_form_of_gravity),
]


# --- stand ------------------------------------------------------------------------------------------


class ErrorSize(FileModel):
    """The limit of an error with its distribution; a normal distribution requires the coverage factor k.

    `dof` are the degrees of freedom if the limit was estimated from repeats; by default infinite.
    """

    limit: float
    distribution: Literal["normal", "rectangular"]
    k: Annotated[float, Field(gt=0.0)] | None = None
    dof: Annotated[float, Field(gt=0.0)] = float("inf")

    @model_validator(mode="after")
    def _k_where_normal(self) -> ErrorSize:
        if self.distribution == "normal" and self.k is None:
            raise ValueError("a normal distribution needs 'k', its limit in standard deviations; add 'k'")
        if self.distribution == "rectangular" and self.k is not None:
            raise ValueError("a rectangular distribution has no 'k'; remove 'k'")
        return self

    def to_distribution(self) -> Distribution:
        """Return the distribution, in SI units."""
        return Distribution(self.limit, self.distribution, 1.0 if self.k is None else self.k)


def _of_a_bench(limit_rad: float) -> float:
    if limit_rad > LARGEST_RAD:
        raise ValueError(
            f"an error of {math.degrees(limit_rad):.3g} deg is too large for a limit of a bench, "
            f"{math.degrees(LARGEST_RAD):g} deg at most; check the unit (arcsec, arcmin)"
        )
    return limit_rad


class AngleError(ErrorSize):
    """The limit of a stand error that is an angle, rad, small enough for sin α = α."""

    limit: Annotated[SizeRad, AfterValidator(_of_a_bench)]


class VoltageError(ErrorSize):
    """The limit of an error in volts."""

    limit: SizeV


class StandSection(FileModel):
    """The stand errors: alpha1 to alpha4 and Delta U_M of the paper, and three more angles.

    By default the mounting roll has the limit of the mounting error, and the mounting offset is zero. `foundation`
    limits the change of the levelled platform's tilt in a day. If the platform is levelled during a run, the
    measured values replace `axis_tilt` and `zero_offset` for that mounting.
    """

    axis_tilt: AngleError
    zero_offset: AngleError
    mounting_error: AngleError
    setting_error: AngleError
    voltmeter_error: VoltageError
    mounting_roll: AngleError | None = None
    mounting_offset: AngleError | None = None
    foundation: AngleError | None = None


class InstallationSection(FileModel):
    """An installation: the platform axis along which each block axis lies.

    The block may also be turned by the angle `turned` about the platform axis `about`.
    """

    axes: Annotated[tuple[str, ...], Field(min_length=3, max_length=3)]
    turned: AngleRad = 0.0
    about: Literal["x", "y", "z"] = "z"

    @field_validator("axes")
    @classmethod
    def _right_handed(cls, axes: tuple[str, ...]) -> tuple[str, ...]:
        Installation.from_axes("", axes)
        return axes

    def to_model(self, label: str) -> Installation:
        """Return the model installation named `label`."""
        return Installation.from_axes(label, self.axes, self.turned, self.about)


# --- the block --------------------------------------------------------------------------------------


class ScaleFactors(FileModel):
    """Nominal scale factors with their signs, V/g."""

    x: ScaleFactor
    y: ScaleFactor
    z: ScaleFactor

    @field_validator("x", "y", "z")
    @classmethod
    def _not_zero(cls, scale_v_g: float) -> float:
        if scale_v_g == 0.0:
            raise ValueError("the scale factor is 0; state another number")
        return scale_v_g

    @property
    def values(self) -> tuple[float, float, float]:
        """The scale factors of x, y and z, V/g."""
        return self.x, self.y, self.z


class UnitUnderTest(FileModel):
    """The block: identity, nominal scale factors, measuring range, permitted temperatures, and supply."""

    type: str
    serial: str
    scale_factors: ScaleFactors
    range: AccelerationG
    temperature: TemperatureRange
    supply: UnitSupplySection | None = None


class PopulationSection(FileModel):
    """The normal distribution of the true error δ of blocks of this type at a verification point, in g."""

    mean: AccelerationG = 0.0
    standard_deviation: Annotated[
        SizeG,
        above_zero("identical blocks need no verification; state a standard deviation above zero"),
    ]


class StatedRule(FileModel):
    """A decision rule as stated in a file; the guard band is a multiple of the expanded uncertainty U.

    A guard band without a rule selects the non-binary rule.
    """

    rule: Literal["simple acceptance", "guarded", "non-binary"] | None = None
    guard_band: Annotated[float, Field(gt=0.0)] | None = None

    @property
    def names_a_rule(self) -> bool:
        """Whether the file states a decision rule or a guard band; otherwise the default rule applies."""
        return self.rule is not None or self.guard_band is not None

    @model_validator(mode="after")
    def _band_with_its_rule(self) -> Self:
        if self.rule == "simple acceptance" and self.guard_band is not None:
            raise ValueError(
                "simple acceptance has no guard band; remove 'guard_band', or state 'rule: guarded'"
            )
        return self


class VerificationSection(StatedRule):
    """The verification: the largest permitted deviation Delta g_A of measured gravity from 1 g.

    Further keys state the decision rule and the population of blocks.
    """

    limit: SizeG
    population: PopulationSection | None = None


BIAS_PER_K: Final = QuantityKind(message("a temperature coefficient of the bias"), "30 ug/K", "g/K")
SCALE_PER_K: Final = QuantityKind(
    message("a temperature coefficient of the scale factor"), "180 ppm/K", "1/K"
)
BIAS_PER_V: Final = QuantityKind(message("a supply coefficient of the bias"), "20 ug/V", "g/V")
SCALE_PER_V: Final = QuantityKind(message("a supply coefficient of the scale factor"), "20 ppm/V", "1/V")
BIAS: Final = QuantityKind(message("a bias"), "20 ug", "g")
QUADRATIC: Final = QuantityKind(message("a quadratic nonlinearity"), "30 ug/g^2", "g/g^2")
CUBIC: Final = QuantityKind(message("a cubic nonlinearity"), "20 ug/g^3", "g/g^3")


class RatioError(ErrorSize):
    """The limit of a relative error."""

    limit: Annotated[float, not_negative(RATIO)]


class GravityError(ErrorSize):
    """The limit of the error of local gravity, m/s²."""

    limit: Annotated[float, not_negative(GRAVITY)]


class TemperatureError(ErrorSize):
    """The limit of the difference between the temperatures of the block in use and in the calibration, K.

    By default the difference is constant throughout a run. With `correlation_time`, it fluctuates with this
    correlation time, and averaging over readings reduces the error.
    """

    limit: SizeK
    correlation_time: (
        Annotated[
            SpanS,
            above_zero("state a value above 0; remove it if the offset is constant in a run"),
        ]
        | None
    ) = None


class RoomError(ErrorSize):
    """The limit of the changes of the room's temperature, K.

    The voltmeters follow the room with the time constant `lag`. It is 100 min by default, as a published record of
    a 34420A in an air bath shows.
    """

    LAG_S: ClassVar[float] = 6000.0

    limit: SizeK
    lag: Annotated[SpanS, above_zero("state a lag above 0 min")] = LAG_S


class BiasPerKelvin(ErrorSize):
    """The limit of a temperature coefficient of the bias, g/K."""

    limit: Annotated[float, not_negative(BIAS_PER_K)]


class ScalePerKelvin(ErrorSize):
    """The limit of a temperature coefficient of the scale factor or of a voltmeter's gain, 1/K."""

    limit: Annotated[float, not_negative(SCALE_PER_K)]


class BiasPerVolt(ErrorSize):
    """The limit of the change of the bias with the voltage of one rail, g/V."""

    limit: Annotated[float, not_negative(BIAS_PER_V)]


class ScalePerVolt(ErrorSize):
    """The limit of the relative change of the scale factor with the voltage of one rail, 1/V."""

    limit: Annotated[float, not_negative(SCALE_PER_V)]


class BiasError(ErrorSize):
    """The limit of the change of a bias from one switch-on to another, g."""

    limit: Annotated[float, not_negative(BIAS)]


class QuadraticError(ErrorSize):
    """The limit of the quadratic nonlinearity K2 of a channel, in g per g²."""

    limit: Annotated[float, not_negative(QUADRATIC)]


class CubicError(ErrorSize):
    """The limit of the cubic nonlinearity K3 of a channel, in g per g³."""

    limit: Annotated[float, not_negative(CUBIC)]


_ZeroG = Annotated[float, not_negative(BIAS)]
_Factor = Annotated[float, Field(ge=0.0)]


class ZeroRepeats(FileModel):
    """The scatter of the zeros of x, y, z between repeats, as found by `bench diagnose --together`.

    `restart` is the standard deviation of the zeros between repeats; `drift` is the standard deviation of
    their change from one repeat to the next; both are in g. `scale` is the standard deviation divided by the
    u of a zero from the readings alone. Exactly one of the three is stated.
    """

    restart: tuple[_ZeroG, _ZeroG, _ZeroG] | None = None
    drift: tuple[_ZeroG, _ZeroG, _ZeroG] | None = None
    scale: tuple[_Factor, _Factor, _Factor] | None = None

    @model_validator(mode="after")
    def _one_of_them(self) -> Self:
        names = ("restart", "drift", "scale")
        stated = [f"'{name}'" for name in names if getattr(self, name) is not None]
        if len(stated) != 1:
            raise ValueError(
                f"{len(stated)} of 'restart', 'drift' and 'scale' are stated ({', '.join(stated) or 'none'}); "
                "state exactly one, with a size for each channel"
            )
        return self


class UncertaintySection(FileModel):
    """The limits of errors that the readings do not reveal; omitted limits have defaults.

    The default for voltmeters is the maker's limits, for temperature the chamber's band, and for rail voltages
    their tolerance; `bench.calibration.budget.sources` has the other defaults. Deviations of rail voltages
    are assumed constant throughout a run, and so is that of temperature unless it states a correlation time.
    `reference_noise` is the 1/f noise of the references in the voltmeters, per decade of frequency.
    """

    voltmeter_gain: RatioError | None = None
    voltmeter_offset: VoltageError | None = None
    voltmeter_linearity: VoltageError | None = None
    reference_noise: RatioError | None = None
    gravity: GravityError | None = None
    temperature: TemperatureError | None = None
    room_temperature: RoomError | None = None
    voltmeter_temperature_coefficient: ScalePerKelvin | None = None
    bias_temperature_coefficient: BiasPerKelvin | None = None
    scale_temperature_coefficient: ScalePerKelvin | None = None
    supply_voltage: VoltageError | None = None
    bias_supply_coefficient: BiasPerVolt | None = None
    scale_supply_coefficient: ScalePerVolt | None = None
    turn_on_repeatability: BiasError | None = None
    zero_repeats: ZeroRepeats | None = None
    K2: QuadraticError | None = None
    K3: CubicError | None = None
