"""What can be typed at a prompt: the answers that fit, and the wishes that are heard there with their meaning."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Final

from bench.run.control import SIGN
from bench.run.states import HEARD, RunState, Wish
from drivers.interfaces import Prompt, PromptKind

HELP: Final = "?"
"""An answer that asks what can be answered."""

MEANINGS: Final = {
    Wish.PAUSE: "wait; nothing on the bench moves until you go on",
    Wish.CONTINUE: "go on after a pause",
    Wish.REPEAT_POINT: "take the last point again; its last reading counts",
    Wish.REPEAT_PASS: "take the last pass again from its first point",
    Wish.MOUNT_AGAIN: "mount the block again, then take the last pass again",
    Wish.SKIP: "leave this point out, with the reason in the record",
    Wish.STOP: "leave the bench safe and stop, as Ctrl-C does; 'bench resume' goes on",
    Wish.ABORT: "end the run for good; what was read is kept",
}

_ANSWERS: Final = {
    PromptKind.CONFIRM: "yes (or y, ok, done) when it is done; no waits and asks again",
    PromptKind.ANGLE: "the angle on the scale, such as 45 00 10 or 45°00′10″ or 45.0028",
    PromptKind.NUMBER: "a number",
    PromptKind.CHOOSE: "one of: ",
}


def heard_at(prompt: Prompt) -> tuple[Wish, ...]:
    """Return the wishes that have something to act on at a prompt of a run."""
    if prompt.action["do"] == "ask" or (prompt.action["do"] == "mount" and prompt.choices):
        return (Wish.PAUSE, Wish.STOP, Wish.ABORT)  # no step goes on yet, or any more
    state = RunState.PAUSED if prompt.action["do"] == "wait" else RunState.RUNNING
    return tuple(wish for wish in Wish if wish in HEARD[state])


def typing_help(prompt: Prompt, wishes: Collection[Wish]) -> str:
    """Return lines that say what can be typed; `wishes` may have their meanings where these are not a run's."""
    meanings = wishes if isinstance(wishes, Mapping) else MEANINGS
    answer = _ANSWERS[prompt.kind] + ", ".join(prompt.choices)
    if prompt.kind is PromptKind.CONFIRM and prompt.action["do"] in ("ask", "answer"):
        answer = "yes, or no"
    if prompt.kind is PromptKind.NUMBER:
        answer += f" in {prompt.unit}" if prompt.unit else ""
        answer += "" if prompt.minimum is None else f", {prompt.minimum:g} at least"
        answer += "" if prompt.maximum is None else f", {prompt.maximum:g} at most"
    lines = ["What can be typed here:", f"  {answer}"]
    if prompt.default is not None:
        lines.append(f"  Enter alone: {prompt.default}")
    for wish in wishes:
        typed = f"{SIGN}{wish.value}" + (" REASON" if wish is Wish.SKIP else "")
        lines.append(f"  {typed}: {meanings[wish]}")
    return "\n".join(lines)
