"""Construction of the drivers named in a bench file, and of their simulated counterparts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, cast

from bench.base.languages import message
from bench.config.bench_file.file import BenchFile
from bench.config.bench_file.sections import SURROUNDINGS, InstrumentForm, InstrumentsSection
from bench.config.devices.device import Role, WiredForm, is_serial
from bench.config.devices.manual import ManualThermometerSection
from bench.config.devices.registry import devices, why_not_loaded
from bench.config.devices.sections import (
    ControlledChamberForm,
    LevelForm,
    MotorisedHeadForm,
    ReadOutHeadForm,
    ThermometerForm,
    VoltmeterForm,
    WiredSupplyForm,
)
from bench.config.devices.voltmeters import Keysight34970AThermometerSection
from bench.model.forward import ForwardModel
from bench.run.instruments import Instruments
from drivers.chambers import ChamberLimits
from drivers.clock import Clock, Haste
from drivers.facts.keysight_34970a import CARD
from drivers.interfaces import (
    BenchError,
    DividingHead,
    Level,
    PowerSupply,
    ThermalChamber,
    Thermometer,
    Voltmeter,
)
from drivers.motion import Travel
from drivers.person import Person
from drivers.readout import Approach, ScaleOfEncoder
from drivers.wire.resources import Holding
from drivers.wire.visa import MessageSession, SerialSettings, Wire
from sim.bench import Elsewhere, SimulatedMeter
from sim.keysight_34970a import Probe
from sim.wires.faults import Fault
from sim.wires.session import Dialect
from sim.world.operator import OperatorSettings
from sim.world.pose import LevelSettings
from sim.world.power import PowerSettings, Rail
from sim.world.world import World, WorldSettings

PROTOCOLS: Final[dict[Role, type[Any]]] = {
    "voltmeter": Voltmeter,
    "head": DividingHead,
    "chamber": ThermalChamber,
    "level": Level,
    "thermometer": Thermometer,
    "power_supply": PowerSupply,
}
"""The protocol that the driver of each role has."""


def protocol_members(protocol: type[Any]) -> set[str]:
    """Return the names of the methods and attributes that a protocol demands."""
    stated = [base for base in protocol.__mro__ if getattr(base, "_is_protocol", False)]
    names = {name for base in stated for name in (*vars(base), *vars(base).get("__annotations__", ()))}
    return {name for name in names if not name.startswith("_")}


@dataclass(frozen=True)
class Surroundings:
    """What drivers need in addition to their bench file sections: person, clock, line frequency, wire log.

    `resources` maps instrument names to resources that replace those of the bench file. `haste` ends waits for
    instruments that do not respond. `holding` reserves the instruments that are opened. `sessions` collects the
    message sessions created, by instrument name.
    """

    person: Person
    clock: Clock
    line_hz: float
    wire: Wire | None = None
    resources: Mapping[str, str] | None = None
    haste: Haste | None = None
    holding: Holding | None = None
    sessions: dict[str, MessageSession] = field(default_factory=dict)

    def session(self, name: str, section: WiredForm) -> MessageSession:
        """Create and return the message session of an instrument without opening it."""
        port = section.port()
        self.sessions[name] = MessageSession(
            name,
            (self.resources or {}).get(name, section.resource),
            timeout_s=section.timeout,
            read_termination=port.read_termination,
            write_termination=port.write_termination,
            read_tail=port.read_tail,
            serial=None if port.serial is None else SerialSettings(**port.serial),
            wire=self.wire,
            haste=self.haste,
            holding=self.holding,
        )
        return self.sessions[name]


def instruments_of(bench: BenchFile, given: Surroundings) -> Instruments:
    """Return the drivers of the instruments in a bench file; nothing is opened yet.

    Raises `BenchError` for a driver that cannot be loaded.
    """
    sections = bench.instruments
    meters = [_driver(meter, given) for meter in sections.voltmeters]
    thermometers = _thermometers(sections, meters, given)
    around = {SURROUNDINGS[key]: thermometers[section.name] for key, section in sections.around.items()}
    in_chamber = {
        column: "chamber" for key, column in SURROUNDINGS.items() if getattr(sections, key) == "chamber"
    }
    return Instruments(
        meters,
        _driver(sections.head, given),
        None if sections.chamber is None else _driver(sections.chamber, given),
        None if sections.level is None else _driver(sections.level, given),
        None if sections.thermometer is None else thermometers[sections.thermometer.name],
        None if sections.power_supply is None else _driver(sections.power_supply, given),
        around | in_chamber,
    )


def meter_of(section: VoltmeterForm, given: Surroundings) -> Voltmeter:
    """Return the driver of a voltmeter, not opened yet. Raises `BenchError` if it cannot be loaded."""
    meter: Voltmeter = _driver(section, given)
    return meter


def loaded_class(section: InstrumentForm, which: Literal["driver", "simulation"]) -> Any:
    """Return the class of a section's driver or simulation. Raises `BenchError` if it cannot be loaded."""
    device = devices().get(section.driver)
    if device is None:
        raise BenchError(
            section.name, f"no driver '{section.driver}' is here", "name its folder with --devices"
        )
    try:
        return device.class_of(which)
    except Exception as error:
        why = why_not_loaded(error, Path(devices().origin(section.driver) or "built-in").parent)
        cause = message(f"the {which} {getattr(device, which)} cannot be loaded ({why})")
        raise BenchError(section.name, cause, f"correct the {which}") from error


def _thermometers(sections: InstrumentsSection, meters: Sequence[Any], given: Surroundings) -> dict[str, Any]:
    """Return the drivers of the thermometers by name; a sensor wired to an instrument uses its session."""
    made: dict[str, Any] = {meter.name: meter for meter in meters}
    of = {section.name: key.partition("_")[0] for key, section in sections.around.items()}
    for section in sections.thermometers:
        options = section.driver_options()
        if not isinstance(section, WiredForm):
            if isinstance(section, ManualThermometerSection) and section.name in of:
                options["of"] = of[section.name]
            made[section.name] = _made(section, given.person, **options)
            continue
        options["line_hz"] = given.line_hz
        beside = sections.beside(section)
        if beside is not None:
            options |= {"interface": getattr(beside, "interface", "lan"), "meter": made[beside.name]}
        session = given.session(section.name, section) if beside is None else given.sessions[beside.name]
        made[section.name] = _made(section, session, given.clock, **options)
    return made


def _driver(section: InstrumentForm, given: Surroundings) -> Any:
    options = section.driver_options()
    if not isinstance(section, WiredForm):
        return _made(section, given.person, **options)
    session, clock = given.session(section.name, section), given.clock
    if isinstance(section, VoltmeterForm):
        options |= {"interface": section.interface, "line_hz": given.line_hz}
        return _made(section, section.inputs_used, session, clock, **options)
    if isinstance(section, MotorisedHeadForm):
        return _made(section, session, clock, Travel(**section.travel()), **options)
    if isinstance(section, ReadOutHeadForm):
        options["scale"] = ScaleOfEncoder(**section.scale())
        return _made(section, session, clock, given.person, Approach(**section.approach()), **options)
    if isinstance(section, ControlledChamberForm):
        return _made(section, session, clock, ChamberLimits(*section.limits()), **options)
    if isinstance(section, WiredSupplyForm | LevelForm):
        return _made(section, session, clock, **options)
    raise TypeError(f"{type(section).__name__} has a wire, but no role of this bench uses it; remove it")


def _made(section: InstrumentForm, *given: Any, **options: Any) -> Any:
    """Return the driver of a section, with all methods of its protocol. Raises `BenchError` otherwise."""
    driver = loaded_class(section, "driver")
    try:
        made = driver(section.name, *given, **options)
    except BenchError:  # it refuses what the bench file states, and has its own remedy
        raise
    except Exception as error:
        cause = message(f"its driver cannot be made ({type(error).__name__}: {error})")
        raise BenchError(section.name, cause, f"correct {driver.__module__}") from error
    protocol = PROTOCOLS[section.role]
    if lacking := sorted(name for name in protocol_members(protocol) if not _has(made, name)):
        cause = message(f"its driver has no {', '.join(lacking)}")
        raise BenchError(
            section.name, cause, message(f"add what {protocol.__name__} in drivers/interfaces.py demands")
        )
    return made


def _has(made: object, name: str) -> bool:
    """Return whether a driver has a member; the class is asked first, as a property may need the instrument."""
    return hasattr(type(made), name) or hasattr(made, name)


def world_of(bench: BenchFile, model: ForwardModel, seed: int, clock: Clock) -> World:
    """Return the simulated world of a bench file with the effects of `model`; `seed` sets its random errors."""
    truth = bench.simulation
    settings = WorldSettings(
        block=bench.simulated_block(),
        model=model,
        stand=bench.stand_distributions(),
        seed=seed,
        ambient_c=truth.ambient_temperature,
        room_swing=(truth.room.swing, truth.room.period),
        meter_lag_s=truth.room.meter_lag,
        chamber_rate_c_s=truth.chamber.rate,
        chamber_lag_s=truth.chamber.lag,
        chamber_off_lag_s=truth.chamber.off_lag,
        chamber_ringing_s=truth.chamber.ringing,
        room_share=truth.chamber.room_share,
        power=power_of(bench),
        level=LevelSettings(
            truth.level.zero_along, truth.level.zero_across, truth.level.noise, truth.level.scale
        ),
    )
    return World(settings, clock)


def power_of(bench: BenchFile) -> PowerSettings:
    """Return the settings of the block's simulated supply; empty settings if the bench has no supply."""
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
    """Return the settings of the simulated bench's scripted operator."""
    operator = bench.simulation.operator
    return OperatorSettings(
        setting_deviation_rad=operator.setting_deviation,
        resolution_rad=operator.resolution,
        turn_time_s=(operator.turn_time[0], operator.turn_time[1]),
        mount_time_s=operator.mount_time,
        slip_probability=operator.slip_probability,
    )


def simulated_instruments(bench: BenchFile, world: World) -> dict[str, Dialect | SimulatedMeter]:
    """Return the simulations of the wired instruments by name; instruments operated by hand have none.

    Raises `BenchError` for a simulation that cannot be loaded.
    """
    simulated: dict[str, Dialect | SimulatedMeter] = {}
    given = bench.instruments
    for section in given.all():
        if section.by_hand or (isinstance(section, ThermometerForm) and given.beside(section) is not None):
            continue
        make: Any = loaded_class(section, "simulation")
        options = section.simulation_options(getattr(bench.simulation, section.role))
        if probes := _probes(bench, world, section):
            options["cards"] = options["cards"] | {100 * (number // 100): CARD for number in probes}
        if isinstance(section, VoltmeterForm):
            options["line_hz"] = bench.line_frequency
            simulated[section.name] = SimulatedMeter(make, section.inputs_used, options, probes)
            continue
        options |= {"probes": probes} if probes else {}
        simulated[section.name] = make(_seen_by(section, given, world), **options)
    return simulated


def _probes(bench: BenchFile, world: World, host: InstrumentForm) -> dict[int, Probe]:
    """Return the simulated sensors that are wired to the instrument `host`, by channel number."""
    given, truth = bench.instruments, bench.simulation.thermometer
    errors = {"error_c": truth.error, "noise_c": truth.noise, "air_share": truth.air_share}
    return {
        section.channel: Probe(_seen_by(section, given, world), section.sensor, **errors)
        for section in given.thermometers
        if isinstance(section, Keysight34970AThermometerSection)
        and host is (given.beside(section) or section)
    }


def _seen_by(section: InstrumentForm, given: InstrumentsSection, world: World) -> World:
    """Return the world that an instrument observes.

    A thermometer of the meters or the room observes a world whose block has the temperature of that place.
    """
    at = {"meter_thermometer": world.meters_c, "room_thermometer": world.room_c}
    key = next((key for key, around in given.around.items() if around is section), None)
    return world if key is None else cast(World, Elsewhere(world, at[key]))


def buses_of(bench: BenchFile) -> dict[str, dict[str, int]]:
    """Return the GPIB addresses of the instruments behind each adapter: adapter name -> {name: address}."""
    buses: dict[str, dict[str, int]] = {name: {} for name in bench.instruments.adapters.values()}
    for section in bench.instruments.all():
        if isinstance(section, WiredForm) and section.place is not None:
            buses[bench.instruments.adapters[section.place.adapter]][section.name] = section.place.address
    return buses


def on_terminals(bench: BenchFile) -> tuple[str, ...]:
    """Return the names of the instruments whose serial port a pseudo-terminal can replace.

    Only ports with 8 data bits qualify: pyvisa-py cannot set 7 data bits on a pseudo-terminal.
    """
    return tuple(
        section.name
        for section in bench.instruments.all()
        if isinstance(section, WiredForm)
        and is_serial(section.resource)
        and (section.port().serial or {}).get("data_bits", 8) == 8
    )


def faults_of(bench: BenchFile) -> list[Fault]:
    """Return the simulated faults of the bench file."""
    return [Fault.parse(fault.model_dump(exclude_none=True)) for fault in bench.simulation.faults]
