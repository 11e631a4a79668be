"""The section of a bench file on what no reading shows: limits of meters, gravity, temperature, priors."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import field_validator

from bench.base.forms import FileModel
from bench.base.units import GRAVITY, RATIO, QuantityKind, SpanS, not_negative
from bench.devices.chambers import SizeK
from bench.files.bench.stand import ErrorSize, VoltageError

BIAS_PER_K: Final = QuantityKind("a temperature coefficient of the bias", "30 ug/K", "g/K")
SCALE_PER_K: Final = QuantityKind("a temperature coefficient of the scale factor", "180 ppm/K", "1/K")
BIAS_PER_V: Final = QuantityKind("a supply coefficient of the bias", "20 ug/V", "g/V")
SCALE_PER_V: Final = QuantityKind("a supply coefficient of the scale factor", "20 ppm/V", "1/V")
ACCELERATION: Final = QuantityKind("a bias", "20 ug", "g")
QUADRATIC: Final = QuantityKind("a quadratic nonlinearity", "30 ug/g^2", "g/g^2")
CUBIC: Final = QuantityKind("a cubic nonlinearity", "20 ug/g^3", "g/g^3")


class RatioError(ErrorSize):
    """A relative error."""

    limit: Annotated[float, not_negative(RATIO)]


class GravityError(ErrorSize):
    """An error of local gravity, m/s²."""

    limit: Annotated[float, not_negative(GRAVITY)]


class TemperatureError(ErrorSize):
    """How far the temperature of the block is from that of the calibration, K: throughout a run, as an offset.

    Where the block's temperature wanders within the limit, `correlation_time` says in what time it forgets where it
    was; only then do readings average it.
    """

    limit: SizeK
    correlation_time: SpanS | None = None

    @field_validator("correlation_time")
    @classmethod
    def _lasts(cls, time_s: float | None) -> float | None:
        if time_s == 0.0:
            raise ValueError(
                "expected more than nothing; leave it out where the offset stays throughout a run"
            )
        return time_s


class BiasPerKelvin(ErrorSize):
    """A temperature coefficient of the bias, g/K."""

    limit: Annotated[float, not_negative(BIAS_PER_K)]


class ScalePerKelvin(ErrorSize):
    """A temperature coefficient of the scale factor, 1/K."""

    limit: Annotated[float, not_negative(SCALE_PER_K)]


class BiasPerVolt(ErrorSize):
    """How the bias follows the voltage of a rail, g/V."""

    limit: Annotated[float, not_negative(BIAS_PER_V)]


class ScalePerVolt(ErrorSize):
    """How the scale factor follows the voltage of a rail, 1/V."""

    limit: Annotated[float, not_negative(SCALE_PER_V)]


class BiasError(ErrorSize):
    """How a bias differs from one switching-on to another, g."""

    limit: Annotated[float, not_negative(ACCELERATION)]


class QuadraticError(ErrorSize):
    """K2 of a channel, in g per g²."""

    limit: Annotated[float, not_negative(QUADRATIC)]


class CubicError(ErrorSize):
    """K3 of a channel, in g per g³."""

    limit: Annotated[float, not_negative(CUBIC)]


class UncertaintySection(FileModel):
    """What is known of the errors that the readings do not show; what is left out has a default.

    The defaults of the voltmeters are their makers' limits, that of the temperature the chamber's band, that of the
    rails' voltages their tolerance; temperature and voltages are off by as much throughout a run.
    """

    voltmeter_gain: RatioError | None = None
    voltmeter_offset: VoltageError | None = None
    voltmeter_linearity: VoltageError | None = None
    gravity: GravityError | None = None
    temperature: TemperatureError | None = None
    bias_temperature_coefficient: BiasPerKelvin | None = None
    scale_temperature_coefficient: ScalePerKelvin | None = None
    supply_voltage: VoltageError | None = None
    bias_supply_coefficient: BiasPerVolt | None = None
    scale_supply_coefficient: ScalePerVolt | None = None
    turn_on_repeatability: BiasError | None = None
    K2: QuadraticError | None = None
    K3: CubicError | None = None
