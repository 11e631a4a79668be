"""The instruments of a bench: opening, identities, the block's temperature, and the safe state at the end."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final, Literal

from bench.base.languages import message
from bench.base.text import listed
from bench.run.driver_checks import checked_identity, checked_temperature, named_fault
from bench.run.events import EventType
from bench.run.person import NO, RunControl, Stopped, agree, ask
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
from drivers.person import ATTEMPTS, Person, Prompt, PromptKind


@dataclass(frozen=True)
class Instruments:
    """The instruments of a bench as the runner uses them. Each of x, y, z is measured by exactly one voltmeter.

    `around` maps each temperature column of the readings (meters, room) to its thermometer, or to "chamber" for the
    chamber's air. `opened` holds the names of the instruments opened so far; other instruments may be in use by
    another program.
    """

    voltmeters: Sequence[Voltmeter]
    head: DividingHead
    chamber: ThermalChamber | None = None
    level: interfaces.Level | None = None
    thermometer: interfaces.Thermometer | None = None
    power_supply: PowerSupply | None = None
    around: Mapping[str, interfaces.Thermometer | Literal["chamber"]] = field(default_factory=dict)
    opened: set[str] = field(default_factory=set)

    def all(self) -> list[Instrument]:
        """Return every instrument, in the order of opening."""
        further = (self.chamber, self.level, self.thermometer, self.power_supply, *self.around.values())
        return [
            *self.voltmeters,
            self.head,
            *(one for one in further if one is not None and one != "chamber"),
        ]

    def open(self) -> dict[str, Identity]:
        """Open all instruments; return their identities by name.

        Raises the `BenchError` of the instrument that fails, or `NotConnected` with all errors if several fail.
        """
        identities: dict[str, Identity] = {}
        failures: list[BenchError] = []
        for instrument in self.all():
            try:
                identities[instrument.name] = checked_identity(instrument, instrument.open())
                self.opened.add(instrument.name)
            except BenchError as error:
                failures.append(error)
            except Exception as error:
                if (fault := named_fault(error, [instrument])) is None:
                    raise
                failures.append(fault)
        if failures:
            raise failures[0] if len(failures) == 1 else NotConnected(failures)
        return identities


def same_serials(identities: Mapping[str, Identity]) -> list[str]:
    """Return a sentence for each serial number reported by several instruments of the same model.

    `identities` maps instrument names to identities.
    """
    names: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
    for name, identity in identities.items():
        if identity.serial.strip() not in NO_SERIAL:
            names[identity.model, identity.serial].append(name)
    return [
        f"{listed(alike)} state one serial number, {serial} ({model}): "
        "if they are one instrument, correct the addresses in the bench file"
        for (model, serial), alike in names.items()
        if len(alike) > 1
    ]


def agree_to_others(person: Person, before: Mapping[str, str], now: Mapping[str, str]) -> None:
    """Ask whether to continue if an instrument's identity differs from the recorded one.

    `before` (recorded) and `now` map instrument names to identities. Raises `BenchError` if the person disagrees.
    """
    changed = [
        message(f"{name} was {identity} and is now {now.get(name, 'gone')}")
        for name, identity in before.items()
        if now.get(name) != identity
    ]
    if changed:
        text = message(f"Other instruments than before: {'; '.join(changed)}. Continue with them?")
        agree(person, Prompt(id="identities", kind=PromptKind.CONFIRM, text=text, action={"do": "ask"}))


ROOM_C: Final = 23.0
ROOM_K: Final = 10.0
"""A room is expected within `ROOM_K` of `ROOM_C`, °C; so is a block whose chamber has no set point."""
UNEXPECTED_K: Final = 5.0
"""Deviation, K, above which a typed temperature is questioned: ten times the limit of a usual thermometer."""


@dataclass(frozen=True)
class TemperatureCheck:
    """Asks a person to confirm an entered temperature that is far from the expected one, °C.

    The expected temperature is `last_c`, the last one entered, or else the set point `demanded_c`, or else room
    temperature.
    """

    person: Person
    last_c: float | None = None
    demanded_c: float | None = None

    def __call__(self, read: Callable[[str], float], key: str) -> float:
        """Return the temperature that the person enters through `read`; ask again if the person takes it back.

        Raises `BenchError` if the person takes each of `ATTEMPTS` temperatures back, and the errors of `ask`.
        """
        for again in range(1, ATTEMPTS + 1):
            shown_c = read(key if again == 1 else f"{key}/again{again - 1}")
            question = self._question(shown_c)
            prompt = Prompt(
                id=f"{key}/right{again}",
                kind=PromptKind.CONFIRM,
                text=question,
                action={"do": "confirm_reading"},
            )
            if not question or ask(self.person, prompt).lower() not in NO:
                return shown_c
        raise BenchError(
            "operator",
            f"answered no several times to: {question}",
            "check the thermometer and its range in the bench file, then repeat this step",
        )

    def _question(self, shown_c: float) -> str:
        if self.last_c is not None:
            expected_c, within_k = self.last_c, UNEXPECTED_K
        elif self.demanded_c is not None:
            expected_c, within_k = self.demanded_c, UNEXPECTED_K
        else:
            expected_c, within_k = ROOM_C, ROOM_K
        off_k = abs(shown_c - expected_c)
        if off_k <= within_k:
            return ""
        if self.last_c is not None:
            return message(
                f"{shown_c:g} °C: {off_k:.3g} °C from the {expected_c:g} °C read before. Is that right?"
            )
        if self.demanded_c is not None:
            return message(f"{shown_c:g} °C: {off_k:.3g} °C from the {expected_c:g} °C set. Is that right?")
        return message(
            f"{shown_c:g} °C: {off_k:.3g} °C from the {expected_c:g} °C of a usual room. Is that right?"
        )


def _thermometer_c(thermometer: interfaces.Thermometer, key: str) -> float:
    return checked_temperature(thermometer, "block_c", thermometer.block_c(key))


def _chamber_c(chamber: ThermalChamber, key: str) -> float:
    return checked_temperature(chamber, "temperature", chamber.temperature(key))


def told_at_mounting(instruments: Instruments, key: str, check: TemperatureCheck) -> float | None:
    """Return the block's temperature, °C, that a person enters at a mounting; None if no person enters it.

    `check` asks about an unexpected temperature. Raises `BenchError`.
    """
    chamber, thermometer = instruments.chamber, instruments.thermometer
    if thermometer is not None:
        return check(partial(_thermometer_c, thermometer), key) if thermometer.asks_person else None
    return check(partial(_chamber_c, chamber), key) if chamber is not None and chamber.asks_person else None


def told_at_reading(
    instruments: Instruments, known_c: float | None, key: str, check: TemperatureCheck
) -> tuple[float | None, float | None]:
    """Return the temperatures of block and chamber air, °C; None for a temperature that is not measured.

    Without a thermometer, the temperature of the chamber's air counts as the block's, and the second value is None.
    A person is asked for the block's temperature only if `known_c` is None; `check` asks about an unexpected one.
    Raises `BenchError`.
    """
    chamber, thermometer = instruments.chamber, instruments.thermometer
    shown_c = _chamber_c(chamber, key) if chamber is not None and not chamber.asks_person else None
    if thermometer is not None and not thermometer.asks_person:
        return _thermometer_c(thermometer, key), shown_c
    if thermometer is None and shown_c is not None:
        return shown_c, None
    return told_at_mounting(instruments, key, check) if known_c is None else known_c, shown_c


def told_around(
    instruments: Instruments,
    known: Mapping[str, float],
    air_c: float | None,
    key: str,
    check: Callable[[str], TemperatureCheck],
) -> dict[str, float]:
    """Return the temperatures of meters and room, °C, by column; `air_c` is the chamber's air, if known.

    `known` holds values already entered in this mounting; a person is not asked for them again. `check(column)`
    returns the check of a temperature that a person enters for that column. Raises `BenchError`.
    """

    def told(column: str, by: interfaces.Thermometer) -> float:
        if not by.asks_person:
            return _thermometer_c(by, key)
        return known[column] if column in known else check(column)(partial(_thermometer_c, by), key)

    by_column = {
        column: air_c if by == "chamber" else told(column, by) for column, by in instruments.around.items()
    }
    return {column: shown_c for column, shown_c in by_column.items() if shown_c is not None}


def leave_safe(
    instruments: Instruments, demanded_c: float | None, power: UnitPower | None = None
) -> dict[str, str]:
    """Leave the block in its safe state, set the chamber to its safe setting, and close all instruments.

    `power` controls the block's supply; None if the run controls none. A block that this run has switched, or found
    on and taken over, is switched off unless the bench file says `when_unsafe = "stay-on"`; any other block keeps
    its state. Only an opened chamber is set: another program may be using a chamber that this run has not opened.
    `demanded_c` is the last set point, °C, or None. Closing stops the head and returns meters to local operation.
    Returns the remaining manual tasks, keyed by instrument name.
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
        message("could not be put into standby: if it still runs, switch it off by hand")
        if demanded_c is None
        else message(f"is still conditioning at {demanded_c:g} °C: switch it off by hand")
    )
    attempts = Attempts()
    attempts.make(by_hand, chamber.make_safe)
    return attempts.end()


def with_notes(error: BaseException) -> str:
    """Return the message of an error together with the notes added to it during shutdown."""
    return "; ".join(filter(None, (str(error), *getattr(error, "__notes__", ()))))


def how_it_stopped(cause: BaseException, wish: RunControl | None) -> tuple[EventType, dict[str, str]]:
    """Return type and data of the event that records why a run stopped.

    An `Exception` in `cause` is recorded as the failure of the run. Any other cause is recorded as an interruption,
    with the reason and author of the wish to stop, if there was one.
    """
    if isinstance(cause, Exception):
        instrument = cause.instrument if isinstance(cause, BenchError) else ""
        return EventType.RUN_FAILED, {"error": with_notes(cause), "instrument": instrument}
    stop = cause.control if isinstance(cause, Stopped) else wish
    return EventType.RUN_INTERRUPTED, {} if stop is None else stop.reason_and_author()
