"""The terminal: asks the person at the bench, shows how far a run has come."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

from bench.plan import Plan
from bench.record import Event
from drivers.interfaces import Answer, NoAnswer, Prompt, PromptKind

HINTS: Final = {
    PromptKind.CONFIRM: "yes/no",
    PromptKind.ANGLE: "degrees minutes seconds",
}


class TerminalPerson:
    """Answers prompts from a text stream: a keyboard, or a file of answers.

    `pause` and `go_on` are called around each question, so that a progress bar does not write over it.
    """

    def __init__(
        self,
        answers: TextIO,
        console: Console,
        pause: Callable[[], None] = lambda: None,
        go_on: Callable[[], None] = lambda: None,
    ) -> None:
        self._answers = answers
        self._console = console
        self._pause = pause
        self._go_on = go_on

    def ask(self, prompt: Prompt) -> Answer:
        """Show the prompt and read a line. Raises `NoAnswer` at the end of the answers."""
        self._pause()
        try:
            if prompt.picture:
                self._console.print(Text(prompt.picture, style="dim"))
            self._console.print(Text(f"» {prompt.text}", style="bold"))
            self._console.print(Text(f"  [{self._hint(prompt)}] "), end="")
            line = self._answers.readline()
        finally:
            self._go_on()
        if not line:
            raise NoAnswer(
                "operator",
                f"the answers ended at the question: {prompt.text}",
                "what was recorded is kept; go on with 'bench resume'",
            )
        return Answer(prompt.id, line.strip())

    @staticmethod
    def _hint(prompt: Prompt) -> str:
        hint = HINTS.get(prompt.kind, prompt.unit) if not prompt.choices else ", ".join(prompt.choices)
        default = f"Enter = {prompt.default}" if prompt.default is not None else ""
        return "; ".join(part for part in (hint, default) if part)


class ProgressBar:
    """An observer of a run that draws a bar: step, installation, pass, point, time left.

    Where the output is not a terminal it prints a line for each mounting and pass instead.
    """

    def __init__(self, plan: Plan, console: Console, step_s: list[float]) -> None:
        self._plan = plan
        self._console = console
        self._step_s = step_s
        self._left_s = [*_running_sums(step_s)]
        self._printed = ""
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %  {task.fields[left]} left"),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("opening the instruments", total=len(plan.steps), left="")

    def __enter__(self) -> ProgressBar:
        self._progress.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._progress.stop()

    def pause(self) -> None:
        """Take the bar away while a question stands."""
        self._progress.stop()

    def go_on(self) -> None:
        """Draw the bar again."""
        self._progress.start()

    def __call__(self, event: Event) -> None:
        """Take note of an event of the run."""
        if event.type == "step_started":
            index = int(event.data["step"])
            step = self._plan.steps[index]
            text = f"step {index + 1}/{len(self._plan.steps)}  {step.describe()}"
            self._progress.update(
                self._task, description=text, completed=index, left=duration(self._left_s[index])
            )
            self._print_line(index)
        elif event.type == "step_done":
            self._progress.update(self._task, completed=int(event.data["step"]) + 1)

    def _print_line(self, index: int) -> None:
        if self._console.is_terminal:
            return
        step = self._plan.steps[index]
        where = getattr(step, "installation", None)
        if where is None:
            return
        number = getattr(step, "pass_number", None)
        line = f"installation {where}" + (f", pass {number}" if number else "")
        if number and line != self._printed:
            self._console.print(f"{line}  (step {index + 1}/{len(self._plan.steps)})", highlight=False)
            self._printed = line


def _running_sums(step_s: list[float]) -> list[float]:
    """Time left at the beginning of each step."""
    left: list[float] = []
    total = 0.0
    for seconds in reversed(step_s):
        total += seconds
        left.append(total)
    return left[::-1]


def duration(seconds: float) -> str:
    """Return a duration as a person says it: "2 h 05 min", "3 min", "40 s"."""
    if seconds >= 3600:
        minutes = round(seconds / 60)
        return f"{minutes // 60} h {minutes % 60:02d} min"
    if seconds >= 90:
        return f"{round(seconds / 60)} min"
    return f"{round(seconds)} s"
