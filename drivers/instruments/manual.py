"""Instruments without an interface, handled by a person who is asked: head, level, chamber."""

from __future__ import annotations

import math
from functools import partial
from typing import Final

from drivers.angles import ROUNDING_RAD, format_dms, parse_angle, read_angle, typed_bubble, typed_temperature
from drivers.interfaces import (
    BadReading,
    Direction,
    HeadPosition,
    Identity,
    Inclination,
    InstrumentRefused,
    LevelAxis,
    LevelSizes,
    LimitExceeded,
)
from drivers.person import ATTEMPTS, Person, Prompt, PromptKind, ask_until


class ByHand:
    """An instrument without an interface, which a `person` handles; `model` is what the record calls it."""

    model = ""

    def __init__(self, name: str, person: Person) -> None:
        self.name = name
        self._person = person

    def open(self) -> Identity:
        """Return what the record says of an instrument without electronics; nothing is asked."""
        return Identity(maker="manual", model=self.model)

    def close(self) -> None:
        """Nothing to release: the person leaves it as it is."""


# --- the head ---------------------------------------------------------------------------------------

_APPROACH: Final[dict[Direction, str]] = {
    1: "approach with the angle rising, from below",
    -1: "approach with the angle falling, from above",
}


class ManualHead(ByHand):
    """A `DividingHead` whose motor and encoder are a person.

    The angle that comes back is the one read on the scale after clamping, never the target: it is what
    the calibration takes. `tolerance_rad` is how far it may lie from the target. Where
    `enter_accepts_target`, an empty answer is the target; else the angle must be typed.
    """

    model = "dividing head"

    def __init__(
        self,
        name: str,
        person: Person,
        *,
        tolerance_rad: float,
        enter_accepts_target: bool = True,
        max_attempts: int = 5,
    ) -> None:
        super().__init__(name, person)
        self._tolerance_rad = tolerance_rad
        self._enter_accepts_target = enter_accepts_target
        self._max_attempts = max_attempts

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        """Ask the person to turn to `target_rad` from the stated side; return the angle read.

        A reading outside the tolerance is never accepted: it is asked again, naming the probable slip.
        Raises `LimitExceeded` after the last attempt, `NoAnswer` when there is nobody to ask.
        """
        try:
            angle_rad = ask_until(
                self._person,
                key,
                partial(self._prompt, target_rad, direction),
                lambda typed: read_angle(typed, target_rad, self._tolerance_rad),
                self._max_attempts,
            )
        except ValueError as trouble:
            raise LimitExceeded(
                self.name,
                f"no reading within {format_dms(self._tolerance_rad)} of {_scale_text(target_rad)} "
                f"in {self._max_attempts} attempts ({trouble})",
                "check the clamp, the scale and the procedure's angle, then take this point again",
            ) from None
        return HeadPosition(angle_rad, direction)

    def _prompt(self, target_rad: float, direction: Direction, prompt_id: str, trouble: str) -> Prompt:
        target = _scale_text(target_rad)
        task = (
            f"Turn the head to {target}: {_APPROACH[direction]}; clamp; read again and type the angle read."
        )
        return Prompt(
            id=prompt_id,
            kind=PromptKind.ANGLE,
            text=f"{trouble} {task}".lstrip(),
            default=target if self._enter_accepts_target else None,
            unit="° ′ ″",
            action={
                "do": "turn",
                "target_rad": target_rad,
                "direction": direction,
                "tolerance_rad": self._tolerance_rad,
            },
        )


def _scale_text(angle_rad: float) -> str:
    """Return the angle as the scale shows it, with as many decimals (3 at most) as it takes to be exact."""
    shown_rad = angle_rad if 0.0 <= angle_rad <= math.tau else angle_rad % math.tau
    for decimals in range(3):
        text = format_dms(shown_rad, decimals)
        if abs(parse_angle(text) - shown_rad) < ROUNDING_RAD:
            return text
    return format_dms(shown_rad, 3)


# --- the level --------------------------------------------------------------------------------------

_ENDS: Final[dict[tuple[LevelAxis, bool], str]] = {
    ("along", False): "along the shaft, its marked end away from you",
    ("along", True): "along the shaft the other way round, its marked end towards you",
    ("across", False): "across the shaft, its marked end to your right",
    ("across", True): "across the shaft the other way round, its marked end to your left",
}


class ManualLevel(ByHand):
    """A `Level` of one vial, laid along the shaft and across it. A graduation is `division_rad`.

    A person reads it to `reading_divisions` (standard uncertainty); the vial has `most_divisions` to either side.
    `scale` is the standard uncertainty of a graduation as a part of it, `turn_rad` that of how it is laid.
    """

    model = "bubble level"
    asks_person = True

    def __init__(
        self,
        name: str,
        person: Person,
        *,
        division_rad: float,
        reading_divisions: float,
        most_divisions: float,
        scale: float,
        turn_rad: float,
    ) -> None:
        super().__init__(name, person)
        self._division_rad = division_rad
        self._most_divisions = most_divisions
        self._sizes = LevelSizes(reading_divisions * division_rad, scale, turn_rad)

    @property
    def sizes(self) -> LevelSizes:
        """As the bench file states them."""
        return self._sizes

    def inclination(self, key: str, *, turned: bool) -> Inclination:
        """Ask for the bubble along the shaft and across it; what is off the vial's scale is asked again.

        Raises `BadReading` when nothing on the scale comes, `NoAnswer` when there is nobody to ask.
        """
        return Inclination(self._read(key, "along", turned), self._read(key, "across", turned))

    def _read(self, key: str, axis: LevelAxis, turned: bool) -> float:
        def prompt(prompt_id: str, trouble: str) -> Prompt:
            return Prompt(
                id=prompt_id,
                kind=PromptKind.NUMBER,
                text=(
                    f"{trouble} Looking at the end of the shaft, lay the level {_ENDS[axis, turned]}; when the "
                    "bubble stands, type by how many divisions it is off the middle, + towards the marked end "
                    "(or so many arcsec)."
                ).lstrip(),
                unit="divisions",
                action={
                    "do": "read_level",
                    "axis": axis,
                    "turned": turned,
                    "division_rad": self._division_rad,
                    "most_divisions": self._most_divisions,
                },
            )

        try:
            return ask_until(
                self._person,
                f"{key}/{axis}",
                prompt,
                lambda typed: typed_bubble(typed, self._division_rad, self._most_divisions),
            )
        except ValueError as trouble:
            raise BadReading(
                self.name,
                f"no reading on its scale in {ATTEMPTS} attempts ({trouble})",
                "level the platform roughly, check the divisions in the bench file, then take this step again",
            ) from None


# --- the chamber ------------------------------------------------------------------------------------


def ask_temperature(
    person: Person, key: str, text: str, low_c: float, high_c: float, outside: str
) -> float | None:
    """Ask for a temperature from `low_c` to `high_c`, °C, until one comes; return None when none does.

    `key` names the question, `text` what to do, `outside` what is said of a value beyond: "is not plausible
    ({low:g} to {high:g} °C)". Raises `NoAnswer` when there is nobody to ask.
    """

    def prompt(prompt_id: str, trouble: str) -> Prompt:
        return Prompt(
            id=prompt_id,
            kind=PromptKind.NUMBER,
            text=f"{trouble} {text} and type the temperature in °C.".lstrip(),
            unit="°C",
            minimum=low_c,
            maximum=high_c,
            action={"do": "read_temperature"},
        )

    def read(typed: str) -> float:
        temperature_c = typed_temperature(typed)
        if not low_c <= temperature_c <= high_c:
            raise ValueError(f"{temperature_c:g} °C {outside.format(low=low_c, high=high_c)}.")
        return temperature_c

    try:
        return ask_until(person, key, prompt, read)
    except ValueError:
        return None


_YES: Final = frozenset({"y", "yes", "ok", "done"})
_NO: Final = frozenset({"n", "no"})
_MAX_WAITS: Final = 1000
"""So often may "no" be answered, which waits: more is nobody who reads the question."""
_PLAUSIBLE_K: Final = 20.0
"""A thermometer may stand this far outside the chamber's range (a room, a chamber not yet switched on)."""


class ManualChamber(ByHand):
    """A `ThermalChamber` whose controller is a person; limits in °C."""

    model = "thermal chamber"
    asks_person = True

    def __init__(
        self, name: str, person: Person, *, minimum_c: float, maximum_c: float, safe_c: float | None = None
    ) -> None:
        super().__init__(name, person)
        self._minimum_c = minimum_c
        self._maximum_c = maximum_c
        self._safe_c = safe_c
        self._set = False

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


class ManualThermometer(ByHand):
    """A `Thermometer` of the given range, °C, whose display a person reads; what is beyond is asked again."""

    model = "thermometer"
    asks_person = True

    def __init__(self, name: str, person: Person, *, minimum_c: float, maximum_c: float, sensor: str) -> None:
        super().__init__(name, person)
        self.sensor = sensor
        self._minimum_c = minimum_c
        self._maximum_c = maximum_c

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
