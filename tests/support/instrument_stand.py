"""One registered instrument on a simulated bench, over a real loopback socket, for the conformance suite.

The bench is the paper's, with this instrument configured as in its `Device.example`. A `Between` can disturb
the simulation: another maker's replies, no replies, a changed number.
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

import pytest
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
    """Return the devices of a role (None: all), also plug-ins; by default only those with a wire."""
    every = [device for name in get_args(Role) for device in devices().of(name)]
    return [d for d in every if role in (None, d.role) and (d.simulation is not None or not wired)]


def turned_by(who: Literal["motor", "hand"]) -> list[Device]:
    """Return the wired heads that a motor turns, or those that a person turns and an encoder reads."""
    return [d for d in known("head") if issubclass(d.section, MotorisedHeadForm) == (who == "motor")]


# --- what stands on the wire ------------------------------------------------------------------------


class Between:
    """A dialect in front of another, to which it passes on whatever a subclass does not handle."""

    def __init__(self, dialect: Any) -> None:
        self._dialect = dialect

    def __getattr__(self, name: str) -> Any:
        return getattr(self._dialect, name)

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        reply: bytes | None = self._dialect.handle(message, interrupted)
        return reply


def answering(reply: bytes) -> type[Between]:
    """Return a class whose instruments give one reply to everything, unlike any instrument of a bench."""

    class Stranger(Between):
        def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
            return reply

    return Stranger


class Cutting(Between):
    """An instrument whose replies lose their last three characters while `cut`; shorter ones stay whole."""

    cut = False

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        reply = super().handle(message, interrupted)
        return reply[:-3] if self.cut and reply is not None and len(reply) > 3 else reply


class Mute(Between):
    """An instrument that accepts every message and never replies."""

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        return None


def taking(wanted: str, instead: str) -> Callable[[Any], Between]:
    """Return a class whose instruments take the number `wanted` in any message as the number `instead`."""
    number = re.compile(rf"(?<![\d.]){wanted}(?=\.0*(?!\d)|(?![\d.]))".encode())

    class Taking(Between):
        def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
            return super().handle(number.sub(instead.encode(), message), interrupted)

    return Taking


def skip_if_own(device: Device, why: str) -> None:
    """Skip the test for a user's own device, on which its fault cannot act; a shipped device must not get here."""
    assert devices().origin(device.name) is not None, why
    pytest.skip(why)


# --- the bench --------------------------------------------------------------------------------------


@cache
def _shipped() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(find_bench("paper-stand").read_text(encoding="utf-8"))
    return found


def bench_data(device: Device, **changes: Any) -> dict[str, Any]:
    """Return a bench file's data with a device in its role; a meter with one signal is entered thrice."""
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
    """Return a resource whose last number, the port excepted, is increased by `further`."""
    match = re.fullmatch(r"(.*?)(\d+)(\D*(?:::\d+::SOCKET)?)", resource)
    assert match is not None, resource
    head, number, tail = match.groups()
    return f"{head}{int(number) + further}{tail}"


def written_bench(device: Device, folder: Path, **changes: Any) -> Path:
    """Write the bench file of a device; return its path."""
    path = folder / f"{device.name}.yaml"
    # JSON is YAML, and written in a twentieth of the time
    path.write_text(json.dumps(bench_data(device, **changes)), encoding="utf-8")
    return path


@dataclass
class Stand:
    """The bench of a device: its driver, session and simulated dialect, the world, the messages sent."""

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
        """Within the context, wait only `SILENCE_S` for a reply, because none is expected."""
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
        """Return settings that the voltmeter supports: seven samples, or the nearest number that it takes."""
        limits = self.driver.limits
        samples = min(max(7, limits.least_samples), limits.most_samples)
        nplc = min(limits.nplc, key=lambda n: abs(n - 1.0))
        return replace(VoltmeterSettings(self.bench.voltmeter_range_v, nplc, samples), **changes)


@contextmanager
def standing(
    device: Device, folder: Path, between: Callable[[Any], Any] = Between, **changes: Any
) -> Iterator[Stand]:
    """Assemble a device's bench, unopened; `between` wraps its simulation, `changes` alter its section."""
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
