"""The simulated bench of a bench file: its world, and what stands there for each instrument that has a wire."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, Final

from bench.devices.chambers import EspecSection, ThermotronSection, WatlowF4TSection
from bench.devices.heads import AcutrolSection, ZaberSection
from bench.devices.voltmeters import Agilent34401ASection, Keysight34461ASection, Keysight34970ASection
from bench.devices.wires import is_serial
from bench.files.bench.file import BenchFile
from bench.files.bench.simulation import SimulationSection
from bench.model import ForwardModel
from drivers.clock import Clock
from sim.acutrol import AcutrolTable
from sim.bench import SimulatedMeter, SimulatedMultiplexer
from sim.espec import EspecP300
from sim.thermotron import Thermotron8800
from sim.watlow_f4t import WatlowF4T
from sim.wires.faults import Fault
from sim.wires.session import Dialect
from sim.world.operator import OperatorSettings
from sim.world.world import World, WorldSettings
from sim.zaber import ZaberStage

Meter = SimulatedMeter | SimulatedMultiplexer

_BEYOND_DEG: Final = 5.0
"""How far a stage can turn beyond the limits in the bench file, degrees."""


def world_of(bench: BenchFile, model: ForwardModel, seed: int, clock: Clock) -> World:
    """Make the world of a bench file: its stand and block as truth, `model` with its effects."""
    told = bench.simulation
    settings = WorldSettings(
        block=bench.simulated_block(),
        model=model,
        stand=bench.stand_distributions(),
        seed=seed,
        ambient_c=told.ambient_temperature,
        chamber_rate_c_s=told.chamber.rate,
        chamber_lag_s=told.chamber.lag,
        chamber_off_lag_s=told.chamber.off_lag,
    )
    return World(settings, clock)


def operator_of(bench: BenchFile) -> OperatorSettings:
    """Return how the person at the simulated bench works."""
    told = bench.simulation.operator
    return OperatorSettings(
        setting_deviation_rad=told.setting_deviation,
        resolution_rad=told.resolution,
        turn_time_s=(told.turn_time[0], told.turn_time[1]),
        mount_time_s=told.mount_time,
        slip_probability=told.slip_probability,
    )


def simulated_instruments(bench: BenchFile, world: World) -> dict[str, Dialect | Meter]:
    """Return by name what stands for each instrument with a wire; for one that a person works there is none."""
    sections = bench.instruments
    simulated: dict[str, Dialect | Meter] = {
        meter.name: VOLTMETERS[meter.driver](meter, bench.simulation, bench.line_frequency)
        for meter in sections.voltmeters
    }
    if (head := sections.head).driver in HEADS:
        simulated[head.name] = HEADS[head.driver](head, bench.simulation, world)
    if (chamber := sections.chamber) is not None and chamber.driver in CHAMBERS:
        simulated[chamber.name] = CHAMBERS[chamber.driver](chamber, bench.simulation, world)
    return simulated


def buses_of(bench: BenchFile) -> dict[str, dict[str, int]]:
    """Return by the name of each GPIB adapter the meters behind it with their addresses."""
    buses: dict[str, dict[str, int]] = {name: {} for name in bench.instruments.adapters.values()}
    for meter in bench.instruments.voltmeters:
        if meter.place is not None:
            buses[bench.instruments.adapters[meter.place.adapter]][meter.name] = meter.place.address
    return buses


def on_terminals(bench: BenchFile) -> tuple[str, ...]:
    """Return the names of the instruments whose serial port a pseudo-terminal can stand for.

    That is one with 8 data bits: pyvisa-py cannot set 7 on a pseudo-terminal, which knows neither.
    """
    sections = bench.instruments
    heated = [] if sections.chamber is None else [sections.chamber]
    names = []
    for section in (*sections.voltmeters, sections.head, *heated):
        resource, serial = getattr(section, "resource", ""), getattr(section, "serial", None)
        if is_serial(resource) and getattr(serial, "data_bits", 8) == 8:
            names.append(section.name)
    return tuple(names)


def faults_of(bench: BenchFile) -> list[Fault]:
    """Return the faults of the bench file."""
    return [Fault.parse(fault.to_plain()) for fault in bench.simulation.faults]


# --- what stands for each driver --------------------------------------------------------------------


def _agilent_34401a(section: Agilent34401ASection, told: SimulationSection, line_hz: float) -> Meter:
    return SimulatedMeter(
        section.channels[0], section.interface, told.voltmeter.noise, told.voltmeter.accuracy, line_hz
    )


def _keysight_34461a(section: Keysight34461ASection, told: SimulationSection, line_hz: float) -> Meter:
    return SimulatedMeter(
        section.channels[0],
        section.interface,
        told.voltmeter.noise,
        told.voltmeter.accuracy,
        line_hz,
        model="34461A",
    )


def _keysight_34970a(section: Keysight34970ASection, told: SimulationSection, line_hz: float) -> Meter:
    return SimulatedMultiplexer(
        section.inputs, section.interface, told.voltmeter.noise, told.voltmeter.accuracy, line_hz
    )


def _zaber(section: ZaberSection, told: SimulationSection, world: World) -> Dialect:
    device_id = {"device_id": int(section.identity)} if section.identity.isdecimal() else {}
    return ZaberStage(
        world,
        steps_per_degree=section.steps_per_degree,
        device=section.device,
        axis=section.axis,
        resolution=section.resolution,
        speed_deg_s=math.degrees(section.speed),
        lowest_deg=math.degrees(section.minimum) - _BEYOND_DEG,
        highest_deg=math.degrees(section.maximum) + _BEYOND_DEG,
        homed=told.head.homed,
        encoder=told.head.encoder,
        **device_id,
    )


def _acutrol(section: AcutrolSection, _told: SimulationSection, world: World) -> Dialect:
    return AcutrolTable(world, speed_deg_s=math.degrees(section.speed), axis=section.axis)


def _espec(section: EspecSection, told: SimulationSection, world: World) -> Dialect:
    return EspecP300(
        world,
        name=_as_stated(section.identity, "P300"),
        lowest_c=section.minimum,
        highest_c=section.maximum,
        noise_c=told.chamber.sensor_noise,
    )


def _watlow_f4t(section: WatlowF4TSection, _told: SimulationSection, world: World) -> Dialect:
    return WatlowF4T(
        world,
        loop=section.loop,
        output=1 if section.output is None else section.output,
        lowest_c=section.minimum,
        highest_c=section.maximum,
    )


def _thermotron(section: ThermotronSection, _told: SimulationSection, world: World) -> Dialect:
    return Thermotron8800(
        world,
        identity=_as_stated(section.identity, "8800 V3.12"),
        lowest_c=section.minimum,
        highest_c=section.maximum,
    )


def _as_stated(identity: str, default: str) -> str:
    """Return the identity of the bench file where it is a plain name and no pattern, else the simulation's own."""
    return identity if re.fullmatch(r"[\w -]+", identity) else default


# Each function takes the section of its own driver, which the name chose: the tables cannot say so.
VOLTMETERS: Final[Mapping[str, Callable[[Any, SimulationSection, float], Meter]]] = {
    "agilent-34401a": _agilent_34401a,
    "keysight-34461a": _keysight_34461a,
    "keysight-34970a": _keysight_34970a,
}
HEADS: Final[Mapping[str, Callable[[Any, SimulationSection, World], Dialect]]] = {
    "zaber": _zaber,
    "acutrol": _acutrol,
}
CHAMBERS: Final[Mapping[str, Callable[[Any, SimulationSection, World], Dialect]]] = {
    "espec": _espec,
    "watlow-f4t": _watlow_f4t,
    "thermotron": _thermotron,
}
