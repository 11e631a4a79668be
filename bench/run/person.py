"""The person at a run: wishes, answers left in the run's folder, prompts, and problems with an answer."""

from __future__ import annotations

import getpass
import json
import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final, Protocol

from bench.base.files import open_regular
from bench.base.numbers import read_number
from bench.base.text import in_json, shortened
from bench.config.procedure.plan import Mount
from bench.run.events import Event, EventType, Wish
from drivers.angles import format_dms, parse_angle, read_angle, typed_bubble, typed_supply, typed_temperature
from drivers.interfaces import BenchError
from drivers.person import Person, Prompt, PromptKind

CONTROL: Final = "control.jsonl"
SIGN: Final = ":"
"""First character of a wish typed at the terminal: ":redo", ":skip the cable came loose"."""


@dataclass(frozen=True)
class WishAuthor:
    """The author of a wish or an answer, the role ("operator", "supervisor"), and the place.

    `where` is "terminal", "panel", or "command" for `bench control`. Old records do not say: then all are
    empty.
    """

    by: str = ""
    role: str = ""
    where: str = ""

    def to_json(self) -> dict[str, str]:
        """Return the author as events and lines in a run's folder record it; an empty dict if nothing is known."""
        return asdict(self) if self != NOBODY_KNOWN else {}

    @classmethod
    def from_json(cls, line: Mapping[str, Any]) -> WishAuthor:
        """Return the author stated in an event or in a line left in a run's folder."""
        return cls(*(str(line.get(name, "")) for name in ("by", "role", "where")))


NOBODY_KNOWN: Final = WishAuthor()


def at_the_shell(where: str) -> WishAuthor:
    """Return the user of this program as author; whoever has a shell in the runs' folder is a supervisor."""
    try:
        name = getpass.getuser()
    except (OSError, KeyError, ImportError):  # no such user, or no such list of them
        name = ""
    return WishAuthor(name, "supervisor", where)


@dataclass(frozen=True)
class RunControl:
    """A wish, its reason and its author; `by_person` says that the person at the prompt has it."""

    wish: Wish
    reason: str = ""
    by_person: bool = False
    who: WishAuthor = NOBODY_KNOWN

    def to_json(self) -> dict[str, str]:
        """Return the wish as a line in the run's folder records it."""
        return {"wish": self.wish.value, "reason": self.reason, **self.who.to_json()}

    def told(self) -> dict[str, str]:
        """Return the reason and the author, as an event records them."""
        return {"reason": self.reason, **self.who.to_json()}

    @classmethod
    def from_json(cls, line: Mapping[str, Any]) -> RunControl:
        """Return the wish in a line. Raises `KeyError`, `TypeError`, `ValueError` where there is none."""
        return cls(Wish(line["wish"]), str(line.get("reason", "")), who=WishAuthor.from_json(line))


class OperatorWish(Exception):
    """The person answered a prompt with a wish; the step that asked is not done."""

    def __init__(self, control: RunControl) -> None:
        super().__init__(control.wish.value)
        self.control = control


class Stopped(KeyboardInterrupt):
    """Somebody wished the run to stop: the same as Ctrl-C, with the author of the wish."""

    def __init__(self, control: RunControl) -> None:
        super().__init__()
        self.control = control


def raised(control: RunControl) -> OperatorWish | Stopped:
    """Return the exception that ends the present step because of a wish."""
    return Stopped(control) if control.wish is Wish.STOP else OperatorWish(control)


class Controls(Protocol):
    """The source of wishes; `stopped` is the wish to stop that interrupted the program."""

    @property
    def stopped(self) -> RunControl | None:
        """The wish to stop, None where there was none."""
        ...

    def poll(self) -> RunControl | None:
        """Return the next wish, None where there is none."""
        ...


class NoControls:
    """A source without wishes."""

    stopped: RunControl | None = None

    def poll(self) -> RunControl | None:
        """Return None."""
        return None


class ControlFile:
    """The wishes left in the folder of a run, one JSON line each; earlier lines count as heard."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / CONTROL
        self._heard = self._path.stat().st_size if self._path.exists() else 0

    def poll(self) -> RunControl | None:
        """Return the next wish, or None; half-written lines wait, lines without a wish are passed over."""
        while (line := self._line()).endswith(b"\n"):
            self._heard += len(line)
            with suppress(ValueError, KeyError, TypeError, AttributeError, RecursionError):
                return RunControl.from_json(json.loads(line))
        return None

    def _line(self) -> bytes:
        try:
            with open_regular(self._path) as file:
                file.seek(self._heard)
                return file.readline()
        except OSError:
            return b""


def leave_wish(folder: Path, control: RunControl) -> None:
    """Write a wish into the folder of a run. Raises `OSError` where it cannot be written."""
    _leave(folder / CONTROL, control.to_json())


def _leave(file: Path, told: Mapping[str, str]) -> None:
    line = in_json(json.dumps(told, ensure_ascii=False))
    with open_regular(file, "ab") as lines:
        lines.write(line.encode() + b"\n")


def parse_wish(text: str) -> RunControl:
    """Return a typed wish, such as ":skip the cable came loose"; the sign may be missing.

    Raises `ValueError` with the list of wishes for anything else, and for a skip without a reason.
    """
    word, _, reason = text.strip().removeprefix(SIGN).partition(" ")
    try:
        wish = Wish(word.lower())
    except ValueError:
        known = ", ".join(f"{SIGN}{w.value}" for w in Wish)
        raise ValueError(f"{SIGN}{word} is no wish; there are {known}") from None
    if wish is Wish.SKIP and not reason.strip():
        raise ValueError(f"say why: {SIGN}skip REASON")
    return RunControl(wish, reason.strip(), by_person=True)


ANSWERS: Final = "answers.jsonl"
LONGEST: Final = 4000
"""Greatest length of an answer in characters; a longer text is no answer."""

YES: Final = frozenset({"y", "yes", "ok", "done"})
NO: Final = frozenset({"n", "no"})
REASON: Final = "REASON"
"""Placeholder at the end of a choice, for words of the person's own: "go on REASON"."""

# --- answers left in a run's folder ------------------------------------------------------------------


@dataclass(frozen=True)
class LeftAnswer:
    """An answer to the question `id`, as typed, with its author; `line` is its number in the file, from 1.

    `flaw` says what is wrong with a line that cannot be read.
    """

    id: str
    answer: str
    who: WishAuthor = NOBODY_KNOWN
    line: int = 0
    flaw: str = ""

    def to_json(self) -> dict[str, str]:
        """Return the answer as a line in the run's folder records it."""
        return {"id": self.id, "answer": self.answer, **self.who.to_json()}


def leave_answer(folder: Path, answer: LeftAnswer) -> None:
    """Write an answer into the folder of a run. Raises `OSError` where it cannot be written."""
    _leave(folder / ANSWERS, answer.to_json())


class AnswersFile:
    """The answers left in the folder of a run, in order; the first `heard` lines are passed over."""

    def __init__(self, folder: Path, heard: int = 0) -> None:
        self._path = folder / ANSWERS
        self._line = 0
        self._place = 0
        while self._line < heard and self._next() is not None:
            pass

    def poll(self) -> LeftAnswer | None:
        """Return the next answer, None where there is none; a half-written line waits.

        A line that cannot be read gives an answer with a `flaw` and without an id.
        """
        found = self._next()
        return None if found is None else _read_answer(found, self._line)

    def _next(self) -> bytes | None:
        """Return the next whole line; of an overlong line only the beginning."""
        try:
            with open_regular(self._path) as file:
                file.seek(self._place)
                beginning = part = file.readline(8 * LONGEST)
                length = len(part)
                while part and not part.endswith(b"\n"):
                    part = file.readline(8 * LONGEST)
                    length += len(part)
        except OSError:
            return None
        if not part.endswith(b"\n"):
            return None
        self._place += length
        self._line += 1
        return beginning


def _read_answer(line: bytes, number: int) -> LeftAnswer:
    try:
        told = json.loads(line)
        prompt_id, text = told["id"], told["answer"]
        if type(prompt_id) is not str or type(text) is not str or len(text) > LONGEST:
            raise ValueError("neither")
        return LeftAnswer(prompt_id, text, WishAuthor.from_json(told), number)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        beginning = line[:100].decode("utf-8", "backslashreplace").strip()
        flaw = f"line {number} of {ANSWERS} is no answer"
        return LeftAnswer("", beginning, WishAuthor(where="panel"), number, flaw)


# --- the question that stands ------------------------------------------------------------------------


@dataclass(frozen=True)
class AskedPrompt:
    """A question on record: its event and its prompt. An answer names the `id` of this prompt."""

    event: Event
    prompt: Prompt


def asked_to_json(prompt: Prompt) -> dict[str, Any]:
    """Return the fields of a prompt that the record keeps."""
    return {of.name: getattr(prompt, of.name) for of in fields(prompt)} | {"kind": prompt.kind.value}


def _asked(event: Event) -> AskedPrompt | None:
    """Return the question in an event; None for a prompt that this version does not know."""
    data = event.data
    try:
        prompt = Prompt(
            id=data["id"],
            kind=PromptKind(data["kind"]),
            text=data["text"],
            default=None if data.get("default") is None else str(data["default"]),
            unit=str(data.get("unit", "")),
            choices=tuple(map(str, data.get("choices", ()))),
            minimum=None if data.get("minimum") is None else float(data["minimum"]),
            maximum=None if data.get("maximum") is None else float(data["maximum"]),
            action=data["action"],
            picture=str(data.get("picture", "")),
        )
    except (KeyError, ValueError, TypeError):
        return None
    return AskedPrompt(event, prompt)


_STANDS: Final = {
    EventType.ASKED, EventType.ANSWER_REFUSED, EventType.WISH_REFUSED, EventType.POWER, EventType.CLOCK_JUMPED,
    EventType.CHAMBER_SLOW, EventType.SAME_SERIAL, EventType.CERTIFICATE,
}  # fmt: skip
"""Events after which a question is still open; any other event closes it."""


@dataclass
class OpenPrompt:
    """Follows a run's events in order, and knows the open question."""

    _event: Event | None = field(default=None, init=False)

    def take(self, event: Event) -> None:
        """Take note of an event."""
        if event.type == EventType.ASKED:
            self._event = event
        elif event.type not in _STANDS:
            self._event = None

    @property
    def prompt(self) -> AskedPrompt | None:
        """The open question, None where there is none."""
        return None if self._event is None else _asked(self._event)


def open_prompt(events: Iterable[Event]) -> AskedPrompt | None:
    """Return the question that is open after the events of a run, in their order; None where none is.

    An answer is heard only as long as a program carries out the run.
    """
    found = OpenPrompt()
    for event in events:
        found.take(event)
    return found.prompt


# --- what is wrong with an answer --------------------------------------------------------------------


def problem_with_answer(prompt: Prompt, text: str) -> str:
    """Return what is wrong with an answer, in words; empty when it fits the prompt's kind, limits and target.

    An empty answer means the prompt's default, where it has one. Values read from a scale or a display are
    judged by the rules of the driver that asks. The function changes nothing, so that it can be called while
    somebody types.
    """
    given = text.strip() or prompt.default or ""
    try:
        _read_by_eye(prompt, given)
    except ValueError as trouble:
        return str(trouble).rstrip(".")
    match prompt.kind:
        case PromptKind.CONFIRM:
            return "" if given.lower() in YES | NO else f"answer yes or no, not {given!r}"
        case PromptKind.CHOOSE:
            return _problem_with_choice(prompt, given)
        case PromptKind.NUMBER:
            return "" if prompt.action.get("do") in _BY_EYE else _problem_with_number(prompt, given)
        case PromptKind.ANGLE:
            return ""


def understood_answer(prompt: Prompt, text: str) -> str:
    """Return the meaning of an answer that fits, such as `120° 30′ 15.0″` or `23.5 °C`; else empty."""
    if problem_with_answer(prompt, text):
        return ""
    given = text.strip() or prompt.default or ""
    match prompt.kind:
        case PromptKind.ANGLE:
            value = _read_by_eye(prompt, given)
            return given if value is None else _spaced(parse_angle(given))
        case PromptKind.NUMBER:
            value = _read_by_eye(prompt, given)
            if prompt.action["do"] == "read_level":
                return f"{given} = {math.degrees(value or 0.0) * 3600.0:+.1f}″"
            return f"{_number(given, prompt.unit) if value is None else value:g} {prompt.unit}".rstrip()
        case PromptKind.CONFIRM:
            return "no" if given.lower() in NO else "yes"
        case PromptKind.CHOOSE:
            return given


_BY_EYE: Final = frozenset({"turn", "read_temperature", "read_level", "read_supply"})


def _read_by_eye(prompt: Prompt, given: str) -> float | None:
    """Return the value read from a scale or a display (rad, °C, V or A); None where no value was asked for.

    Raises `ValueError` with the problem in a sentence.
    """
    action: Any = prompt.action  # of a record, which may say anything
    match action.get("do"), prompt.kind:
        case "turn", PromptKind.ANGLE:
            tolerance_rad = float(action.get("tolerance_rad", math.inf))
            return read_angle(given, float(action["target_rad"]), tolerance_rad)
        case _, PromptKind.ANGLE if given != prompt.default:
            return parse_angle(given)
        case "read_temperature", PromptKind.NUMBER:
            return _between(prompt, typed_temperature(given))
        case "read_level", PromptKind.NUMBER:
            most = float(action.get("most_divisions", math.inf))
            return typed_bubble(given, float(action["division_rad"]), most)
        case "read_supply", PromptKind.NUMBER:
            return typed_supply(given, "A" if prompt.unit == "A" else "V")
    return None


def _problem_with_choice(prompt: Prompt, given: str) -> str:
    open_ended = [choice.removesuffix(REASON) for choice in prompt.choices if choice.endswith(f" {REASON}")]
    words = " ".join(given.split())
    for beginning in open_ended:
        reason = words[len(beginning) :]
        if words.lower().startswith(beginning) and reason:
            return f"say why in place of {REASON}" if reason == REASON else ""
    fits = words.lower() in prompt.choices if open_ended else given in prompt.choices
    return "" if fits else f"choose one of {', '.join(prompt.choices)}, not {given!r}"


def _problem_with_number(prompt: Prompt, given: str) -> str:
    try:
        _between(prompt, _number(given, prompt.unit))
    except ValueError as trouble:
        return str(trouble)
    return ""


def _number(given: str, unit: str) -> float:
    try:
        return read_number(given.replace(",", ".").removesuffix(unit).strip())
    except ValueError:
        raise ValueError(
            f"a number{' in ' + unit if unit else ''} is wanted, not {shortened(given)!r}"
        ) from None


def _between(prompt: Prompt, value: float) -> float:
    if prompt.minimum is not None and value < prompt.minimum:
        raise ValueError(f"{value:g} is below the least, {prompt.minimum:g} {prompt.unit}".rstrip())
    if prompt.maximum is not None and value > prompt.maximum:
        raise ValueError(f"{value:g} is above the most, {prompt.maximum:g} {prompt.unit}".rstrip())
    if not math.isfinite(value):
        raise ValueError("a number is wanted")
    return value


def _spaced(angle_rad: float) -> str:
    return format_dms(angle_rad, 1).replace("°", "° ").replace("′", "′ ")


MOST_ATTEMPTS: Final = 20
MOST_WAITS: Final = 1000
"""Greatest number of answers "no" to a task: somebody who gives more does not read the question."""


def ask(person: Person, prompt: Prompt) -> str:
    """Put the prompt until its answer fits; return the answer's text, the default for an empty one.

    `prompt.id` is the step's key; "#1", "#2"… is added for each attempt, and an answer to another id is stale
    and ignored. Raises `NoAnswer` when nobody answers, `BenchError` after `MOST_ATTEMPTS` answers that do not
    fit.
    """
    text = prompt.text
    for attempt in range(1, MOST_ATTEMPTS + 1):
        put = replace(prompt, id=f"{prompt.id}#{attempt}", text=text)
        answer = person.ask(put)
        given = answer.text.strip() or (prompt.default or "")
        problem = "the answer belongs to an earlier question" if answer.prompt_id != put.id else ""
        problem = problem or problem_with_answer(prompt, given)
        if not problem:
            return given
        text = f"{problem[0].upper()}{problem[1:]}. {prompt.text}"
    raise BenchError("operator", f"no usable answer to {prompt.text!r}", "read the question again")


def confirm(person: Person, prompt: Prompt) -> None:
    """Have a task done; after "no" the question is put again until it is done. Raises the errors of `ask`."""
    put = prompt
    for wait in range(1, MOST_WAITS + 1):
        if ask(person, put).lower() not in NO:
            return
        text = f"There is no hurry: say yes when it is done. {prompt.text}"
        put = replace(prompt, id=f"{prompt.id}#wait{wait}", text=text)
    raise BenchError("operator", f"answered no again and again to: {prompt.text}", "go on when it is done")


def agree(person: Person, prompt: Prompt) -> None:
    """Ask for permission to go on. Raises `BenchError` when the person says no, and the errors of `ask`."""
    if ask(person, prompt).lower() in NO:
        raise BenchError("operator", f"answered no to: {prompt.text}", "go on when that is settled")


PICTURES: Final[Mapping[str, str]] = {
    "1": """\
        z up                 head at 0°, seen from the end of the shaft:
        |   y                the block's z points up, its x lies level to the
        |  /  (shaft)        right, its y lies along the shaft
        | /
        o------ x""",
    "2": """\
        y up                 head at 0°, seen from the end of the shaft:
        |   z                the block's y points up, its x lies level to the
        |  /  (shaft)        left, its z lies along the shaft
        | /
  x ----o""",
}


UNTOUCHED: Final = "untouched"


def mount_prompt(step: Mount, *, chamber: bool) -> Prompt:
    """Return the task of mounting the block, with a drawing of the installation where there is one.

    It has no default: a key hit by chance mounts nothing. `chamber` says whether there is a chamber to close.
    """
    close = ", close the chamber" if chamber else ""
    again = "" if step.series == 1 else f" (visit {step.series})"
    return Prompt(
        id=step.key,
        kind=PromptKind.CONFIRM,
        text=f"Mount the block in installation {step.installation}{again}, clamp it{close}",
        action={"do": "mount", "installation": step.installation, "series": step.series},
        picture=PICTURES.get(step.installation, ""),
    )


def untouched_prompt(step: Mount) -> Prompt:
    """Return the question whether the block is still mounted as the step `step` left it."""
    text = (
        f"The block was mounted in installation {step.installation}. Is it untouched since? "
        "If not, mount it again now, and say so"
    )
    choices = (UNTOUCHED, "mounted again")
    return replace(mount_prompt(step, chamber=False), kind=PromptKind.CHOOSE, text=text, choices=choices)
