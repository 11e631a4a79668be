"""Events of a run, read as they are written, and the state of the run derived from them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import SEEK_END
from pathlib import Path
from typing import Final

from bench.base.computing import uncollected
from bench.base.files import open_regular
from bench.base.text import cause_of
from bench.config.procedure.plan import Mount, Plan, Read, SetTemperature, Settle, Step, Turn, Wait
from bench.readings.table import Reading
from bench.run.events import (
    EVENTS,
    CameToRest,
    Event,
    EventType,
    RecordError,
    RunState,
    Turned,
    sha256,
    state_after_one,
)
from bench.run.person import AskedPrompt
from bench.run.record import parse_line
from bench.run.resume import PlanProgress

MOST_LAST: Final = 40
"""Number of recent events kept for display."""

MOST_WARNINGS: Final = 20

_STOPPED: Final = frozenset(
    {EventType.RUN_FINISHED, EventType.RUN_FAILED, EventType.RUN_INTERRUPTED, EventType.RUN_ABORTED}
)


@dataclass
class RunView:
    """The state of a run, derived from its events.

    `step` is the event with which the current step began, None between steps. `turn` is the start event of the last
    turn since the block was mounted; `set_c` is the set point (°C) of the chamber. `unmet` is the event of a wish
    that was refused since the last answer. Results of steps are computed only when they are read.
    """

    plan: Plan
    state: RunState = RunState.READY
    progress: PlanProgress = field(default_factory=PlanProgress)
    events: int = 0
    latest: Event | None = None
    step: Event | None = None
    turn: Event | None = None
    set_c: float | None = None
    slow: Event | None = None
    refused: Event | None = None
    unmet: Event | None = None
    answered: Event | None = None
    left_safe: dict[str, str] = field(default_factory=dict)
    why: str = ""
    stopped_by: str = ""
    readings_done: int = 0
    warnings: deque[Event] = field(default_factory=lambda: deque(maxlen=MOST_WARNINGS))
    last: deque[Event] = field(default_factory=lambda: deque(maxlen=MOST_LAST))
    _brought: dict[type[Step], Event] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._kinds: list[type[Step]] = [type(step) for step in self.plan.steps]
        self.readings_planned = self._kinds.count(Read)

    def take(self, event: Event) -> None:
        """Process the next event. Raises `RecordError` for an event that is invalid in this state."""
        try:
            self._take(event)
        except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
            raise RecordError(
                f"event {event.number} of the record contradicts those before it ({cause_of(error)}); check "
                "the record with 'bench show RUN --verify'"
            ) from error

    def _take(self, event: Event) -> None:
        self.state = state_after_one(self.state, event.type)
        before = len(self.progress.done)
        self.progress.take(event)
        self.events, self.latest = event.number, event
        self.last.append(event)
        if event.type == EventType.STEP_STARTED:
            self.step = event
            if self._kinds[event.step] is Turn:
                self.turn = event
        elif event.type == EventType.STEP_DONE:
            self.step = None
            kind = self._kinds[event.step]
            self._brought[kind] = event
            if kind is Read:
                self.readings_done += len(self.progress.done) > before
            elif kind is Mount:
                self.turn = None
            elif kind is SetTemperature:
                self.set_c = float(event.data["target_c"])
        else:
            self._take_other(event)

    def _take_other(self, event: Event) -> None:
        match event.type:
            case EventType.REDO:
                self.step = None
                self.readings_done = sum(self._kinds[i] is Read for i in self.progress.done)
            case EventType.SKIPPED | EventType.STEP_FAILED:
                self.step = None
            case EventType.CHOSEN:
                out = self.progress.left_out
                self.readings_planned = sum(k is Read and i not in out for i, k in enumerate(self._kinds))
            case EventType.EARLY_SIGN:
                self.warnings.append(event)
            case EventType.CHAMBER_SLOW:
                self.slow = event
            case EventType.LEFT_SAFE:
                self.left_safe = {str(name): str(what) for name, what in event.data["to_do"].items()}
            case EventType.RUN_RESUMED:
                self.step, self.left_safe, self.why = None, {}, ""
            case EventType.ASKED:
                self.refused = None
            case EventType.ANSWERED:
                self.answered, self.unmet = event, None
            case EventType.WISH_REFUSED:
                self.unmet = event
            case EventType.ANSWER_REFUSED:
                self.refused = event
            case _ if event.type in _STOPPED:
                self.step = None
                self.why = str(event.data.get("error") or event.data.get("reason") or "")
                self.stopped_by = str(event.data.get("by", ""))

    @property
    def prompt(self) -> AskedPrompt | None:
        """The open question to the operator; None if there is none."""
        return self.progress.asked.prompt

    @property
    def waiting(self) -> tuple[Event, Wait | Settle] | None:
        """The wait or settling in progress, with its start event; None without one, or during a question."""
        if self.step is None or self.prompt is not None:
            return None
        step = self.plan.steps[self.step.step]
        return (self.step, step) if isinstance(step, Wait | Settle) else None

    @property
    def taken(self) -> tuple[Event, Reading] | None:
        """The last reading, with the event that recorded it; None before the first reading."""
        event = self._brought.get(Read)
        return (event, event.reading) if event is not None and event.reading is not None else None

    @property
    def turned(self) -> tuple[Event, Turned] | None:
        """The last turn since the mounting, with its event and the angle read back; None before the first."""
        event, mounted = self._brought.get(Turn), self._brought.get(Mount)
        if event is None or (mounted is not None and mounted.number > event.number):
            return None
        return (event, event.result) if isinstance(event.result, Turned) else None

    @property
    def rest(self) -> tuple[Settle, CameToRest] | None:
        """The last settling step and its result; None before the first."""
        event = self._brought.get(Settle)
        if event is None or not isinstance(event.result, CameToRest):
            return None
        step = self.plan.steps[event.step]
        return (step, event.result) if isinstance(step, Settle) else None

    @property
    def mounted(self) -> Mount | None:
        """The last step that mounted the block; None if the block was not mounted yet."""
        event = self._brought.get(Mount)
        step = None if event is None else self.plan.steps[event.step]
        return step if isinstance(step, Mount) else None

    @property
    def chamber(self) -> tuple[Event, float] | None:
        """The last event with the chamber's air temperature, and its value (°C); None before the first."""
        known: list[tuple[Event, float]] = []
        if self.slow is not None:
            known.append((self.slow, float(self.slow.data["air_c"])))
        if self.taken is not None and self.set_c is not None:
            event, reading = self.taken
            air_c = reading.temperature_c if reading.chamber_c is None else reading.chamber_c
            if air_c is not None:
                known.append((event, air_c))
        if self.rest is not None and self.rest[0].what == "temperature":
            known.append((self._brought[Settle], self.rest[1].settled_at[0]))
        return max(known, key=lambda one: one[0].number, default=None)


KEPT_LINES, KEPT_BYTES = 100, 1 << 20
"""The first lines and the last bytes of a record are read in full; in between, starts of steps are skipped."""

HEAD: Final = 160
_BEGUN: Final = f'"type": "{EventType.STEP_STARTED}"'.encode()
"""The mark of a step's start within the first `HEAD` bytes of a line, which hold no text of persons."""


class Tail:
    """A reader of the events of a growing record; it reads an incomplete last line later, when it is complete."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / EVENTS
        self._read = 0
        self._count = 0
        self._head = ""

    def grown(self) -> bool:
        """Return whether the record has unread content; also True if the file is shorter now, or gone."""
        try:
            return self._path.stat().st_size != self._read
        except OSError:
            return self._read > 0

    def new(self) -> Iterator[Event]:
        """Yield events since the last call; in the middle of a long record, starts of steps are left out.

        Raises `RecordError` if anything but new lines changed.
        """
        try:
            with open_regular(self._path) as file, uncollected():
                size = file.seek(0, SEEK_END)
                if size < self._read:
                    raise RecordError(
                        f"{self._path}: became shorter, as another program changed it; restore it from a copy"
                    )
                file.seek(self._read)
                for line in file:
                    if not line.endswith(b"\n"):
                        return
                    if (
                        self._count > KEPT_LINES
                        and size - self._read > KEPT_BYTES
                        and _BEGUN in line[:HEAD]
                        and line.endswith(f'"{self._head}"}}\n'.encode())
                    ):
                        self._pass(line)
                        continue
                    yield self._event(line)
        except OSError as error:
            if isinstance(error, FileNotFoundError) and not self._read:
                return
            raise RecordError(
                f"{self._path}: cannot be read ({error.strerror}); check its permissions, or restore it from a "
                "copy of the run"
            ) from error

    def _event(self, line: bytes) -> Event:
        try:
            event, previous = parse_line(line)
        except ValueError as error:
            raise self._broken() from error
        if event.number != self._count + 1 or self._head not in ("", previous):
            raise self._broken()
        self._pass(line)
        return event

    def _pass(self, line: bytes) -> None:
        self._count, self._read, self._head = self._count + 1, self._read + len(line), sha256(line[:-1])

    def _broken(self) -> RecordError:
        return RecordError(
            f"{self._path}, line {self._count + 1}: the record cannot be trusted; 'bench show RUN --verify' "
            "shows why"
        )
