"""The drivers that a bench file names, made as their sections say: of each role it is known what it is given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from bench.devices.chambers import ControlledChamberForm
from bench.devices.heads import MotorisedHeadForm
from bench.devices.levels import LevelForm
from bench.devices.registry import devices
from bench.devices.supplies import WiredSupplyForm
from bench.devices.voltmeters import VoltmeterForm
from bench.devices.wires import WiredForm
from bench.files.bench.file import BenchFile
from bench.files.bench.instruments import InstrumentForm, InstrumentsSection
from bench.run.workbench import Instruments
from drivers.chambers import ChamberLimits
from drivers.clock import Clock
from drivers.interfaces import BenchError, Person
from drivers.motion import Travel
from drivers.wire.haste import Haste
from drivers.wire.holding import Holding
from drivers.wire.visa import MessageSession, SerialSettings, Wire


@dataclass(frozen=True)
class Surroundings:
    """What drivers are given beside their own section.

    `resources` has by name the resources that are taken in place of those in the bench file; `haste` tells
    when instruments that do not answer are waited for no longer. What is opened is held by `holding`; `sessions`
    takes up the sessions that are made, by the names of their instruments.
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
        """Return the message session of an instrument; nothing is opened."""
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
    """Make the drivers that a bench file names; nothing is opened yet.

    Raises `BenchError` for a driver that cannot be loaded.
    """
    sections = bench.instruments
    meters = [_driver(meter, given) for meter in sections.voltmeters]
    return Instruments(
        meters,
        _driver(sections.head, given),
        None if sections.chamber is None else _driver(sections.chamber, given),
        None if sections.level is None else _driver(sections.level, given),
        _thermometer(sections, meters, given),
        None if sections.power_supply is None else _driver(sections.power_supply, given),
    )


def loaded_class(section: InstrumentForm, which: Literal["driver", "simulation"]) -> Any:
    """Return the class of a section's driver or simulation. Raises `BenchError` where it cannot be loaded."""
    device = devices().get(section.driver)
    if device is None:
        raise BenchError(
            section.name, f"no driver '{section.driver}' is here", "name its folder with --devices"
        )
    try:
        return device.class_of(which)
    except Exception as error:
        cause = f"the {which} {getattr(device, which)} cannot be loaded ({type(error).__name__}: {error})"
        raise BenchError(section.name, cause, "mend it, then start again") from error


def _thermometer(sections: InstrumentsSection, meters: Sequence[Any], given: Surroundings) -> Any:
    """Return the driver of the thermometer; beside the signals it speaks over the voltmeter's session."""
    section = sections.thermometer
    if section is None:
        return None
    driver, options = loaded_class(section, "driver"), section.driver_options()
    if not isinstance(section, WiredForm):
        return driver(section.name, given.person, **options)
    options["line_hz"] = given.line_hz
    beside = sections.meter_of_thermometer
    if beside is None:
        return driver(section.name, given.session(section.name, section), given.clock, **options)
    options |= {"interface": beside.interface, "meter": meters[sections.voltmeters.index(beside)]}
    return driver(section.name, given.sessions[beside.name], given.clock, **options)


def _driver(section: InstrumentForm, given: Surroundings) -> Any:
    driver, options = loaded_class(section, "driver"), section.driver_options()
    if not isinstance(section, WiredForm):
        return driver(section.name, given.person, **options)
    session = given.session(section.name, section)
    if isinstance(section, VoltmeterForm):
        options |= {"interface": section.interface, "line_hz": given.line_hz}
        return driver(section.name, section.inputs_used, session, given.clock, **options)
    if isinstance(section, MotorisedHeadForm):
        return driver(section.name, session, given.clock, Travel(**section.travel()), **options)
    if isinstance(section, ControlledChamberForm):
        return driver(section.name, session, given.clock, ChamberLimits(*section.limits()), **options)
    if isinstance(section, WiredSupplyForm | LevelForm):
        return driver(section.name, session, given.clock, **options)
    raise TypeError(f"{type(section).__name__} has a wire, but the form of no role")
