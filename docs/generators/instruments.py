"""The page on instruments: what each driver is for, what it is told, what it can do."""

from __future__ import annotations

from typing import Any, Final, Literal, cast, get_args, get_origin

from pydantic import BaseModel

from bench.devices.device import Role
from bench.devices.registry import devices
from bench.devices.voltmeters import VoltmeterForm, VoltmeterKind
from docs.generators.forms import anchor
from docs.generators.markdown import code, first_line, prose, table

_ROLES: Final[dict[Role, str]] = {
    "voltmeter": "Voltmeters", "head": "Dividing heads", "chamber": "Thermal chambers",
}  # fmt: skip

_INTRODUCTION: Final = """\
# Instruments

What stands under `driver` in a [bench file](bench-files.md). Every one of them can be simulated: `bench run
… --dry-run` and `bench simulate` serve it on a TCP port and speak with it through the same driver. An
instrument that is not here is [a page of work](../writing-a-driver.md). How each is connected and set is in
[From wiring to result](../real-bench.md).
"""


def driver_name(model: type[BaseModel]) -> str:
    """Return the driver that a section of a bench file is for, empty where it is not an instrument's."""
    field = model.model_fields.get("driver")
    if field is None or get_origin(field.annotation) is not Literal:
        return ""
    return str(get_args(field.annotation)[0])


def sections_of(role: Role) -> list[type[BaseModel]]:
    """Return the sections of a role in the order in which instruments are listed."""
    return [device.section for device in devices().of(role)]


def drivers() -> list[str]:
    """Return the names of all drivers."""
    return [driver_name(section) for role in _ROLES for section in sections_of(role)]


def page() -> str:
    """Return the page."""
    parts = [_INTRODUCTION]
    for role, heading in _ROLES.items():
        rows = [
            (_link(section), first_line(prose(section)), _interfaces(section))
            for section in sections_of(role)
        ]
        parts.append(f"## {heading}\n\n{table(('driver', 'what it is', 'connected by'), rows)}")
    parts.append(_limits())
    return "\n\n".join(parts)


def _link(section: type[BaseModel]) -> str:
    name = driver_name(section)
    return f"[{code(name)}](bench-files.md#{anchor(f'Driver {name}')})"


def _interfaces(section: type[BaseModel]) -> str:
    """Return how an instrument can be connected: the words of `interface`, else what its resource may be."""
    interface = section.model_fields.get("interface")
    if interface is not None:
        return ", ".join(map(str, get_args(interface.annotation)))
    resource = section.model_fields.get("resource")
    return "a person" if resource is None else _of_resource(resource.metadata)


def _of_resource(metadata: list[Any]) -> str:
    for entry in metadata:
        cells = getattr(getattr(entry, "func", None), "__closure__", None) or ()
        for cell in cells:
            if isinstance(cell.cell_contents, tuple):
                words = {"TCPIP": "lan", "ASRL": "rs232"}
                return ", ".join(words.get(str(word), str(word)) for word in cell.cell_contents)
    return "lan, gpib, rs232"


def _limits() -> str:
    rows = []
    for section in sections_of("voltmeter"):
        facts = cast(type[VoltmeterForm], section).facts
        name, limits = driver_name(section), VoltmeterKind.of(facts).limits
        rows.append(
            (
                code(name),
                ", ".join(f"{v:g}" for v in limits.ranges_v),
                ", ".join(f"{n:g}" for n in limits.nplc),
                f"{limits.least_samples} to {limits.most_samples:,}",
                ", ".join(map(str, getattr(facts, "BAUD_RATES", ()))) or "–",
            )
        )
    head = ("driver", "ranges / V", "power-line cycles", "samples of a reading", "baud rates")
    return f"""\
## What voltmeters can do

`bench check` holds a procedure against these before anything is sent.

{table(head, rows)}"""
