"""The plain log of a run: what happened, a line each, for a person with a text editor."""

from __future__ import annotations

from pathlib import Path

from bench.base.visible import visible
from bench.procedure.plan import Plan
from bench.readings.reading import Reading
from bench.run.events import Answered, Event, EventType, Turned
from bench.run.sentences import duration, said, sentence

LOG = "run.log"


class RunLog:
    """An observer of a run that appends lines to `run.log`. It is derived: a full disk stops it, not the run."""

    def __init__(self, folder: Path, plan: Plan) -> None:
        self._plan = plan
        self._path = folder / LOG

    def __call__(self, event: Event) -> None:
        """Append a line for an event; the beginnings of steps are left out, their ends say as much."""
        if event.type == EventType.STEP_STARTED:
            return
        try:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(
                    visible(
                        f"{event.time[:19]}  {duration(event.bench_s):>11}  {in_words(event, self._plan)}\n"
                    )
                )
        except OSError:
            return


def in_words(event: Event, plan: Plan) -> str:
    """Return an event of a run of that plan as a line."""
    if event.type == EventType.STEP_STARTED:
        return f"begun: {plan.steps[event.step].describe()}"
    if event.type == EventType.ASKED:
        return f"asked: {event.data['text']}"
    if event.type in (EventType.ANSWERED, EventType.ANSWER_REFUSED):
        return said(event)
    if event.type != EventType.STEP_DONE:
        why = event.data.get("error") or event.data.get("reason")
        return f"{event.type}: {why}" if why else sentence(event)
    text = plan.steps[event.step].describe()
    match event.result:
        case Reading(mean=mean, unit=unit):
            text += "  " + "  ".join(f"{value:+.8f}" for value in mean) + f" {unit}"
        case Turned(angle_deg=angle):
            text += f"  read {angle:.6f}°"
        case Answered(answer=answer):
            text += f"  {answer}"
    return text
