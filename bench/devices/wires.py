"""What the sections of all instruments with a wire share: where an instrument is, how its port is set."""

from __future__ import annotations

import re
from typing import Annotated, Any, Final, Literal, NamedTuple, get_args

from pydantic import AfterValidator, BeforeValidator, ConfigDict, create_model, field_validator

from bench.base.forms import FileModel
from bench.base.units import DurationS

BAUD_RATES: Final = (300, 600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)

_VISA: Final = re.compile(r"(ASRL|GPIB|PRLGX|TCPIP|USB)[^\s]*::[^\s]+")
_ADAPTER: Final = re.compile(r"prologix://(/\S+|COM\d+|[^\s/:]+(?::\d{1,5})?)/(\d{1,2})")
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


def meter_resource(resource: str) -> str:
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


class WiredForm(FileModel):
    """An instrument with a wire: how long to wait for a reply."""

    timeout: DurationS = 3.0

    @field_validator("timeout")
    @classmethod
    def _positive(cls, timeout_s: float) -> float:
        if timeout_s <= 0.0:
            raise ValueError(f"expected a duration longer than nothing such as '5 s', got {timeout_s:g} s")
        return timeout_s


class PortSection(FileModel):
    """How fast a serial port is; all else about it is as the maker has fixed it."""

    baud_rate: int

    @field_validator("baud_rate")
    @classmethod
    def _usual(cls, baud_rate: int) -> int:
        return usual_baud_rate(baud_rate, BAUD_RATES)


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


def driver_of(*sections: type[FileModel]) -> BeforeValidator:
    """Return the validator that tells of a driver that none of these sections is for, and of nothing else.

    It goes before the choice among them, which would not say where the driver stands and which is near.
    """
    names = tuple(
        name for section in sections for name in get_args(section.model_fields["driver"].annotation)
    )
    fields: dict[str, Any] = {"driver": (Literal[names], ...)}
    named = create_model("Named", __config__=ConfigDict(extra="ignore"), **fields)

    def check(written: object) -> object:
        if isinstance(written, dict):
            named.model_validate(written)
        return written

    return BeforeValidator(check)
