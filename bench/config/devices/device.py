"""The declaration of an instrument: name, bench-file section, certificate, wire, driver, simulation."""

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
from drivers.facts import text_line

Role = Literal["voltmeter", "head", "chamber", "level", "thermometer", "power_supply"]
Options = tuple[str | tuple[str, str], ...]
"""Names of keyword arguments; if argument and key have different names, the pair (argument, key)."""


class DeviceSection(FileModel):
    """Base class of instrument sections in a bench file; each role has a base class of its own, its form."""

    # build the schema at import: a faulty field is then reported as a mistake of the module that declares it
    model_config = ConfigDict(defer_build=False)

    role: ClassVar[Role]
    by_hand: ClassVar[bool] = False
    """Whether a person operates the instrument; such an instrument has no wire and no simulation."""
    sections_of: ClassVar[Callable[[Role], Sequence[type[FileModel]]]] = staticmethod(lambda role: ())
    """Return the section classes of all instruments of a role; set by the registry, which knows them."""
    for_driver: ClassVar[Options] = ()
    for_simulation: ClassVar[Options] = ()
    """Keys of the section: their values are keyword arguments of the driver or of the simulation."""

    driver: str

    @classmethod
    def alternatives(cls) -> Iterable[type[FileModel]]:
        """Return the section classes of all instruments of the role if this class is its form, else ()."""
        return cls.sections_of(cls.role) if "role" in cls.__dict__ else ()

    def driver_options(self) -> dict[str, Any]:
        """Return the driver's own keyword arguments, in addition to those of every driver of its role."""
        return self._options(self.for_driver)

    def simulation_options(self, truth: Any) -> dict[str, Any]:
        """Return the keyword arguments of the simulated instrument.

        `truth` is the section on this role under `simulation` in the bench file.
        """
        return self._options(self.for_simulation)

    def _options(self, options: Options) -> dict[str, Any]:
        named = [(one, one) if isinstance(one, str) else one for one in options]
        return {argument: getattr(self, key) for argument, key in named}


@dataclass(frozen=True)
class Device:
    """The declaration of an instrument, found as `DEVICE` in a module of this folder or of a plug-in.

    `name` is the instrument's `driver` in bench files. `driver` and `simulation` name classes as "module:Class"; a
    leading dot means a module in the folder of the declaration. `simulation` is None for an instrument that a
    person operates. `example` is a bench-file section of the instrument; for a voltmeter that reads one signal, it
    is the section of channel x. `simulated` lists the keys of the role's simulation section that this instrument's
    simulation uses. In lists, the instruments of a role are in the order of `place`, then of name.
    """

    name: str
    section: type[DeviceSection]
    driver: str
    simulation: str | None
    example: Mapping[str, Any]
    simulated: tuple[str, ...] = ()
    place: int = 100
    package: str = ""
    """The package against which a leading dot is resolved; set by the registry."""

    @property
    def role(self) -> Role:
        """The kind of instrument."""
        return self.section.role

    def class_of(self, which: Literal["driver", "simulation"]) -> Any:
        """Import the module of the driver or simulation and return the class. Raises any error of the import."""
        module, _, attribute = str(getattr(self, which)).partition(":")
        return getattr(importlib.import_module(module, self.package or None), attribute)


BAUD_RATES: Final = (300, 600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)

_VISA: Final = re.compile(r"(ASRL|GPIB|PRLGX|TCPIP|USB)[^\s]*::[^\s]+")
_ADAPTER: Final = re.compile(r"prologix://(/\S+|COM[0-9]+|[^\s/:]+(?::[0-9]{1,5})?)/([0-9]{1,2})")
_HIGHEST_ADDRESS: Final = 30
_ADAPTER_PORT: Final = ":1234"
"""The default TCP port of a GPIB adapter (`drivers.wire.prologix`)."""


class BusPlace(NamedTuple):
    """The location of an instrument behind a GPIB adapter, such as ("192.0.2.10", 22) or ("/dev/ttyUSB0", 22)."""

    adapter: str
    address: int


def bus_place(resource: str) -> BusPlace | None:
    """Return the location that "prologix://192.0.2.10/22" names; None for any other kind of resource."""
    match = _ADAPTER.fullmatch(resource)
    if match is None or int(match[2]) > _HIGHEST_ADDRESS:
        return None
    return BusPlace(match[1].removesuffix(_ADAPTER_PORT), int(match[2]))


def is_serial(resource: str) -> bool:
    """Whether a VISA resource is a serial port of the computer."""
    return resource.startswith("ASRL")


def any_resource(resource: str) -> str:
    """Return the resource if it is a VISA resource or lies behind a GPIB adapter. Raises `ValueError` otherwise."""
    if _VISA.fullmatch(resource) is None and bus_place(resource) is None:
        raise ValueError(
            "expected a VISA resource such as 'GPIB0::22::INSTR', 'ASRL/dev/ttyUSB0::INSTR' or "
            "'TCPIP0::192.0.2.22::5025::SOCKET', or one behind a GPIB adapter such as "
            f"'prologix://192.0.2.10/22', got '{resource}'"
        )
    return resource


def resource_on(*interfaces: Literal["TCPIP", "ASRL"], example: str) -> AfterValidator:
    """Return a validator of VISA resources that accepts these `interfaces` only; its message shows `example`."""

    def check(resource: str) -> str:
        if _VISA.fullmatch(resource) is None or not resource.startswith(interfaces):
            raise ValueError(f"expected a VISA resource such as {example}, got '{resource}'")
        return resource

    return AfterValidator(check)


def serial_or_socket(port: str, address: str) -> AfterValidator:
    """Return a validator that accepts serial ports and network sockets; its message shows these two as examples."""
    example = f"'ASRL/dev/{port}::INSTR' or 'TCPIP0::{address}::SOCKET'"
    return resource_on("ASRL", "TCPIP", example=example)


@dataclass(frozen=True)
class Port:
    """The line terminations of an instrument's wire, and the parameters of its serial port, if it has one."""

    read_termination: str
    write_termination: str
    serial: Mapping[str, Any] | None = None
    read_tail: int = 0
    """The number of bytes that follow the termination of a reply."""


WIRE_FACTS: Final = ("READ_TERMINATION", "WRITE_TERMINATION")
"""Names that the facts of every wired instrument define; with a serial port, also `SERIAL`."""


Timeout = Annotated[DurationS, above_zero("expected a duration above 0 such as '5 s', got {:g} s")]


class WiredForm(DeviceSection):
    """An instrument with a wire; the module `facts` describes its protocol."""

    facts: ClassVar[ModuleType]

    resource: str
    timeout: Timeout = 3.0

    @field_validator("serial", check_fields=False)
    @classmethod
    def _speed_that_it_has(cls, serial: Any) -> Any:
        known = getattr(cls.facts, "BAUD_RATES", BAUD_RATES)
        if serial.baud_rate not in known:
            raise ValueError(
                f"baud_rate: expected one of {', '.join(map(str, known))}, got '{serial.baud_rate}'"
            )
        return serial

    @property
    def place(self) -> BusPlace | None:
        """The location behind a GPIB adapter; None without an adapter."""
        return bus_place(self.resource)

    def port(self) -> Port:
        """Return the setup of the wire: that in the instrument's facts, with the settings in `serial`, if any."""
        stated, of_facts = getattr(self, "serial", None), getattr(self.facts, "SERIAL", None)
        serial = of_facts if stated is None else {**self.facts.SERIAL, **stated.settings()}
        tail = getattr(self.facts, "READ_TAIL", 0)
        return Port(self.facts.READ_TERMINATION, self.facts.WRITE_TERMINATION, serial, tail)


class PortSection(FileModel):
    """The baud rate set at the instrument's serial port; the instrument's facts fix all other parameters."""

    baud_rate: int

    @classmethod
    def of(cls, facts: ModuleType) -> Self:
        """Return the port with the factory setting that an instrument's facts state."""
        return cls(baud_rate=facts.SERIAL["baud_rate"])

    def settings(self) -> dict[str, Any]:
        """Return the stated serial port parameters."""
        return {"baud_rate": self.baud_rate}


def _pattern(text: str) -> str:
    try:
        re.compile(text)
    except re.error as error:
        raise ValueError(f"expected a pattern (a regular expression), got '{text}' ({error})") from None
    return text


IdentityPattern = Annotated[str, AfterValidator(_pattern)]
"""A regular expression that the instrument's own name must match."""


def as_stated(identity: str) -> bool:
    """Whether the identity is a plain name and not a regular expression; the simulation then reports that name."""
    return re.fullmatch(r"[\w -]+", identity) is not None


DAYS_OF_YEAR: Final = 365.25

GAIN_DRIFT: Final = QuantityKind("a drift of the gain", "8 ppm/year", "1/year")
OFFSET_DRIFT: Final = QuantityKind("a drift of the zero", "10 uV/year", "V/year")

LARGEST_GAIN: Final = 0.01
LARGEST_OF_SCALE_RAD: Final = math.radians(1.0)
"""The largest accepted corrections: of a gain, and of a head's scale. Larger ones are typing errors or faults."""
WIDEST_GAP_RAD: Final = math.radians(45.0)
"""The largest accepted gap between angles of a head's table; corrections are interpolated linearly across it."""
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
    """A correction with its expanded uncertainty U = k u, and the degrees of freedom of u (default infinite)."""

    k: Annotated[float, Field(gt=0.0)]
    dof: Annotated[float, Field(gt=0.0)] = float("inf")


class CertifiedGain(Certified):
    """The correction of a voltmeter's gain on a range; `drift` is the gain's largest change in a year."""

    correction: Ratio = 0.0
    U: Annotated[float, not_negative(RATIO)]
    drift: Annotated[float, not_negative(GAIN_DRIFT)] | None = None

    @field_validator("correction")
    @classmethod
    def _small(cls, gain: float) -> float:
        if abs(gain) > LARGEST_GAIN:
            raise ValueError(f"state a gain correction within ±1 %, such as '-12 ppm', not {gain:g}")
        return gain


class CertifiedOffset(Certified):
    """The correction of a voltmeter's zero on a range; `drift` is the zero's largest change in a year."""

    correction: VoltageV = 0.0
    U: Annotated[float, not_negative(VOLTAGE)]
    drift: Annotated[float, not_negative(OFFSET_DRIFT)] | None = None


class RangeValues(FileModel):
    """The corrections of a voltmeter on one range: corrected reading = reading (1 + gain) + offset."""

    range: VoltageV
    gain: CertifiedGain | None = None
    offset: CertifiedOffset | None = None

    @model_validator(mode="after")
    def _says_something(self) -> RangeValues:
        if self.gain is None and self.offset is None:
            raise ValueError("the range has neither 'gain' nor 'offset'; state one or both")
        if self.offset is not None and abs(self.offset.correction) > LARGEST_GAIN * self.range:
            raise ValueError(
                f"state a zero correction within 1 % of the range, not {self.offset.correction:g} V"
            )
        return self


class AngleValue(Certified):
    """The correction of the head's scale at one angle."""

    angle: AngleRad
    correction: AngleRad
    U: Annotated[float, not_negative(ANGLE)]

    @field_validator("correction")
    @classmethod
    def _small(cls, angle_rad: float) -> float:
        if abs(angle_rad) > LARGEST_OF_SCALE_RAD:
            raise ValueError(f"state a scale correction within ±1°, not {_degrees(angle_rad)}")
        return angle_rad


class TemperatureValue(Certified):
    """The correction of a thermometer at one temperature."""

    temperature: TemperatureC
    correction: Annotated[float, reads(DIFFERENCE)]
    U: Annotated[float, not_negative(DIFFERENCE)]


class Certificate(FileModel):
    """A calibration certificate: its number, laboratory, date, expiry date and the instrument's serial number.

    An omitted serial number matches any instrument.
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
            raise ValueError(
                f"the certificate expired on {until}, before its own date {begun}; correct one of "
                "the two dates"
            )
        return until

    def years_until(self, day: datetime.date) -> float:
        """Return the time between the calibration and a day, in years; positive also for an earlier day."""
        return abs((day - self.date).days) / DAYS_OF_YEAR

    @property
    def words(self) -> str:
        """The number, date and laboratory in words: "certificate 123 of 2026-03-02, Acme"."""
        return f"certificate {self.number} of {self.date}, {self.laboratory}"


class VoltmeterCertificate(Certificate):
    """The certificate of a voltmeter: corrections for each range."""

    values: Annotated[tuple[RangeValues, ...], Field(min_length=1)]

    @field_validator("values")
    @classmethod
    def _each_range_once(cls, values: tuple[RangeValues, ...]) -> tuple[RangeValues, ...]:
        _refuse_twice([f"{value.range:g} V" for value in values], "range")
        return values

    def of_range(self, range_v: float) -> RangeValues | None:
        """Return the corrections for a range; None if the certificate does not cover the range."""
        return next((value for value in self.values if value.range == range_v), None)

    def errors(self) -> dict[float, tuple[float, float]]:
        """Return the errors that the corrections remove: range (V) -> (relative gain error, offset in V)."""
        found = {}
        for value in self.values:
            gain = 1.0 + (value.gain.correction if value.gain else 0.0)
            offset_v = value.offset.correction if value.offset else 0.0
            found[value.range] = (1.0 / gain - 1.0, -offset_v / gain)
        return found


class HeadCertificate(Certificate):
    """The certificate of a dividing head: scale corrections over the full circle, interpolated linearly."""

    values: Annotated[tuple[AngleValue, ...], Field(min_length=1)]

    @field_validator("values")
    @classmethod
    def _all_round(cls, values: tuple[AngleValue, ...]) -> tuple[AngleValue, ...]:
        turn = math.tau
        angles = sorted(value.angle % turn for value in values)
        gaps = [b - a for a, b in pairwise([*angles, angles[0] + turn])]
        if len(angles) > 1 and min(gaps) < _ROUNDING_RAD:
            raise ValueError(
                f"{_degrees(angles[gaps.index(min(gaps))])} appears twice, perhaps a turn apart; keep one"
            )
        if max(gaps) > WIDEST_GAP_RAD + _ROUNDING_RAD:
            low = gaps.index(max(gaps))
            raise ValueError(
                f"the table has no angle between {_degrees(angles[low])} and {_degrees(angles[low] + max(gaps))}: "
                f"state angles at most {_degrees(WIDEST_GAP_RAD)} apart over the whole turn"
            )
        return values


class ChamberCertificate(Certificate):
    """The certificate of a thermometer: corrections by temperature; beyond the table, its end values hold."""

    values: Annotated[tuple[TemperatureValue, ...], Field(min_length=1)]

    @field_validator("values")
    @classmethod
    def _each_once(cls, values: tuple[TemperatureValue, ...]) -> tuple[TemperatureValue, ...]:
        _refuse_twice([f"{value.temperature:g} °C" for value in values], "temperature")
        return values


def of_known_ranges(certificate: VoltmeterCertificate, known_v: Iterable[float]) -> None:
    """Raise `ValueError` if a certificate covers a range that the meter does not have."""
    known = list(known_v)
    for value in certificate.values:
        if value.range not in known:
            listed = ", ".join(f"{r:g} V" for r in known)
            raise ValueError(
                f"the certificate states the range {value.range:g} V, which the meter lacks; choose from {listed}"
            )


def _refuse_twice(names: list[str], what: str) -> None:
    if twice := repeated(names):
        raise ValueError(f"the {what} {', '.join(twice)} appears twice; keep one")


def _degrees(angle_rad: float) -> str:
    return f"{math.degrees(angle_rad):.6g}°"


End = Literal["CR", "LF", "CR LF"]


def _plain(text: str) -> str:
    if re.fullmatch(r"[\x20-\x7e]+", text) is None:
        raise ValueError("expected printable ASCII characters; line ends are stated by 'ends'")
    return text


Printable = Annotated[str, AfterValidator(_plain)]


class LineForm(WiredForm):
    """The request and the form of the reply of an instrument that answers with one line of text.

    The whole line must match `pattern`, a regular expression; its group, such as `(?P<angle>...)`, matches the
    number. `example` is a line as the instrument sends it. `errors` maps each line that it sends instead of a
    number to its meaning. `model` names the instrument in the record.
    """

    group: ClassVar[str]
    for_driver: ClassVar[Options] = ("model", "request", "pattern", "errors")

    model: Printable
    request: Printable
    request_end: End = "CR LF"
    reply_end: End = "CR LF"
    pattern: IdentityPattern
    example: Printable
    errors: Annotated[dict[Printable, str], Field(default_factory=dict)]
    serial: PortSection = PortSection.of(text_line)

    @model_validator(mode="after")
    def _fits(self) -> LineForm:
        if list(re.compile(self.pattern).groupindex) != [self.group]:
            such = rf"POS=(?P<{self.group}>[+-]\d+\.\d+)"
            raise ValueError(
                f"the pattern must have exactly one named group, '{self.group}', as in '{such}'; "
                f"correct '{self.pattern}'"
            )
        match = re.fullmatch(self.pattern, self.example)
        if match is None:
            raise ValueError(
                f"the pattern '{self.pattern}' does not match the example; correct one of "
                f"them: '{self.example}'"
            )
        if re.fullmatch(r"[+-]? *\d+(?:\.\d+)?", match[self.group] or "") is None:
            raise ValueError(
                f"correct the pattern: the {self.group} in the example is not a number, but '{match[self.group]}'"
            )
        for error in self.errors:
            if re.fullmatch(self.pattern, error) is not None:
                raise ValueError(
                    f"the pattern matches the error '{error}': exclude it, or it is read as a number"
                )
        return self

    def port(self) -> Port:
        """Return the setup of the wire, with the line ends that the section states."""
        ends = text_line.ENDS
        serial = {**text_line.SERIAL, **self.serial.settings()} if is_serial(self.resource) else None
        return Port(ends[self.reply_end], ends[self.request_end], serial)

    def line_options(self) -> dict[str, Any]:
        """Return the simulation's options: request, pattern and example of the reply, error lines."""
        ends = text_line.ENDS
        return {
            **self.model_dump(include={"request", "pattern", "example"}),
            "ends": (ends[self.request_end], ends[self.reply_end]),
            "errors": tuple(self.errors),
        }
