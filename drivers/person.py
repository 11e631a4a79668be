"""Prompts to a person as values, to be shown in a terminal or on a page, or answered by a program."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final, Literal, NotRequired, Protocol, TypedDict, TypeVar, runtime_checkable

from drivers.interfaces import Direction, LevelAxis


class PromptKind(StrEnum):
    """What sort of answer a prompt wants."""

    CONFIRM = "confirm"
    CHOOSE = "choose"
    NUMBER = "number"
    ANGLE = "angle"


class MountBlock(TypedDict):
    """Mount the block in an installation; `series` numbers the visits to it from 1."""

    do: Literal["mount"]
    installation: str
    series: NotRequired[int]


class TurnHead(TypedDict):
    """Turn the head and read its scale; where it is stated, what is read may be `tolerance_rad` off the target."""

    do: Literal["turn"]
    target_rad: float
    direction: Direction
    tolerance_rad: NotRequired[float]


class SetChamber(TypedDict):
    """Set the chamber."""

    do: Literal["set_temperature"]
    target_c: float


class SwitchInputs(TypedDict):
    """Switch the inputs of all voltmeters."""

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
    """Read the display of the power supply: whether an output is on, what it is set to (V, A), what it gives."""

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
    """Put a level on the platform along the shaft or across it, and read its bubble, on ± `most_divisions`."""

    do: Literal["read_level"]
    axis: LevelAxis
    turned: bool
    division_rad: float
    most_divisions: NotRequired[float]


class LevelPlatform(TypedDict):
    """Level the platform, before the block is mounted in an installation for the `series`-th time."""

    do: Literal["level_platform"]
    installation: str
    series: int


class Say(TypedDict):
    """Read the chamber's thermometer, answer, see that the way is clear, or wait: nothing is changed."""

    do: Literal["read_temperature", "answer", "ask", "wait", "stand_clear"]


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
"""The task of a prompt, for a program in place of a person."""


@dataclass(frozen=True, slots=True)
class Prompt:
    """A question as a value: it can be shown in a terminal, on a page, or answered by a script.

    `id` names the step and the attempt that ask ("12/turn#1"); an answer to another id is stale.
    `default` is what an empty answer means; a prompt without one cannot be answered in a dry run
    except by the scripted operator.
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
    """What the person said to the prompt of that `id`; the text as typed."""

    prompt_id: str
    text: str


class Person(Protocol):
    """The interface to the person who is asked: a terminal, a panel, a scripted operator."""

    def ask(self, prompt: Prompt) -> Answer:
        """Put the prompt and wait for the answer.

        Raises `NoAnswer` when there is nobody (left) to answer.
        """


@runtime_checkable
class WatchingPerson(Protocol):
    """A `Person` with whom something can be watched while a question waits.

    Where `meanwhile` is set it is called again and again until the answer is there, at least every 10 s of bench
    time, in the thread that asks; what it raises is raised by `ask`.
    """

    meanwhile: Callable[[], None] | None

    def ask(self, prompt: Prompt) -> Answer:
        """Put the prompt and wait for the answer, as a `Person`."""


ATTEMPTS: Final = 5
"""The most attempts of a question."""

_Read = TypeVar("_Read")


def ask_until(
    person: Person,
    key: str,
    question: Callable[[str, str], Prompt],
    read: Callable[[str], _Read],
    attempts: int = ATTEMPTS,
) -> _Read:
    """Put a question until its answer can be read; return what `read` makes of it.

    `question` makes the prompt of its id and of a sentence on what was wrong with the answer before, empty at
    first; `read` raises `ValueError` with that sentence. Raises `ValueError` with the last one after all
    `attempts`, `NoAnswer` when there is nobody to ask.
    """
    trouble = ""
    for attempt in range(1, attempts + 1):
        prompt = question(f"{key}#{attempt}", trouble)
        answer = person.ask(prompt)
        if answer.prompt_id != prompt.id:
            trouble = "That answer belonged to an earlier question."
            continue
        try:
            return read(answer.text.strip() or prompt.default or "")
        except ValueError as error:
            trouble = str(error)
    raise ValueError(trouble.rstrip("."))
