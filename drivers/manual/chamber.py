"""A thermal chamber that a person sets and reads."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from drivers.interfaces import BadReading, Identity, InstrumentRefused, LimitExceeded, Prompt, PromptKind

if TYPE_CHECKING:
    from drivers.interfaces import Person

_NUMBER: Final = re.compile(r"([+-]?\d{1,4}(?:[.,]\d+)?)\s*°?\s*[cC]?")
_YES: Final = frozenset({"y", "yes", "ok", "done"})
_NO: Final = frozenset({"n", "no"})
_MAX_WAITS: Final = 1000
"""So often may "no" be answered, which waits: more is nobody who reads the question."""
_PLAUSIBLE_K: Final = 20.0
"""A thermometer may stand this far outside the chamber's range (a room, a chamber not yet switched on)."""
_MAX_ATTEMPTS: Final = 5


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
        left = _MAX_ATTEMPTS
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
        low_c, high_c = self._minimum_c - _PLAUSIBLE_K, self._maximum_c + _PLAUSIBLE_K
        trouble = ""
        for attempt in range(1, _MAX_ATTEMPTS + 1):
            text = self._ask(
                Prompt(
                    id=f"{key}#{attempt}",
                    kind=PromptKind.NUMBER,
                    text=f"{trouble} Read the thermometer and type the temperature in °C.".lstrip(),
                    unit="°C",
                    minimum=low_c,
                    maximum=high_c,
                    action={"do": "read_temperature"},
                )
            )
            match = _NUMBER.fullmatch(text) if text is not None else None
            if match is None:
                trouble = "That was not a temperature such as 23.5."
                continue
            temperature_c = float(match[1].replace(",", "."))
            if low_c <= temperature_c <= high_c:
                return temperature_c
            trouble = f"{temperature_c:g} °C is not plausible ({low_c:g} to {high_c:g} °C)."
        raise BadReading(
            self.name,
            f"no plausible temperature in {_MAX_ATTEMPTS} attempts",
            "check the thermometer and the chamber's limits in the bench file, then take this step again",
        )

    def _ask(self, prompt: Prompt) -> str | None:
        """Return the answer as text, the default where it is empty, or None where it is a stale one."""
        answer = self._person.ask(prompt)
        if answer.prompt_id != prompt.id:
            return None
        text = answer.text.strip().replace("−", "-")
        return text or prompt.default or ""
