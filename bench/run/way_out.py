"""The way out of a run: the bench left safe, whatever fails on it and whatever went wrong before.

Nothing here raises: what one instrument does must not keep the next from being let go.
"""

from __future__ import annotations

from bench.run.control import RunControl, Stopped
from bench.run.events import EventType
from bench.run.power import UnitPower
from bench.run.workbench import Instruments
from drivers.interfaces import BenchError, ThermalChamber
from drivers.making_safe import Attempts, let_go


def leave_safe(
    instruments: Instruments, demanded_c: float | None, power: UnitPower | None = None
) -> dict[str, str]:
    """Leave the block as is safe for it, set the chamber to its safe setting, close everything.

    A head then stops, a meter goes to local. A chamber that was not opened is another program's, or as it was
    before: it is left so, and so is a block that this run has not switched. `demanded_c` is what the chamber was
    last sent to, None where it was not. Returns what a person must still do, by instrument.
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
    """Return the sentence of an error with what was noted on it on the way out."""
    return "; ".join(filter(None, (str(error), *getattr(error, "__notes__", ()))))


def how_it_stopped(cause: BaseException, wish: RunControl | None) -> tuple[EventType, dict[str, str]]:
    """Return the event that tells what stopped a run; `wish` is the one to stop that interrupted it, if any."""
    if isinstance(cause, Exception):
        instrument = cause.instrument if isinstance(cause, BenchError) else ""
        return EventType.RUN_FAILED, {"error": with_notes(cause), "instrument": instrument}
    stop = cause.control if isinstance(cause, Stopped) else wish
    return EventType.RUN_INTERRUPTED, {} if stop is None else stop.told()
