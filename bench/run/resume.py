"""Progress of a plan, the steps to repeat after a stop, and the prompts that ask how to continue."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, fields, replace
from itertools import takewhile
from typing import Any, Final

from bench.base.languages import message
from bench.config.procedure.plan import (
    Level,
    Mount,
    Plan,
    Power,
    Read,
    SetTemperature,
    Settle,
    Step,
    Turn,
    Wait,
)
from bench.run.events import Event, EventType, Wish
from bench.run.person import OpenPrompt, OperatorWish, RunControl, problem_with_answer
from drivers.interfaces import BenchError, NoAnswer
from drivers.person import ATTEMPTS, Person, Prompt, PromptKind

_LEVELLED: Final = "/platform"
"""A part of the `id` of the questions at which a person turns the platform's screws (`Levelling`)."""


@dataclass
class PlanProgress:
    """The progress of a plan: the steps done or left out, and how often each was redone at a person's wish.

    `temperature_c` is the last recorded temperature, None after a new set point; `identities` are the instruments'
    identities by name. `remounts` maps (series, installation) to the series number of the readings after an
    unplanned remounting.

    `doubt` is the early sign of a misfit that stopped the run, until a person has decided how to continue. Of the
    readings at which the run stopped for this reason, `in_vain` holds the steps whose point was redone, and
    `gone_on` the steps after which a person continued. `signs` counts all early signs.

    `power` is the last recorded state of the block's supply: "on", "found on", "off", "fault", or empty.
    `off_since_s` is the bench time of switching off; `warm` says whether the block has warmed up since it was
    switched on. `asked` tracks the open prompt; `answers_heard` is the number of lines already processed in the
    folder's file of answers. `chosen` lists the choices of points made during the run, in order; `left_out` holds
    the steps that these choices drop. `platform_moved` says whether a person levelled the platform since the last
    turn to a point. `resumed_by` names the persons who resumed the run.
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
    platform_moved: bool = False
    resumed_by: list[str] = field(default_factory=list)

    def operators(self, first: object) -> str:
        """Return the names of the operators, each once: `first`, who began the run, then those who resumed it."""
        return ", ".join(dict.fromkeys([*([str(first)] if first else []), *self.resumed_by]))

    def copy(self) -> PlanProgress:
        """Return a copy that can change independently."""
        return replace(self, **{of.name: copy(getattr(self, of.name)) for of in fields(self)})

    def take(self, event: Event) -> None:  # noqa: PLR0912 - one case for each kind of event
        """Update the progress with the next event."""
        self.asked.take(event)
        match event.type:
            case EventType.RUN_STARTED | EventType.RUN_RESUMED:
                self.identities = dict(event.data["instruments"])
                self.resumed_by += [str(event.data["by"])] if event.data.get("by") else []
            case EventType.STEP_STARTED:
                self.begun_s[event.step] = event.bench_s
            case EventType.STEP_DONE:
                self.done.add(event.step)
                self._note_temperature(event.data)
                self.platform_moved &= "angle_deg" not in event.data
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
                self.platform_moved |= event.type == EventType.ANSWERED and _LEVELLED in str(event.data["id"])

    def _note_choice(self, chosen: Mapping[str, Any]) -> None:
        self.chosen.append(chosen)
        self.left_out |= steps_of(chosen["left_out"])
        self.left_out -= steps_of(chosen.get("taken_up", ()))

    def _note_redo(self, redo: Event) -> None:
        """Note that a point is redone because of an early sign; a redo of a whole pass clears the notes on it."""
        if redo.data.get("wish") != Wish.REPEAT_POINT:
            self.in_vain.difference_update(redo.steps)
        elif self.doubt is not None:
            self.in_vain.add(self.doubt.step)

    def _note_temperature(self, brought: Mapping[str, Any]) -> None:
        """Store the last temperature entered or read; a new set point makes it unknown.

        The event data are read directly, because building a result object for thousands of steps takes seconds.
        """
        if (reading := brought.get("reading")) is not None:
            self.temperature_c = reading.get("temperature_c")
        elif "temperature_c" in brought or "target_c" in brought:
            self.temperature_c = brought.get("temperature_c")

    def reopen(self, plan: Plan, step: int) -> None:
        """Mark the steps from `step` to the end of its point as not done, except readings."""
        for index in range(step, end_of_point(plan, step)):
            if not isinstance(plan.steps[index], Read):
                self.done.discard(index)

    def attempt(self, step: int) -> int:
        """Return the number of the present attempt at a step: 1, and 1 more for each redo on request."""
        return 1 + self.redone[step]

    def settled(self, step: int) -> bool:
        """Return whether a step is done, skipped or left out."""
        return step in self.done or step in self.skipped or step in self.left_out


def steps_of(ranges: Iterable[Sequence[int]]) -> set[int]:
    """Return the step indices in inclusive ranges: [[1, 3], [7, 7]] -> {1, 2, 3, 7}."""
    return {step for first, last in ranges for step in range(int(first), int(last) + 1)}


ENDS_A_POINT: Final = Mount | SetTemperature | Level | Power
"""Steps that end a point, because they may move the head or change the state of the block."""


def turn_before(plan: Plan, step: int, without: Collection[int] = ()) -> int:
    """Return the index of the last turn before `step`; `step` itself if there is none.

    The search ends at a step of `ENDS_A_POINT`. The steps `without` are ignored.
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
    """Return whether a reading remains to be taken between `step` and the next mounting.

    After a misfit that stopped the run, return True until a person has decided: the reading may be repeated.
    """
    if progress.doubt is not None:
        return True
    coming = (plan.steps[index] for index in range(step, len(plan.steps)) if not progress.settled(index))
    return isinstance(next((one for one in coming if isinstance(one, Mount | Read)), None), Read)


def soak_to_repeat(plan: Plan, progress: PlanProgress, step: int) -> list[int]:
    """Return the indices of the finished waits after the last setting of the chamber before `step`.

    Meanwhile the chamber was in standby, as a stop leaves it, or open for a mounting. Return [] if no reading
    remains to be taken at this temperature.
    """
    kept = [index for index in range(len(plan.steps)) if index not in progress.left_out]
    settings = [index for index in kept if isinstance(plan.steps[index], SetTemperature)]
    last = max((index for index in settings if index < step), default=None)
    if last is None:
        return []
    after = min((index for index in settings if index >= step), default=len(plan.steps))
    coming = (plan.steps[index] for index in range(step, after) if not progress.settled(index))
    if progress.doubt is None and not any(isinstance(one, Read) for one in coming):
        return []
    waits = takewhile(
        lambda index: isinstance(plan.steps[index], Wait | Settle), kept[kept.index(last) + 1 :]
    )
    return [index for index in waits if index < step and index in progress.done]


def latest_turn(plan: Plan, progress: PlanProgress, step: int) -> int:
    """Return the index of the turn begun last; `step` if there is none or an `ENDS_A_POINT` step was begun since.

    Steps left out, and `step` itself, are ignored. `turn_before` follows the order of the plan; this function
    follows the order of execution, which differs when points are chosen during the run.
    """
    begun = (i for i in progress.begun_s if i != step and i not in progress.left_out)
    own = [i for i in begun if isinstance(plan.steps[i], Turn | ENDS_A_POINT)]
    latest = max(own, key=lambda i: (progress.begun_s[i], i), default=step)
    return latest if isinstance(plan.steps[latest], Turn) else step


def end_of_point(plan: Plan, step: int) -> int:
    """Return the index of the step that follows the point of `step`; the number of steps if none follows."""
    after = range(step + 1, len(plan.steps))
    return next((i for i in after if isinstance(plan.steps[i], Turn | ENDS_A_POINT)), len(plan.steps))


def first_of_pass(plan: Plan, turn: int) -> int:
    """Return the index of the first turn in the same pass as the turn at index `turn`."""
    first = turn
    for index in range(turn, -1, -1):
        if isinstance(plan.steps[index], Mount | SetTemperature):
            break
        if _is_of_pass(plan, turn, index):
            first = index
    return first


def last_of_pass(plan: Plan, progress: PlanProgress, turn: int) -> int:
    """Return the index of the last step of the last begun point, in plan order, of the pass of `turn`."""
    last = turn
    for index in range(turn, len(plan.steps)):
        if isinstance(plan.steps[index], Mount | SetTemperature):
            break
        if index in progress.begun_s and _is_of_pass(plan, turn, index):
            last = index
    return end_of_point(plan, last) - 1


def _is_of_pass(plan: Plan, turn: int, index: int) -> bool:
    def place(step: Step) -> tuple[int, str, int] | None:
        return (step.series, step.installation, step.pass_number) if isinstance(step, Turn) else None

    return place(plan.steps[index]) == place(plan.steps[turn])


GO_ON: Final = "go on"
ANSWERS: Final = {
    message("redo point"): Wish.REPEAT_POINT,
    message("redo pass"): Wish.REPEAT_PASS,
    message("mount again"): Wish.MOUNT_AGAIN,
}
"""The answers besides "go on REASON", with the wish that each expresses."""
AGAIN: Final = message("the reading was measured again and is still in doubt")


def halt_prompt(doubt: Event, *, again: bool = False) -> Prompt:
    """Return the prompt of a run stopped by the early sign `doubt`; it has no default.

    `again` says that the run stopped at this reading before, and that the reading has been redone since.
    """
    why, first = "", message("redo the point, redo the pass")
    answers = [*ANSWERS]
    if again:
        why = message(
            "The reading was measured again and is still in doubt: an earlier setting of the pass may be wrong."
        )
        first = message("redo the pass (try this first), redo the point")
        answers.sort(key=lambda answer: ANSWERS[answer] is not Wish.REPEAT_PASS)
    stopped = message(f"Stopped: {doubt.data['sentence']}.")
    choose = message(
        f"Correct the cause, then choose: {first}, mount the block again and redo the pass, or keep the "
        "readings and give a reason"
    )
    text = " ".join(filter(None, (stopped, why, choose)))
    return Prompt(
        id=f"halt@{doubt.number}",
        kind=PromptKind.CHOOSE,
        text=text,
        choices=(*answers, message("go on REASON")),
        action={"do": "ask"},
    )


def pause_prompt(now_s: float) -> Prompt:
    """Return the prompt of a paused run; `now_s` is the bench time since the run began, s."""
    return Prompt(
        id=f"pause@{now_s:.3f}",
        kind=PromptKind.CONFIRM,
        text=message(
            "Paused. Press Enter to continue, or type :redo, :redo-pass, :remount, :skip REASON, :abort"
        ),
        default="yes",
        action={"do": "wait"},
    )


def how_to_go_on(person: Person, doubt: Event, *, again: bool = False) -> str:
    """Ask how to continue after the early sign `doubt` of a misfit; return the reason for going on despite it.

    Raises `OperatorWish` if the person chooses to repeat something, `NoAnswer` with the sign's sentence if nobody
    answers, and `BenchError` after `ATTEMPTS` invalid answers. `again` is explained at `halt_prompt`.
    """
    prompt = halt_prompt(doubt, again=again)
    answers = ", ".join(prompt.choices)
    trouble = ""
    for attempt in range(1, ATTEMPTS + 1):
        put = replace(prompt, id=f"{prompt.id}#{attempt}", text=f"{trouble}{prompt.text}")
        try:
            answer = person.ask(put)
        except NoAnswer as nobody:
            reason = f"{doubt.data['sentence']} ({AGAIN})" if again else doubt.data["sentence"]
            raise NoAnswer(
                "operator",
                f"the run stopped: {reason}; nobody chose how to continue",
                f"check the bench, then resume and answer {answers}",
            ) from nobody
        given = " ".join(answer.text.split()) if answer.prompt_id == put.id else ""
        if given and not problem_with_answer(prompt, given):
            if given.lower() in ANSWERS:
                raise OperatorWish(RunControl(ANSWERS[given.lower()], by_person=True))
            return given[len(GO_ON) :].strip()
        trouble = message(f"Answer one of {answers}, not {given!r}.") + " "
    raise BenchError(
        "operator", "no valid answer said how to continue", f"resume the run and answer one of {answers}"
    )


def step_in_doubt(plan: Plan, doubt: Event) -> int:
    """Return the index of the step after the reading at fault.

    The reading at fault is the reading of the early sign `doubt`, or an earlier one on the same mounting.
    """
    _, _, pass_number, point = doubt.data.get("wrong") or (0, "", 0, 0)
    for index in range(doubt.step, -1, -1):
        step = plan.steps[index]
        if isinstance(step, Mount | SetTemperature | Power):
            break
        if isinstance(step, Read) and (step.pass_number, step.point) == (pass_number, point):
            return index + 1
    return doubt.step + 1


@dataclass(frozen=True)
class Redo:
    """The range of steps to repeat, `first` to `last`, and the mounting step to carry out before it, if any."""

    first: int
    last: int
    mount: Mount | None = None


def redo_from(plan: Plan, progress: PlanProgress, wish: Wish, index: int) -> Redo | None:
    """Return the steps to repeat for a `wish` (operator's command) received at step `index`.

    Return None if the head was not turned since the last mounting, levelling, switching or new set point.
    """
    if index < len(plan.steps) and isinstance(plan.steps[index], Power) and index in progress.begun_s:
        return None  # the block is off, or colder than it was
    after = index if progress.doubt is None else step_in_doubt(plan, progress.doubt)
    in_turn = not progress.chosen or progress.doubt is not None
    turn = turn_before(plan, after, progress.left_out) if in_turn else latest_turn(plan, progress, after)
    if turn == after:
        return None
    last = index - 1
    if progress.chosen:  # steps between this point and `index` were measured earlier and remain valid
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
    # if nothing was read since the mounting, the mounting step itself is repeated
    return Redo(turn, last, step) if was_read else Redo(mounted, last)


def _mounting_before(plan: Plan, index: int) -> tuple[int, Mount] | None:
    for i in range(index - 1, -1, -1):
        if isinstance(step := plan.steps[i], Mount):
            return i, step
    return None
