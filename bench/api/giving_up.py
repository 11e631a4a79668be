"""An interrupted run ended for good; its record is kept."""

from __future__ import annotations

from bench.api.execution import taken_up
from bench.run.control import NOBODY_KNOWN, Who
from bench.run.events import EventType
from bench.run.folder import Run


def give_up(run: Run, who: Who = NOBODY_KNOWN) -> tuple[str, ...]:
    """End a run that nobody carries out for good; return what must be looked after yet, a sentence each.

    Raises `Refused` for one that has ended, `RecordError` where another program writes it or it was changed.
    """
    record, history = taken_up(run)
    try:
        bench_s = history.events[-1].bench_s if history.events else 0.0
        record.append(EventType.RUN_ABORTED, bench_s, **who.to_json())
    finally:
        record.close()
    if history.progress.power in {"on", "found on", "fault"}:
        return ("the block was on when the run stopped, and nobody has switched it off since",)
    return ()
