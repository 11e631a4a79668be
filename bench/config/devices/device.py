"""An instrument as it declares itself: name, section in bench files, wire, driver, simulation."""

from __future__ import annotations

import importlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Annotated, Any, ClassVar, Final, Literal, NamedTuple

from pydantic import AfterValidator, field_validator

from bench.base.units import DurationS
from bench.base.yaml_files import FileModel

Role = Literal["voltmeter", "head", "chamber", "level", "thermometer", "power_supply"]


class DeviceSection(FileModel):
    """The section of an instrument in a bench file; the form of its role stands between this and it."""

    role: ClassVar[Role]
    by_hand: ClassVar[bool] = False
    """Whether a person works the instrument: it has no wire, and nothing stands for it in a simulation."""

    driver: str

    @classmethod
    def alternatives(cls) -> Iterable[type[FileModel]]:
        """Return the sections of all instruments, for the form of a role."""
        if "role" not in cls.__dict__:
            return ()
        from bench.config.devices.registry import devices

        return [device.section for device in devices().of(cls.role)]

    def driver_options(self) -> dict[str, Any]:
        """Return what its driver is given by keyword, beside what all of its role are given."""
        return {}

    def simulation_options(self, truth: Any) -> dict[str, Any]:
        """Return what its simulation is given by keyword; `truth` is what the bench file says of its role's."""
        return {}


@dataclass(frozen=True)
class Device:
    """An instrument, declared: a module of this folder, or of a plug-in, has it as `DEVICE`.

    `name` is what `driver` says in a bench file. `driver` and `simulation` name classes, "module:Class", a module
    with a leading dot beside the declaration's own; one that a person works has no simulation. `example` is a
    section as a bench file has it (of a voltmeter with one signal, that of x). `simulated` are the keys of the
    bench file's section on its role in a simulation that its simulation heeds. `place` is where it stands among
    those of its role when they are listed; those without one come after, by name.
    """

    name: str
    section: type[DeviceSection]
    driver: str
    simulation: str | None
    example: Mapping[str, Any]
    simulated: tuple[str, ...] = ()
    place: int = 100
    package: str = ""
    """The package beside which modules with a leading dot are looked for; the registry sets it."""

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
    """How an instrument's wire is set up: how lines end, and how a serial port speaks where it may have one."""

    read_termination: str
    write_termination: str
    serial: Mapping[str, Any] | None = None
    read_tail: int = 0
    """How many bytes follow the termination of a reply."""


WIRE_FACTS: Final = ("READ_TERMINATION", "WRITE_TERMINATION")
"""What the facts of an instrument with a wire must say; with a serial port `SERIAL`, too."""


class WiredForm(DeviceSection):
    """An instrument with a wire: where it is, how long to wait for a reply. Its `facts` say how it speaks."""

    facts: ClassVar[ModuleType]

    resource: str
    timeout: DurationS = 3.0

    @property
    def place(self) -> BusPlace | None:
        """Where it is behind a GPIB adapter, None without one."""
        return bus_place(self.resource)

    @field_validator("timeout")
    @classmethod
    def _positive(cls, timeout_s: float) -> float:
        if timeout_s <= 0.0:
            raise ValueError(f"expected a duration longer than nothing such as '5 s', got {timeout_s:g} s")
        return timeout_s

    def port(self) -> Port:
        """Return how its wire is set up: as its facts have it, a serial port as the section says."""
        stated = getattr(self, "serial", None)
        serial = None if stated is None else {**self.facts.SERIAL, **stated.settings()}
        tail = getattr(self.facts, "READ_TAIL", 0)
        return Port(self.facts.READ_TERMINATION, self.facts.WRITE_TERMINATION, serial, tail)


class PortSection(FileModel):
    """How fast a serial port is; all else about it is as the maker has fixed it."""

    baud_rate: int

    @field_validator("baud_rate")
    @classmethod
    def _usual(cls, baud_rate: int) -> int:
        return usual_baud_rate(baud_rate, BAUD_RATES)

    @classmethod
    def of(cls, facts: ModuleType) -> PortSection:
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
    """Whether the identity of a bench file is a plain name and no pattern: then a simulation has that name."""
    return re.fullmatch(r"[\w -]+", identity) is not None
