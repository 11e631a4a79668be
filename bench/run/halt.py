"""A run that stopped for an early sign: the question how to go on, and what an answer means."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from bench.config.procedure.plan import Mount, Plan, Read, SetTemperature
from bench.run.answers import MOST_ATTEMPTS, REASON, problem_with_answer
from bench.run.control import OperatorWish, RunControl
from bench.run.events import Event
from bench.run.resume import Progress, end_of_point, first_of_pass, last_of_pass, latest_turn, turn_before
from bench.run.states import Wish
from drivers.interfaces import BenchError, NoAnswer, Person, Prompt, PromptKind

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


def redo_from(plan: Plan, progress: Progress, wish: Wish, index: int) -> Redo | None:
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
