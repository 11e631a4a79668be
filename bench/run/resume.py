"""The progress of a plan, the steps redone after a stop, and the questions to the person about them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final

from bench.config.procedure.plan import Level, Mount, Plan, Read, SetTemperature, Step, Turn
from bench.run.events import Event, EventType, Wish
from bench.run.person import MOST_ATTEMPTS, REASON, OpenPrompt, OperatorWish, RunControl, problem_with_answer
from drivers.interfaces import BenchError, NoAnswer
from drivers.person import Person, Prompt, PromptKind


@dataclass
class PlanProgress:
    """The progress of a plan: which steps are done or left out, and how often each was redone on request.

    `temperature_c` is the last one on record; `identities` are those of the instruments. `remounts` gives the
    series of the readings of a (series, installation) after the block was mounted again in the middle of it.

    `doubt` is the early sign that stopped the run and is not answered yet. `in_vain` are the steps whose
    point was redone for an early sign, `gone_on` the steps whose sign was overruled. `signs` is the number of
    early signs.

    `power` is the last recorded state of the block's supply: "on", "found on", "off", "fault", or empty.
    `off_since_s` is when it was switched off; `warm` says whether the block has warmed up since it was
    switched on. `asked` knows the open question; `answers_heard` is the number of lines heard of the answers
    in the folder. `chosen` are the choices made during the run, in order; `left_out` are the steps that they
    make unnecessary.
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
        """Return a copy that can change independently."""
        return replace(self, **{of.name: copy(getattr(self, of.name)) for of in fields(self)})

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
        """Note the reading whose point was redone for a sign; a larger redo clears the notes within it."""
        if redo.data.get("wish") != Wish.REPEAT_POINT:
            self.in_vain.difference_update(redo.steps)
        elif self.doubt is not None:
            self.in_vain.add(self.doubt.step)

    def _note_temperature(self, brought: Mapping[str, Any]) -> None:
        """Keep the temperature last given or read; after a new set point it is unknown.

        The recorded data are read directly: making a result object for each of many steps would take seconds.
        """
        if (reading := brought.get("reading")) is not None:
            self.temperature_c = reading.get("temperature_c")
        elif "temperature_c" in brought or "target_c" in brought:
            self.temperature_c = brought.get("temperature_c")

    def reopen(self, plan: Plan, step: int) -> None:
        """Reopen a point at `step`: all its steps except the readings are done again."""
        for index in range(step, end_of_point(plan, step)):
            if not isinstance(plan.steps[index], Read):
                self.done.discard(index)

    def attempt(self, step: int) -> int:
        """Return the number of the attempt at a step: 1, plus one for each request to redo it."""
        return 1 + self.redone[step]

    def settled(self, step: int) -> bool:
        """Return whether a step needs nothing more."""
        return step in self.done or step in self.skipped or step in self.left_out


def steps_of(ranges: Iterable[Sequence[int]]) -> set[int]:
    """Return the steps in the ranges [first, last]."""
    return {step for first, last in ranges for step in range(int(first), int(last) + 1)}


ENDS_A_POINT: Final = Mount | SetTemperature | Level
"""After these steps the head may have left its last turn, or the block has changed."""


def turn_before(plan: Plan, step: int, without: Collection[int] = ()) -> int:
    """Return the last turn before `step` with no mounting since; `step` where there is none.

    Steps in `without` do not belong to the run.
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
    """Return whether a reading is still to come from `step` on, before the block is next mounted.

    A reading that stopped the run by an early sign may be redone.
    """
    if progress.doubt is not None:
        return True
    for index in range(step, len(plan.steps)):
        if not progress.settled(index) and isinstance(plan.steps[index], Mount | Read):
            return isinstance(plan.steps[index], Read)
    return False


def latest_turn(plan: Plan, progress: PlanProgress, step: int) -> int:
    """Return the turn last begun before `step` with no mounting since; `step` where there is none.

    Where points are chosen during the run, this turn may come later in the plan.
    """
    begun = (i for i in progress.begun_s if i != step and i not in progress.left_out)
    own = [i for i in begun if isinstance(plan.steps[i], Turn | ENDS_A_POINT)]
    latest = max(own, key=lambda i: (progress.begun_s[i], i), default=step)
    return latest if isinstance(plan.steps[latest], Turn) else step


def end_of_point(plan: Plan, step: int) -> int:
    """Return the step after the point to which `step` belongs."""
    for index in range(step + 1, len(plan.steps)):
        if isinstance(plan.steps[index], Turn | ENDS_A_POINT):
            return index
    return len(plan.steps)


def first_of_pass(plan: Plan, turn: int) -> int:
    """Return the first turn of the pass to which the turn at `turn` belongs."""
    first = turn
    for index in range(turn, -1, -1):
        if isinstance(plan.steps[index], Mount | SetTemperature):
            break
        if _is_of_pass(plan, turn, index):
            first = index
    return first


def last_of_pass(plan: Plan, progress: PlanProgress, turn: int) -> int:
    """Return the last step of the points begun in the pass to which the turn at `turn` belongs."""
    last = turn
    for index in range(turn, len(plan.steps)):
        if isinstance(plan.steps[index], Mount | SetTemperature):
            break
        if index in progress.begun_s and _is_of_pass(plan, turn, index):
            last = index
    return end_of_point(plan, last) - 1


def _is_of_pass(plan: Plan, turn: int, index: int) -> bool:
    """Return whether a step is a turn of the pass to which the turn at `turn` belongs."""

    def place(step: Step) -> tuple[int, str, int] | None:
        return (step.series, step.installation, step.pass_number) if isinstance(step, Turn) else None

    return place(plan.steps[index]) == place(plan.steps[turn])


GO_ON: Final = "go on"
ANSWERS: Final = {
    "redo point": Wish.REPEAT_POINT,
    "redo pass": Wish.REPEAT_PASS,
    "mount again": Wish.MOUNT_AGAIN,
}
"""Possible answers beside "go on REASON", each with its wish."""
AGAIN: Final = "the same reading again after it was redone"


def halt_prompt(doubt: Event, *, again: bool = False) -> Prompt:
    """Return the question of a run that stopped for an early sign; it has no default.

    `again` says that the run stopped at this reading before, and that the reading was redone since.
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
    """Return the question of a paused run; `now_s` is the time since the run began, s."""
    return Prompt(
        id=f"pause@{now_s:.3f}",
        kind=PromptKind.CONFIRM,
        text="Paused. Enter goes on; or :redo, :redo-pass, :remount, :skip REASON, :abort",
        default="yes",
        action={"do": "wait"},
    )


def how_to_go_on(person: Person, doubt: Event, *, again: bool = False) -> str:
    """Ask how to go on; return the reason for going on, or raise `OperatorWish` to repeat something.

    `again` is as in `halt_prompt`. Raises `NoAnswer` with the sign's sentence where nobody answers.
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
    """Return the step after the wrong reading of a sign: its own, or an earlier one on its mounting."""
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
    """The steps `first` to `last` to be repeated, and the step that mounts the block before them, if any."""

    first: int
    last: int
    mount: Mount | None = None


def redo_from(plan: Plan, progress: PlanProgress, wish: Wish, index: int) -> Redo | None:
    """Return the steps that a wish at step `index` repeats.

    Return None where no point was measured since the block was mounted.
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
    """Return the step of the mounting that is present at step `index`; None where there is none."""
    for i in range(index - 1, -1, -1):
        if isinstance(step := plan.steps[i], Mount):
            return i, step
    return None
