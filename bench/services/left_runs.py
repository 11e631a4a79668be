"""Runs that another program has left: found, taken up to be gone on with, or ended for good."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from bench.config.bench_file.file import missing_drivers
from bench.run.events import ENDED, EventType, RecordError, RunState
from bench.run.folder import BENCH, Digests, Run, all_runs, find_run
from bench.run.person import NOBODY_KNOWN, Who
from bench.run.record import History, Record, is_being_written
from bench.services.errors import Refused
from drivers.clock import utc_now


def unfinished_run(name: str | None, runs: Path, *, results_too: bool = False) -> Run:
    """Return a run that can be gone on with, the latest if none is named. Raises `Refused` for another.

    With `results_too` it may be one that has finished and lacks results, where none waits to be gone on with.
    """
    if name is None:
        digests = Digests(runs)
        states = [(run, _idle_at(run, digests)) for run in all_runs(runs)]
        digests.save()
        waiting = [run for run, state in states if state is not None and state not in ENDED]
        if results_too and not waiting:
            waiting = [run for run, state in states if _lacks_results(run, state)]
        if not waiting:
            raise Refused(f"{runs}: no unfinished run there")
        return waiting[-1]
    found = find_run(name, runs)
    if found.imported:
        raise Refused(f"{found.name}: was imported from a readings file; there is nothing to go on with")
    return found


def taken_up(
    run: Run,
    shield: Callable[[], AbstractContextManager[None]] = nullcontext,
    *,
    results_too: bool = False,
) -> tuple[Record, History]:
    """Open a run to go on with it; with `results_too` it may have finished and lack results.

    Raises `Refused` for another that has ended, `RecordError` as `Record.reopen`.
    """
    record, history = Record.reopen(run.folder, utc_now, shield)
    if history.state in ENDED and not (results_too and _lacks_results(run, history.state)):
        record.close()
        raise Refused(f"{run.name}: nothing to do, the run is {history.state}")
    return record, history


def _lacks_results(run: Run, state: RunState | None) -> bool:
    return state is RunState.FINISHED and run.results_missing


def _idle_at(run: Run, digests: Digests) -> RunState | None:
    """Return the state of a run that was begun here and that nobody is carrying out, None for another."""
    try:
        state = None if run.imported else digests.of(run).state
    except (RecordError, ValueError):
        return None
    return None if is_being_written(run.folder) else state


def refuse_missing_devices(run: Run) -> None:
    """Raise `Refused` where a driver that the run was begun with is not here."""
    came_from = run.manifest.get("devices", {})
    missing = [
        f"the driver '{name}'" + (f" (it came from {came_from[name]})" if name in came_from else "")
        for name in missing_drivers(run.folder / BENCH)
    ]
    if missing:
        raise Refused(
            f"{run.name} goes on only with {' and '.join(missing)}, which is not here; name the folder that it is "
            "in with --devices or BENCH_DEVICES, or install its distribution"
        )


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
