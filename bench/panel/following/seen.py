"""What the events of a run say of it by now: taken in one by one, so that a long record is gone through
once."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final

from bench.procedure.plan import Plan, Read, Settle, Wait
from bench.readings.reading import Reading
from bench.run.answers import AskedPrompt
from bench.run.events import CameToRest, Event, EventType, Mounted, TemperatureSet, Turned
from bench.run.manifest import RecordError
from bench.run.resume import Progress
from bench.run.states import RunState, state_after_one

MOST_LAST: Final = 40
"""So many of the last events are told."""

MOST_WARNINGS: Final = 20

_STOPPED: Final = frozenset(
    {EventType.RUN_FINISHED, EventType.RUN_FAILED, EventType.RUN_INTERRUPTED, EventType.RUN_ABORTED}
)


@dataclass
class Seen:
    """A run as its events tell it.

    `step` is the one begun and not done yet, with the event of its beginning.
    `taken` is the reading taken last, with its event; `chamber` the air's temperature, °C, as it was known
    last; `set_c` what the chamber was sent to; `rest` what was waited for last and how it came to rest.
    """

    plan: Plan
    state: RunState = RunState.READY
    progress: Progress = field(default_factory=Progress)
    events: int = 0
    first: Event | None = None
    latest: Event | None = None
    step: Event | None = None
    turn: Event | None = None
    turned: tuple[Event, Turned] | None = None
    taken: tuple[Event, Reading] | None = None
    rest: tuple[Event, CameToRest] | None = None
    set_c: float | None = None
    chamber: tuple[Event, float] | None = None
    installation: tuple[str, int] | None = None
    refused: Event | None = None
    answered: Event | None = None
    left_safe: dict[str, str] = field(default_factory=dict)
    why: str = ""
    warnings: deque[Event] = field(default_factory=lambda: deque(maxlen=MOST_WARNINGS))
    last: deque[Event] = field(default_factory=lambda: deque(maxlen=MOST_LAST))

    def __post_init__(self) -> None:
        self._reads = [isinstance(step, Read) for step in self.plan.steps]
        self.readings_planned = sum(self._reads)
        self.readings_done = 0

    def take(self, event: Event) -> None:
        """Take in the next event. Raises `RecordError` for one that cannot be."""
        try:
            self._take(event)
        except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
            raise RecordError(
                f"event {event.number} of the record cannot follow here ({error}); see 'bench show RUN --verify'"
            ) from error

    def _take(self, event: Event) -> None:
        self.state = state_after_one(self.state, event.type)
        before = len(self.progress.done)
        self.progress.take(event)
        self.events, self.latest = event.number, event
        self.first = self.first or event
        self.last.append(event)
        match event.type:
            case EventType.STEP_STARTED:
                self._begin(event)
            case EventType.STEP_DONE:
                self.readings_done += self._reads[event.step] and len(self.progress.done) > before
                self.step = None
                self._bring(event)
            case EventType.REDO | EventType.SKIPPED | EventType.STEP_FAILED:
                self.step = None
                if event.type == EventType.REDO:
                    self.readings_done = sum(self._reads[i] for i in self.progress.done)
            case EventType.EARLY_SIGN:
                self.warnings.append(event)
            case EventType.CHAMBER_SLOW:
                self.chamber = (event, float(event.data["air_c"]))
            case EventType.LEFT_SAFE:
                self.left_safe = {str(name): str(what) for name, what in event.data["to_do"].items()}
            case EventType.RUN_RESUMED:
                self.step = None
                self.left_safe, self.why = {}, ""
            case _ if event.type in _STOPPED:
                self.step = None
                self.why = str(event.data.get("error") or event.data.get("reason") or "")
            case EventType.ASKED:
                self.refused = None
            case EventType.ANSWERED:
                self.answered = event
            case EventType.ANSWER_REFUSED:
                self.refused = event

    def _begin(self, event: Event) -> None:
        step = self.plan.steps[event.step]
        self.step = event
        if isinstance(getattr(step, "target_rad", None), float) and not isinstance(step, Read):
            self.turn = event

    def _bring(self, event: Event) -> None:
        step = self.plan.steps[event.step]
        match event.result:
            case Reading() as reading:
                self.taken = (event, reading)
                air_c = reading.temperature_c if reading.chamber_c is None else reading.chamber_c
                if air_c is not None and self.set_c is not None:
                    self.chamber = (event, air_c)
            case Turned() as turned:
                self.turned = (event, turned)
            case Mounted():
                self.turn = self.turned = None
                self.installation = (str(getattr(step, "installation", "")), int(getattr(step, "series", 1)))
            case TemperatureSet(target_c=target_c):
                self.set_c = target_c
            case CameToRest() as rest:
                self.rest = (event, rest)
                if isinstance(step, Settle) and step.what == "temperature":
                    self.chamber = (event, rest.settled_at[0])
            case _:
                return

    @property
    def prompt(self) -> AskedPrompt | None:
        """The question that stands."""
        return self.progress.asked.prompt

    @property
    def waiting(self) -> tuple[Event, Wait | Settle] | None:
        """What is being waited for, and since when."""
        if self.step is None or self.prompt is not None:
            return None
        step = self.plan.steps[self.step.step]
        return (self.step, step) if isinstance(step, Wait | Settle) else None
