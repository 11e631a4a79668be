"""The operator's side of a run: commands (wishes), prompts, answers left in the run folder, their validation."""

from __future__ import annotations

import getpass
import json
import math
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final
from weakref import finalize

from bench.base.files import open_regular, read_regular
from bench.base.languages import ENGLISH, language, message, translated
from bench.base.numbers import read_number
from bench.base.text import in_json, shortened
from bench.config.procedure.plan import Mount
from bench.run.events import Event, EventType, Wish
from drivers.angles import (
    format_dms,
    parse_angle,
    read_angle,
    typed_angle,
    typed_bubble,
    typed_supply,
    typed_temperature,
)
from drivers.interfaces import BenchError
from drivers.person import ATTEMPTS, Person, Prompt, PromptKind

CONTROL: Final = "control.jsonl"
ANSWERS: Final = "answers.jsonl"
HOLDS_FOLDERS: Final = sys.platform == "linux"
LONGEST: Final = 4000
"""Greatest length of an answer in characters; longer texts are rejected."""
SIGN: Final = ":"
"""First character of a wish typed at the terminal: ":redo", ":skip the cable came loose"."""


@dataclass(frozen=True)
class WishAuthor:
    """The author of an operator's command (wish) or answer: name, role ("operator", "supervisor") and place.

    `where` is "terminal", "panel", or "command" for `bench control`. In old records, which do not state the
    author, all fields are empty.
    """

    by: str = ""
    role: str = ""
    where: str = ""

    def to_json(self) -> dict[str, str]:
        """Return the author as stored in events and in the run folder's files; an empty dict if unknown."""
        return asdict(self) if self != NOBODY_KNOWN else {}

    @classmethod
    def from_json(cls, line: Mapping[str, Any]) -> WishAuthor:
        """Return the author stated in `line`: the data of an event, or a line of the run folder's files."""
        return cls(*(str(line.get(name, "")) for name in ("by", "role", "where")))


NOBODY_KNOWN: Final = WishAuthor()
INSTRUMENT: Final = "instrument"
"""The `where` of an author that is an instrument, such as an encoder that answers instead of a person."""


def at_the_shell(where: str) -> WishAuthor:
    """Return the user of this process as author: a supervisor, as this user has write access to the runs."""
    try:
        name = getpass.getuser()
    except (OSError, KeyError, ImportError):  # no such user, or no user database on this system
        name = ""
    return WishAuthor(name, "supervisor", where)


@dataclass(frozen=True)
class RunControl:
    """A wish (an operator's command), its reason and author; `by_person` marks a wish given at the prompt."""

    wish: Wish
    reason: str = ""
    by_person: bool = False
    who: WishAuthor = NOBODY_KNOWN

    def to_json(self) -> dict[str, str]:
        """Return the wish as stored in `control.jsonl`."""
        return {"wish": self.wish.value, "reason": self.reason, **self.who.to_json()}

    def reason_and_author(self) -> dict[str, str]:
        """Return the reason and the author as recorded in an event."""
        return {"reason": self.reason, **self.who.to_json()}

    @classmethod
    def from_json(cls, line: Mapping[str, Any]) -> RunControl:
        """Return the wish that a parsed line of the file states.

        Raises `KeyError`, `TypeError` or `ValueError` if the line states none.
        """
        return cls(Wish(line["wish"]), str(line.get("reason", "")), who=WishAuthor.from_json(line))


class OperatorWish(Exception):
    """The person answered a prompt with a wish (a command); the step that asked is not completed."""

    def __init__(self, control: RunControl) -> None:
        super().__init__(control.wish.value)
        self.control = control


class Stopped(KeyboardInterrupt):
    """An operator's wish stopped the run: treated like Ctrl-C, but with a known author."""

    def __init__(self, control: RunControl) -> None:
        super().__init__()
        self.control = control


def raised(control: RunControl) -> OperatorWish | Stopped:
    """Return the exception by which an operator's command interrupts the current step."""
    return Stopped(control) if control.wish is Wish.STOP else OperatorWish(control)


class Controls:
    """A source of operator's commands (wishes). This base class supplies none, for a run nobody can control.

    `stopped` is the command that interrupted the program, if any.
    """

    stopped: RunControl | None = None

    def poll(self) -> RunControl | None:
        """Return the next wish, or None."""
        return None


class _Lines:
    """The lines of a file that other programs append to, from the byte `place` on.

    On Linux, the file is found also after its folder was renamed or moved.
    """

    def __init__(self, path: Path, place: int = 0) -> None:
        self._path, self._place = path, place
        self._held = False

    def _hold(self) -> None:
        """Keep the folder open, once it exists, and reach the file through it from then on."""
        descriptor = os.open(self._path.parent, os.O_RDONLY)
        self._held = True
        finalize(self, os.close, descriptor)
        if (through := Path(f"/proc/self/fd/{descriptor}")).is_dir():
            self._path = through / self._path.name

    def next(self) -> bytes | None:
        """Return the next complete line, or None; an overlong line is cut to its first 8 × `LONGEST` bytes."""
        try:
            if not self._held and HOLDS_FOLDERS:
                self._hold()
            if self._path.stat().st_size <= self._place:  # as nearly always: quicker than to open it
                return None
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
        return beginning


class ControlFile:
    """The operator's wishes left in a run folder, a JSON line each; lines present at construction are ignored."""

    def __init__(self, folder: Path) -> None:
        path = folder / CONTROL
        self._lines = _Lines(path, path.stat().st_size if path.exists() else 0)

    def poll(self) -> RunControl | None:
        """Return the next wish, or None; skip invalid lines, and leave an incomplete last line for later."""
        while (line := self._lines.next()) is not None:
            with suppress(ValueError, KeyError, TypeError, AttributeError, RecursionError):
                return RunControl.from_json(json.loads(line))
        return None


def leave_wish(folder: Path, control: RunControl) -> None:
    """Append an operator's wish to the run folder's file. Raises `OSError` if it cannot be written."""
    _leave(folder / CONTROL, control.to_json())


def _leave(file: Path, told: Mapping[str, str]) -> None:
    """Append a line; an incomplete line that a full disk or a power cut left at the end must not swallow it."""
    line = in_json(json.dumps(told, ensure_ascii=False)).encode() + b"\n"
    torn = file.exists() and (content := read_regular(file)) and not content.endswith(b"\n")
    with open_regular(file, "ab") as lines:
        rest = b"\n" * bool(torn) + line
        while rest:  # an unbuffered file may accept only a part at once
            rest = rest[lines.write(rest) :]


def parse_wish(text: str) -> RunControl:
    """Return the wish typed as `text`, such as ":skip the cable came loose"; the leading ":" is optional.

    Raises `ValueError`, listing the known wishes, for any other text, and for a skip without a reason.
    """
    word, _, reason = text.strip().removeprefix(SIGN).partition(" ")
    try:
        wish = Wish(word.lower())
    except ValueError:
        known = ", ".join(f"{SIGN}{w.value}" for w in Wish)
        raise ValueError(message(f"there is no command {SIGN}{word}; type one of {known}")) from None
    if wish is Wish.SKIP and not reason.strip():
        raise ValueError(message(f"a skip needs a reason; type {SIGN}skip REASON"))
    return RunControl(wish, reason.strip(), by_person=True)


YES: Final = frozenset({"y", "yes", "ok", "done"})
NO: Final = frozenset({"n", "no"})
REASON: Final = message("REASON")
"""Placeholder at the end of a choice for the person's own words: "go on REASON"."""

# --- answers left in a run's folder ------------------------------------------------------------------


@dataclass(frozen=True)
class LeftAnswer:
    """An answer to the prompt `id`, as typed, with its author; `line` is its line number in the file, from 1.

    `flaw` describes the fault of an unreadable line; otherwise it is empty.
    """

    id: str
    answer: str
    who: WishAuthor = NOBODY_KNOWN
    line: int = 0
    flaw: str = ""

    def to_json(self) -> dict[str, str]:
        """Return the answer as written into the run folder's file."""
        return {"id": self.id, "answer": self.answer, **self.who.to_json()}


def leave_answer(folder: Path, answer: LeftAnswer) -> None:
    """Append an answer to the run folder's file. Raises `OSError` if it cannot be written."""
    _leave(folder / ANSWERS, answer.to_json())


class AnswersFile:
    """The answers left in a run folder, in order; the first `answers_read` lines are skipped."""

    def __init__(self, folder: Path, answers_read: int = 0) -> None:
        self._lines, self._count = _Lines(folder / ANSWERS), 0
        while self._count < answers_read and self._lines.next() is not None:
            self._count += 1

    def poll(self) -> LeftAnswer | None:
        """Return the next answer, or None; an incomplete last line is left for later.

        An unreadable line is returned as an answer with a `flaw` and an empty id.
        """
        if (line := self._lines.next()) is None:
            return None
        self._count += 1
        return _read_answer(line, self._count)


def _read_answer(line: bytes, number: int) -> LeftAnswer:
    try:
        parsed = json.loads(line)
        prompt_id, text = parsed["id"], parsed["answer"]
        if type(prompt_id) is not str or type(text) is not str or len(text) > LONGEST:
            raise ValueError("neither")
        return LeftAnswer(prompt_id, text, WishAuthor.from_json(parsed), number)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        beginning = line[:100].decode("utf-8", "backslashreplace").strip()
        flaw = f"line {number} of {ANSWERS} is not an answer"
        return LeftAnswer("", beginning, WishAuthor(where="panel"), number, flaw)


_WORDS: Final = {message("yes"): "yes", message("done"): "yes", message("no"): "no"}


def in_english(prompt: Prompt, typed: str) -> str:
    """Return a typed answer in English, the language of records: так → yes.

    The answer to a choice becomes the English name of the choice. Other text is returned as typed.
    """
    given = " ".join(typed.split()).lower()
    if language() == ENGLISH or not given:
        return typed
    if prompt.kind is PromptKind.CONFIRM:
        return next(
            (english for word, english in _WORDS.items() if given in (translated(word), translated(word)[0])),
            typed,
        )
    for choice in prompt.choices:
        choice_name = translated(choice).lower()
        if given == choice_name:
            return choice
        if choice.endswith(REASON) and given.startswith(
            start := choice_name.removesuffix(translated(REASON).lower())
        ):
            return choice.removesuffix(REASON) + " ".join(typed.split())[len(start) :]
    return typed


# --- the open prompt ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class AskedPrompt:
    """A recorded prompt and the event that recorded it; answers refer to the prompt's `id`."""

    event: Event
    prompt: Prompt


def asked_to_json(prompt: Prompt) -> dict[str, Any]:
    """Return the fields of a prompt for the record."""
    return {of.name: getattr(prompt, of.name) for of in fields(prompt)} | {"kind": prompt.kind.value}


def _asked(event: Event) -> AskedPrompt | None:
    """Return the prompt of an `asked` event; None for a kind of prompt that this version does not know."""
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


_KEEPS_OPEN: Final = {
    EventType.ASKED, EventType.ANSWER_REFUSED, EventType.WISH_REFUSED, EventType.POWER, EventType.CLOCK_JUMPED,
    EventType.CHAMBER_SLOW, EventType.SAME_SERIAL, EventType.CERTIFICATE,
}  # fmt: skip
"""Events after which a question is still open; any other event closes it."""


@dataclass
class OpenPrompt:
    """Finds the prompt that is open after the events of a run, which are passed to `take` in order.

    The prompt can be answered only while a program is carrying out the run.
    """

    _event: Event | None = field(default=None, init=False)

    def take(self, event: Event) -> None:
        """Update the open prompt with the next event."""
        if event.type == EventType.ASKED:
            self._event = event
        elif event.type not in _KEEPS_OPEN:
            self._event = None

    @property
    def prompt(self) -> AskedPrompt | None:
        """The open prompt, or None."""
        return None if self._event is None else _asked(self._event)


# --- faults of an answer -----------------------------------------------------------------------------


def problem_with_answer(prompt: Prompt, text: str) -> str:
    """Return a description of the fault in an answer; empty if the answer fits the prompt's kind and limits.

    An empty answer selects the prompt's default, if any. A head angle must lie near the target, and a bubble on the
    level's scale, as the driver requires. The function has no side effects, so it can be called during typing.
    """
    given = text.strip() or prompt.default or ""
    try:
        _read_value(prompt, given)
    except ValueError as trouble:
        return str(trouble).rstrip(".")
    match prompt.kind:
        case PromptKind.CONFIRM:
            if not given:
                return message("nothing was typed: answer yes or no")
            return "" if given.lower() in YES | NO else message(f"answer yes or no, not {given!r}")
        case PromptKind.CHOOSE:
            return _problem_with_choice(prompt, given)
        case PromptKind.NUMBER | PromptKind.ANGLE:
            return ""


def understood_answer(prompt: Prompt, text: str) -> str:
    """Return a valid answer as understood, such as `120° 30′ 15.0″` or `23.5 °C`; empty for an invalid one."""
    if problem_with_answer(prompt, text):
        return ""
    given = text.strip() or prompt.default or ""
    match prompt.kind:
        case PromptKind.ANGLE:
            value = _read_value(prompt, given)
            return given if value is None else _spaced(_on_scale(prompt, given))
        case PromptKind.NUMBER:
            value = _read_value(prompt, given) or 0.0
            if prompt.action["do"] == "read_level":
                return f"{given} = {math.degrees(value) * 3600.0:+.1f}″"
            return f"{value:g} {prompt.unit}".rstrip()
        case PromptKind.CONFIRM:
            return "no" if given.lower() in NO else "yes"
        case PromptKind.CHOOSE:
            return given


def _on_scale(prompt: Prompt, given: str) -> float:
    """Return a typed angle in rad; a text such as `+5"` states the deviation from the prompt's target."""
    target_rad: Any = prompt.action.get("target_rad")
    return parse_angle(given) if target_rad is None else typed_angle(given, float(target_rad))


def _read_value(prompt: Prompt, given: str) -> float | None:
    """Return the typed angle (rad) or number; None for other prompts.

    Raises `ValueError` with a sentence on the fault.
    """
    action: Any = prompt.action  # may come from a record, so its content is not validated
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
        case _, PromptKind.NUMBER:
            return _between(prompt, _number(given, prompt.unit))
    return None


def _problem_with_choice(prompt: Prompt, given: str) -> str:
    open_ended = [choice.removesuffix(REASON) for choice in prompt.choices if choice.endswith(f" {REASON}")]
    words = " ".join(given.split())
    for beginning in open_ended:
        reason = words[len(beginning) :]
        if words.lower().startswith(beginning) and reason:
            return message(f"give the reason instead of {REASON}") if reason == REASON else ""
    fits = words.lower() in prompt.choices if open_ended else given in prompt.choices
    return "" if fits else message(f"choose one of {', '.join(prompt.choices)}, not {given!r}")


def _number(given: str, unit: str) -> float:
    try:
        return read_number(given.replace(",", ".").removesuffix(unit).strip())
    except ValueError:
        raise ValueError(
            message(f"type a number{' in ' + unit if unit else ''}, not {shortened(given)!r}")
        ) from None


def _between(prompt: Prompt, value: float) -> float:
    if prompt.minimum is not None and value < prompt.minimum:
        raise ValueError(
            message(
                f"type a number of {_exact(prompt.minimum)} or more, not {_exact(value)} {prompt.unit}"
            ).rstrip()
        )
    if prompt.maximum is not None and value > prompt.maximum:
        raise ValueError(
            message(
                f"type a number of at most {_exact(prompt.maximum)}, not {_exact(value)} {prompt.unit}"
            ).rstrip()
        )
    if not math.isfinite(value):
        raise ValueError("type a number")
    return value


def _exact(value: float) -> str:
    """Return a number with all its digits: a rounded limit could be refused itself."""
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


def _spaced(angle_rad: float) -> str:
    return format_dms(angle_rad, 1).replace("°", "° ").replace("′", "′ ")


def ask(person: Person, prompt: Prompt) -> str:
    """Repeat the prompt until the answer is valid; return the answer, or the default for an empty answer.

    "#1", "#2"… is appended to `prompt.id` for each attempt, so that a stale answer, which names an earlier id,
    is rejected. Raises `NoAnswer` when nobody answers, `BenchError` after `ATTEMPTS` invalid answers.
    """
    text = prompt.text
    for attempt in range(1, ATTEMPTS + 1):
        put = replace(prompt, id=f"{prompt.id}#{attempt}", text=text)
        answer = person.ask(put)
        given = answer.text.strip() or (prompt.default or "")
        problem = message("the answer belongs to an earlier question") if answer.prompt_id != put.id else ""
        problem = problem or problem_with_answer(prompt, given)
        if not problem:
            return given
        text = f"{problem[0].upper()}{problem[1:]}. {prompt.text}"
    raise BenchError(
        "operator",
        f"no valid answer came to {prompt.text!r}",
        "resume the run, or repeat the command, and answer as the question says",
    )


def confirm(person: Person, prompt: Prompt) -> None:
    """Ask the person to do a task; repeat the prompt after each "no". Raises the errors of `ask`."""
    put = prompt
    for wait in range(1, ATTEMPTS + 1):
        if ask(person, put).lower() not in NO:
            return
        text = message(f"There is no hurry: answer yes when it is done. {prompt.text}")
        put = replace(prompt, id=f"{prompt.id}#wait{wait}", text=text)
    raise BenchError(
        "operator",
        f"answered no several times to: {prompt.text}",
        "do what the question asks, then resume the run",
    )


def agree(person: Person, prompt: Prompt) -> None:
    """Ask for permission to continue. Raises `BenchError` if the person answers no, and the errors of `ask`."""
    if ask(person, prompt).lower() in NO:
        raise BenchError(
            "operator",
            f"answered no to: {prompt.text}",
            "remove the reason, then start or resume again",
        )


PICTURES: Final[Mapping[str, str]] = {
    "1": message("""\
        z up                 head at 0°, seen from the end of the shaft:
        |   y                the block's z points up, its x lies level to the
        |  /  (shaft)        right, its y lies along the shaft
        | /
        o------ x"""),
    "2": message("""\
        y up                 head at 0°, seen from the end of the shaft:
        |   z                the block's y points up, its x lies level to the
        |  /  (shaft)        left, its z lies along the shaft
        | /
  x ----o"""),
}


UNTOUCHED: Final = message("untouched")


def mount_prompt(step: Mount, *, chamber: bool) -> Prompt:
    """Return the prompt to mount the block, with a drawing of the installation if there is one.

    The prompt has no default, so that an accidental Enter confirms nothing. With `chamber`, the person must also
    close the chamber.
    """
    close = message(", close the chamber") if chamber else ""
    again = "" if step.series == 1 else message(f" (visit {step.series})")
    return Prompt(
        id=step.key,
        kind=PromptKind.CONFIRM,
        text=message(f"Mount the block in installation {step.installation}{again}, clamp it{close}"),
        action={"do": "mount", "installation": step.installation, "series": step.series},
        picture=PICTURES.get(step.installation, ""),
    )


def untouched_prompt(step: Mount) -> Prompt:
    """Return the prompt asking whether the block is still mounted as it was after `step`."""
    text = message(
        f"The block was mounted in installation {step.installation}. Has nobody touched it since? If "
        "somebody has, mount it again now and answer 'mounted again'"
    )
    choices = (UNTOUCHED, message("mounted again"))
    return replace(mount_prompt(step, chamber=False), kind=PromptKind.CHOOSE, text=text, choices=choices)
