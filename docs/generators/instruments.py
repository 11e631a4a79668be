"""The page on instruments: what each driver is for, its settings, what it can do."""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType
from typing import Any, Final, Literal, get_args, get_origin

import yaml
from pydantic import BaseModel

from bench.config.devices.device import Device, Role
from bench.config.devices.registry import devices
from bench.config.devices.sections import SupplyForm
from docs.generators.forms import anchor
from docs.generators.markdown import code, prose
from drivers.interfaces import OutputLimits, SupplyLimits

_ROLES: Final[dict[Role, str]] = {
    "voltmeter": "Voltmeters",
    "head": "Dividing heads",
    "chamber": "Thermal chambers",
    "level": "Levels",
    "thermometer": "Thermometers at the block",
    "power_supply": "Power supplies",
}
_RESOURCES: Final = (
    ("GPIB", "GPIB"),
    ("ASRL", "RS-232"),
    ("TCPIP", "LAN"),
    ("prologix", "a GPIB adapter"),
)

_INTRODUCTION: Final = """\
# Instruments

The values of `driver` in a [bench file](bench-files.md), by role, with an example of each. Every instrument
that is not worked by a person can be simulated: `bench run … --dry-run` and `bench simulate` serve it on a TCP
port, and the same driver talks to it. [Adding an instrument](../writing-a-driver.md) shows how to add
another. [From wiring to result](../real-bench.md) shows how to connect and set them. `bench check` compares a
procedure with the limits below before anything is sent.
"""


def driver_name(model: type[BaseModel]) -> str:
    """Return the driver that a section of a bench file is for, empty where it is not an instrument's."""
    field = model.model_fields.get("driver")
    if field is None or get_origin(field.annotation) is not Literal:
        return ""
    return str(get_args(field.annotation)[0])


def drivers() -> list[str]:
    """Return the names of all drivers."""
    return [device.name for role in _ROLES for device in devices().of(role)]


def page() -> str:
    """Return the page."""
    parts = [_INTRODUCTION]
    for role, heading in _ROLES.items():
        parts.append(f"## {heading}")
        parts += [_section(device) for device in devices().of(role)]
    return "\n\n".join(parts)


def _section(device: Device) -> str:
    facts = getattr(device.section, "facts", None)
    listed = "\n".join(f"- {name}: {text}" for name, text in _facts(device, facts))
    keys = f"[Its keys](bench-files.md#{anchor(f'Driver {device.name}')})."
    example = {"driver": device.name, **device.example}
    written = yaml.safe_dump(example, sort_keys=False, default_flow_style=None).rstrip()
    texts = [f"### {device.name}", prose(device.section), listed, f"```yaml\n{written}\n```", keys]
    return "\n\n".join(text for text in texts if text)


def _facts(device: Device, facts: ModuleType | None) -> Iterator[tuple[str, str]]:
    """Yield label and text of each fact known of an instrument."""
    if device.simulation is None:
        yield "connected by", "a person; in a dry run the scripted operator answers"
    else:
        yield "connected by", ", ".join(_wires(device))
    for name, told, unit in (
        ("RANGES_V", "ranges", " V"),
        ("NPLC", "power-line cycles", ""),
        ("BAUD_RATES", "baud rates", ""),
    ):
        values = getattr(facts, name, None)
        if values:
            yield told, ", ".join(f"{value:g}" for value in values) + unit
    if issubclass(device.section, SupplyForm) and facts is not None:
        yield from _outputs(facts)
    most = getattr(facts, "MEMORY_READINGS", None)
    if most is not None:
        least = getattr(facts, "LEAST_SAMPLES", 1)
        yield "samples of a reading", f"{least} to {most:,} for one channel"
    if device.simulated:
        yield (
            "keys of `simulation` that its simulation uses",
            ", ".join(code(key) for key in device.simulated),
        )
    source = _source(facts)
    if source:
        yield "source", source


def _outputs(facts: ModuleType) -> Iterator[tuple[str, str]]:
    """Yield what the outputs of each model can do."""
    for model in facts.OUTPUTS:
        limits = SupplyLimits.of(facts, model)
        told = "; ".join(f"{code(name)} {_range(output)}" for name, output in limits.outputs.items())
        yield f"outputs of the {model}", told + (", one switch for all" if limits.together else "")


def _range(output: OutputLimits) -> str:
    protection = output.over_voltage_v
    protected = "no over-voltage protection"
    if protection is not None:
        protected = f"over-voltage protection up to {max(protection, key=abs):g} V"
    low_v, high_v = output.voltage_v
    return f"{low_v:g} to {high_v:g} V, up to {output.current_a[1]:g} A, {protected}"


def _wires(device: Device) -> list[str]:
    """Return how an instrument is connected: the words of its `interface`, else what its resource may be."""
    fields: dict[str, Any] = device.section.model_fields
    if "interface" in fields and get_args(fields["interface"].annotation):
        return [str(word) for word in get_args(fields["interface"].annotation)]
    allowed = [
        cell.cell_contents
        for entry in getattr(fields.get("resource"), "metadata", ())
        for cell in (getattr(getattr(entry, "func", None), "__closure__", None) or ())
        if isinstance(cell.cell_contents, tuple)
    ]
    words = allowed[0] if allowed else (str(device.example.get("resource", "")),)
    return [told for word, told in _RESOURCES if any(str(w).startswith(word) for w in words)]


def _source(facts: ModuleType | None) -> str:
    """Return what the facts say of where they are from."""
    text = " ".join(prose(facts).split()) if facts is not None else ""
    for word in ("Sources: ", "Source: "):
        _, found, rest = text.partition(word)
        if found:
            return rest.rstrip(".")
    return ""
