"""One instrument of the registry on a simulated bench, over a real loopback socket, for the conformance suite.

The bench is the paper's with this instrument in its place, as its `Device.example` has it. What stands between the
wire and its simulation can be chosen: somebody else's instrument, nobody, one that takes another value.
"""

import copy
import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args

import yaml

from bench.config.bench_file.file import BenchFile, load_bench
from bench.config.devices.device import Device, Role
from bench.config.devices.registry import devices
from bench.config.devices.sections import MotorisedHeadForm
from bench.config.shipped import find_bench
from bench.model import ForwardModel
from bench.run.assembly.instruments import (
    Surroundings,
    instruments_of,
    operator_of,
    simulated_instruments,
    world_of,
)
from drivers.interfaces import VoltmeterSettings
from drivers.wire.visa import MessageSession
from sim.bench import SimulatedBench, SimulatedMeter
from sim.world.clock import VirtualClock
from sim.world.operator import ScriptedOperator
from sim.world.world import World

SEED = 1
SILENCE_S = 0.05
"""How long one is waited for that says nothing, s of real time."""


def known(role: Role | None = None, *, wired: bool = True) -> list[Device]:
    """Return the devices there are, plug-ins too: those of a role, those that have a wire."""
    every = [device for name in get_args(Role) for device in devices().of(name)]
    return [d for d in every if role in (None, d.role) and (d.simulation is not None or not wired)]


def turned_by(who: Literal["motor", "hand"]) -> list[Device]:
    """Return the heads with a wire that a motor turns, or that a person turns and an encoder reads."""
    return [d for d in known("head") if issubclass(d.section, MotorisedHeadForm) == (who == "motor")]


# --- what stands on the wire ------------------------------------------------------------------------


class Between:
    """A dialect in front of another; whatever it does not do itself the other does."""

    def __init__(self, dialect: Any) -> None:
        self._dialect = dialect

    def __getattr__(self, name: str) -> Any:
        return getattr(self._dialect, name)

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        reply: bytes | None = self._dialect.handle(message, interrupted)
        return reply


def answering(reply: bytes) -> type[Between]:
    """Return what answers everything alike, and is no instrument of a bench."""

    class Stranger(Between):
        def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
            return reply

    return Stranger


class Mute(Between):
    """An instrument that takes everything and never says a word."""

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        return None


def taking(wanted: str, instead: str) -> Callable[[Any], Between]:
    """Return what makes an instrument that takes one number in place of another, wherever it is sent."""
    number = re.compile(rf"(?<![\d.]){wanted}(?=\.0*(?!\d)|(?![\d.]))".encode())

    class Taking(Between):
        def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
            return super().handle(number.sub(instead.encode(), message), interrupted)

    return Taking


# --- the bench --------------------------------------------------------------------------------------


@cache
def _shipped() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(find_bench("paper-stand").read_text(encoding="utf-8"))
    return found


def bench_data(device: Device, **changes: Any) -> dict[str, Any]:
    """Return a bench file with a device in the place of its role; a meter with one signal stands three times."""
    data = copy.deepcopy(_shipped())
    section = {"driver": device.name, **copy.deepcopy(dict(device.example)), **changes}
    if device.role != "voltmeter":
        data["instruments"][device.role] = section
    elif "channels" not in section:
        data["instruments"]["voltmeters"] = [section]
    else:
        data["instruments"]["voltmeters"] = [
            {**section, "channels": [channel], "resource": _next_resource(section["resource"], further)}
            for further, channel in enumerate("xyz")
        ]
    if "noise" in device.simulated:
        data["simulation"]["voltmeter"] = {"noise": "no"}
    return data


def _next_resource(resource: str, further: int) -> str:
    """Return a resource with its last number but the port counted on."""
    match = re.fullmatch(r"(.*?)(\d+)(\D*(?:::\d+::SOCKET)?)", resource)
    assert match is not None, resource
    head, number, tail = match.groups()
    return f"{head}{int(number) + further}{tail}"


def written_bench(device: Device, folder: Path, **changes: Any) -> Path:
    """Write the bench file of a device; return where."""
    path = folder / f"{device.name}.yaml"
    # JSON is YAML, and written in a twentieth of the time
    path.write_text(json.dumps(bench_data(device, **changes)), encoding="utf-8")
    return path


@dataclass
class Stand:
    """The bench of a device: its driver and wire, what stands for it there, the world, what was sent to it."""

    device: Device
    bench: BenchFile
    world: World
    driver: Any
    session: MessageSession
    dialect: Any
    sent: list[str]
    served: SimulatedBench

    @contextmanager
    def expecting_nothing(self) -> Iterator[None]:
        """Wait but shortly for replies; a silence ends it."""
        patience_s, self.session.timeout_s = self.session.timeout_s, SILENCE_S
        try:
            yield
        finally:
            self.session.timeout_s = patience_s

    @property
    def section(self) -> Any:
        """The section of the driver in the bench file."""
        return next(section for section in self.bench.instruments.all() if section.name == self.driver.name)

    def settings(self, **changes: Any) -> VoltmeterSettings:
        """Return settings that the voltmeter can have: seven samples, if it takes so few."""
        limits = self.driver.limits
        samples = min(max(7, limits.least_samples), limits.most_samples)
        nplc = min(limits.nplc, key=lambda n: abs(n - 1.0))
        return replace(VoltmeterSettings(self.bench.voltmeter_range_v, nplc, samples), **changes)


@contextmanager
def standing(
    device: Device, folder: Path, between: Callable[[Any], Any] = Between, **changes: Any
) -> Iterator[Stand]:
    """Put the bench of a device together; nothing is opened. `changes` are of its section."""
    bench = load_bench(written_bench(device, folder, **changes))
    clock = VirtualClock()
    world = world_of(bench, ForwardModel(bench.installation_models()), SEED, clock)
    name = next(s.name for s in bench.instruments.all() if s.role == device.role)
    simulated = simulated_instruments(bench, world)
    stood = simulated[name]
    if isinstance(stood, SimulatedMeter):
        simulated[name] = replace(stood, make=lambda *a, make=stood.make, **k: between(make(*a, **k)))
    else:
        simulated[name] = between(stood)
    sent: list[str] = []

    def log(instrument: str, way: str, text: str) -> None:
        if (instrument, way) == (name, ">"):
            sent.append(text)

    with SimulatedBench(world, simulated) as served:
        given = Surroundings(
            ScriptedOperator(world, operator_of(bench)), clock, bench.line_frequency, log, served.resources
        )
        instruments = instruments_of(bench, given)
        driver = next(instrument for instrument in instruments.all() if instrument.name == name)
        try:
            yield Stand(
                device, bench, world, driver, given.sessions[name], served.dialects[name], sent, served
            )
        finally:
            driver.close()
