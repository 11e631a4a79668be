"""The search for instruments: resources that the interfaces offer, and what an addressed resource answers."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

from bench.base.arrays import CHANNELS
from bench.base.yaml_files import FileMistakes
from bench.config.devices.device import Device, Role, any_resource, is_serial
from bench.config.devices.registry import devices
from bench.config.devices.sections import VoltmeterForm
from bench.run.assembly.instruments import Surroundings, meter_of
from bench.run.assembly.served import held_instruments
from bench.run.workbench import QUICK_NPLC
from bench.services.errors import Refused
from bench.services.instruments import Nobody
from drivers.clock import SystemClock
from drivers.interfaces import BenchError, Identity, VoltmeterSettings
from drivers.making_safe import let_go
from drivers.wire.resources import discover
from drivers.wire.visa import MessageSession

ANSWERS_WITHIN_S: Final = 3.0
RANGE_V: Final = 10.0


@dataclass(frozen=True)
class FoundResource:
    """A resource of this computer: its kind (`what`) and, if it was asked, its identity or the failure.

    `driver` is the driver for the instrument, empty if none is known. For a voltmeter, `interface` is its
    interface and `shows` its reading.
    """

    resource: str
    what: str = ""
    identity: str = ""
    serial: str = ""
    driver: str = ""
    interface: str = ""
    shows: str = ""
    failure: str = ""

    def to_json(self) -> dict[str, str]:
        """Return the resource as members of JSON."""
        return asdict(self)


def offered() -> tuple[list[FoundResource], list[str]]:
    """Return the resources that interfaces list, and notes on unsearched interfaces; no resource is asked."""
    offer = discover()
    ports = [
        FoundResource(port.resource, f"serial port {port.device} {port.description}".rstrip())
        for port in offer.serial_ports
    ]
    return [*map(FoundResource, offer.resources), *ports], list(offer.notes)


def checked_resource(text: str) -> str:
    """Return the name of a resource unchanged. Raises `Refused` if `text` is not such a name."""
    try:
        return any_resource(text)
    except ValueError as mistake:
        raise Refused(str(mistake)) from mistake


def identified(resource: str, what: str = "") -> FoundResource:
    """Ask a resource for its identity, and read a voltmeter of a known kind once. Never raises `BenchError`."""
    try:
        identity = _identity(resource)
    except BenchError as error:
        return FoundResource(resource, what, failure=str(error).removeprefix(f"{resource}: "))
    device = _device_of(identity)
    driver = device.name if device else ""
    shows = failure = interface = ""
    if device is not None and device.role == "voltmeter":
        interface = _interface(resource)
        try:
            shows = _reading(device, resource)
        except (BenchError, FileMistakes, ValueError) as error:
            failure = str(error)
    return FoundResource(resource, what, str(identity), identity.serial, driver, interface, shows, failure)


def _identity(resource: str) -> Identity:
    session = MessageSession(resource, resource, timeout_s=ANSWERS_WITHIN_S, holding=held_instruments())
    try:
        session.open()
        parts = [part.strip() for part in session.query("*IDN?").split(",")]
    finally:
        session.close()
    return Identity(*[*parts, "", ""][:2], *parts[2:4])


def _device_of(identity: Identity) -> Device | None:
    roles: tuple[Role, ...] = ("voltmeter", "power_supply", "chamber")
    for role in roles:
        for device in devices().of(role):
            facts: Any = getattr(device.section, "facts", None)
            models = [*getattr(facts, "MEMORY_OF_MODEL", ()), *getattr(facts, "MODELS", ())]
            if identity.model in (*models, getattr(facts, "MODEL", None)):
                return device
    return None


def _reading(device: Device, resource: str) -> str:
    """Return one reading of a voltmeter on its 10 V range, and make it safe. Raises `BenchError`."""
    stated = {**device.example, "driver": device.name, "resource": resource}
    if "interface" in device.section.model_fields:
        stated["interface"] = _interface(resource)
    section = device.section.model_validate(stated)
    if not isinstance(section, VoltmeterForm):
        return ""
    meter = meter_of(section, Surroundings(Nobody(), SystemClock(), 50.0, holding=held_instruments()))
    try:
        meter.open()
        least = section.kind.limits.least_samples
        meter.configure(VoltmeterSettings(RANGE_V, QUICK_NPLC, least))
        meter.start()
        read = meter.fetch()
    finally:
        let_go(meter)
    known = {channel: samples[0] for channel, samples in read.items()}
    if len(known) == 1:
        return f"{next(iter(known.values())):+.6f} V"
    return ", ".join(f"{section.inputs_used[c]}: {known[c]:+.6f} V" for c in CHANNELS if c in known)  # type: ignore[index]


def _interface(resource: str) -> str:
    if is_serial(resource):
        return "rs232"
    return "gpib" if resource.startswith(("GPIB", "PRLGX", "prologix")) else "lan"
