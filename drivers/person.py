"""Prompts to a person as values, for display in a terminal or on a page, or for a program to answer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final, Literal, NotRequired, Protocol, TypedDict, TypeVar, runtime_checkable

from drivers.interfaces import Direction, LevelAxis, message

if TYPE_CHECKING:
    from drivers.clock import Clock


class PromptKind(StrEnum):
    """The kind of answer that a prompt expects."""

    CONFIRM = "confirm"
    CHOOSE = "choose"
    NUMBER = "number"
    ANGLE = "angle"


class MountBlock(TypedDict):
    """Mount the block in `installation`; `series` numbers the mountings in this installation, from 1."""

    do: Literal["mount"]
    installation: str
    series: NotRequired[int]


class TurnHead(TypedDict):
    """Turn the head and read its scale; the reading may differ from the target by `tolerance_rad`, if given.

    With `by_way_of_rad` the head is first turned there, without reading its scale.
    """

    do: Literal["turn"]
    target_rad: float
    direction: Direction
    tolerance_rad: NotRequired[float]
    by_way_of_rad: NotRequired[float]
    read_by: NotRequired[Literal["encoder"]]
    """Given if an encoder reads the angle; the head must then approach it from at least `backoff_rad` away."""
    backoff_rad: NotRequired[float]
    hands_free: NotRequired[bool]
    """The encoder answers in the person's place when the head is at rest at the target."""


class SetChamber(TypedDict):
    """Set the chamber to `target_c`, °C."""

    do: Literal["set_temperature"]
    target_c: float


class SwitchInputs(TypedDict):
    """Switch the inputs of all voltmeters to `source`; for a reference, `reference_v` is its voltage, V."""

    do: Literal["select_input"]
    source: Literal["signal", "short", "reference"]
    reference_v: NotRequired[float | None]


class SetSupply(TypedDict):
    """Set outputs of the power supply, by name: voltage (V), current limit (A), over-voltage protection (V)."""

    do: Literal["set_supply"]
    outputs: dict[str, tuple[float, float, float | None]]


class SwitchSupply(TypedDict):
    """Switch an output of the power supply on or off."""

    do: Literal["switch_supply"]
    output: str
    on: bool


class ReadSupply(TypedDict):
    """Read from the supply's display whether an output is on, a setting, or the measured voltage or current."""

    do: Literal["read_supply"]
    output: str
    what: Literal["switch", "set_voltage", "current_limit", "voltage", "current"]


class HandleCable(TypedDict):
    """Pull the cable of an instrument, or plug it in."""

    do: Literal["cable"]
    instrument: str
    plugged: bool


class PlaceLevel(TypedDict):
    """Put the level on the platform in its first position, or `turned` by half a turn from it."""

    do: Literal["place_level"]
    turned: bool


class ReadLevel(TypedDict):
    """Put a level on the platform, along the shaft or across it, and read its bubble.

    If `turned`, it is rotated by half a turn. One division is `division_rad`; the scale ends at
    ±`most_divisions`.
    """

    do: Literal["read_level"]
    axis: LevelAxis
    turned: bool
    division_rad: float
    most_divisions: NotRequired[float]


class LevelPlatform(TypedDict):
    """Level the platform before mounting number `series` of the block in `installation`."""

    do: Literal["level_platform"]
    installation: str
    series: int


class Say(TypedDict):
    """A task that changes no setting: read a thermometer or the head's scale, answer, wait, keep clear.

    "confirm_reading" asks whether an unexpected reading is right. `of` is the place of a thermometer, "meter"
    or "room"; without it, the thermometer is at the block or the chamber's.
    """

    do: Literal["read_temperature", "read_head", "confirm_reading", "answer", "ask", "wait", "stand_clear"]
    of: NotRequired[str]


Action = (
    MountBlock
    | TurnHead
    | SetChamber
    | SwitchInputs
    | SetSupply
    | SwitchSupply
    | ReadSupply
    | HandleCable
    | PlaceLevel
    | ReadLevel
    | LevelPlatform
    | Say
)
"""The task of a prompt in machine-readable form, for a program that answers in place of a person."""


@dataclass(frozen=True, slots=True)
class Prompt:
    """A question as a value: it can be shown in a terminal or on a page, or answered by a script.

    `id` names the step and the attempt ("12/turn#1"); an answer to another id is stale.
    `default` is the meaning of an empty answer. In a dry run, only the scripted operator can answer a prompt
    without a default.
    """

    id: str
    kind: PromptKind
    text: str
    default: str | None = None
    unit: str = ""
    choices: tuple[str, ...] = ()
    minimum: float | None = None
    maximum: float | None = None
    action: Action = field(default_factory=lambda: Say(do="answer"))
    picture: str = ""


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to the prompt with the id `prompt_id`; `text` as typed."""

    prompt_id: str
    text: str


class Person(Protocol):
    """The interface to the person who answers prompts: a terminal, a panel, a scripted operator."""

    def ask(self, prompt: Prompt) -> Answer:
        """Show the prompt and wait for the answer. Raises `NoAnswer` if nobody can answer."""


@runtime_checkable
class WatchingPerson(Protocol):
    """A `Person` that calls `meanwhile` repeatedly while a question waits for its answer.

    If set, `meanwhile` is called at least every 10 s of bench time, in the thread that called `ask`. An exception
    from it ends `ask`.
    """

    meanwhile: Callable[[], None] | None

    def ask(self, prompt: Prompt) -> Answer:
        """Show the prompt and wait for the answer, as `Person.ask`."""


class AnsweredByInstrument(Exception):
    """Raised by `meanwhile` when an instrument answers in the person's place; `ask` passes it on.

    `by` names the instrument ("encoder"), `text` is the answer. If `problem` is not empty, it says why the
    answer is rejected, and the question is asked again.
    """

    def __init__(self, by: str, text: str, problem: str = "") -> None:
        super().__init__(text)
        self.by = by
        self.text = text
        self.problem = problem


@runtime_checkable
class _HasInterval(Protocol):
    """A `WatchingPerson` whose interval between calls of `meanwhile` can be set: `slice_s`, s."""

    slice_s: float


@contextmanager
def watching(person: Person, look: Callable[[], None], every_s: float, clock: Clock) -> Iterator[None]:
    """Within the context, have `person` call `look` repeatedly while a question waits for its answer.

    If the interval between calls can be set (`slice_s`), it is `every_s`, s; else it is the person's own. The
    person's own `meanwhile` is still called, too. A person who is not a `WatchingPerson` never calls `look`.
    """
    if not isinstance(person, WatchingPerson):
        yield
        return
    before, told = person.meanwhile, person if isinstance(person, _HasInterval) else None
    before_s = 0.0 if told is None else told.slice_s
    due_s = clock.now_s()

    def both() -> None:
        nonlocal due_s
        if before is not None and clock.now_s() >= due_s:
            due_s = clock.now_s() + before_s
            before()
        look()

    person.meanwhile = both
    if told is not None:
        told.slice_s = every_s
    try:
        yield
    finally:
        person.meanwhile = before
        if told is not None:
            told.slice_s = before_s


ATTEMPTS: Final = 1000
"""The most times that a question is asked: no tired person, but a program that answers, is wrong so often."""

APPROACH: Final[dict[Direction, str]] = {
    1: message("approach with the angle rising, from below"),
    -1: message("approach with the angle falling, from above"),
}
"""The side of an approach, in words for a person."""

_Read = TypeVar("_Read")


def ask_until(
    person: Person,
    question: Prompt,
    read: Callable[[str], _Read],
    again: Prompt | None = None,
) -> _Read:
    """Ask a question until `read` accepts the answer; return the value from `read`.

    `read` takes the answer's text; to reject it, it raises `ValueError` with a sentence that says what is
    wrong. The next prompt is this sentence followed by the question, or by `again` if given. Each attempt
    adds its number to the `id` of the prompt. Raises `ValueError` with the last sentence after `ATTEMPTS`
    rejected answers, and `NoAnswer` if nobody can answer.
    """
    trouble = ""
    for attempt in range(1, ATTEMPTS + 1):
        asked = again if trouble and again is not None else question
        prompt = replace(asked, id=f"{asked.id}#{attempt}", text=f"{trouble} {asked.text}".lstrip())
        answer = person.ask(prompt)
        if answer.prompt_id != prompt.id:
            trouble = message("That answer belonged to an earlier question.")
            continue
        try:
            return read(answer.text.strip() or prompt.default or "")
        except ValueError as error:
            trouble = str(error)
    raise ValueError(trouble.rstrip("."))
