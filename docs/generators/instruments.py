"""The page on instruments: what each driver is for, what it is told, what it can do."""

from __future__ import annotations

from typing import Any, Final, Literal, get_args, get_origin

from pydantic import BaseModel

from bench.devices.voltmeters import VOLTMETERS
from bench.files.bench.file import BenchFile
from docs.generators.forms import anchor, models_in, reachable
from docs.generators.markdown import code, first_line, prose, table

_ROLES: Final = {"voltmeters": "Voltmeters", "head": "Dividing heads", "chamber": "Thermal chambers"}

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


def sections_of(role: str) -> list[type[BaseModel]]:
    """Return the sections of a role (a key of the section `instruments`), in the order of the program."""
    instruments: Any = BenchFile.model_fields["instruments"].annotation
    held = models_in(instruments.model_fields[role].annotation)
    return [model for section in held for model in reachable(section)[:1] if driver_name(model)]


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
                told = {"TCPIP": "lan", "ASRL": "rs232"}
                return ", ".join(told.get(word, word) for word in cell.cell_contents)
    return "lan, gpib, rs232"


def _limits() -> str:
    rows = []
    for name, kind in VOLTMETERS.items():
        limits = kind.limits
        rows.append(
            (
                code(name),
                ", ".join(f"{v:g}" for v in limits.ranges_v),
                ", ".join(f"{n:g}" for n in limits.nplc),
                f"{limits.least_samples} to {limits.most_samples:,}",
                ", ".join(map(str, kind.baud_rates)) or "–",
            )
        )
    head = ("driver", "ranges / V", "power-line cycles", "samples of a reading", "baud rates")
    return f"""\
## What voltmeters can do

`bench check` holds a procedure against these before anything is sent.

{table(head, rows)}"""
