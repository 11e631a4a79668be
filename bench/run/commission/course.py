"""The course of the evening: which checks follow each other, each announced; how it ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

from bench.run.commission import heads, meters, surroundings
from bench.run.commission.cables import check_cables
from bench.run.commission.session import Evening, Finding, Skipped, State
from bench.run.same_serial import same_serials
from drivers.interfaces import Instrument

IDENTITY: Final = "identity"
BENCH: Final = "bench"


@dataclass(frozen=True)
class Part:
    """A part of the evening: what the person is told before it, who takes part, and the checks."""

    title: str
    announced: str
    carry_out: Callable[[Evening], None]
    applies: Callable[[Evening], bool] = lambda evening: True


def _limits(evening: Evening) -> None:
    heads.check_limits(evening)
    surroundings.check_chamber_limits(evening)
    surroundings.check_supply_limits(evening)


def _identities(evening: Evening) -> None:
    for instrument in evening.instruments.all():
        evening.carry_out(IDENTITY, instrument, partial(_who, evening, instrument))
    meters.check_settings(evening)
    if not evening.simulated:  # simulated meters of a make have one serial number
        _tell_twins(evening)


def _who(evening: Evening, instrument: Instrument) -> Finding:
    by_hand = evening.section(instrument.name).by_hand
    said = "is worked by hand" if by_hand else str(evening.identities[instrument.name])
    return Finding(IDENTITY, instrument.name, State.WORKS, said)


def _tell_twins(evening: Evening) -> None:
    """Say which voltmeters state one serial number."""
    for words in same_serials(evening.identities):
        remedy = "compare the serial numbers with those on the instruments, and correct the addresses"
        evening.note(Finding(IDENTITY, BENCH, State.OTHER, words, remedy=remedy))


PARTS: Final = (
    Part(
        "limits",
        "What lies beyond the limits of head, chamber and power supply is demanded while no wire is open: "
        "it must be refused. "
        "Nothing can move.",
        _limits,
    ),
    Part(
        "identity and settings",
        "Every instrument is opened and asked who it is; the voltmeters are set up twice. Nothing moves.",
        _identities,
    ),
    Part("time of a reading", "Each voltmeter takes a reading alone.", meters.check_time),
    Part("together", "All voltmeters are started as in a run.", meters.check_together),
    Part("noise", "The inputs of the voltmeters are shorted and read.", meters.check_noise),
    Part(
        "head",
        "The head makes small moves, each announced; keep an eye on the cables.",
        heads.check_moves,
    ),
    Part(
        "chamber",
        "The chamber is read and put into standby.",
        surroundings.check_standby,
        applies=lambda evening: evening.instruments.chamber is not None,
    ),
    Part(
        "power supply",
        "Its outputs are read. Nothing is set or switched.",
        surroundings.check_outputs,
        applies=lambda evening: evening.instruments.power_supply is not None,
    ),
    Part(
        "level",
        "The head is set to 0°, the level read on the platform in two positions half a turn apart.",
        surroundings.check_level,
        applies=lambda evening: evening.instruments.level is not None,
    ),
    Part(
        "thermometer",
        "The thermometer at the block is read.",
        surroundings.check_thermometer,
        applies=lambda evening: evening.instruments.thermometer is not None,
    ),
    Part(
        "cables",
        "Every cable is pulled once and plugged in again: its loss must be told.",
        check_cables,
        applies=lambda evening: any(not section.by_hand for section in evening.file.instruments.all()),
    ),
)


def go_through(evening: Evening) -> None:
    """Go through all parts that apply. Raises `Ended` where the person ends it, `KeyboardInterrupt`."""
    parts = [part for part in PARTS if part.applies(evening)]
    for number, part in enumerate(parts, start=1):
        try:
            evening.confirm(
                f"Part {number} of {len(parts)}, {part.title}: {part.announced} Go on?", default="yes"
            )
            part.carry_out(evening)
        except Skipped as why:
            evening.note(Finding(part.title, BENCH, State.SKIPPED, str(why)))
