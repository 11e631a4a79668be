"""The instruments of a bench: opened, told apart, asked for the block's temperature, left safe."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from bench.base.text import listed
from bench.run.events import EventType
from bench.run.person import RunControl, Stopped, agree
from bench.run.power import UnitPower
from drivers import interfaces
from drivers.interfaces import (
    NO_SERIAL,
    BenchError,
    DividingHead,
    Identity,
    Instrument,
    NotConnected,
    PowerSupply,
    ThermalChamber,
    Voltmeter,
)
from drivers.making_safe import Attempts, let_go
from drivers.person import Person, Prompt, PromptKind


@dataclass(frozen=True)
class Instruments:
    """The instruments of a bench as the runner sees them. Together the voltmeters carry x, y, z once each.

    `opened` are the names of the instruments that were opened: another program may be using the others.
    """

    voltmeters: Sequence[Voltmeter]
    head: DividingHead
    chamber: ThermalChamber | None = None
    level: interfaces.Level | None = None
    thermometer: interfaces.Thermometer | None = None
    power_supply: PowerSupply | None = None
    opened: set[str] = field(default_factory=set)

    def all(self) -> list[Instrument]:
        """Every instrument, in the order in which they are opened."""
        further = (self.chamber, self.level, self.thermometer, self.power_supply)
        return [*self.voltmeters, self.head, *(one for one in further if one is not None)]

    def open(self) -> dict[str, Identity]:
        """Open all instruments; return the identities by name. Raises the errors of all failures together."""
        identities: dict[str, Identity] = {}
        failures: list[BenchError] = []
        for instrument in self.all():
            try:
                identities[instrument.name] = instrument.open()
                self.opened.add(instrument.name)
            except BenchError as error:
                failures.append(error)
        if failures:
            raise failures[0] if len(failures) == 1 else NotConnected(failures)
        return identities


def same_serials(identities: Mapping[str, Identity]) -> list[str]:
    """Return a sentence for each serial number that several instruments of one model state.

    `identities` are by name.
    """
    names: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
    for name, identity in identities.items():
        if identity.serial.strip() not in NO_SERIAL:
            names[identity.model, identity.serial].append(name)
    return [
        f"{listed(alike)} state one serial number, {serial} ({model}): "
        "if that is one instrument, the addresses in the bench file are wrong"
        for (model, serial), alike in names.items()
        if len(alike) > 1
    ]


def agree_to_others(person: Person, before: Mapping[str, str], now: Mapping[str, str]) -> None:
    """Ask before going on with other instruments than those at the start; identities are by name."""
    changed = [
        f"{name} was {identity} and is now {now.get(name, 'gone')}"
        for name, identity in before.items()
        if now.get(name) != identity
    ]
    if changed:
        text = f"Other instruments than before: {'; '.join(changed)}. Go on with them?"
        agree(person, Prompt(id="identities", kind=PromptKind.CONFIRM, text=text, action={"do": "ask"}))


def told_at_mounting(instruments: Instruments, key: str) -> float | None:
    """Return the temperature that a person gives, °C; None where nobody is asked. Raises `BenchError`."""
    chamber, thermometer = instruments.chamber, instruments.thermometer
    if thermometer is not None:
        return thermometer.block_c(key) if thermometer.asks_person else None
    return chamber.temperature(key) if chamber is not None and chamber.asks_person else None


def told_at_reading(
    instruments: Instruments, known_c: float | None, key: str
) -> tuple[float | None, float | None]:
    """Return the temperatures of the block and, if it has its own thermometer, of the chamber's air, °C.

    A person is asked once after each mounting and each new temperature; later the block's is `known_c`.
    Raises `BenchError`.
    """
    chamber, thermometer = instruments.chamber, instruments.thermometer
    by_controller = chamber is not None and not chamber.asks_person
    if thermometer is not None:
        air_c = chamber.temperature(key) if chamber is not None and by_controller else None
        asked = known_c is None or not thermometer.asks_person
        return thermometer.block_c(key) if asked else known_c, air_c
    if chamber is not None and (known_c is None or by_controller):
        return chamber.temperature(key), None
    return known_c, None


def leave_safe(
    instruments: Instruments, demanded_c: float | None, power: UnitPower | None = None
) -> dict[str, str]:
    """Leave the block in its safe state, set the chamber to its safe setting, close all instruments.

    A head then stops, and a meter returns to local operation. A chamber that was not opened is left as it is,
    because another program may use it; so is a block that this run has not switched. `demanded_c` is the
    chamber's last set point, None where there was none. Returns the tasks left for a person, by instrument.
    """
    to_do = {}
    if power is not None and (note := power.leave()):
        to_do[power.supply.name] = note
    chamber = instruments.chamber
    opened = chamber is not None and chamber.name in instruments.opened
    if chamber is not None and opened and (note := _standby(chamber, demanded_c)):
        to_do[chamber.name] = note
    for instrument in instruments.all():
        if trouble := let_go(instrument):
            to_do[instrument.name] = "; ".join(filter(None, (to_do.get(instrument.name), trouble)))
    return to_do


def _standby(chamber: ThermalChamber, demanded_c: float | None) -> str:
    by_hand = (
        "could not be put into standby: where it conditions, switch it off by hand"
        if demanded_c is None
        else f"goes on conditioning at {demanded_c:g} °C: switch it off by hand"
    )
    attempts = Attempts()
    attempts.make(by_hand, chamber.make_safe)
    return attempts.end()


def with_notes(error: BaseException) -> str:
    """Return the sentence of an error, with the notes added to it on the way out."""
    return "; ".join(filter(None, (str(error), *getattr(error, "__notes__", ()))))


def how_it_stopped(cause: BaseException, wish: RunControl | None) -> tuple[EventType, dict[str, str]]:
    """Return the event for the stop of a run; `wish` is the wish to stop that interrupted it, if any."""
    if isinstance(cause, Exception):
        instrument = cause.instrument if isinstance(cause, BenchError) else ""
        return EventType.RUN_FAILED, {"error": with_notes(cause), "instrument": instrument}
    stop = cause.control if isinstance(cause, Stopped) else wish
    return EventType.RUN_INTERRUPTED, {} if stop is None else stop.told()
