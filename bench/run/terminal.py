"""The operator's terminal: questions, typed lines, help, progress and time left."""

from __future__ import annotations

import io
import os
import select
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any, Final, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

from bench.base.computing import quiet
from bench.config.procedure.plan import Plan
from bench.readings.reading import Reading
from bench.run.events import HEARD, Event, EventType, RunState, Wish
from bench.run.person import NOBODY_KNOWN, SIGN, WishAuthor, parse_wish, raised
from bench.run.resume import steps_of
from bench.run.samples import Settling
from bench.run.sentences import duration, sentence
from drivers.interfaces import NoAnswer
from drivers.person import Answer, Prompt, PromptKind

SLICE_S: Final = 1.0


class LineReader:
    """Reads lines of a stream, one for each question.

    It uses one thread. Input typed during other work waits in the terminal, so that no answer is lost.
    Streams that are no terminal, file or pipe of the system (and all on Windows) allow no waiting with a
    timeout: a read then blocks, and `meanwhile` is not called.
    """

    def __init__(self, answers: TextIO) -> None:
        self._answers = answers
        self._descriptor = _descriptor(answers)
        self._begun = bytearray()

    def read(self, meanwhile: Callable[[], None] | None = None, slice_s: float = SLICE_S) -> str:
        """Return the next line with its end; empty where the answers have ended.

        Until the line is there, `meanwhile` is called every `slice_s`. An exception from it ends the
        question; the rest of a line begun for that question is not used for the next.
        """
        if self._descriptor is None:
            return self._answers.readline()
        while True:
            late = bool(self._begun)  # for a question that was ended
            line = self._rest_of_line(self._descriptor, meanwhile, slice_s)
            if late and line.endswith(b"\n"):
                continue
            return "" if late else line.decode(self._answers.encoding or "utf-8", "backslashreplace")

    def _rest_of_line(self, descriptor: int, meanwhile: Callable[[], None] | None, slice_s: float) -> bytes:
        # byte by byte: what a stream had read ahead, the system would not say to be there
        while not self._begun.endswith(b"\n"):
            if meanwhile is not None and not select.select([descriptor], [], [], slice_s)[0]:
                meanwhile()
            elif byte := os.read(descriptor, 1):
                self._begun += byte
            else:
                break
        line, self._begun = bytes(self._begun), bytearray()
        return line


def _descriptor(answers: TextIO) -> int | None:
    if sys.platform == "win32":  # which can wait for sockets alone
        return None
    try:
        return answers.fileno()
    except (OSError, ValueError):
        return None


HELP: Final = "?"
"""The answer that asks for help on possible answers."""

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
    """Return the wishes that can have an effect at a prompt of a run."""
    if prompt.action["do"] == "ask" or (prompt.action["do"] == "mount" and prompt.choices):
        return (Wish.PAUSE, Wish.STOP, Wish.ABORT)  # no step goes on yet, or any more
    state = RunState.PAUSED if prompt.action["do"] == "wait" else RunState.RUNNING
    return tuple(wish for wish in Wish if wish in HEARD[state])


def typing_help(prompt: Prompt, wishes: Collection[Wish]) -> str:
    """Return lines on what can be typed; `wishes` is a mapping to meanings where they differ from a run's."""
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


SLOW_TO_LEARN_S: Final = 1800.0
"""Bench time that the plan's expectation weighs against the run's own pace, s."""


class TimeLeft:
    """Estimates the time left at the start of a step from the expected time of each step, s."""

    def __init__(self, step_s: Sequence[float]) -> None:
        self._step_s = list(step_s)
        self._out: set[int] = set()
        self._left_s = _from_each_on(self._step_s)
        self._begun: tuple[int, float] | None = None

    def choose(self, chosen: Mapping[str, Any]) -> None:
        """Apply a choice: the steps that are not needed, and the expected time of undecided steps."""
        self._out |= steps_of(chosen["left_out"])
        self._out -= steps_of(chosen.get("taken_up", ()))
        step_s = [0.0 if i in self._out else seconds for i, seconds in enumerate(self._step_s)]
        if (open_s := chosen.get("undecided")) is not None:
            place = slice(int(open_s["first"]), int(open_s["last"]) + 1)
            whole_s = sum(step_s[place])
            part = float(open_s["takes_s"]) / whole_s if whole_s > 0 else 0.0
            step_s[place] = [part * seconds for seconds in step_s[place]]
        self._left_s = _from_each_on(step_s)

    def begin(self, index: int, bench_s: float) -> None:
        """Set the step and the bench time from which the pace is measured."""
        self._begun = (index, bench_s)

    def at(self, index: int, bench_s: float) -> float:
        """Return the time left at the step `index` that begins at `bench_s`.

        Without `begin`, the first call sets the step from which the pace is measured.
        """
        if self._begun is None:
            self._begun = (index, bench_s)
        first, begun_s = self._begun
        expected_s = self._left_s[first] - self._left_s[index]
        pace = (bench_s - begun_s + SLOW_TO_LEARN_S) / (expected_s + SLOW_TO_LEARN_S)
        return pace * self._left_s[index]


def _from_each_on(step_s: Sequence[float]) -> list[float]:
    """Return for each step the time of it and all later ones, s; a last 0 stands for the end."""
    return [*reversed(list(accumulate(reversed(step_s)))), 0.0]


HINTS: Final = {
    PromptKind.CONFIRM: "yes/no",
    PromptKind.ANGLE: "degrees minutes seconds",
}


class TerminalPerson:
    """Answers prompts from a text stream: a keyboard, or a file of answers.

    `pause` and `go_on` are called around each question, so that a progress bar does not write over it.
    `wishes` are those heard at its questions, if not a run's; `who` is their author. It is a
    `drivers.interfaces.WatchingPerson`; `slice_s` is the interval between calls of `meanwhile`.
    """

    def __init__(
        self,
        answers: TextIO,
        console: Console,
        pause: Callable[[], None] = lambda: None,
        go_on: Callable[[], None] = lambda: None,
        wishes: Collection[Wish] | None = None,
        who: WishAuthor = NOBODY_KNOWN,
    ) -> None:
        self.meanwhile: Callable[[], None] | None = None
        self.slice_s = SLICE_S
        self.wishes = wishes
        self.who = who
        self._answers = answers
        self._reader = LineReader(answers)
        self._console = console
        self._pause = pause
        self._go_on = go_on
        if isinstance(answers, io.TextIOWrapper) and answers.errors != "backslashreplace":
            answers.reconfigure(
                errors="backslashreplace"
            )  # bytes that are no text are an answer that does not fit

    @property
    def by_hand(self) -> bool:
        """Whether somebody types the answers; False for a file."""
        return self._answers.isatty()

    def beside(self, bar: ProgressBar) -> None:
        """Hide a progress bar during each question."""
        self._pause, self._go_on = bar.pause, bar.go_on

    def ask(self, prompt: Prompt) -> Answer:
        """Show the prompt and read a line.

        Raises `NoAnswer` at the end of the answers. For a wish (":redo") raises `OperatorWish` or `Stopped`.
        """
        self._pause()
        try:
            if prompt.picture:
                self._console.print(Text(prompt.picture, style="dim"))
            line = self._line(prompt)
            while line.startswith(SIGN) or line.strip() == HELP:
                self._say(self._to_extra(prompt, line))
                line = self._line(prompt)
        finally:
            self._go_on()
        if not line:
            raise NoAnswer(
                "operator",
                f"the answers ended at the question: {prompt.text}",
                "answer the rest when the run goes on",
            )
        return Answer(prompt.id, line.strip())

    def _to_extra(self, prompt: Prompt, line: str) -> str:
        """Return the reply to `?` or to an unknown wish; raise `OperatorWish` or `Stopped` for a wish."""
        wishes = heard_at(prompt) if self.wishes is None else self.wishes
        if line.strip() == HELP:
            return typing_help(prompt, wishes)
        if not wishes:
            return "no wish is heard at this question; answer it, or Ctrl-C"
        try:
            wish = replace(parse_wish(line), who=self.who)
        except ValueError as mistake:
            return str(mistake)
        raise raised(wish)

    def _say(self, text: str, style: str = "", end: str = "\n") -> None:
        """Print with lines broken between words, as a terminal alone would not."""
        self._console.print(Text(text, style=style), end=end, soft_wrap=False)

    def _line(self, prompt: Prompt) -> str:
        _forget_typed_ahead(self._answers)
        self._say(f"» {prompt.text}", "bold")
        self._say(f"  [{self._hint(prompt)}] ", end="")
        line = self._reader.read(self.meanwhile, self.slice_s)
        if line and not self._answers.isatty():
            self._console.print(Text(line.rstrip()))  # as a keyboard would have shown it
        return line

    @staticmethod
    def _hint(prompt: Prompt) -> str:
        hint = HINTS.get(prompt.kind, prompt.unit) if not prompt.choices else ", ".join(prompt.choices)
        default = f"Enter = {prompt.default}" if prompt.default is not None else ""
        return "; ".join(part for part in (hint, default, f"{HELP} = help") if part)


def _forget_typed_ahead(answers: TextIO) -> None:
    """Drop keys that were pressed before the question was shown: they cannot answer it."""
    if not answers.isatty():
        return
    try:
        import termios
    except ImportError:  # no such terminals on this system
        return
    termios.tcflush(answers.fileno(), termios.TCIFLUSH)


class ProgressBar:
    """An observer of a run that draws a bar: step, installation, pass, point, time left.

    Where the output is not a terminal it prints a line for each mounting and pass instead.
    """

    def __init__(self, plan: Plan, console: Console, step_s: list[float]) -> None:
        self._plan = plan
        self._console = console
        self._time_left = TimeLeft(step_s)
        self._status = ""
        self._printed = ""
        self._asked = False
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %  {task.fields[left]} left"),
            console=console,
            transient=True,
            disable=not console.is_terminal or quiet.get(),
        )
        self._task = self._progress.add_task("opening the instruments", total=len(plan.steps), left="")

    def __enter__(self) -> ProgressBar:
        self._progress.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._progress.stop()

    def pause(self) -> None:
        """Hide the bar during a question, and print where the run is."""
        self._progress.stop()
        self._asked = True
        if self._status:
            self._console.print(Text(self._status, style="dim"), soft_wrap=False)

    def go_on(self) -> None:
        """Draw the bar again."""
        self._asked = False
        self._progress.start()

    def __call__(self, event: Event) -> None:
        """Update the bar for an event of the run."""
        if event.type == EventType.STEP_STARTED:
            index = event.step
            left = duration(self._time_left.at(index, event.bench_s))
            text = f"step {index + 1}/{len(self._plan.steps)}  {self._plan.steps[index].describe()}"
            self._status = f"{text}; {left} left"
            self._progress.update(self._task, description=text, completed=index, left=left)
            self._print_line(index)
        elif event.type == EventType.STEP_DONE:
            self._progress.update(self._task, completed=event.step + 1)
            self._show_reading(event.reading)
        elif event.type == EventType.CHOSEN:
            self._time_left.choose(event.data)
            self._say_chosen(event)
        elif event.type == EventType.EARLY_SIGN and event.data.get("confident"):
            pass  # the question how to go on says it, and where nobody answers the end of the run
        elif (text := sentence(event)) != event.type:
            if self._asked:
                self._console.print()  # the question's line ends where the answer is to stand
            self._console.print(Text(text, style="bold yellow"), soft_wrap=False)

    def recall(self, chosen: Sequence[Mapping[str, Any]]) -> None:
        """Apply the choices made before the run was resumed."""
        for one in chosen:
            self._time_left.choose(one)

    def _say_chosen(self, event: Event) -> None:
        if not quiet.get():
            self._console.print(Text(sentence(event), style="bold"), soft_wrap=False)

    def settling(self, state: Settling) -> None:
        """Show the progress of the settling."""
        left = "" if state.left_s is None else f", about {duration(state.left_s)} to go"
        if not state.spread:
            self._progress.update(self._task, description=f"the block warms up{left}")
            return
        moving = ", ".join(f"{spread:.2g}" for spread in state.spread)
        self._progress.update(self._task, description=f"settling: moved by {moving} in the window{left}")

    def _show_reading(self, reading: Reading | None) -> None:
        """Keep the last reading on the screen, above the bar."""
        if reading and self._console.is_terminal and not quiet.get():
            values = "  ".join(f"{c} {value:+.6f}" for c, value in zip("xyz", reading.mean, strict=True))
            self._console.print(Text(f"{reading}: {values} {reading.unit}", style="dim"))

    def _print_line(self, index: int) -> None:
        if self._console.is_terminal or quiet.get():
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
