"""Run records as the list of runs has them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from bench.base.regular import read_regular
from bench.readings.supplied import columns_of, ranges_in_words
from bench.run.digest import Digest, Digests
from bench.run.folder import VERIFY, Run, all_runs
from bench.run.manifest import RecordError
from bench.run.record import is_being_written
from bench.run.states import ENDED, RunState


def run_summaries(runs: Path) -> list[dict[str, object]]:
    """Return the list of the runs in a folder, oldest first. Nothing in that folder is opened for writing."""
    digests = Digests(runs)
    found = [run_summary(run, digests.of) for run in all_runs(runs)]
    digests.save()
    return found


def run_summary(run: Run, digest_of: Callable[[Run], Digest] = Digest.of) -> dict[str, object]:
    """Return a row of the list; a run that cannot be read is one as well, with the reason."""
    try:
        digest = digest_of(run)
        state, to_go_on = _state_and_next(run, digest)
        count = int(run.manifest["readings"]) if run.imported else digest.readings
    except (RecordError, ValueError, TypeError, KeyError) as reason:
        return {
            "name": run.name,
            "created": "",
            "instruments": "-",
            "state": f"damaged: {reason}",
            "readings": 0,
            "verdict": None,
            "to_go_on": "",
        }
    return {
        "name": run.name,
        "created": run.created,
        "instruments": "simulated" if run.simulated else ("-" if state == "imported" else "real"),
        "state": state,
        "readings": count,
        "verdict": _verdict(run),
        "to_go_on": to_go_on,
    }


def supply_in_words(run: Run) -> str:
    """Return from which to which voltage and current each rail of the block was; empty where nobody measured it."""
    if run.imported:
        return ""
    return ranges_in_words(columns_of([one.rails for one in run.history.readings.values()]))


def _verdict(run: Run) -> str | None:
    """Return the verdict that stands in a run's folder, None where there is none.

    Results of versions before have no statement: they passed or failed.
    """
    try:
        found = json.loads(read_regular(run.folder / f"{VERIFY}.json").decode())
        statement = str(found.get("statement") or ("pass" if found["passed"] else "fail"))
        return {"pass": "passed", "fail": "failed"}.get(statement, statement)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def _state_and_next(run: Run, digest: Digest) -> tuple[str, str]:
    """Return the state of a run in words, and the command that goes on with it."""
    if digest.problems:
        return "damaged", f"bench show {run.name} --verify"
    if run.imported:
        return "imported", ""
    state = digest.state
    wanted = run.results_missing if state is RunState.FINISHED else state not in ENDED
    if not wanted or is_being_written(run.folder):
        return state.value, ""
    alive = {RunState.READY: "not begun", RunState.RUNNING: "unfinished", RunState.PAUSED: "unfinished"}
    return alive.get(state, state.value), f"bench resume {run.name}"
