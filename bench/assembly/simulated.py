"""The simulated bench of a bench file: its world, and what stands there for each instrument that has a wire."""

from __future__ import annotations

from typing import Any

from bench.assembly.real import loaded_class
from bench.devices.keysight_34970a_thermometer import Keysight34970AThermometerSection
from bench.devices.thermometers import ThermometerForm
from bench.devices.voltmeters import VoltmeterForm
from bench.devices.wires import WiredForm, is_serial
from bench.files.bench.file import BenchFile
from bench.model import ForwardModel
from drivers.clock import Clock
from sim.bench import SimulatedMeter
from sim.keysight_34970a.probe import Probe
from sim.wires.faults import Fault
from sim.wires.session import Dialect
from sim.world.levelling import LevelSettings
from sim.world.operator import OperatorSettings
from sim.world.rails import PowerSettings, Rail
from sim.world.world import World, WorldSettings


def world_of(bench: BenchFile, model: ForwardModel, seed: int, clock: Clock) -> World:
    """Make the world of a bench file: its stand and block as truth, `model` with its effects."""
    truth = bench.simulation
    settings = WorldSettings(
        block=bench.simulated_block(),
        model=model,
        stand=bench.stand_distributions(),
        seed=seed,
        ambient_c=truth.ambient_temperature,
        chamber_rate_c_s=truth.chamber.rate,
        chamber_lag_s=truth.chamber.lag,
        chamber_off_lag_s=truth.chamber.off_lag,
        power=power_of(bench),
        level=LevelSettings(
            truth.level.zero_along, truth.level.zero_across, truth.level.noise, truth.level.scale
        ),
    )
    return World(settings, clock)


def power_of(bench: BenchFile) -> PowerSettings:
    """Return what the simulated block takes from the supply of the bench: nothing where it has none."""
    truth, feed = bench.simulation.power_supply, bench.unit_under_test.supply
    if feed is None or bench.instruments.power_supply is None:
        return PowerSettings()
    rails = [
        Rail(
            name=rail.name,
            output=rail.output,
            nominal_v=rail.voltage,
            working_v=_span(
                truth.brown_out * rail.voltage, max(rail.limits.minimum, rail.limits.maximum, key=abs)
            ),
            absolute_v=(rail.limits.minimum, rail.limits.maximum),
            current_a=(rail.current.minimum + rail.current.maximum) / 2.0
            if truth.current is None
            else truth.current,
            absolute_a=rail.limits.current,
        )
        for rail in feed.rails
    ]
    return PowerSettings(
        tuple(rails),
        current_by_temperature=truth.current_by_temperature,
        in_rush=truth.in_rush,
        in_rush_time_s=truth.in_rush_time,
        dead_offset_v=truth.dead_offset,
        dead_noise_v=truth.dead_noise,
    )


def _span(one: float, other: float) -> tuple[float, float]:
    return min(one, other), max(one, other)


def operator_of(bench: BenchFile) -> OperatorSettings:
    """Return how the person at the simulated bench works."""
    operator = bench.simulation.operator
    return OperatorSettings(
        setting_deviation_rad=operator.setting_deviation,
        resolution_rad=operator.resolution,
        turn_time_s=(operator.turn_time[0], operator.turn_time[1]),
        mount_time_s=operator.mount_time,
        slip_probability=operator.slip_probability,
    )


def simulated_instruments(bench: BenchFile, world: World) -> dict[str, Dialect | SimulatedMeter]:
    """Return by name what stands for each instrument with a wire; for one that a person works there is none.

    Raises `BenchError` for a simulation that cannot be loaded.
    """
    simulated: dict[str, Dialect | SimulatedMeter] = {}
    beside = bench.instruments.meter_of_thermometer
    for section in bench.instruments.all():
        if section.by_hand or (isinstance(section, ThermometerForm) and beside is not None):
            continue
        make: Any = loaded_class(section, "simulation")
        options = section.simulation_options(getattr(bench.simulation, section.role))
        if isinstance(section, VoltmeterForm):
            options["line_hz"] = bench.line_frequency
            probes = {} if section is not beside else _probes(bench, world)
            simulated[section.name] = SimulatedMeter(make, section.inputs_used, options, probes)
        else:
            simulated[section.name] = make(world, **options)
    return simulated


def _probes(bench: BenchFile, world: World) -> dict[int, Probe]:
    """Return the sensor that is wired to the voltmeter with the signals, by its channel."""
    section = bench.instruments.thermometer
    truth = bench.simulation.thermometer
    if not isinstance(section, Keysight34970AThermometerSection):
        return {}
    own = {"error_c": truth.error, "noise_c": truth.noise, "air_share": truth.air_share}
    return {section.channel: Probe(world, section.sensor, **own)}


def buses_of(bench: BenchFile) -> dict[str, dict[str, int]]:
    """Return by the name of each GPIB adapter the instruments behind it with their addresses."""
    buses: dict[str, dict[str, int]] = {name: {} for name in bench.instruments.adapters.values()}
    for section in bench.instruments.all():
        if isinstance(section, WiredForm) and section.place is not None:
            buses[bench.instruments.adapters[section.place.adapter]][section.name] = section.place.address
    return buses


def on_terminals(bench: BenchFile) -> tuple[str, ...]:
    """Return the names of the instruments whose serial port a pseudo-terminal can stand for.

    That is one with 8 data bits: pyvisa-py cannot set 7 on a pseudo-terminal, which knows neither.
    """
    return tuple(
        section.name
        for section in bench.instruments.all()
        if isinstance(section, WiredForm)
        and is_serial(section.resource)
        and getattr(getattr(section, "serial", None), "data_bits", 8) == 8
    )


def faults_of(bench: BenchFile) -> list[Fault]:
    """Return the faults of the bench file."""
    return [Fault.parse(fault.to_plain()) for fault in bench.simulation.faults]
