"""What is done of a plan, what is redone after a stop, and how a person says so."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any, Final

from bench.config.procedure.plan import Level, Mount, Plan, Read, SetTemperature, Step, Turn
from bench.run.events import Event, EventType, Wish
from bench.run.person import MOST_ATTEMPTS, REASON, OpenPrompt, OperatorWish, RunControl, problem_with_answer
from drivers.interfaces import BenchError, NoAnswer
from drivers.person import Person, Prompt, PromptKind


@dataclass
class PlanProgress:
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

    def copy(self) -> PlanProgress:
        """Return a copy, to be gone on with."""
        return replace(
            self,
            done=set(self.done),
            skipped=set(self.skipped),
            redone=Counter(self.redone),
            begun_s=dict(self.begun_s),
            identities=dict(self.identities),
            remounts=dict(self.remounts),
            in_vain=set(self.in_vain),
            gone_on=set(self.gone_on),
            asked=copy(self.asked),
            chosen=list(self.chosen),
            left_out=set(self.left_out),
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


ENDS_A_POINT: Final = Mount | SetTemperature | Level
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
        if isinstance(plan.steps[index], ENDS_A_POINT):
            break
    return step


def is_still_to_be_read(plan: Plan, progress: PlanProgress, step: int) -> bool:
    """Whether a reading is still to come before the block is mounted next, from `step` on.

    One that stopped the run by an early sign may be redone.
    """
    if progress.doubt is not None:
        return True
    for index in range(step, len(plan.steps)):
        if not progress.settled(index) and isinstance(plan.steps[index], Mount | Read):
            return isinstance(plan.steps[index], Read)
    return False


def latest_turn(plan: Plan, progress: PlanProgress, step: int) -> int:
    """The turn that was begun last in time before `step`, with nothing mounted since; `step` where there is none.

    Where points are chosen on the way, it may stand later in the plan.
    """
    begun = (i for i in progress.begun_s if i != step and i not in progress.left_out)
    own = [i for i in begun if isinstance(plan.steps[i], Turn | ENDS_A_POINT)]
    latest = max(own, key=lambda i: (progress.begun_s[i], i), default=step)
    return latest if isinstance(plan.steps[latest], Turn) else step


def end_of_point(plan: Plan, step: int) -> int:
    """The step after the point that `step` belongs to."""
    for index in range(step + 1, len(plan.steps)):
        if isinstance(plan.steps[index], Turn | ENDS_A_POINT):
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


def last_of_pass(plan: Plan, progress: PlanProgress, turn: int) -> int:
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


GO_ON: Final = "go on"
ANSWERS: Final = {
    "redo point": Wish.REPEAT_POINT,
    "redo pass": Wish.REPEAT_PASS,
    "mount again": Wish.MOUNT_AGAIN,
}
"""What can be answered beside "go on REASON"."""
AGAIN: Final = "the same reading again after it was redone"


def halt_prompt(doubt: Event, *, again: bool = False) -> Prompt:
    """Return the question that a run asks which stopped for an early sign; it has no default.

    `again` says that the run stopped at this reading before and that it was redone since.
    """
    why, first = "", "take the point again, take the pass again"
    answers = [*ANSWERS]
    if again:
        why = f"{AGAIN[0].upper()}{AGAIN[1:]}: an earlier setting of the pass may be what is wrong. "
        first = "take the pass again, which is the first choice, take the point again"
        answers.sort(key=lambda answer: ANSWERS[answer] is not Wish.REPEAT_PASS)
    return Prompt(
        id=f"halt@{doubt.number}",
        kind=PromptKind.CHOOSE,
        text=f"Stopped. {doubt.data['sentence']}. {why}Put it right, then say how to go on: {first}, "
        "mount the block again and take the pass again, or go on with the readings as they are and say why",
        choices=(*answers, f"{GO_ON} {REASON}"),
        action={"do": "ask"},
    )


def pause_prompt(now_s: float) -> Prompt:
    """Return the question that a run asks which is paused, `now_s` since it began."""
    return Prompt(
        id=f"pause@{now_s:.3f}",
        kind=PromptKind.CONFIRM,
        text="Paused. Enter goes on; or :redo, :redo-pass, :remount, :skip REASON, :abort",
        default="yes",
        action={"do": "wait"},
    )


def how_to_go_on(person: Person, doubt: Event, *, again: bool = False) -> str:
    """Ask how to go on: raise `OperatorWish` for something to be taken again, or return why it is gone on.

    `again` is as in `halt_prompt`. Raises `NoAnswer` with what the sign says where nobody answers.
    """
    prompt = halt_prompt(doubt, again=again)
    answers = ", ".join(prompt.choices)
    trouble = ""
    for attempt in range(1, MOST_ATTEMPTS + 1):
        put = replace(prompt, id=f"{prompt.id}#{attempt}", text=f"{trouble}{prompt.text}")
        try:
            answer = person.ask(put)
        except NoAnswer as nobody:
            told = f"{doubt.data['sentence']} ({AGAIN})" if again else doubt.data["sentence"]
            raise NoAnswer(
                "operator",
                f"the run stopped: {told}; nobody said how to go on",
                f"look at the bench, then resume and answer {answers}",
            ) from nobody
        given = " ".join(answer.text.split()) if answer.prompt_id == put.id else ""
        if given and not problem_with_answer(prompt, given):
            if given.lower() in ANSWERS:
                raise OperatorWish(RunControl(ANSWERS[given.lower()], by_person=True))
            return given[len(GO_ON) :].strip()
        trouble = f"Answer one of {answers}, not {given!r}. "
    raise BenchError("operator", "no usable answer to how to go on", f"answer {answers}")


def step_in_doubt(plan: Plan, doubt: Event) -> int:
    """Return the step after the reading that a sign finds wrong: its own, or one before on its mounting."""
    _, _, pass_number, point = doubt.data.get("wrong") or (0, "", 0, 0)
    for index in range(doubt.step, -1, -1):
        step = plan.steps[index]
        if isinstance(step, Mount | SetTemperature):
            break
        if isinstance(step, Read) and (step.pass_number, step.point) == (pass_number, point):
            return index + 1
    return doubt.step + 1


@dataclass(frozen=True)
class Redo:
    """The steps `first` to `last` that are taken again, and what is mounted before them, if anything."""

    first: int
    last: int
    mount: Mount | None = None


def redo_from(plan: Plan, progress: PlanProgress, wish: Wish, index: int) -> Redo | None:
    """Return what a wish at step `index` has taken again.

    None where no point was measured since the block was mounted.
    """
    after = index if progress.doubt is None else step_in_doubt(plan, progress.doubt)
    in_turn = not progress.chosen or progress.doubt is not None
    turn = turn_before(plan, after, progress.left_out) if in_turn else latest_turn(plan, progress, after)
    if turn == after:
        return None
    last = index - 1
    if progress.chosen:  # what stands between in the plan was measured before, and stays
        own = end_of_point(plan, turn)
        last = min(own, index) - 1 if turn < index else own - 1
    if wish is not Wish.REPEAT_POINT:
        last = last_of_pass(plan, progress, turn) if progress.chosen else last
        turn = first_of_pass(plan, turn)
    found = _mounting_before(plan, turn) if wish is Wish.MOUNT_AGAIN else None
    if found is None:
        return Redo(turn, last)
    mounted, step = found
    was_read = any(isinstance(plan.steps[i], Read) and i in progress.done for i in range(mounted, turn))
    # with nothing read on it the mounting begins again
    return Redo(turn, last, step) if was_read else Redo(mounted, last)


def _mounting_before(plan: Plan, index: int) -> tuple[int, Mount] | None:
    """Return the step that mounted the block as it is mounted at step `index`; None where none did."""
    for i in range(index - 1, -1, -1):
        if isinstance(step := plan.steps[i], Mount):
            return i, step
    return None
