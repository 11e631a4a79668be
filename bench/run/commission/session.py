"""A commissioning session: bench, person and wires, and the findings of its checks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final

from bench.config.bench_file.file import BenchFile
from bench.config.bench_file.sections import InstrumentForm
from bench.config.devices.device import WiredForm
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
from drivers.person import Action, Answer, Person, Prompt, PromptKind


class State(StrEnum):
    """The result of one check of an instrument."""

    WORKS = "works"
    SLOWER = "slower"
    """The instrument works, but more slowly than its driver expects."""
    OTHER = "other"
    """The instrument answers, but not as its driver or its data sheet says."""
    COULD_NOT = "could not"
    """The check could not be carried out."""
    SKIPPED = "skipped"
    """The person left the check out; the reason is on record."""


DONE, NOT_AS_EXPECTED, NOT_DONE = 0, 1, 2
"""Exit statuses, by the worst finding."""

_STATUS: Final = {State.SLOWER: NOT_AS_EXPECTED, State.OTHER: NOT_AS_EXPECTED, State.COULD_NOT: NOT_DONE}


@dataclass(frozen=True, slots=True)
class Figure:
    """A measured number in `unit`, and in words the value with which it was compared."""

    what: str
    value: float
    unit: str
    expected: str = ""

    @property
    def text(self) -> str:
        """The figure as text for a person."""
        held = f" ({self.expected})" if self.expected else ""
        return f"{self.what} {self.value:.4g} {self.unit}".rstrip() + held


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check of one instrument.

    `said` is a clause without the instrument's name, `remedy` the action to take.
    """

    check: str
    instrument: str
    state: State
    said: str
    figures: tuple[Figure, ...] = ()
    remedy: str = ""

    @property
    def sentence(self) -> str:
        """The finding in one line."""
        remedy = f"; {self.remedy}" if self.remedy else ""
        return f"{self.instrument}: {self.check}: {self.said}{remedy}"


def status_of(findings: Sequence[Finding], *, whole: bool) -> int:
    """Return the exit status.

    It is 2 where a check could not be done or the session was not completed, 1 after other deviations, 0
    otherwise.
    """
    if not whole or not findings:
        return NOT_DONE
    return max(_STATUS.get(finding.state, DONE) for finding in findings)


Wire = Callable[[str, str, str], None]
"""A wire log: called with the instrument, the direction (`>` sent, `<` received, `!` failed) and the text."""


@dataclass(frozen=True, slots=True)
class TimedExchange:
    """A command and the time until its answer, s."""

    instrument: str
    command: str
    took_s: float


class WireWatch:
    """A `Wire` that notes exchanges and failures and passes everything on; `time_s` is its clock."""

    def __init__(self, log: Wire | None, time_s: Callable[[], float] | None = None) -> None:
        self.time_s = time_s or SystemClock().now_s
        self._log = log
        self._sent: dict[str, tuple[str, float]] = {}
        self._exchanges: list[TimedExchange] = []
        self._failures: list[tuple[str, str]] = []

    def __call__(self, instrument: str, direction: str, text: str) -> None:
        """Note one message and pass it on."""
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
        """Return the number of exchanges and of failures so far."""
        return len(self._exchanges), len(self._failures)

    def exchanges(self, mark: tuple[int, int], instrument: str) -> list[TimedExchange]:
        """Return the exchanges of an instrument since a mark."""
        return [one for one in self._exchanges[mark[0] :] if one.instrument == instrument]

    def failures(self, mark: tuple[int, int], instrument: str) -> list[str]:
        """Return the failures on an instrument's wire since a mark."""
        return [text for name, text in self._failures[mark[1] :] if name == instrument]


WISHES: Final = {
    Wish.SKIP: "leave this out; the reason goes into the page",
    Wish.ABORT: "end here; the bench is left safe and the page written",
}
"""Wishes that may be typed at any question, with their effects."""
ONLY_THESE: Final = "Here only :skip REASON and :abort are heard. "
MOST_LOSSES: Final = 2
"""Number of checks that may lose an instrument before it is tried no more: each loss costs its timeouts."""
SLOW_PART: Final = 0.5
"""Greatest part of its timeout that an answer may take; beyond this the reserve is too small."""
_CHECK_WIRE: Final = "check cable and power; the wire log shows at which command"


class Skipped(Exception):
    """The person leaves a check out; the text is the reason."""


class SessionEnded(Exception):
    """The person, or the end of the answers, ends the session; the text is the reason."""


class CheckEnded(Exception):
    """A check ends here with its finding."""

    def __init__(self, finding: Finding) -> None:
        super().__init__(finding.said)
        self.finding = finding


class CommissioningPerson:
    """A `Person` for commissioning: raises `Skipped` for :skip REASON, `SessionEnded` for :abort."""

    def __init__(self, person: Person) -> None:
        self._person = person

    def ask(self, prompt: Prompt) -> Answer:
        """Put the prompt; after any other wish, name those that are heard and put it again."""
        put = prompt
        while True:
            try:
                return self._person.ask(put)
            except OperatorWish as wish:
                if wish.control.wish is Wish.SKIP:
                    raise Skipped(wish.control.reason) from wish
                if wish.control.wish is Wish.ABORT:
                    raise SessionEnded("ended by the person") from wish
            put = replace(prompt, text=ONLY_THESE + prompt.text)


@dataclass
class CommissioningSession:
    """A commissioning session on a bench, with its findings.

    `time_s` measures durations: the bench's clock; on a simulated bench plus the computer's time for the
    wires. `connections` returns the number of the present connection of each wired instrument (None: not
    connected). `tell` shows a line.
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

    # --- what the bench file says -------------------------------------------------------------------

    def section(self, name: str) -> InstrumentForm:
        """Return the section of an instrument."""
        return next(section for section in self.file.instruments.all() if section.name == name)

    def timeout_s(self, name: str) -> float:
        """Return the timeout of a reply, s; 0 for an instrument worked by hand."""
        section = self.section(name)
        return section.timeout if isinstance(section, WiredForm) else 0.0

    # --- the person ---------------------------------------------------------------------------------

    def confirm(self, text: str, *, default: str | None = None, action: Action | None = None) -> None:
        """Have the person confirm. Raises `Skipped`, `SessionEnded`, `BenchError` after a refusal."""
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
        """Store a finding and show it."""
        self.findings.append(finding)
        self.tell(f"{finding.state.value:>9}  {finding.sentence}")

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
        """Carry out one check of one instrument; return and store its finding, also after an exception.

        `also` are further instruments in the check. `by_answers` judges the time of single answers as well,
        `by_wire` other faults on the wires. If `opened` is False, the check needs no open instrument. Raises
        `SessionEnded` and `KeyboardInterrupt` alone.
        """
        name = instrument.name
        if not self.present(instrument):
            found = Finding(check, name, State.COULD_NOT, "not tried, it was lost before", remedy=_CHECK_WIRE)
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
        """Return whether an instrument is still tried; one lost in too many checks is not."""
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
        except Exception as error:  # one driver's mistake must not hide what the others show
            cause = f"the driver failed with {type(error).__name__} ({error})"
            return Finding(check, name, State.OTHER, cause, remedy="report it with the wire log")

    def _open(self, instrument: Instrument) -> None:
        """Open an instrument; one that refuses counts as lost, too. Raises `BenchError`."""
        try:
            self.identities[instrument.name] = instrument.open()
        except InstrumentLost:
            raise
        except BenchError:
            self._lose(instrument.name)
            raise

    def _lose(self, name: str) -> None:
        self._losses[name] = self._losses.get(name, 0) + 1

    def _of_error(self, check: str, name: str, state: State, error: BenchError) -> Finding:
        """Return the finding for an error; it belongs to the instrument that raised the error."""
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
        """Return a finding with faults on a wire: failures that the driver overcame, and late answers."""
        failures, after = self.watch.failures(mark, name), self._connection(name)
        if failures:
            said = f"{found.said}, but its wire failed on the way ({failures[0]})"
            return replace(found, instrument=name, state=State.OTHER, said=said, remedy=_CHECK_WIRE)
        if before is not None and after != before:
            said = f"{found.said}, but an answer could not be understood and was asked for again"
            return replace(found, instrument=name, state=State.OTHER, said=said, remedy=_CHECK_WIRE)
        exchanges = self.watch.exchanges(mark, name)
        if not by_answers or not exchanges or found.state is State.SLOWER:
            return found
        slowest = max(exchanges, key=lambda one: one.took_s)
        most_s = SLOW_PART * self.timeout_s(name)
        figure = Figure("slowest answer", slowest.took_s, "s", f"given up after {self.timeout_s(name):g} s")
        found = replace(found, figures=(*found.figures, figure))
        if slowest.took_s <= most_s:
            return found
        return replace(
            found,
            state=State.SLOWER,
            said=f"{found.said}, but the answer to {slowest.command} took {slowest.took_s:.2g} s",
            remedy=f"find out what holds it up, or give it a timeout of more than {2.0 * slowest.took_s:.2g} s in "
            "the bench file",
        )
