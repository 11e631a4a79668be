"""The plain log of a run: what happened, a line each, for a person with a text editor."""

from __future__ import annotations

from pathlib import Path

from bench.procedure.plan import Plan
from bench.run.record import Event
from bench.run.terminal import duration, told

LOG = "run.log"


class RunLog:
    """An observer of a run that appends lines to `run.log`. It is derived: a full disk stops it, not the run."""

    def __init__(self, folder: Path, plan: Plan) -> None:
        self._plan = plan
        self._path = folder / LOG

    def __call__(self, event: Event) -> None:
        """Append a line for an event; the beginnings of steps are left out, their ends say as much."""
        if event.type == "step_started":
            return
        try:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(f"{event.time[:19]}  {duration(event.bench_s):>11}  {self._text(event)}\n")
        except OSError:
            return

    def _text(self, event: Event) -> str:
        if event.type != "step_done":
            why = event.data.get("error") or event.data.get("reason")
            return f"{event.type}: {why}" if why else told(event)
        text = self._plan.steps[int(event.data["step"])].describe()
        reading = event.data.get("reading")
        if reading:
            text += "  " + "  ".join(f"{value:+.8f}" for value in reading["mean"]) + f" {reading['unit']}"
        elif "angle_deg" in event.data:
            text += f"  read {event.data['angle_deg']:.6f}°"
        elif "answer" in event.data:
            text += f"  {event.data['answer']}"
        return text
