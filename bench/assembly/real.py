"""The drivers that a bench file names: one table for each kind of instrument, by the name of the driver."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from bench.devices.chambers import (
    ControlledChamberForm,
    EspecSection,
    ManualChamberSection,
    ThermotronSection,
    WatlowF4TSection,
)
from bench.devices.heads import AcutrolSection, ManualHeadSection, MotorisedHeadForm, ZaberSection
from bench.devices.voltmeters import Agilent34401ASection, Keysight34461ASection, Keysight34970ASection
from bench.files.bench.file import BenchFile
from bench.run.workbench import Instruments
from drivers.acutrol import driver as acutrol
from drivers.agilent_34401a.driver import Agilent34401A
from drivers.chambers import ChamberLimits
from drivers.clock import Clock
from drivers.espec import driver as espec
from drivers.interfaces import DividingHead, Person, ThermalChamber, Voltmeter
from drivers.keysight_34461a.driver import Keysight34461A
from drivers.keysight_34970a.driver import Keysight34970A
from drivers.manual.chamber import ManualChamber
from drivers.manual.head import ManualHead
from drivers.motion import Travel
from drivers.thermotron import driver as thermotron
from drivers.watlow_f4t import driver as watlow_f4t
from drivers.wire.visa import MessageSession, SerialSettings, Wire
from drivers.zaber import driver as zaber


@dataclass(frozen=True)
class Surroundings:
    """What drivers are given beside their own section.

    `resources` has by name the resources that are taken in place of those in the bench file.
    """

    person: Person
    clock: Clock
    line_hz: float
    wire: Wire | None = None
    resources: Mapping[str, str] | None = None

    def session(
        self,
        name: str,
        resource: str,
        timeout_s: float,
        *,
        serial: SerialSettings | None = None,
        read_termination: str = "\n",
        write_termination: str = "\n",
    ) -> MessageSession:
        """Return the message session of an instrument; nothing is opened."""
        return MessageSession(
            name,
            (self.resources or {}).get(name, resource),
            timeout_s=timeout_s,
            read_termination=read_termination,
            write_termination=write_termination,
            serial=serial,
            wire=self.wire,
        )


def instruments_of(bench: BenchFile, given: Surroundings) -> Instruments:
    """Make the drivers that a bench file names; nothing is opened yet."""
    sections = bench.instruments
    return Instruments(
        [VOLTMETER_DRIVERS[meter.driver](meter, given) for meter in sections.voltmeters],
        HEAD_DRIVERS[sections.head.driver](sections.head, given),
        None
        if sections.chamber is None
        else CHAMBER_DRIVERS[sections.chamber.driver](sections.chamber, given),
    )


# --- voltmeters -------------------------------------------------------------------------------------


def _agilent_34401a(section: Agilent34401ASection, given: Surroundings) -> Voltmeter:
    return Agilent34401A(
        section.name,
        section.channels[0],
        given.session(section.name, section.resource, section.timeout, serial=_meter_port(section)),
        given.clock,
        interface=section.interface,
        line_hz=given.line_hz,
    )


def _keysight_34461a(section: Keysight34461ASection, given: Surroundings) -> Voltmeter:
    return Keysight34461A(
        section.name,
        section.channels[0],
        given.session(section.name, section.resource, section.timeout),
        given.clock,
        interface=section.interface,
        line_hz=given.line_hz,
    )


def _keysight_34970a(section: Keysight34970ASection, given: Surroundings) -> Voltmeter:
    return Keysight34970A(
        section.name,
        section.inputs,
        given.session(section.name, section.resource, section.timeout, serial=_meter_port(section)),
        given.clock,
        interface=section.interface,
        line_hz=given.line_hz,
        channel_delay_s=section.channel_delay,
    )


def _meter_port(section: Agilent34401ASection | Keysight34970ASection) -> SerialSettings:
    """A meter with a parity sends 7 data bits, without one 8 (34401A User's Guide, chapter 4)."""
    serial = section.serial
    return SerialSettings(baud_rate=serial.baud_rate, parity=serial.parity, data_bits=serial.data_bits)


# --- heads ------------------------------------------------------------------------------------------


def _manual_head(section: ManualHeadSection, given: Surroundings) -> DividingHead:
    return ManualHead(section.name, given.person, tolerance_rad=section.tolerance)


def _travel(section: MotorisedHeadForm) -> Travel:
    return Travel(
        minimum_rad=section.minimum,
        maximum_rad=section.maximum,
        tolerance_rad=section.tolerance,
        speed_rad_s=section.speed,
        backoff_rad=section.backoff,
        settle_s=section.settle,
    )


def _zaber(section: ZaberSection, given: Surroundings) -> DividingHead:
    session = given.session(
        section.name,
        section.resource,
        section.timeout,
        serial=replace(zaber.SERIAL, baud_rate=section.serial.baud_rate),
        read_termination=zaber.READ_TERMINATION,
        write_termination=zaber.WRITE_TERMINATION,
    )
    return zaber.ZaberHead(
        section.name,
        session,
        given.clock,
        _travel(section),
        steps_per_degree=section.steps_per_degree,
        resolution=section.resolution,
        device=section.device,
        axis=section.axis,
        identity=section.identity,
        allow_homing=section.allow_homing,
        checksums=section.checksums,
    )


def _acutrol(section: AcutrolSection, given: Surroundings) -> DividingHead:
    session = given.session(
        section.name,
        section.resource,
        section.timeout,
        read_termination=acutrol.READ_TERMINATION,
        write_termination=acutrol.WRITE_TERMINATION,
    )
    return acutrol.AcutrolHead(
        section.name,
        session,
        given.clock,
        _travel(section),
        axis=section.axis,
        still_rad_s=section.still_rate,
    )


# --- chambers ---------------------------------------------------------------------------------------


def _manual_chamber(section: ManualChamberSection, given: Surroundings) -> ThermalChamber:
    return ManualChamber(
        section.name,
        given.person,
        minimum_c=section.minimum,
        maximum_c=section.maximum,
        safe_c=section.safe,
    )


def _limits(section: ControlledChamberForm) -> ChamberLimits:
    return ChamberLimits(section.minimum, section.maximum, section.band)


def _espec(section: EspecSection, given: Surroundings) -> ThermalChamber:
    session = given.session(
        section.name,
        section.resource,
        section.timeout,
        serial=replace(espec.SERIAL, baud_rate=section.serial.baud_rate),
        read_termination=espec.READ_TERMINATION,
        write_termination=espec.WRITE_TERMINATION,
    )
    return espec.EspecChamber(section.name, session, given.clock, _limits(section), identity=section.identity)


def _watlow_f4t(section: WatlowF4TSection, given: Surroundings) -> ThermalChamber:
    session = given.session(
        section.name,
        section.resource,
        section.timeout,
        read_termination=watlow_f4t.READ_TERMINATION,
        write_termination=watlow_f4t.WRITE_TERMINATION,
    )
    return watlow_f4t.WatlowF4TChamber(
        section.name,
        session,
        given.clock,
        _limits(section),
        loop=section.loop,
        output=section.output,
        safe_c=section.safe,
        identity=section.identity,
    )


def _thermotron(section: ThermotronSection, given: Surroundings) -> ThermalChamber:
    session = given.session(
        section.name,
        section.resource,
        section.timeout,
        serial=replace(thermotron.SERIAL, baud_rate=section.serial.baud_rate),
        read_termination=thermotron.READ_TERMINATION,
        write_termination=thermotron.WRITE_TERMINATION,
    )
    return thermotron.ThermotronChamber(
        section.name, session, given.clock, _limits(section), identity=section.identity
    )


# Each function takes the section of its own driver, which the name chose: the tables cannot say so.
VOLTMETER_DRIVERS: Final[Mapping[str, Callable[[Any, Surroundings], Voltmeter]]] = {
    "agilent-34401a": _agilent_34401a,
    "keysight-34461a": _keysight_34461a,
    "keysight-34970a": _keysight_34970a,
}
HEAD_DRIVERS: Final[Mapping[str, Callable[[Any, Surroundings], DividingHead]]] = {
    "manual-head": _manual_head,
    "zaber": _zaber,
    "acutrol": _acutrol,
}
CHAMBER_DRIVERS: Final[Mapping[str, Callable[[Any, Surroundings], ThermalChamber]]] = {
    "manual-chamber": _manual_chamber,
    "espec": _espec,
    "watlow-f4t": _watlow_f4t,
    "thermotron": _thermotron,
}
