"""What a run may be doing, what may be asked of it, and what leads where."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Final

from bench.run.events import EventType


class RunState(StrEnum):
    """What a run is doing."""

    READY = "ready"
    RUNNING = "running"
    PAUSED = "paused"
    FINISHED = "finished"
    FAILED = "failed"
    INTERRUPTED = "interrupted"
    ABORTED = "aborted"


_OPEN: Final[Mapping[str, RunState]] = {
    EventType.RUN_RESUMED: RunState.RUNNING,
    EventType.RUN_FAILED: RunState.FAILED,
    EventType.RUN_INTERRUPTED: RunState.INTERRUPTED,
    EventType.RUN_ABORTED: RunState.ABORTED,
}
"""What may happen to every run that has not ended, whatever its last program left it at."""


def _stopped(state: RunState) -> Mapping[str, RunState]:
    """Return the row of a run that has stopped: a further attempt that fails leaves it as it was."""
    return {**_OPEN, EventType.RUN_FAILED: state, EventType.RUN_INTERRUPTED: state}


TRANSITIONS: Final[Mapping[RunState, Mapping[str, RunState]]] = {
    RunState.READY: {**_OPEN, EventType.RUN_STARTED: RunState.RUNNING},
    RunState.RUNNING: {
        **_OPEN,
        EventType.RUN_PAUSED: RunState.PAUSED,
        EventType.RUN_FINISHED: RunState.FINISHED,
    },
    RunState.PAUSED: {**_OPEN, EventType.RUN_CONTINUED: RunState.RUNNING},
    RunState.FAILED: _stopped(RunState.FAILED),
    RunState.INTERRUPTED: _stopped(RunState.INTERRUPTED),
    RunState.FINISHED: {},
    RunState.ABORTED: {},
}
"""Which event leads from which state to which: there is no other way, for who writes a record or reads it."""

ENDED: Final = frozenset({RunState.FINISHED, RunState.ABORTED})
"""States in which nothing more happens to a run."""


class Wish(StrEnum):
    """What a person may ask of a run that goes on."""

    PAUSE = "pause"
    CONTINUE = "continue"
    REPEAT_POINT = "redo"
    REPEAT_PASS = "redo-pass"
    MOUNT_AGAIN = "remount"
    SKIP = "skip"
    STOP = "stop"
    ABORT = "abort"


HEARD: Final[Mapping[RunState, frozenset[Wish]]] = {
    RunState.RUNNING: frozenset(Wish) - {Wish.CONTINUE},
    RunState.PAUSED: frozenset(Wish) - {Wish.PAUSE},
}
"""Which wishes are heard in which state."""


_CHANGING: Final = frozenset(event for row in TRANSITIONS.values() for event in row)


def state_after(events: list[str]) -> RunState:
    """Return the state that a run's events lead to; events that change no state are passed over.

    Raises `ValueError` for a sequence that the table does not allow.
    """
    state = RunState.READY
    for event in events:
        state = state_after_one(state, event)
    return state


def state_after_one(state: RunState, event: str) -> RunState:
    """Return the state that an event on record leads to. Raises `ValueError` where the table does not allow it."""
    if event not in _CHANGING:
        return state
    if event not in TRANSITIONS[state]:
        raise ValueError(f"{event} cannot follow on {state}")
    return TRANSITIONS[state][event]
