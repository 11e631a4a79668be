"""A temperature that a person reads from a display and types."""

from __future__ import annotations

from typing import Final

from drivers.interfaces import Person, Prompt, PromptKind
from drivers.typed import typed_temperature

ATTEMPTS: Final = 5


def ask_temperature(
    person: Person, key: str, text: str, low_c: float, high_c: float, outside: str
) -> float | None:
    """Ask for a temperature from `low_c` to `high_c`, °C, until one comes; return None when none does.

    `key` names the question, `text` what to do, `outside` what is said of a value beyond: "is not plausible
    ({low:g} to {high:g} °C)". Raises `NoAnswer` when there is nobody to ask.
    """
    trouble = ""
    for attempt in range(1, ATTEMPTS + 1):
        prompt = Prompt(
            id=f"{key}#{attempt}",
            kind=PromptKind.NUMBER,
            text=f"{trouble} {text} and type the temperature in °C.".lstrip(),
            unit="°C",
            minimum=low_c,
            maximum=high_c,
            action={"do": "read_temperature"},
        )
        answer = person.ask(prompt)
        if answer.prompt_id != prompt.id:
            trouble = "That answer belonged to an earlier question."
            continue
        try:
            temperature_c = typed_temperature(answer.text)
        except ValueError as error:
            trouble = str(error)
            continue
        if low_c <= temperature_c <= high_c:
            return temperature_c
        trouble = f"{temperature_c:g} °C {outside.format(low=low_c, high=high_c)}."
    return None
