"""A chamber and a thermometer that a person sets and reads."""

from __future__ import annotations

from typing import Final

from drivers.angles import typed_temperature
from drivers.interfaces.errors import BadReading, InstrumentRefused, LimitExceeded
from drivers.interfaces.instruments import Identity
from drivers.interfaces.person import Person, Prompt, PromptKind

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


_YES: Final = frozenset({"y", "yes", "ok", "done"})
_NO: Final = frozenset({"n", "no"})
_MAX_WAITS: Final = 1000
"""So often may "no" be answered, which waits: more is nobody who reads the question."""
_PLAUSIBLE_K: Final = 20.0
"""A thermometer may stand this far outside the chamber's range (a room, a chamber not yet switched on)."""


class ManualChamber:
    """A `ThermalChamber` whose controller is a person; limits in °C."""

    def __init__(
        self,
        name: str,
        person: Person,
        *,
        minimum_c: float,
        maximum_c: float,
        safe_c: float | None = None,
    ) -> None:
        self.name = name
        self.asks_person = True
        self._person = person
        self._minimum_c = minimum_c
        self._maximum_c = maximum_c
        self._safe_c = safe_c
        self._set = False

    def open(self) -> Identity:
        """Return what stands in the record for a chamber without an interface; nothing is asked."""
        return Identity(maker="manual", model="thermal chamber")

    def close(self) -> None:
        """Nothing to release: what the chamber is left at is the person's to decide."""

    def make_safe(self) -> str:
        """Return what the person must do where a temperature was set; nobody is asked on the way out."""
        if not self._set:
            return ""
        safe = "off" if self._safe_c is None else f"to {self._safe_c:g} °C"
        return f"set the chamber {safe} by hand"

    def set_temperature(self, target_c: float, key: str) -> None:
        """Ask the person to set `target_c` and to confirm it; "no" waits.

        Raises `LimitExceeded` before anybody is asked, `InstrumentRefused` when it is never confirmed,
        `NoAnswer` when there is nobody to ask.
        """
        if not self._minimum_c <= target_c <= self._maximum_c:
            raise LimitExceeded(
                self.name,
                f"{target_c:g} °C is outside {self._minimum_c:g} to {self._maximum_c:g} °C",
                "change the temperature in the procedure or the limits in the bench file",
            )
        self._set = True
        left = ATTEMPTS
        for attempt in range(1, _MAX_WAITS + 1):
            text = self._ask(
                Prompt(
                    id=f"{key}#{attempt}",
                    kind=PromptKind.CONFIRM,
                    text=f"Set the chamber to {target_c:g} °C and confirm.",
                    default="yes",
                    action={"do": "set_temperature", "target_c": target_c},
                )
            )
            if text is not None and text.lower() in _YES:
                return
            left -= text is None or text.lower() not in _NO
            if not left:
                break
        raise InstrumentRefused(
            self.name,
            f"nobody confirmed that the chamber is set to {target_c:g} °C",
            "set it and take this step again",
        )

    def temperature(self, key: str, *, settling: bool = False) -> float:
        """Ask for the temperature on the thermometer at the block, °C; an implausible one is asked again.

        Raises `BadReading` when no plausible one comes, `NoAnswer` when there is nobody to ask.
        """
        found_c = ask_temperature(
            self._person,
            key,
            "Read the thermometer",
            self._minimum_c - _PLAUSIBLE_K,
            self._maximum_c + _PLAUSIBLE_K,
            "is not plausible ({low:g} to {high:g} °C)",
        )
        if found_c is not None:
            return found_c
        raise BadReading(
            self.name,
            f"no plausible temperature in {ATTEMPTS} attempts",
            "check the thermometer and the chamber's limits in the bench file, then take this step again",
        )

    def _ask(self, prompt: Prompt) -> str | None:
        """Return the answer as text, the default where it is empty, or None where it is a stale one."""
        answer = self._person.ask(prompt)
        if answer.prompt_id != prompt.id:
            return None
        text = answer.text.strip().replace("−", "-")
        return text or prompt.default or ""


class ManualThermometer:
    """A `Thermometer` of the given range, °C, whose display a person reads; what is beyond is asked again."""

    asks_person = True

    def __init__(self, name: str, person: Person, *, minimum_c: float, maximum_c: float, sensor: str) -> None:
        self.name = name
        self.sensor = sensor
        self._person = person
        self._minimum_c = minimum_c
        self._maximum_c = maximum_c

    def open(self) -> Identity:
        """Return what stands in the record for a thermometer without an interface; nothing is asked."""
        return Identity(maker="manual", model="thermometer")

    def close(self) -> None:
        """Nothing to release."""

    def block_c(self, key: str) -> float:
        """Ask for the temperature at the block, °C.

        Raises `BadReading` when nothing within its range comes, `NoAnswer` when there is nobody to ask.
        """
        found_c = ask_temperature(
            self._person,
            f"{key}/thermometer",
            "Read the thermometer at the block",
            self._minimum_c,
            self._maximum_c,
            "is outside the thermometer's {low:g} to {high:g} °C",
        )
        if found_c is not None:
            return found_c
        raise BadReading(
            self.name,
            f"no temperature within its range in {ATTEMPTS} attempts",
            "check the thermometer and its range in the bench file, then take this step again",
        )
