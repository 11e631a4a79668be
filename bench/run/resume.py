"""What a record says is done, and where an interrupted run goes on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

from bench.config.procedure.plan import Level, Mount, Plan, Read, SetTemperature, Step, Turn
from bench.run.answers import OpenPrompt
from bench.run.events import Event, EventType
from bench.run.manifest import RecordError
from bench.run.states import Wish

if TYPE_CHECKING:
    from bench.run.history import History


@dataclass
class Progress:
    """Which steps of a plan are done, left out, and how often each was begun anew on request.

    `temperature_c` is the last one on record, `identities` those of the instruments; `remounts` gives the
    series that readings of a (series, installation) have since the block was taken off and mounted again in
    the middle of it. `doubt` is an early sign that stopped the run and is not answered yet, `in_vain` the steps
    at which one did whose point was redone for it, `gone_on` those at which one was overruled, `signs` how many
    there were. `power` is what was told last of the block's: "on", "found on", "off", "fault", or nothing;
    `off_since_s` since when it is off, `warm` whether it has warmed up since it was switched on. `asked` knows the
    question that stands, `answers_heard` how many lines of the answers left in the folder were heard. `chosen` is
    what was chosen on the way, in order, and `left_out` are the steps that are not needed by that.
    """

    done: set[int] = field(default_factory=set)
    skipped: set[int] = field(default_factory=set)
    redone: Counter[int] = field(default_factory=Counter)
    begun_s: dict[int, float] = field(default_factory=dict)
    temperature_c: float | None = None
    identities: dict[str, str] = field(default_factory=dict)
    remounts: dict[tuple[int, str], int] = field(default_factory=dict)
    doubt: Event | None = None
    in_vain: set[int] = field(default_factory=set)
    gone_on: set[int] = field(default_factory=set)
    signs: int = 0
    power: str = ""
    off_since_s: float | None = None
    warm: bool = False
    asked: OpenPrompt = field(default_factory=OpenPrompt)
    answers_heard: int = 0
    chosen: list[Mapping[str, Any]] = field(default_factory=list)
    left_out: set[int] = field(default_factory=set)

    @classmethod
    def of(cls, history: History) -> Progress:
        """Return what the events of a run say, to be gone on with."""
        of = history.progress
        return replace(
            of,
            done=set(of.done),
            skipped=set(of.skipped),
            redone=Counter(of.redone),
            begun_s=dict(of.begun_s),
            identities=dict(of.identities),
            remounts=dict(of.remounts),
            in_vain=set(of.in_vain),
            gone_on=set(of.gone_on),
            asked=copy(of.asked),
            chosen=list(of.chosen),
            left_out=set(of.left_out),
        )

    def take(self, event: Event) -> None:  # noqa: PLR0912 - one case for each kind of event
        """Take note of an event."""
        self.asked.take(event)
        match event.type:
            case EventType.RUN_STARTED | EventType.RUN_RESUMED:
                self.identities = dict(event.data["instruments"])
            case EventType.STEP_STARTED:
                self.begun_s[event.step] = event.bench_s
            case EventType.STEP_DONE:
                self.done.add(event.step)
                self._note_temperature(event.data)
            case EventType.REMOUNTED:
                place = (int(event.data["series"]), str(event.data["installation"]))
                self.remounts[place] = int(event.data["now_series"])
            case EventType.POWER:
                self.power = str(event.data["power"])
                self.off_since_s = event.bench_s if self.power == "off" else None
                self.warm = False
            case EventType.WARMED_UP:
                self.warm = True
            case EventType.EARLY_SIGN:
                self.signs += 1
                if event.data.get("confident"):
                    self.doubt = event
            case EventType.WENT_ON:
                self.doubt = None
                self.gone_on.add(event.step)
            case EventType.REDO:
                self._note_redo(event)
                self.doubt = None
                self.done.difference_update(event.steps)
                self.skipped.difference_update(event.steps)
                self.redone.update(event.steps)
            case EventType.SKIPPED:
                self.skipped.update(event.steps)
            case EventType.CHOSEN:
                self._note_choice(event.data)
            case EventType.ANSWERED | EventType.ANSWER_REFUSED:
                self.answers_heard = max(self.answers_heard, int(event.data.get("line", 0)))

    def _note_choice(self, chosen: Mapping[str, Any]) -> None:
        self.chosen.append(chosen)
        self.left_out |= steps_of(chosen["left_out"])
        self.left_out -= steps_of(chosen.get("taken_up", ()))

    def _note_redo(self, redo: Event) -> None:
        """Remember at which reading the point alone was redone for a sign; more than the point begins anew."""
        if redo.data.get("wish") != Wish.REPEAT_POINT:
            self.in_vain.difference_update(redo.steps)
        elif self.doubt is not None:
            self.in_vain.add(self.doubt.step)

    def _note_temperature(self, brought: Mapping[str, Any]) -> None:
        """Keep the temperature last told or read; after a new setting it is not known.

        What a step brought is looked at as recorded: to make the result of each of many would take seconds.
        """
        if (reading := brought.get("reading")) is not None:
            self.temperature_c = reading.get("temperature_c")
        elif "temperature_c" in brought or "target_c" in brought:
            self.temperature_c = brought.get("temperature_c")

    def reopen(self, plan: Plan, step: int) -> None:
        """Take up a point again at `step`: what leads to its open readings is done anew, readings are not."""
        for index in range(step, end_of_point(plan, step)):
            if not isinstance(plan.steps[index], Read):
                self.done.discard(index)

    def attempt(self, step: int) -> int:
        """Which attempt at a step this is: 1, and one more for each time that it was to be redone."""
        return 1 + self.redone[step]

    def settled(self, step: int) -> bool:
        """Whether nothing is left to do about a step."""
        return step in self.done or step in self.skipped or step in self.left_out


def steps_of(ranges: Iterable[Sequence[int]]) -> set[int]:
    """Return the steps of ranges [first, last]."""
    return {step for first, last in ranges for step in range(int(first), int(last) + 1)}


@dataclass(frozen=True)
class ResumePoint:
    """Where to go on: `step` is the next one to do, `turn` the turn to make again before it, if any.

    `bench_s` is the bench time (s since the run began) at which `step` was last begun.
    """

    step: int
    bench_s: float
    turn: int | None = None


def resume_point(plan: Plan, history: History) -> ResumePoint:
    """Find where to go on.

    Between a turn and the readings of its point the head may have been moved: the turn is made again, and
    with it what stands between the last reading taken and the next. Readings taken are never repeated.
    `step` is `len(plan.steps)` when nothing is left to do. Raises `RecordError` for steps that the plan lacks.
    """
    progress = Progress.of(history)
    known = progress.done | progress.skipped | progress.left_out
    if beyond := [step for step in known if step >= len(plan.steps)]:
        raise RecordError(
            f"the record tells of step {max(beyond) + 1}, and the plan has {len(plan.steps)}: "
            "they are not of one run; take both from a copy of it"
        )
    last_s = history.events[-1].bench_s if history.events else 0.0
    step = next((i for i in range(len(plan.steps)) if not progress.settled(i)), len(plan.steps))
    turn = turn_before(plan, step, progress.left_out)
    if turn == step or not _reading_is_open(plan, step):
        return ResumePoint(step, progress.begun_s.get(step, last_s))
    taken = [i for i in range(turn, step) if isinstance(plan.steps[i], Read)]
    step = max(taken, default=turn) + 1
    return ResumePoint(step, progress.begun_s.get(step, last_s), turn)


def _reading_is_open(plan: Plan, step: int) -> bool:
    """Whether `step` lies within a point of which a reading is still to come."""
    if step == len(plan.steps) or isinstance(plan.steps[step], Turn | _ENDS_A_POINT):
        return False
    return any(isinstance(later, Read) for later in plan.steps[step : end_of_point(plan, step)])


_ENDS_A_POINT: Final = Mount | SetTemperature | Level
"""After these the head is not where the last turn left it, or the block not as it was."""


def turn_before(plan: Plan, step: int, without: Collection[int] = ()) -> int:
    """The last turn before `step` with nothing mounted since; `step` where there is none.

    Steps in `without` are none of the run.
    """
    for index in range(min(step, len(plan.steps)) - 1, -1, -1):
        if index in without:
            continue
        if isinstance(plan.steps[index], Turn):
            return index
        if isinstance(plan.steps[index], _ENDS_A_POINT):
            break
    return step


def is_still_to_be_read(plan: Plan, progress: Progress, step: int) -> bool:
    """Whether a reading is still to come before the block is mounted next, from `step` on.

    One that stopped the run by an early sign may be redone.
    """
    if progress.doubt is not None:
        return True
    for index in range(step, len(plan.steps)):
        if not progress.settled(index) and isinstance(plan.steps[index], Mount | Read):
            return isinstance(plan.steps[index], Read)
    return False


def latest_turn(plan: Plan, progress: Progress, step: int) -> int:
    """The turn that was begun last in time before `step`, with nothing mounted since; `step` where there is none.

    Where points are chosen on the way, it may stand later in the plan.
    """
    begun = (i for i in progress.begun_s if i != step and i not in progress.left_out)
    own = [i for i in begun if isinstance(plan.steps[i], Turn | _ENDS_A_POINT)]
    latest = max(own, key=lambda i: (progress.begun_s[i], i), default=step)
    return latest if isinstance(plan.steps[latest], Turn) else step


def end_of_point(plan: Plan, step: int) -> int:
    """The step after the point that `step` belongs to."""
    for index in range(step + 1, len(plan.steps)):
        if isinstance(plan.steps[index], Turn | _ENDS_A_POINT):
            return index
    return len(plan.steps)


def first_of_pass(plan: Plan, turn: int) -> int:
    """The first turn of the pass to which the turn at `turn` belongs."""
    first = turn
    for index in range(turn, -1, -1):
        if isinstance(plan.steps[index], Mount | SetTemperature):
            break
        if _is_of_pass(plan, turn, index):
            first = index
    return first


def last_of_pass(plan: Plan, progress: Progress, turn: int) -> int:
    """The last step of the points that were begun in the pass to which the turn at `turn` belongs."""
    last = turn
    for index in range(turn, len(plan.steps)):
        if isinstance(plan.steps[index], Mount | SetTemperature):
            break
        if index in progress.begun_s and _is_of_pass(plan, turn, index):
            last = index
    return end_of_point(plan, last) - 1


def _is_of_pass(plan: Plan, turn: int, index: int) -> bool:
    """Whether a step is a turn of the pass to which the turn at `turn` belongs."""

    def place(step: Step) -> tuple[int, str, int] | None:
        return (step.series, step.installation, step.pass_number) if isinstance(step, Turn) else None

    return place(plan.steps[index]) == place(plan.steps[turn])
