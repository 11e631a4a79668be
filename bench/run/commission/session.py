"""A commissioning session: bench, person, wire log, and the findings of the checks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final

from bench.base.languages import HEADING, message, translated
from bench.config.bench_file.file import BenchFile
from bench.config.bench_file.sections import InstrumentForm
from bench.config.devices.device import WiredForm
from bench.run.driver_checks import checked_identity, named_fault
from bench.run.events import Wish
from bench.run.instruments import Instruments
from bench.run.person import OperatorWish, confirm
from drivers.clock import Clock, SystemClock
from drivers.interfaces import (
    BadReading,
    BenchError,
    Identity,
    Instrument,
    InstrumentLost,
    InstrumentRefused,
    LimitExceeded,
    NoAnswer,
)
from drivers.person import Action, Answer, Person, Prompt, PromptKind, WatchingPerson


class State(StrEnum):
    """The result of one check of an instrument."""

    WORKS = message("works", "heading")
    SLOWER = message("slower", "heading")
    """The instrument works, but more slowly than its driver expects."""
    OTHER = message("other", "heading")
    """The instrument answers, but not as its driver or its data sheet says."""
    COULD_NOT = message("could not")
    """The check could not be carried out."""
    SKIPPED = message("skipped", "heading")
    """The person left the check out; the reason is on record."""


DONE, NOT_AS_EXPECTED, NOT_DONE = 0, 1, 2
"""Exit statuses; the worst finding determines the status of a session."""

_STATUS: Final = {State.SLOWER: NOT_AS_EXPECTED, State.OTHER: NOT_AS_EXPECTED, State.COULD_NOT: NOT_DONE}


@dataclass(frozen=True, slots=True)
class Figure:
    """A measured value in `unit`; `expected` describes the value with which it was compared."""

    what: str
    value: float
    unit: str
    expected: str = ""

    @property
    def text(self) -> str:
        """The figure as text, such as "reading took 3.2 s (the driver expects 3 s)"."""
        held = f" ({self.expected})" if self.expected else ""
        return f"{self.what} {self.value:.4g} {self.unit}".rstrip() + held


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check of one instrument.

    `said` is a clause without the instrument's name; `remedy` tells the person how to correct a deviation.
    """

    check: str
    instrument: str
    state: State
    said: str
    figures: tuple[Figure, ...] = ()
    remedy: str = ""

    @property
    def sentence(self) -> str:
        """The finding as one line of text, in the current language."""
        remedy = f"; {translated(self.remedy)}" if self.remedy else ""
        check, said = translated(self.check, HEADING), translated(self.said, HEADING)
        return f"{translated(self.instrument)}: {check}: {said}{remedy}"


def status_of(findings: Sequence[Finding], *, whole: bool) -> int:
    """Return the exit status of a session with these findings; `whole` says whether the session was completed.

    The status is 2 if the session was incomplete or a check could not be done, else 1 if a check found a deviation,
    else 0.
    """
    if not whole or not findings:
        return NOT_DONE
    return max(_STATUS.get(finding.state, DONE) for finding in findings)


Wire = Callable[[str, str, str], None]
"""A wire log: called with the instrument, the direction (`>` sent, `<` received, `!` failed) and the text."""


@dataclass(frozen=True, slots=True)
class TimedExchange:
    """A command and its response time, s."""

    instrument: str
    command: str
    took_s: float


class WireWatch:
    """A `Wire` that records exchanges and failures, timed by `time_s`, and forwards all messages to `log`."""

    def __init__(self, log: Wire | None, time_s: Callable[[], float] | None = None) -> None:
        self.time_s = time_s or SystemClock().now_s
        self._log = log
        self._sent: dict[str, tuple[str, float]] = {}
        self._exchanges: list[TimedExchange] = []
        self._failures: list[tuple[str, str]] = []

    def __call__(self, instrument: str, direction: str, text: str) -> None:
        """Record one message and forward it."""
        now_s = self.time_s()
        if direction == ">":
            self._sent[instrument] = (text, now_s)
        elif direction == "!":
            self._sent.pop(instrument, None)
            self._failures.append((instrument, text))
        elif instrument in self._sent:
            command, sent_s = self._sent.pop(instrument)
            self._exchanges.append(TimedExchange(instrument, command, now_s - sent_s))
        if self._log is not None:
            self._log(instrument, direction, text)

    def mark(self) -> tuple[int, int]:
        """Return a mark of this moment; `exchanges` and `failures` return what follows it."""
        return len(self._exchanges), len(self._failures)

    def exchanges(self, mark: tuple[int, int], instrument: str) -> list[TimedExchange]:
        """Return the exchanges of an instrument since `mark`."""
        return [one for one in self._exchanges[mark[0] :] if one.instrument == instrument]

    def failures(self, mark: tuple[int, int], instrument: str) -> list[str]:
        """Return the failures on an instrument's wire since `mark`."""
        return [text for name, text in self._failures[mark[1] :] if name == instrument]


WISHES: Final = {
    Wish.SKIP: message("leave this check out; the page states the reason"),
    Wish.ABORT: message("end here; the bench is made safe and the page written"),
}
"""Wishes accepted at any prompt, with their effects."""
ONLY_THESE: Final = message("Only :skip REASON and :abort work here. ")
MOST_LOSSES: Final = 2
"""Number of losses after which an instrument is no longer checked, because each loss costs several timeouts."""
SLOW_PART: Final = 0.5
"""Greatest fraction of the timeout that a response may take; a slower one is reported."""
_CHECK_WIRE: Final = message("check cable and power; the wire log shows the failed command")


class Skipped(Exception):
    """The person skips a check; the text is the reason."""


class SessionEnded(Exception):
    """The person has ended the session, or no more answers come; the text is the reason."""


class CheckEnded(Exception):
    """A check ends early; `finding` is its result."""

    def __init__(self, finding: Finding) -> None:
        super().__init__(finding.said)
        self.finding = finding


class PersonBehind:
    """A `WatchingPerson` that passes prompts on to `person`, and `meanwhile` if that is a `WatchingPerson`."""

    def __init__(self, person: Person) -> None:
        self._person = person

    @property
    def meanwhile(self) -> Callable[[], None] | None:
        """The function that is called while a question waits for its answer."""
        return self._person.meanwhile if isinstance(self._person, WatchingPerson) else None

    @meanwhile.setter
    def meanwhile(self, look: Callable[[], None] | None) -> None:
        if isinstance(self._person, WatchingPerson):
            self._person.meanwhile = look


class CommissioningPerson(PersonBehind):
    """A `Person` for commissioning, who can type the commands :skip REASON and :abort at any prompt."""

    def ask(self, prompt: Prompt) -> Answer:
        """Show the prompt and return the answer. Raises `Skipped` for :skip, and `SessionEnded` for :abort.

        After any other command, name the accepted ones and show the prompt again.
        """
        put = prompt
        while True:
            try:
                return self._person.ask(put)
            except OperatorWish as wish:
                if wish.control.wish is Wish.SKIP:
                    raise Skipped(wish.control.reason) from wish
                if wish.control.wish is Wish.ABORT:
                    raise SessionEnded("the person ended the session") from wish
            put = replace(prompt, text=ONLY_THESE + prompt.text)


@dataclass
class CommissioningSession:
    """A commissioning session on a bench, with its findings.

    `time_s` is the clock for measuring durations: the bench's clock, plus the computer's time on a simulated
    bench. `connections` maps each wired instrument to a function that returns the number of the present connection,
    None if there is no connection. `tell` displays a line.
    """

    file: BenchFile
    instruments: Instruments
    person: Person
    clock: Clock
    time_s: Callable[[], float]
    watch: WireWatch
    connections: Mapping[str, Callable[[], int | None]]
    tell: Callable[[str], None] = lambda line: None
    simulated: bool = False
    findings: list[Finding] = field(default_factory=list)
    identities: dict[str, Identity] = field(default_factory=dict)
    _losses: dict[str, int] = field(default_factory=dict)
    _prompts: int = 0

    # --- settings of the bench file -----------------------------------------------------------------

    def section(self, name: str) -> InstrumentForm:
        """Return the bench file's section on an instrument."""
        return next(section for section in self.file.instruments.all() if section.name == name)

    def timeout_s(self, name: str) -> float:
        """Return the timeout of an instrument's reply, s; 0 for an instrument operated by hand."""
        section = self.section(name)
        return section.timeout if isinstance(section, WiredForm) else 0.0

    # --- the person ---------------------------------------------------------------------------------

    def confirm(self, text: str, *, default: str | None = None, action: Action | None = None) -> None:
        """Ask the person to confirm `text`, again after each "no".

        Raises `Skipped`, `SessionEnded`, or `BenchError` after too many invalid answers or refusals.
        """
        self._prompts += 1
        prompt = Prompt(
            f"commission/{self._prompts}",
            PromptKind.CONFIRM,
            text,
            default,
            action=action or {"do": "answer"},
        )
        try:
            confirm(self.person, prompt)
        except NoAnswer as error:
            raise SessionEnded(error.cause) from error

    # --- checks -------------------------------------------------------------------------------------

    def note(self, finding: Finding) -> None:
        """Store a finding and display it."""
        self.findings.append(finding)
        self.tell(f"{translated(finding.state.value, HEADING):>9}  {finding.sentence}")

    def carry_out(
        self,
        check: str,
        instrument: Instrument,
        look: Callable[[], Finding],
        *,
        also: Sequence[Instrument] = (),
        by_answers: bool = True,
        by_wire: bool = True,
        opened: bool = True,
    ) -> Finding:
        """Carry out one check of one instrument; store and return its finding, even after an exception.

        `look` performs the check. `also` are the other instruments that take part. `by_wire` adds a check for
        faults on the wires; with `by_answers`, this includes the response times of single commands. With `opened`
        False, the instruments are not opened first. Raises only `SessionEnded` and `KeyboardInterrupt`.
        """
        name = instrument.name
        if not self.present(instrument):
            found = Finding(
                check, name, State.COULD_NOT, "not tried: the instrument was lost before", remedy=_CHECK_WIRE
            )
        else:
            taking_part = (instrument, *also)
            mark = self.watch.mark()
            connections = {one.name: self._connection(one.name) for one in taking_part}
            found = self._found(check, taking_part, look, opened)
            for one in taking_part if by_wire else ():
                if found.state in (State.WORKS, State.SLOWER):
                    found = self._with_wire(found, one.name, mark, connections[one.name], by_answers)
        self.note(found)
        return found

    def present(self, instrument: Instrument) -> bool:
        """Return whether an instrument is still checked; not after `MOST_LOSSES` losses or failed openings."""
        return self._losses.get(instrument.name, 0) < MOST_LOSSES

    def _found(
        self, check: str, taking_part: Sequence[Instrument], look: Callable[[], Finding], opened: bool
    ) -> Finding:
        name = taking_part[0].name
        try:
            for one in taking_part:
                if opened and one.name not in self.identities:
                    self._open(one)
            return look()
        except Skipped as why:
            return Finding(check, name, State.SKIPPED, str(why))
        except CheckEnded as ended:
            return ended.finding
        except NoAnswer as error:
            raise SessionEnded(error.cause) from error
        except InstrumentLost as error:
            self._lose(error.instrument)
            return self._of_error(check, name, State.COULD_NOT, error)
        except (InstrumentRefused, BadReading, LimitExceeded) as error:
            not_opened = opened and any(one.name not in self.identities for one in taking_part)
            return self._of_error(check, name, State.COULD_NOT if not_opened else State.OTHER, error)
        except BenchError as error:
            return self._of_error(check, name, State.COULD_NOT, error)
        except Exception as error:  # a defect of one driver must not prevent the checks of the others
            if (fault := named_fault(error, taking_part)) is not None:
                return self._of_error(check, name, State.OTHER, fault)
            cause = message(f"the driver failed with {type(error).__name__} ({error})")
            return Finding(check, name, State.OTHER, cause, remedy="report it with the wire log")

    def _open(self, instrument: Instrument) -> None:
        """Open an instrument; a failure counts as a loss of the instrument. Raises `BenchError`."""
        try:
            self.identities[instrument.name] = checked_identity(instrument, instrument.open())
        except InstrumentLost:
            raise
        except BenchError:
            self._lose(instrument.name)
            raise

    def _lose(self, name: str) -> None:
        self._losses[name] = self._losses.get(name, 0) + 1

    def _of_error(self, check: str, name: str, state: State, error: BenchError) -> Finding:
        """Return the finding for an error.

        It concerns the instrument that the error names or, if the bench lacks that instrument, `name`.
        """
        known = error.instrument in {one.name for one in self.instruments.all()}
        about = "" if known else f"{error.instrument}: "
        remedy = "; ".join((error.remedy, *getattr(error, "__notes__", ())))
        return Finding(
            check, error.instrument if known else name, state, f"{about}{error.cause}", remedy=remedy
        )

    def _connection(self, name: str) -> int | None:
        number = self.connections.get(name)
        return None if number is None else number()

    def _with_wire(
        self, found: Finding, name: str, mark: tuple[int, int], before: int | None, by_answers: bool
    ) -> Finding:
        """Return the finding with faults on the wire since `mark` added: failures, garbled replies, slow responses.

        `before` is the number of the connection at `mark`; `by_answers` also adds slow responses.
        """
        failures, after = self.watch.failures(mark, name), self._connection(name)
        if failures:
            said = message(f"{found.said}, but its wire failed meanwhile ({failures[0]})")
            return replace(found, instrument=name, state=State.OTHER, said=said, remedy=_CHECK_WIRE)
        if before is not None and after != before:
            said = message(f"{found.said}, but one answer was garbled and was requested again")
            return replace(found, instrument=name, state=State.OTHER, said=said, remedy=_CHECK_WIRE)
        exchanges = self.watch.exchanges(mark, name)
        if not by_answers or not exchanges or found.state is State.SLOWER:
            return found
        slowest = max(exchanges, key=lambda one: one.took_s)
        most_s = SLOW_PART * self.timeout_s(name)
        given_up = message(f"given up after {self.timeout_s(name):g} s")
        figure = Figure("slowest answer", slowest.took_s, "s", given_up)
        found = replace(found, figures=(*found.figures, figure))
        if slowest.took_s <= most_s:
            return found
        return replace(
            found,
            state=State.SLOWER,
            said=message(f"{found.said}, but the answer to {slowest.command} took {slowest.took_s:.2g} s"),
            remedy=message(
                f"find the cause of the delay, or set its timeout above {2.0 * slowest.took_s:.2g} s in "
                "the bench file"
            ),
        )
