"""An instrument as it declares itself: name, section in bench files, certificate, wire, driver, simulation."""

from __future__ import annotations

import datetime
import importlib
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import ModuleType
from typing import Annotated, Any, ClassVar, Final, Literal, NamedTuple, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

from bench.base.text import repeated
from bench.base.units import (
    ANGLE,
    DIFFERENCE,
    RATIO,
    VOLTAGE,
    AngleRad,
    DurationS,
    QuantityKind,
    Ratio,
    TemperatureC,
    VoltageV,
    above_zero,
    not_negative,
    reads,
)
from bench.base.yaml_files import FileModel

Role = Literal["voltmeter", "head", "chamber", "level", "thermometer", "power_supply"]


class DeviceSection(FileModel):
    """Base of the sections of instruments in a bench file; the forms of roles derive from it."""

    # a field that cannot be read is a mistake of the module that declares it, told when that is loaded
    model_config = ConfigDict(defer_build=False)

    role: ClassVar[Role]
    by_hand: ClassVar[bool] = False
    """Whether a person operates the instrument: it has neither a wire nor a simulation."""
    sections_of: ClassVar[Callable[[Role], Sequence[type[FileModel]]]] = staticmethod(lambda role: ())
    """The sections of all instruments of a role; the registry, which knows them, sets it."""

    driver: str

    @classmethod
    def alternatives(cls) -> Iterable[type[FileModel]]:
        """Return the sections of all instruments, for the form of a role."""
        return cls.sections_of(cls.role) if "role" in cls.__dict__ else ()

    def driver_options(self) -> dict[str, Any]:
        """Return the keyword arguments of its driver beyond those of its role."""
        return {}

    def simulation_options(self, truth: Any) -> dict[str, Any]:
        """Return the keyword arguments of its simulation; `truth` is the simulation section of its role."""
        return {}


@dataclass(frozen=True)
class Device:
    """The declaration of an instrument: the `DEVICE` of a module in this folder or of a plug-in.

    `name` is its `driver` in bench files. `driver` and `simulation` name classes as "module:Class", where a leading
    dot means a module beside the declaration; an instrument that a person operates has no simulation. `example` is
    a section of a bench file (of a voltmeter with one signal: that of x). `simulated` are the keys of its role's
    simulation section that its simulation heeds. `place` orders the instruments of a role in lists; those without
    one follow by name.
    """

    name: str
    section: type[DeviceSection]
    driver: str
    simulation: str | None
    example: Mapping[str, Any]
    simulated: tuple[str, ...] = ()
    place: int = 100
    package: str = ""
    """The package of modules with a leading dot; the registry sets it."""

    @property
    def role(self) -> Role:
        """What kind of instrument it is."""
        return self.section.role

    def class_of(self, which: Literal["driver", "simulation"]) -> Any:
        """Import the driver or the simulation and return its class. Raises what the import raises."""
        module, _, attribute = str(getattr(self, which)).partition(":")
        return getattr(importlib.import_module(module, self.package or None), attribute)


BAUD_RATES: Final = (300, 600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)

_VISA: Final = re.compile(r"(ASRL|GPIB|PRLGX|TCPIP|USB)[^\s]*::[^\s]+")
_ADAPTER: Final = re.compile(r"prologix://(/\S+|COM[0-9]+|[^\s/:]+(?::[0-9]{1,5})?)/([0-9]{1,2})")
_HIGHEST_ADDRESS: Final = 30
_ADAPTER_PORT: Final = ":1234"
"""The port of an adapter on the network where none is stated (`drivers.wire.prologix`)."""


class BusPlace(NamedTuple):
    """Where an instrument behind a GPIB adapter is: the adapter ("192.0.2.10", "/dev/ttyUSB0"), the address."""

    adapter: str
    address: int


def bus_place(resource: str) -> BusPlace | None:
    """Return the place that `prologix://192.0.2.10/22` names, None for a resource of another kind."""
    match = _ADAPTER.fullmatch(resource)
    if match is None or int(match[2]) > _HIGHEST_ADDRESS:
        return None
    return BusPlace(match[1].removesuffix(_ADAPTER_PORT), int(match[2]))


def is_serial(resource: str) -> bool:
    """Whether a resource is a serial port of the computer."""
    return resource.startswith("ASRL")


def any_resource(resource: str) -> str:
    """Return it when it is a VISA resource or one behind an adapter. Raises `ValueError` for another."""
    if _VISA.fullmatch(resource) is None and bus_place(resource) is None:
        raise ValueError(
            "expected a VISA resource such as 'GPIB0::22::INSTR', 'ASRL/dev/ttyUSB0::INSTR' or "
            "'TCPIP0::192.0.2.22::5025::SOCKET', or one behind a GPIB adapter such as "
            f"'prologix://192.0.2.10/22', got '{resource}'"
        )
    return resource


def resource_on(*interfaces: Literal["TCPIP", "ASRL"], example: str) -> AfterValidator:
    """Return the validator of a VISA resource on one of the interfaces that an instrument has."""

    def check(resource: str) -> str:
        if _VISA.fullmatch(resource) is None or not resource.startswith(interfaces):
            raise ValueError(f"expected a VISA resource such as {example}, got '{resource}'")
        return resource

    return AfterValidator(check)


@dataclass(frozen=True)
class Port:
    """The setup of an instrument's wire: line ends, and the parameters of a serial port if it may have one."""

    read_termination: str
    write_termination: str
    serial: Mapping[str, Any] | None = None
    read_tail: int = 0
    """How many bytes follow the termination of a reply."""


WIRE_FACTS: Final = ("READ_TERMINATION", "WRITE_TERMINATION")
"""Names that the facts of an instrument with a wire must define; with a serial port also `SERIAL`."""


Timeout = Annotated[
    DurationS, above_zero("expected a duration longer than nothing such as '5 s', got {:g} s")
]


class WiredForm(DeviceSection):
    """An instrument with a wire: its resource and timeout; its `facts` describe the protocol."""

    facts: ClassVar[ModuleType]

    resource: str
    timeout: Timeout = 3.0

    @property
    def place(self) -> BusPlace | None:
        """Where it is behind a GPIB adapter, None without one."""
        return bus_place(self.resource)

    def port(self) -> Port:
        """Return the setup of its wire by its facts, of a serial port by the section."""
        stated = getattr(self, "serial", None)
        serial = None if stated is None else {**self.facts.SERIAL, **stated.settings()}
        tail = getattr(self.facts, "READ_TAIL", 0)
        return Port(self.facts.READ_TERMINATION, self.facts.WRITE_TERMINATION, serial, tail)


class PortSection(FileModel):
    """The speed of a serial port, one of those `known`; its other parameters are fixed by the maker."""

    known: ClassVar[tuple[int, ...]] = BAUD_RATES

    baud_rate: int

    @field_validator("baud_rate")
    @classmethod
    def _usual(cls, baud_rate: int) -> int:
        return usual_baud_rate(baud_rate, cls.known)

    @classmethod
    def of(cls, facts: ModuleType) -> Self:
        """Return the port as delivered."""
        return cls(baud_rate=facts.SERIAL["baud_rate"])

    def settings(self) -> dict[str, Any]:
        """Return what it says of the port."""
        return {"baud_rate": self.baud_rate}


def usual_baud_rate(baud_rate: int, known: tuple[int, ...]) -> int:
    """Return it when it is one of those known. Raises `ValueError` for another."""
    if baud_rate not in known:
        raise ValueError(f"expected one of {', '.join(map(str, known))}, got '{baud_rate}'")
    return baud_rate


def _pattern(text: str) -> str:
    try:
        re.compile(text)
    except re.error as error:
        raise ValueError(f"expected a pattern (a regular expression), got '{text}' ({error})") from None
    return text


IdentityPattern = Annotated[str, AfterValidator(_pattern)]
"""A regular expression that the instrument's own name must match."""


def as_stated(identity: str) -> bool:
    """Whether the stated identity is a plain name and no pattern; a simulation then has that name."""
    return re.fullmatch(r"[\w -]+", identity) is not None


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
