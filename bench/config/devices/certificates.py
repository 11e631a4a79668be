"""What a bench file says of the certificates of its instruments: who calibrated them when, and what was found.

A correction is what is added to a value shown (JCGM 200:2012, 2.53): a meter that reads 100 ppm too much has the
correction −100 ppm. U is the expanded uncertainty of the correction, k its coverage factor.
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterable
from itertools import pairwise
from typing import Annotated, Final

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from bench.base.text import repeated
from bench.base.units import (
    ANGLE,
    DIFFERENCE,
    RATIO,
    VOLTAGE,
    AngleRad,
    QuantityKind,
    Ratio,
    TemperatureC,
    VoltageV,
    not_negative,
    reads,
)
from bench.base.yaml_files import FileModel

DAYS_OF_YEAR: Final = 365.25

GAIN_DRIFT: Final = QuantityKind("a drift of the gain", "8 ppm/year", "1/year")
OFFSET_DRIFT: Final = QuantityKind("a drift of the zero", "10 uV/year", "V/year")

LARGEST_GAIN: Final = 0.01
LARGEST_OF_SCALE_RAD: Final = math.radians(1.0)
"""Larger corrections are slips, or of an instrument to be mended."""
WIDEST_GAP_RAD: Final = math.radians(45.0)
"""So far apart may the angles of a head's table lie: between them its correction is drawn straight."""
_ROUNDING_RAD: Final = 1e-6


def _day(written: object) -> datetime.date:
    if isinstance(written, datetime.date):
        return written
    if not isinstance(written, str) or re.fullmatch(r"[0-9]{4}-[0-9][0-9]-[0-9][0-9]", written) is None:
        raise ValueError(f"expected a date such as 2026-03-02, got '{written}'")
    try:
        return datetime.date.fromisoformat(written)
    except ValueError:
        raise ValueError(f"there is no day {written}: expected a date such as 2026-03-02") from None


Day = Annotated[datetime.date, BeforeValidator(_day)]


class Certified(FileModel):
    """A correction with its expanded uncertainty U = k u, and the degrees of freedom of u where they are few."""

    k: Annotated[float, Field(gt=0.0)]
    dof: Annotated[float, Field(gt=0.0)] = float("inf")


class CertifiedGain(Certified):
    """The correction of a voltmeter's gain on a range.

    `drift` is how much it may change in a year, of either sign.
    """

    correction: Ratio = 0.0
    U: Annotated[float, not_negative(RATIO)]
    drift: Annotated[float, not_negative(GAIN_DRIFT)] | None = None

    @field_validator("correction")
    @classmethod
    def _small(cls, gain: float) -> float:
        if abs(gain) > LARGEST_GAIN:
            raise ValueError(f"a correction of the gain is within ±1 %, such as '-12 ppm', not {gain:g}")
        return gain


class CertifiedOffset(Certified):
    """The correction of a voltmeter's zero on a range.

    `drift` is how much it may change in a year, of either sign.
    """

    correction: VoltageV = 0.0
    U: Annotated[float, not_negative(VOLTAGE)]
    drift: Annotated[float, not_negative(OFFSET_DRIFT)] | None = None


class RangeValues(FileModel):
    """What a certificate states of a range: the corrected reading is U (1 + gain) + offset."""

    range: VoltageV
    gain: CertifiedGain | None = None
    offset: CertifiedOffset | None = None

    @model_validator(mode="after")
    def _says_something(self) -> RangeValues:
        if self.gain is None and self.offset is None:
            raise ValueError("say what was found on this range: gain, offset or both")
        if self.offset is not None and abs(self.offset.correction) > LARGEST_GAIN * self.range:
            raise ValueError(
                f"a correction of the zero is within 1 % of the range, not {self.offset.correction:g} V"
            )
        return self


class AngleValue(Certified):
    """The correction of the head's scale at an angle."""

    angle: AngleRad
    correction: AngleRad
    U: Annotated[float, not_negative(ANGLE)]

    @field_validator("correction")
    @classmethod
    def _small(cls, angle_rad: float) -> float:
        if abs(angle_rad) > LARGEST_OF_SCALE_RAD:
            raise ValueError(f"a correction of the scale is within ±1°, not {_degrees(angle_rad)}")
        return angle_rad


class TemperatureValue(Certified):
    """The correction of the chamber's thermometer at a temperature."""

    temperature: TemperatureC
    correction: Annotated[float, reads(DIFFERENCE)]
    U: Annotated[float, not_negative(DIFFERENCE)]


class Certificate(FileModel):
    """Who calibrated an instrument when, until when that counts, and the serial number of what was calibrated.

    A serial number that is left out is compared with none.
    """

    number: str
    laboratory: str
    date: Day
    valid_until: Day | None = None
    serial: str | None = None

    @field_validator("valid_until")
    @classmethod
    def _later(cls, until: datetime.date | None, info: ValidationInfo) -> datetime.date | None:
        begun = info.data.get("date")
        if until is not None and begun is not None and until < begun:
            raise ValueError(f"the certificate is of {begun}: it cannot have expired before, on {until}")
        return until

    def years_until(self, day: datetime.date) -> float:
        """Return how far a day is from that of the calibration, years; a day before counts as one after."""
        return abs((day - self.date).days) / DAYS_OF_YEAR

    @property
    def words(self) -> str:
        """Which one it is."""
        return f"certificate {self.number} of {self.date}, {self.laboratory}"


class VoltmeterCertificate(Certificate):
    """The certificate of a voltmeter: what was found on each range."""

    values: Annotated[tuple[RangeValues, ...], Field(min_length=1)]

    @field_validator("values")
    @classmethod
    def _each_range_once(cls, values: tuple[RangeValues, ...]) -> tuple[RangeValues, ...]:
        _refuse_twice([f"{value.range:g} V" for value in values], "range")
        return values

    def of_range(self, range_v: float) -> RangeValues | None:
        """Return what it states of a range; None where it states nothing."""
        return next((value for value in self.values if value.range == range_v), None)

    def errors(self) -> dict[float, tuple[float, float]]:
        """Return by range the gain error and the offset, V, that the corrections take away."""
        found = {}
        for value in self.values:
            gain = 1.0 + (value.gain.correction if value.gain else 0.0)
            offset_v = value.offset.correction if value.offset else 0.0
            found[value.range] = (1.0 / gain - 1.0, -offset_v / gain)
        return found


class HeadCertificate(Certificate):
    """The certificate of a dividing head: its table of corrections all round, drawn straight between the angles."""

    values: Annotated[tuple[AngleValue, ...], Field(min_length=1)]

    @field_validator("values")
    @classmethod
    def _all_round(cls, values: tuple[AngleValue, ...]) -> tuple[AngleValue, ...]:
        turn = math.tau
        angles = sorted(value.angle % turn for value in values)
        gaps = [b - a for a, b in pairwise([*angles, angles[0] + turn])]
        if len(angles) > 1 and min(gaps) < _ROUNDING_RAD:
            raise ValueError(f"{_degrees(angles[gaps.index(min(gaps))])} stands twice in the table")
        if max(gaps) > WIDEST_GAP_RAD + _ROUNDING_RAD:
            low = gaps.index(max(gaps))
            raise ValueError(
                f"the table says nothing between {_degrees(angles[low])} and {_degrees(angles[low] + max(gaps))}: "
                f"its angles are at most {_degrees(WIDEST_GAP_RAD)} apart, all round"
            )
        return values


class ChamberCertificate(Certificate):
    """The certificate of a chamber's thermometer: corrections by temperature, those at the ends hold beyond."""

    values: Annotated[tuple[TemperatureValue, ...], Field(min_length=1)]

    @field_validator("values")
    @classmethod
    def _each_once(cls, values: tuple[TemperatureValue, ...]) -> tuple[TemperatureValue, ...]:
        _refuse_twice([f"{value.temperature:g} °C" for value in values], "temperature")
        return values


def of_known_ranges(certificate: VoltmeterCertificate, known_v: Iterable[float]) -> None:
    """Raise `ValueError` where a certificate is of a range that the meter does not have."""
    known = list(known_v)
    for value in certificate.values:
        if value.range not in known:
            listed = ", ".join(f"{r:g} V" for r in known)
            raise ValueError(
                f"the certificate states {value.range:g} V, but the meter has the ranges {listed}"
            )


def _refuse_twice(names: list[str], what: str) -> None:
    if twice := repeated(names):
        raise ValueError(f"the {what} {', '.join(twice)} stands twice; leave one out")


def _degrees(angle_rad: float) -> str:
    return f"{math.degrees(angle_rad):.6g}°"
