"""The operator's terminal: prompts, typed lines, help, progress bar and time left."""

from __future__ import annotations

import io
import math
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
from bench.base.languages import message, translated
from bench.config.procedure.plan import Plan
from bench.readings.table import Reading
from bench.run.events import HEARD, Event, EventType, RunState, Wish
from bench.run.person import NOBODY_KNOWN, REASON, SIGN, WishAuthor, in_english, parse_wish, raised
from bench.run.resume import steps_of
from bench.run.samples import Settling
from bench.run.sentences import duration, sentence
from drivers.angles import format_dms
from drivers.interfaces import NoAnswer
from drivers.person import Answer, AnsweredByInstrument, Prompt, PromptKind

SLICE_S: Final = 1.0


class LineReader:
    """Reads lines from a stream, one line for each question, without a thread of its own.

    Lines typed while nobody reads wait in the terminal, so that no answer is lost. A stream without a file
    descriptor (and any stream on Windows) cannot be waited for with a timeout: reading then blocks, and `meanwhile`
    is not called.
    """

    def __init__(self, answers: TextIO) -> None:
        self._answers = answers
        self._descriptor = _descriptor(answers)
        self._begun = bytearray()

    def read(self, meanwhile: Callable[[], None] | None = None, slice_s: float = SLICE_S) -> str:
        """Return the next line with its line end; an empty string at the end of the input.

        While waiting for the line, call `meanwhile` every `slice_s` seconds. An exception from `meanwhile` ends
        the question; the rest of a half-typed line is then discarded instead of answering the next question.
        """
        if self._descriptor is None:
            return self._answers.readline()
        while True:
            late = bool(self._begun)  # the rest of a line typed for a question that was abandoned
            line = self._rest_of_line(self._descriptor, meanwhile, slice_s)
            if late and line.endswith(b"\n"):
                continue
            return "" if late else line.decode(self._answers.encoding or "utf-8", "backslashreplace")

    @property
    def waits(self) -> bool:
        """Whether a typed line waits to be read."""
        return self._descriptor is not None and bool(select.select([self._descriptor], [], [], 0.0)[0])

    def _rest_of_line(self, descriptor: int, meanwhile: Callable[[], None] | None, slice_s: float) -> bytes:
        # byte by byte, because `select` would not report bytes that a buffered stream had already read
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
    if sys.platform == "win32":  # `select` supports only sockets there
        return None
    try:
        return answers.fileno()
    except (OSError, ValueError):
        return None


HELP: Final = "?"
"""The answer that requests help on the possible answers."""

MEANINGS: Final = {
    Wish.PAUSE: message("pause; nothing on the bench moves until you continue"),
    Wish.CONTINUE: message("continue after a pause"),
    Wish.REPEAT_POINT: message("measure the last point again; only the new reading counts"),
    Wish.REPEAT_PASS: message("measure the last pass again, from its first point"),
    Wish.MOUNT_AGAIN: message("mount the block again, then measure the last pass again"),
    Wish.SKIP: message("leave this point out; the record keeps your reason"),
    Wish.STOP: message("make the bench safe and stop, as Ctrl-C does; 'bench resume' continues"),
    Wish.ABORT: message("end the run for good; its readings are kept"),
}

_ANSWERS: Final = {
    PromptKind.CONFIRM: message("yes (or y, ok, done): it is done; no: the question comes again"),
    PromptKind.ANGLE: message("the angle on the scale, such as 45 00 10 or 45°00′10″ or 45.0028"),
    PromptKind.NUMBER: message("a number"),
    PromptKind.CHOOSE: message("one of the answers in brackets"),
}


def heard_at(prompt: Prompt) -> tuple[Wish, ...]:
    """Return the wishes (operator's commands) that can have an effect at a prompt of a run."""
    if prompt.action["do"] == "ask" or (prompt.action["do"] == "mount" and prompt.choices):
        return (Wish.PAUSE, Wish.STOP, Wish.ABORT)  # no step is in progress
    state = RunState.PAUSED if prompt.action["do"] == "wait" else RunState.RUNNING
    return tuple(wish for wish in Wish if wish in HEARD[state])


def typing_help(prompt: Prompt, wishes: Collection[Wish]) -> str:
    """Return help on the answers and wishes that can be typed.

    If `wishes` is a mapping, it states the meaning of each wish, in place of `MEANINGS`.
    """
    meanings = wishes if isinstance(wishes, Mapping) else MEANINGS
    answer = _ANSWERS[prompt.kind]
    if prompt.choices:
        answer = message(f"one of: {', '.join(prompt.choices)}")
    if prompt.kind is PromptKind.CONFIRM and prompt.action["do"] in ("ask", "answer", "confirm_reading"):
        answer = message("yes, or no")
    if prompt.kind is PromptKind.NUMBER:
        parts = [message(f"a number in {prompt.unit}") if prompt.unit else answer]
        parts.append("" if prompt.minimum is None else message(f", {prompt.minimum:g} at least"))
        parts.append("" if prompt.maximum is None else message(f", {prompt.maximum:g} at most"))
        answer = "".join(map(translated, parts))
    lines = [translated(message("What can be typed here:")), f"  {translated(answer)}"]
    if prompt.default is not None:
        lines.append("  " + translated(message(f"Enter alone: {prompt.default}")))
    for wish in wishes:
        typed = f"{SIGN}{wish.value}" + (f" {translated(REASON)}" if wish is Wish.SKIP else "")
        lines.append(f"  {typed}: {translated(meanings[wish])}")
    return "\n".join(lines)


SLOW_TO_LEARN_S: Final = 1800.0
"""In the estimated pace, the expected durations count as much as this bench time, s, of observation."""


class TimeLeft:
    """An estimator of the time left in a run from its events; `step_s` is the expected duration of each step, s.

    The pace is that of the steps carried out since the run was begun or resumed. A step that was done before, such
    as a soak after a stop, delays the steps that remain, and is no progress among them.
    """

    def __init__(self, step_s: Sequence[float]) -> None:
        self._step_s = list(step_s)
        self._out: set[int] = set()
        self._done: set[int] = set()
        self._left_s = _from_each_on(self._step_s)
        self._since_s: float | None = None
        self._took_s = self._expected_s = 0.0

    def take(self, event: Event) -> None:
        """Update the estimate with the next event."""
        match event.type:
            case EventType.RUN_RESUMED:
                self._done.update(range(event.step))
                self._since_s, self._took_s, self._expected_s = None, 0.0, 0.0
            case EventType.STEP_DONE:
                if self._since_s is not None and event.bench_s >= self._since_s:  # else a dry run was resumed
                    self._took_s += event.bench_s - self._since_s
                    self._expected_s += self._step_s[event.step]
                self._since_s = event.bench_s
                self._done.add(event.step)
            case EventType.REDO:
                self._done.difference_update(event.steps)
            case EventType.CHOSEN:
                self.choose(event.data)

    def choose(self, chosen: Mapping[str, Any]) -> None:
        """Apply a choice of points: leave out the steps it excludes, rescale the durations of undecided steps."""
        self._out |= steps_of(chosen["left_out"])
        self._out -= steps_of(chosen.get("taken_up", ()))
        step_s = [0.0 if i in self._out else seconds for i, seconds in enumerate(self._step_s)]
        if (open_s := chosen.get("undecided")) is not None:
            place = slice(int(open_s["first"]), int(open_s["last"]) + 1)
            whole_s = sum(step_s[place])
            part = float(open_s["takes_s"]) / whole_s if whole_s > 0 else 0.0
            step_s[place] = [part * seconds for seconds in step_s[place]]
        self._left_s = _from_each_on(step_s)

    def at(self, index: int) -> float:
        """Return the estimated time left, s, at the beginning of step `index`."""
        pace = (self._took_s + SLOW_TO_LEARN_S) / (self._expected_s + SLOW_TO_LEARN_S)
        if index not in self._done:
            return pace * self._left_s[index]
        remaining = (i for i in range(len(self._step_s)) if i not in self._done and i not in self._out)
        return pace * (self._step_s[index] + self._left_s[next(remaining, -1)])


def _from_each_on(step_s: Sequence[float]) -> list[float]:
    """Return the time from the start of each step to the end of all, s, then a final 0: [1, 2] -> [3, 2, 0]."""
    return [*reversed(list(accumulate(reversed(step_s)))), 0.0]


HINTS: Final = {
    PromptKind.CONFIRM: message("yes/no"),
    PromptKind.ANGLE: message("degrees minutes seconds"),
}


class TerminalPerson:
    """A person who answers prompts through a text stream: a keyboard, or a file of answers.

    `pause` and `go_on` are called before and after each prompt, so that a progress bar is hidden during it.
    `wishes` are the operator's commands that the help names, by default those of `heard_at`; if there are none,
    prompts accept no command. `who` is the author of answers and commands. The class implements
    `drivers.interfaces.WatchingPerson`; `slice_s` is the interval between calls of `meanwhile`, s.
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
        self._has_live_line = False
        if isinstance(answers, io.TextIOWrapper) and answers.errors != "backslashreplace":
            answers.reconfigure(
                errors="backslashreplace"
            )  # undecodable bytes become an invalid answer instead of an error

    @property
    def by_hand(self) -> bool:
        """Whether the answers are typed at a terminal; False for a file."""
        return self._answers.isatty()

    def beside(self, bar: ProgressBar) -> None:
        """Hide the progress bar `bar` during each prompt."""
        self._pause, self._go_on = bar.pause, bar.go_on

    def ask(self, prompt: Prompt) -> Answer:
        """Show the prompt and return the typed line as its answer.

        Raises `NoAnswer` at the end of the input, and `OperatorWish` or `Stopped` for a wish (":redo").
        """
        self._pause()
        try:
            if prompt.picture:
                self._console.print(Text(translated(prompt.picture), style="dim"))
            line = self._line(prompt)
            while line.startswith(SIGN) or line.strip() == HELP:
                self._say(self._to_extra(prompt, line))
                line = self._line(prompt)
        except AnsweredByInstrument:
            self._console.bell()
            raise
        finally:
            self._go_on()
        if not line:
            raise NoAnswer(
                "operator",
                f"the input ended before an answer to: {prompt.text}",
                "resume the run and answer it",
            )
        return Answer(prompt.id, in_english(prompt, line.strip()))

    def _to_extra(self, prompt: Prompt, line: str) -> str:
        """Return the reply to `?` or to an invalid wish; raise `OperatorWish` or `Stopped` for a valid wish."""
        wishes = heard_at(prompt) if self.wishes is None else self.wishes
        if line.strip() == HELP:
            return typing_help(prompt, wishes)
        if not wishes:
            return translated(message("this question accepts no command; answer it, or press Ctrl-C"))
        try:
            wish = replace(parse_wish(line), who=self.who)
        except ValueError as mistake:
            return translated(str(mistake))
        raise raised(wish)

    def _say(self, text: str, style: str = "", end: str = "\n") -> None:
        """Print text wrapped between words; a terminal would break lines within words."""
        self._console.print(Text(text, style=style), end=end, soft_wrap=False)

    def _line(self, prompt: Prompt) -> str:
        _forget_typed_ahead(self._answers)
        self._say(f"» {translated(prompt.text)}", "bold")
        self._has_live_line = self.by_hand and self._console.is_terminal
        if self._has_live_line:
            self._console.print()  # leave the line with the live signals
        self._say(f"  [{self._hint(prompt)}] ", end="")
        line = self._reader.read(self.meanwhile, self.slice_s)
        if line and not self._answers.isatty():
            self._console.print(Text(line.rstrip()))  # echo the line as a terminal does for typed input
        return line

    def show_live(self, line: str) -> None:
        """Show a line above the one being typed, at a terminal; the cursor stays where it is.

        Once Enter was pressed, nothing is shown: the line above the cursor is then the typed answer.
        """
        if self._has_live_line and not self._reader.waits:
            cut = line[: max(self._console.width - 3, 0)]
            self._console.file.write(f"\x1b7\x1b[1A\r\x1b[2K  {cut}\x1b8")
            self._console.file.flush()

    @staticmethod
    def _hint(prompt: Prompt) -> str:
        hints = prompt.choices or (HINTS.get(prompt.kind, prompt.unit),)
        default = message(f"Enter = {prompt.default}") if prompt.default is not None else ""
        parts = (
            ", ".join(map(translated, hints)),
            translated(default),
            translated(message(f"{HELP} = help")),
        )
        return "; ".join(filter(None, parts))


def _forget_typed_ahead(answers: TextIO) -> None:
    """Discard keys pressed before the prompt was shown, because they cannot answer it."""
    if not answers.isatty():
        return
    try:
        import termios
    except ImportError:  # a system without POSIX terminals
        return
    termios.tcflush(answers.fileno(), termios.TCIFLUSH)


class ProgressBar:
    """An observer of a run that draws a progress bar: step, installation, pass, point, time left.

    If the output is not a terminal, it prints a line for each pass instead.
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
            TextColumn(
                "{task.percentage:>3.0f} %  {task.fields[left]} "
                + translated(message("left", "time"), "time")
            ),
            console=console,
            transient=True,
            disable=not console.is_terminal or quiet.get(),
        )
        self._task = self._progress.add_task(
            translated(message("opening the instruments")), total=len(plan.steps), left=""
        )

    def __enter__(self) -> ProgressBar:
        self._progress.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._progress.stop()

    def pause(self) -> None:
        """Hide the bar during a prompt, and print the run's present status."""
        self._progress.stop()
        self._asked = True
        if self._status:
            self._console.print(Text(translated(self._status), style="dim"), soft_wrap=False)

    def go_on(self) -> None:
        """Show the bar again after a prompt."""
        self._asked = False
        self._progress.start()

    def __call__(self, event: Event) -> None:
        """Update the bar for an event of the run."""
        self._time_left.take(event)
        if event.type == EventType.STEP_STARTED:
            index = event.step
            left = duration(self._time_left.at(index))
            step = message(f"step {index + 1}/{len(self._plan.steps)}")
            text = f"{step}  {self._plan.steps[index].describe()}"
            self._status = f"{text}; {message(f'{left} left')}"
            self._progress.update(self._task, description=translated(text), completed=index, left=left)
            self._print_line(index)
        elif event.type == EventType.STEP_DONE:
            self._progress.update(self._task, completed=event.step + 1)
            self._show_reading(event.reading)
        elif event.type == EventType.CHOSEN:
            if not quiet.get():
                self._console.print(Text(translated(sentence(event)), style="bold"), soft_wrap=False)
        elif event.type == EventType.EARLY_SIGN and event.data.get("confident"):
            pass  # the next prompt, or the run's error message, contains the sign
        elif (text := sentence(event)) != event.type:
            if self._asked:
                self._console.print()  # leave the prompt's line, where the answer is to be typed
            self._console.print(Text(translated(text), style="bold yellow"), soft_wrap=False)

    def recall(self, chosen: Sequence[Mapping[str, Any]]) -> None:
        """Apply the choices of points recorded before the run was resumed."""
        for one in chosen:
            self._time_left.choose(one)

    def settling(self, state: Settling) -> None:
        """Show the progress of settling or warming up in the bar."""
        left = "" if state.left_s is None else message(f", about {duration(state.left_s)} to go")
        if not state.spread:
            self._progress.update(self._task, description=translated(message(f"the block warms up{left}")))
            return
        moving = ", ".join(f"{spread:.2g}" for spread in state.spread)
        self._progress.update(
            self._task, description=translated(message(f"settling: moved by {moving} in the window{left}"))
        )

    def _show_reading(self, reading: Reading | None) -> None:
        if reading and self._console.is_terminal and not quiet.get():
            values = "  ".join(f"{c} {value:+.6f}" for c, value in zip("xyz", reading.mean, strict=True))
            # with the angle, so that a person sees how a typed one was understood
            at = "" if reading.angle_deg is None else f", {format_dms(math.radians(reading.angle_deg), 1)}"
            self._console.print(Text(f"{reading}{at}: {values} {reading.unit}", style="dim"))

    def _print_line(self, index: int) -> None:
        if self._console.is_terminal or quiet.get():
            return
        step = self._plan.steps[index]
        where, number = getattr(step, "installation", None), getattr(step, "pass_number", None)
        if where is None or not number:
            return
        line = message(f"installation {where}") + message(f", pass {number}")
        if line != self._printed:
            step_of = message(f"(step {index + 1}/{len(self._plan.steps)})")
            self._console.print(f"{translated(line)}  {translated(step_of)}", highlight=False)
            self._printed = line
