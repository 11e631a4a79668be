"""The composition root: the only module that knows both the drivers and the simulation.

A real bench is drivers on the resources of the bench file and a person at the terminal; a dry run is the
very same drivers on resources that lead to simulated instruments, a scripted operator and a virtual clock.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

from bench.bench_file import BenchFile
from bench.bench_instruments import SerialSection
from bench.model import ForwardModel
from bench.record import Event
from bench.runner import Instruments, Observer
from drivers.agilent_34401a import Agilent34401A
from drivers.clock import Clock, SystemClock
from drivers.interfaces import Person, ThermalChamber
from drivers.manual_chamber import ManualChamber
from drivers.manual_head import ManualHead
from drivers.visa import MessageSession, SerialSettings, Wire
from sim.bench import SimulatedBench, SimulatedMeter
from sim.clock import VirtualClock
from sim.operator import OperatorSettings, ScriptedOperator
from sim.world import World, WorldSettings


@dataclass(frozen=True)
class Assembly:
    """A bench put together: instruments, who answers prompts, the clock, and who watches the run."""

    instruments: Instruments
    person: Person
    clock: Clock
    observers: tuple[Observer, ...] = ()
    at_resumed_time: Callable[[float], None] | None = None


def real_bench(bench: BenchFile, person: Person, wire: Wire | None = None) -> Assembly:
    """Put the bench of a bench file together; nothing is opened yet."""
    clock = SystemClock()
    resources = {meter.name: meter.resource for meter in bench.instruments.voltmeters}
    return Assembly(_instruments(bench, resources, person, clock, wire), person, clock)


@contextmanager
def dry_bench(
    bench: BenchFile, model: ForwardModel, seed: int, wire: Wire | None = None
) -> Iterator[Assembly]:
    """Put a simulated bench together: the bench file's stand and block as truth, `model` with its effects."""
    clock = VirtualClock()
    world = World(
        WorldSettings(
            block=bench.simulated_block(),
            model=model,
            stand=bench.stand_distributions(),
            seed=seed,
            ambient_c=bench.simulation.ambient_temperature,
        ),
        clock,
    )
    operator = ScriptedOperator(world, _operator(bench))

    def key_world(event: Event) -> None:
        """Tell the world which step goes on, so that its random numbers belong to the step."""
        if event.type == "step_started":
            world.begin_step(str(event.data["key"]))

    with SimulatedBench(world, _meters(bench)) as simulated:
        instruments = _instruments(bench, simulated.resources, operator, clock, wire)
        yield Assembly(instruments, operator, clock, (key_world,), clock.advance_to)


def _instruments(
    bench: BenchFile, resources: Mapping[str, str], person: Person, clock: Clock, wire: Wire | None
) -> Instruments:
    """Make the drivers that a bench file names, on these resources."""
    sections = bench.instruments
    meters = [
        Agilent34401A(
            meter.name,
            meter.channels[0],
            MessageSession(
                meter.name,
                resources[meter.name],
                timeout_s=meter.timeout,
                serial=_serial(meter.serial),
                wire=wire,
            ),
            clock,
            interface=meter.interface,
            line_hz=bench.line_frequency,
        )
        for meter in sections.voltmeters
    ]
    head = ManualHead(sections.head.name, person, tolerance_rad=sections.head.tolerance)
    chamber: ThermalChamber | None = None
    if sections.chamber is not None:
        held = sections.chamber
        chamber = ManualChamber(held.name, person, minimum_c=held.minimum, maximum_c=held.maximum)
    return Instruments(meters, head, chamber)


def _serial(section: SerialSection) -> SerialSettings:
    """A 34401A with a parity sends 7 data bits, without one 8 (User's Guide, chapter 4)."""
    return SerialSettings(
        baud_rate=section.baud_rate,
        parity=section.parity,
        data_bits=8 if section.parity == "none" else 7,
    )


def _operator(bench: BenchFile) -> OperatorSettings:
    told = bench.simulation.operator
    return OperatorSettings(
        setting_deviation_rad=told.setting_deviation,
        resolution_rad=told.resolution,
        turn_time_s=(told.turn_time[0], told.turn_time[1]),
        mount_time_s=told.mount_time,
        slip_probability=told.slip_probability,
    )


def _meters(bench: BenchFile) -> dict[str, SimulatedMeter]:
    told = bench.simulation.voltmeter
    return {
        meter.name: SimulatedMeter(
            channel=meter.channels[0],
            interface=meter.interface,
            noise=told.noise,
            accuracy=told.accuracy,
            line_hz=bench.line_frequency,
        )
        for meter in bench.instruments.voltmeters
    }
