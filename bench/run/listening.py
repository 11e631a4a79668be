"""Inputs of a run from outside: jumps of the computer's clock, the operator's wishes and answers."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from bench.run.events import EventType, Wish
from bench.run.interrupts import interrupt_main
from bench.run.live import LiveSignals
from bench.run.person import (
    INSTRUMENT,
    NOBODY_KNOWN,
    AnswersFile,
    ControlFile,
    Controls,
    LeftAnswer,
    OperatorWish,
    RunControl,
    Stopped,
    WishAuthor,
    asked_to_json,
    problem_with_answer,
    raised,
)
from bench.run.record import Record
from bench.run.terminal import TerminalPerson, heard_at
from drivers.clock import Clock, SystemClock
from drivers.interfaces import NoAnswer, message
from drivers.person import Answer, AnsweredByInstrument, Prompt

GAP_S: Final = 30.0
"""Least jump of civil time against bench time that is reported, s; ordinary clock adjustments are smaller."""


class ClockWatch:
    """Compares civil time (`civil`) with bench time (`now_s`, s) from event to event.

    While a computer sleeps, civil time continues, but on most systems the bench's clock stops. `last` holds both
    times of an earlier event, if any.
    """

    def __init__(
        self,
        civil: Callable[[], datetime],
        now_s: Callable[[], float],
        last: tuple[datetime, float] | None = None,
    ) -> None:
        self._civil = civil
        self._now_s = now_s
        self._last = last

    def gap_s(self) -> float:
        """Return the gain of civil time over bench time since the last call, s; 0 within ± `GAP_S`."""
        civil, now_s = self._civil(), self._now_s()
        last, self._last = self._last, (civil, now_s)
        if last is None:
            return 0.0
        ahead_s = (civil - last[0]).total_seconds() - (now_s - last[1])
        return ahead_s if abs(ahead_s) >= GAP_S else 0.0


LISTEN_S: Final = 0.1
"""Interval between checks of the run's folder for wishes and answers, s."""


class WishListener(Controls):
    """Reads the wishes (operator's commands) left in a run folder; `stopped` is the first wish to stop.

    As a context, it interrupts the main thread at a wish to stop.
    """

    def __init__(self, controls: ControlFile) -> None:
        self._controls = controls
        self._waiting: deque[RunControl] = deque()
        self._taking = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="wishes", daemon=True)

    def __enter__(self) -> WishListener:
        if threading.current_thread() is threading.main_thread():
            self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def poll(self) -> RunControl | None:
        """Return the next wish, or None. Raises `Stopped` for a wish to stop."""
        if (stop := self._take_in()) is not None:
            raise Stopped(stop)
        return self._waiting.popleft() if self._waiting else None

    def _listen(self) -> None:
        while not self._over.wait(LISTEN_S):
            if self._take_in() is not None:
                interrupt_main()

    def _take_in(self) -> RunControl | None:
        """Read the new wishes; return a wish to stop, ahead of all other wishes, or None."""
        with self._taking:
            while (control := self._controls.poll()) is not None:
                if control.wish is Wish.STOP:
                    self.stopped = self.stopped or control
                    return control
                self._waiting.append(control)
        return None


LOOK_S: Final = 1.0
"""Interval between calls of `meanwhile` while a prompt is open, s."""
READ_S: Final = 0.7
"""Least time in which a person can read a prompt and type an answer, s.

If the previous prompt was answered elsewhere, a line typed within this time was meant for that prompt.
"""

Tell = Callable[[EventType, dict[str, Any]], object]
WhyNot = Callable[[RunControl], str]
"""A function that returns why a wish cannot be obeyed now, or an empty string."""


class _Elsewhere(Exception):
    """The prompt was answered in the run's folder; the text of the exception is the answer."""


class Asker:
    """The person of a run, who can answer at a terminal (if any) and through files in the run's `folder`.

    The first `answers_read` answers in the folder are skipped. Until `attach` is called, `tell` records the
    events, and prompts accept no wish (operator's command). `answered_by` is the author of the last answer.
    The class implements `drivers.interfaces.WatchingPerson`.
    """

    def __init__(
        self,
        folder: Path,
        record: Record,
        tell: Tell,
        *,
        terminal: TerminalPerson | None = None,
        answers_read: int = 0,
        clock: Clock | None = None,
    ) -> None:
        self.meanwhile: Callable[[], None] | None = None
        self.live: LiveSignals | None = None
        self.slice_s = LOOK_S
        self.answered_by = NOBODY_KNOWN
        self.terminal = terminal
        if terminal is not None:
            terminal.meanwhile, terminal.slice_s = self._listen, LISTEN_S
        self._record = record
        self._tell = tell
        self._controls = Controls()
        self._why_not: WhyNot = lambda control: ""
        self._wishes: Collection[Wish] | None = ()
        self._answers = AnswersFile(folder, answers_read)
        self._clock = SystemClock() if clock is None else clock
        self._prompt: Prompt | None = None
        self._id, self._refused, self._answered = "", "", ""
        self._looked_s = 0.0

    def attach(self, tell: Tell, controls: Controls, why_not: WhyNot = lambda control: "") -> None:
        """Serve a run from now on: record events by `tell`, and obey the operator's commands from `controls`.

        A wish that `why_not` refuses leaves the question open, so that no step begins again in vain.
        """
        self._tell, self._controls, self._wishes, self._why_not = tell, controls, None, why_not
        if self.terminal is not None:
            self.terminal.wishes = None

    def ask(self, prompt: Prompt) -> Answer:
        """Show the prompt; return the first valid answer, or an invalid answer typed at the terminal.

        The caller rejects an invalid answer and asks again; the record then shows one question, not two. Raises
        `OperatorWish` for an operator's command, and `NoAnswer` at the end of the terminal's input.
        """
        question = prompt.id.rpartition("#")[0]
        if not question or question != self._refused:
            self._id = f"{prompt.id}@{self._record.count + 1}"
            self._tell(EventType.ASKED, asked_to_json(replace(prompt, id=self._id)))
        self._prompt, self._refused = prompt, ""
        if self.live is not None:
            self.live.begin(replace(prompt, id=self._id))
        try:
            text = self._in_folder() if self.terminal is None else self._at_terminal(self.terminal, prompt)
        except _Elsewhere as found:
            text = str(found)
        finally:
            self._prompt = None
            if self.live is not None:
                self.live.end()
        return Answer(prompt.id, text)

    def drain(self) -> None:
        """Refuse the answers left in the folder while no prompt was open."""
        while (left := self._answers.poll()) is not None:
            self._refuse(left, self._why_stale(left))

    # --- sources of an answer ------------------------------------------------------------------------

    def _at_terminal(self, terminal: TerminalPerson, prompt: Prompt) -> str:
        """Return the line typed, even if invalid; the caller reports the fault and asks again."""
        asked_s, after_another = self._clock.now_s(), self.answered_by.where not in ("", terminal.who.where)
        while True:
            try:
                text = terminal.ask(prompt).text
            except NoAnswer:
                if prompt.action["do"] != "wait":
                    raise
                return self._in_folder()  # the person who paused the run may be at the panel
            except OperatorWish as wish:
                if not (why := self._why_not(wish.control)):
                    raise
                self._refuse_wish(wish.control, why)
                continue
            given = LeftAnswer(self._id, text, terminal.who)
            if not (after_another and terminal.by_hand and self._clock.now_s() - asked_s < READ_S):
                break
            self._refuse(given, message("the answer was typed before this question appeared; answer again"))
        if problem := problem_with_answer(prompt, text):
            self._refuse(given, problem)
            self._refused = prompt.id.rpartition("#")[0]
        else:
            self._take(given, prompt)
        return text

    def _in_folder(self) -> str:
        while True:
            self._listen()
            self._clock.sleep(LISTEN_S)

    def _listen(self) -> None:
        """Process wishes and answers; call `meanwhile` if due. Raises `_Elsewhere` or `OperatorWish`."""
        prompt = self._prompt
        if prompt is None:
            return
        if (control := self._controls.poll()) is not None:
            self._hear(control, prompt)
        while (left := self._answers.poll()) is not None:
            if why := self._why_stale(left) or problem_with_answer(prompt, left.answer):
                self._refuse(left, why)
                continue
            self._take(left, prompt)
            raise _Elsewhere(left.answer.strip())
        if self.live is not None:
            self.live.look()
        if self.meanwhile is not None and self._clock.now_s() - self._looked_s >= self.slice_s:
            self._looked_s = self._clock.now_s()
            try:
                self.meanwhile()
            except AnsweredByInstrument as seen:
                self._note(seen, prompt)
                raise

    def _hear(self, control: RunControl, prompt: Prompt) -> None:
        heard = control.wish in (heard_at(prompt) if self._wishes is None else self._wishes)
        why = self._why_not(control) if heard else message("this question does not accept it")
        if not why:
            raise raised(control)
        self._refuse_wish(control, why)

    def _refuse_wish(self, control: RunControl, why: str) -> None:
        refusal = {"wish": control.wish.value, "why": why, **control.who.to_json()}
        self._tell(EventType.WISH_REFUSED, refusal)

    # --- acceptance and refusal ----------------------------------------------------------------------

    def _why_stale(self, left: LeftAnswer) -> str:
        if left.flaw:
            return left.flaw
        if left.id == self._answered:
            by = self.answered_by.by
            already = message("the question was answered already")
            return message(f"the question was answered already by {by}") if by else already
        if self._prompt is None:
            return message("no question is open")
        return "" if left.id == self._id else message("it answers another question than the open one")

    def _take(self, given: LeftAnswer, prompt: Prompt) -> None:
        self.answered_by, self._answered = given.who, given.id
        text = given.answer.strip() or prompt.default or ""
        self._tell(EventType.ANSWERED, _event_data(replace(given, answer=text)))

    def _note(self, seen: AnsweredByInstrument, prompt: Prompt) -> None:
        """Record an instrument's answer, or record its problem so that the question is asked again."""
        given = LeftAnswer(self._id, seen.text, WishAuthor(by=seen.by, where=INSTRUMENT))
        if not seen.problem:
            self._take(given, prompt)
            return
        self._refuse(given, seen.problem)
        self._refused = prompt.id.rpartition("#")[0]

    def _refuse(self, given: LeftAnswer, why: str) -> None:
        self._tell(EventType.ANSWER_REFUSED, {**_event_data(given), "why": why})


def _event_data(given: LeftAnswer) -> dict[str, Any]:
    return {**given.to_json(), **({"line": given.line} if given.line else {})}
