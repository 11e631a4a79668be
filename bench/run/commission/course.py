"""The course of a commissioning session: the order of the parts, and the check of every cable."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple, Protocol, runtime_checkable

from bench.base.languages import HEADING, message, translated
from bench.config.devices.device import WiredForm
from bench.config.devices.sections import ThermometerForm
from bench.run.commission import devices, meters
from bench.run.commission.meters import quick
from bench.run.commission.session import CommissioningSession, Figure, Finding, Skipped, State
from bench.run.instruments import same_serials
from drivers.interfaces import BenchError, Instrument, PowerSupply, ThermalChamber, Voltmeter

CABLE: Final = message("cable pulled")
AGAIN: Final = message("cable plugged in again")

TRIES: Final = 3
"""Attempts that a driver makes before it reports a lost connection; each takes a timeout and a reconnection."""
PATIENCE_S: Final = 30.0
"""Time within which a replugged network port or serial adapter must respond again, s."""
PAUSE_S: Final = 2.0


@runtime_checkable
class HasScale(Protocol):
    """A head that can report its angle without moving."""

    def position_rad(self) -> float:
        """Return the angle read back, rad."""
        ...


@dataclass(frozen=True)
class Cable:
    """A cable to be pulled: `text` describes it to a person, `instruments` are all instruments that it connects."""

    text: str
    instruments: Sequence[Instrument]


def cables(evening: CommissioningSession) -> Iterator[Cable]:
    """Yield the cable of each wired instrument; instruments behind the same GPIB adapter share its cable."""
    by_adapter: dict[str, list[Instrument]] = {}
    for instrument in evening.instruments.all():
        section = evening.section(instrument.name)
        if isinstance(section, ThermometerForm) and evening.file.instruments.beside(section) is not None:
            continue  # connected through the cable of that instrument
        place = section.place if isinstance(section, WiredForm) else None
        if place is not None:
            by_adapter.setdefault(place.adapter, []).append(instrument)
        elif isinstance(section, WiredForm):
            yield Cable(f"the cable of {instrument.name} ({section.resource})", [instrument])
    for adapter, instruments in by_adapter.items():
        names = ", ".join(one.name for one in instruments)
        yield Cable(f"the computer's cable to the GPIB adapter {adapter} ({names})", instruments)


def check_cables(evening: CommissioningSession) -> None:
    """Ask the person to pull and replug each cable; check that the instruments on it then respond as before."""
    for cable in cables(evening):
        present = [one for one in cable.instruments if evening.present(one)]
        first = (present or cable.instruments)[0]
        evening.carry_out(CABLE, first, partial(_pulled, evening, cable, first), by_wire=False)
        for one in present:
            evening.carry_out(AGAIN, one, partial(_looked_at, evening, one))


def _pulled(evening: CommissioningSession, cable: Cable, first: Instrument) -> Finding:
    look = _look(evening, first)
    look()
    name = first.name
    evening.confirm(
        f"Pull {cable.text}. Is it out?", action={"do": "cable", "instrument": name, "plugged": False}
    )
    told_s, why = _time_to_loss(evening, look)
    evening.confirm(
        f"Plug {cable.text} in again, and wait until it shows a link. Is it in?",
        action={"do": "cable", "instrument": name, "plugged": True},
    )
    most_s = TRIES * 2.0 * evening.timeout_s(name)
    back_s, still = _wait_until_back(evening, [_look(evening, one) for one in cable.instruments])
    figures = (
        Figure("loss reported after", told_s, "s", message(f"at most {most_s:.3g} s")),
        Figure("answers again after", back_s, "s", message(f"at most {PATIENCE_S:g} s")),
    )
    if still is not None:
        said = f"did not respond again after its cable was plugged in ({still.cause})"
        return Finding(CABLE, still.instrument, State.COULD_NOT, said, figures, still.remedy)
    if not why:
        said = "still answered with its cable pulled"
        remedy = (
            "check which cable was pulled; if it was the right one, correct the address in the bench file"
        )
        return Finding(CABLE, name, State.OTHER, said, figures, remedy)
    if told_s > most_s:
        said = f"the program reported its loss after {told_s:.3g} s; at most {most_s:.3g} s are allowed"
        return Finding(
            CABLE, name, State.SLOWER, said, figures, "give it a shorter timeout in the bench file"
        )
    return Finding(
        CABLE, name, State.WORKS, f"its loss was reported ({why}), then it answered again", figures
    )


def _looked_at(evening: CommissioningSession, instrument: Instrument) -> Finding:
    _look(evening, instrument)()
    return Finding(AGAIN, instrument.name, State.WORKS, "answers as before")


def _look(evening: CommissioningSession, instrument: Instrument) -> Callable[[], object]:
    """Return a function that queries an instrument without changing any setting on which a run relies."""
    if isinstance(instrument, Voltmeter):
        return partial(instrument.configure, quick(evening, instrument))
    if isinstance(instrument, ThermalChamber):
        return partial(instrument.temperature, "commission/cable", settling=True)
    if isinstance(instrument, PowerSupply):
        return partial(instrument.state, "commission/cable")
    if isinstance(instrument, HasScale):
        return instrument.position_rad
    return instrument.open


def _time_to_loss(evening: CommissioningSession, look: Callable[[], object]) -> tuple[float, str]:
    """Query an instrument whose cable is out; return the time until an error, s, and the error ("" for none).

    Every exception is caught, because the session has to continue until the cable is back in.
    """
    begun_s, failure = evening.time_s(), ""
    try:
        look()
    except BenchError as error:
        failure = error.cause
    except Exception as error:
        failure = f"the driver failed with {type(error).__name__} ({error})"
    return evening.time_s() - begun_s, failure


def _wait_until_back(
    evening: CommissioningSession, looks: Sequence[Callable[[], object]]
) -> tuple[float, BenchError | None]:
    """Query until all instruments respond; return the time, s, that this took, and the last error or None."""
    begun_s = evening.time_s()
    while True:
        try:
            for look in looks:
                look()
            return evening.time_s() - begun_s, None
        except BenchError as error:
            if evening.time_s() - begun_s > PATIENCE_S:
                return evening.time_s() - begun_s, error
        evening.clock.sleep(PAUSE_S)


IDENTITY: Final = message("identity", "heading")
BENCH: Final = message("bench", "heading")


class Part(NamedTuple):
    """A part of the session: its title, the message that announces it to the person, and its checks."""

    title: str
    announced: str
    carry_out: Callable[[CommissioningSession], None]


def _identities(evening: CommissioningSession) -> None:
    for instrument in evening.instruments.all():
        evening.carry_out(IDENTITY, instrument, partial(who, evening, instrument))
    meters.check_settings(evening)
    if not evening.simulated:  # all simulated meters of a model have the same serial number
        _report_equal_serials(evening)


def who(evening: CommissioningSession, instrument: Instrument) -> Finding:
    """Return a finding with the identity that an opened instrument reported."""
    by_hand = evening.section(instrument.name).by_hand
    said = "is operated by hand" if by_hand else str(evening.identities[instrument.name])
    return Finding(IDENTITY, instrument.name, State.WORKS, said)


def _report_equal_serials(evening: CommissioningSession) -> None:
    for words in same_serials(evening.identities):
        remedy = "compare the serial numbers with those on the instruments, and correct the addresses"
        evening.note(Finding(IDENTITY, BENCH, State.OTHER, words, remedy=remedy))


def parts(evening: CommissioningSession) -> Iterator[Part]:
    """Yield the parts of a session that the bench needs, in their order."""
    instruments, stated = evening.instruments, evening.file.instruments
    yield Part(
        "limits",
        "The program demands values beyond the limits of head, chamber and power supply; their drivers must "
        "refuse them. No wire is open, so nothing can move.",
        devices.check_limits,
    )
    yield Part(
        "identity and settings",
        "The program opens every instrument, reads its identity, and sets the voltmeters up twice. Nothing "
        "moves.",
        _identities,
    )
    yield Part("time of a reading", "Each voltmeter takes a reading alone.", meters.check_time)
    yield Part("together", "All voltmeters start together, as in a run.", meters.check_together)
    yield Part("noise", "The inputs of the voltmeters are shorted and read.", meters.check_noise)
    yield Part(
        "head", "The head makes small moves, each announced; keep an eye on the cables.", devices.check_moves
    )
    if (chamber := instruments.chamber) is not None:
        check = partial(devices.check_standby, chamber=chamber)
        yield Part("chamber", "The chamber is read and put into standby.", check)
    if (supply := instruments.power_supply) is not None:
        check = partial(devices.check_outputs, supply=supply)
        yield Part("power supply", "The program reads its outputs and sets or switches nothing.", check)
    if (level := instruments.level) is not None:
        yield Part(
            "level",
            "The head turns to 0°; you read the level on the platform in two positions, half a turn apart.",
            partial(devices.check_level, level=level),
        )
    if stated.thermometers:
        yield Part("thermometer", "The thermometers are read.", devices.check_thermometer)
    if not all(section.by_hand for section in stated.all()):
        yield Part(
            "cables",
            "You pull every cable once and plug it in again; the program must report each loss.",
            check_cables,
        )


def go_through(evening: CommissioningSession) -> None:
    """Announce and carry out each part of the session; a part that the person skips becomes a finding.

    Raises `SessionEnded` if the person ends the session, and `KeyboardInterrupt`.
    """
    every = list(parts(evening))
    for number, part in enumerate(every, start=1):
        try:
            title, announced = translated(part.title, HEADING), translated(part.announced)
            evening.confirm(f"Part {number} of {len(every)}, {title}: {announced} Continue?", default="yes")
            part.carry_out(evening)
        except Skipped as why:
            evening.note(Finding(part.title, BENCH, State.SKIPPED, str(why)))
