"""Instruments without an interface, operated by a person through prompts: head, level, chamber, thermometer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

from drivers.angles import (
    format_dms,
    parse_angle,
    read_angle,
    scale_text,
    typed_bubble,
    typed_temperature,
    wrapped_rad,
)
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
    message,
)
from drivers.person import APPROACH, ATTEMPTS, Person, Prompt, PromptKind, TurnHead, ask_until


class ByHand:
    """An instrument without an interface, operated by `person`; `model` is its name in the record."""

    model = ""

    def __init__(self, name: str, person: Person) -> None:
        self.name = name
        self._person = person

    def open(self) -> Identity:
        """Return the identity for the record, maker "manual"; nobody is asked."""
        return Identity(maker="manual", model=self.model)

    def close(self) -> None:
        """Do nothing: there is no connection, and the instrument stays as it is."""


# --- the head ---------------------------------------------------------------------------------------


class ManualHead(ByHand):
    """A `DividingHead` that a person turns and reads.

    `move` returns the angle that the person reads from the scale after clamping, not the target. The reading may
    differ from the target by `tolerance_rad`. With `enter_accepts_target`, an empty answer means that the scale
    shows the target; else the angle must be typed.
    """

    model = "dividing head"

    def __init__(
        self,
        name: str,
        person: Person,
        *,
        tolerance_rad: float,
        enter_accepts_target: bool = True,
    ) -> None:
        super().__init__(name, person)
        self._tolerance_rad = tolerance_rad
        self._enter_accepts_target = enter_accepts_target

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        """Ask the person to turn to `target_rad` in the stated direction; return the angle read.

        A reading outside the tolerance is never accepted: the question is repeated with the probable mistake.
        Raises `LimitExceeded` after the last attempt, `NoAnswer` if nobody can answer.
        """
        return self._turned(target_rad, direction, key, None)

    def return_to(
        self, target_rad: float, direction: Direction, key: str, *, by_way_of_rad: float
    ) -> HeadPosition:
        """Ask the person to turn to `by_way_of_rad` without reading it, then to `target_rad` as `move` does.

        Raises the errors of `move`.
        """
        return self._turned(target_rad, direction, key, by_way_of_rad)

    def stands_at(self, key: str) -> float:
        """Ask for the angle at which the head stands; return it within half a turn of 0, rad.

        Nobody turns the head. Raises `BadReading` after the last attempt, `NoAnswer` if nobody can answer.
        """
        task = message("Leave the head as it stands; read its scale and type the angle read.")
        question = Prompt(key, PromptKind.ANGLE, task, unit="° ′ ″", action={"do": "read_head"})

        def read(typed: str) -> float:
            if not typed:
                raise ValueError(message("Nothing was typed: read the scale and type what it shows."))
            try:
                return wrapped_rad(parse_angle(typed))
            except ValueError as error:
                raise ValueError(f"{error}.") from None

        try:
            return ask_until(self._person, question, read)
        except ValueError as trouble:
            raise BadReading(
                self.name,
                f"no angle in {ATTEMPTS} attempts ({trouble})",
                "read its scale again",
            ) from None

    def _turned(
        self, target_rad: float, direction: Direction, key: str, by_way_of_rad: float | None
    ) -> HeadPosition:
        target = scale_text(target_rad)
        action: TurnHead = {
            "do": "turn",
            "target_rad": target_rad,
            "direction": direction,
            "tolerance_rad": self._tolerance_rad,
        }
        question = again = Prompt(
            id=key,
            kind=PromptKind.ANGLE,
            text=message(
                f"Turn the head to {target}: {APPROACH[direction]}; clamp; read again and type the angle read."
            ),
            default=target if self._enter_accepts_target else None,
            unit="° ′ ″",
            action=action,
        )
        if by_way_of_rad is not None:  # after a wrong reading the head is back already
            away = message(f"First turn the head away to {scale_text(by_way_of_rad)}, roughly.")
            way: TurnHead = {**action, "by_way_of_rad": by_way_of_rad}
            question = replace(again, text=f"{away} {again.text}", action=way)
        try:
            angle_rad = ask_until(
                self._person,
                question,
                lambda typed: read_angle(typed, target_rad, self._tolerance_rad),
                again,
            )
        except ValueError as trouble:
            raise LimitExceeded(
                self.name,
                f"no reading within {format_dms(self._tolerance_rad)} of {scale_text(target_rad)} "
                f"in {ATTEMPTS} attempts ({trouble})",
                "check the clamp, the scale and the procedure's angle, then redo this point",
            ) from None
        return HeadPosition(angle_rad, direction)


# --- the level --------------------------------------------------------------------------------------

_ENDS: Final[dict[tuple[LevelAxis, bool], str]] = {
    ("along", False): message("along the shaft, its marked end away from you"),
    ("along", True): message("along the shaft the other way round, its marked end towards you"),
    ("across", False): message("across the shaft, its marked end to your right"),
    ("across", True): message("across the shaft the other way round, its marked end to your left"),
}


class ManualLevel(ByHand):
    """A `Level` with one vial, which a person lays first along the shaft, then across it.

    The scale has `most_divisions` divisions of `division_rad` on either side of its middle. The standard
    uncertainties are `reading_divisions` for a reading, `scale` (relative) for a division, and `turn_rad` for
    the direction of the level.
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
        """The standard uncertainties, from the bench file."""
        return self._sizes

    def inclination(self, key: str, *, turned: bool) -> Inclination:
        """Ask for the bubble's position along the shaft and across it; repeat the question if it is off the scale.

        Raises `BadReading` after the last attempt, `NoAnswer` if nobody can answer.
        """
        return Inclination(self._read(key, "along", turned), self._read(key, "across", turned))

    def _read(self, key: str, axis: LevelAxis, turned: bool) -> float:
        task = message(
            f"Looking at the end of the shaft, lay the level {_ENDS[axis, turned]}; when the bubble stands, "
            f"type by "
            "how many divisions it is off the middle, + towards the marked end (or so many arcsec)."
        )
        question = Prompt(
            id=f"{key}/{axis}",
            kind=PromptKind.NUMBER,
            text=task,
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
                question,
                lambda typed: typed_bubble(typed, self._division_rad, self._most_divisions),
            )
        except ValueError as trouble:
            raise BadReading(
                self.name,
                f"no reading on its scale in {ATTEMPTS} attempts ({trouble})",
                "level the platform roughly, check the divisions in the bench file, then repeat this step",
            ) from None


# --- the chamber ------------------------------------------------------------------------------------


def ask_temperature(
    person: Person,
    key: str,
    text: str,
    low_c: float,
    high_c: float,
    outside: Callable[[float], str],
    of: str = "block",
) -> float | None:
    """Ask for a temperature, °C; return None if no attempt gives one between `low_c` and `high_c`.

    `key` is the prompt's id, `text` the task. `outside` returns the sentence shown for a value out of range.
    `of` is "block", "meter" or "room". Raises `NoAnswer` if nobody can answer.
    """
    question = Prompt(
        id=key,
        kind=PromptKind.NUMBER,
        text=message(f"{text} and type the temperature in °C."),
        unit="°C",
        minimum=low_c,
        maximum=high_c,
        action={"do": "read_temperature"} if of == "block" else {"do": "read_temperature", "of": of},
    )

    def read(typed: str) -> float:
        temperature_c = typed_temperature(typed)
        if not low_c <= temperature_c <= high_c:
            raise ValueError(outside(temperature_c))
        return temperature_c

    try:
        return ask_until(person, question, read)
    except ValueError:
        return None


_YES: Final = frozenset({"y", "yes", "ok", "done"})
_PLAUSIBLE_K: Final = 20.0
"""A reading may lie this far outside the chamber's range, K, because the chamber may not be on yet."""


class ManualChamber(ByHand):
    """A `ThermalChamber` that a person sets and reads.

    Its safe state is the temperature `safe_c`, °C, or, if that is None, switched off.
    """

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
        """Return the task of making the chamber safe, for a person; an empty string if no temperature was set.

        No question is asked.
        """
        if not self._set:
            return ""
        if self._safe_c is None:
            return message("switch the chamber off by hand")
        return message(f"set the chamber to {self._safe_c:g} °C by hand")

    def set_temperature(self, target_c: float, key: str) -> None:
        """Ask the person to set `target_c` and to confirm; any answer but "yes" repeats the question.

        Raises `LimitExceeded` before anybody is asked, `InstrumentRefused` if the person never confirms,
        `NoAnswer` if nobody can answer.
        """
        if not self._minimum_c <= target_c <= self._maximum_c:
            raise LimitExceeded(
                self.name,
                f"{target_c:g} °C is outside {self._minimum_c:g} to {self._maximum_c:g} °C",
                "change the temperature in the procedure or the limits in the bench file",
            )
        self._set = True
        for attempt in range(1, ATTEMPTS + 1):
            text = self._ask(
                Prompt(
                    id=f"{key}#{attempt}",
                    kind=PromptKind.CONFIRM,
                    text=message(f"Set the chamber to {target_c:g} °C and confirm."),
                    default="yes",
                    action={"do": "set_temperature", "target_c": target_c},
                )
            )
            if text is not None and text.lower() in _YES:
                return
        raise InstrumentRefused(
            self.name,
            f"nobody confirmed that the chamber is set to {target_c:g} °C",
            "set it and take this step again",
        )

    def temperature(self, key: str, *, settling: bool = False) -> float:
        """Ask for the temperature at the block, °C; repeat the question if it is implausible.

        Raises `BadReading` after the last attempt, `NoAnswer` if nobody can answer.
        """
        low_c, high_c = self._minimum_c - _PLAUSIBLE_K, self._maximum_c + _PLAUSIBLE_K
        found_c = ask_temperature(
            self._person,
            key,
            message("Read the thermometer"),
            low_c,
            high_c,
            lambda typed_c: message(f"{typed_c:g} °C is not plausible ({low_c:g} to {high_c:g} °C)."),
        )
        if found_c is not None:
            return found_c
        raise BadReading(
            self.name,
            f"no plausible temperature in {ATTEMPTS} attempts",
            "check the thermometer and the chamber's limits in the bench file, then repeat this step",
        )

    def _ask(self, prompt: Prompt) -> str | None:
        """Return the answer (if empty, the default), or None if it answers an earlier prompt."""
        answer = self._person.ask(prompt)
        if answer.prompt_id != prompt.id:
            return None
        text = answer.text.strip().replace("−", "-")
        return text or prompt.default or ""


_PLACES: Final = {
    "block": message("Read the thermometer at the block"),
    "meter": message("Read the thermometer at the voltmeters"),
    "room": message("Read the thermometer in the room"),
}


class ManualThermometer(ByHand):
    """A `Thermometer` that a person reads; its range is `minimum_c` to `maximum_c`, °C.

    It is at the "block", at the "meter" or in the "room", as `of` says; `sensor` describes it in the record.
    """

    model = "thermometer"
    asks_person = True

    def __init__(
        self,
        name: str,
        person: Person,
        *,
        minimum_c: float,
        maximum_c: float,
        sensor: str,
        of: str = "block",
    ) -> None:
        super().__init__(name, person)
        self.sensor = sensor
        self._of = of
        self._minimum_c = minimum_c
        self._maximum_c = maximum_c

    def block_c(self, key: str) -> float:
        """Ask for the temperature at the thermometer's place, °C; repeat the question if it is out of range.

        Raises `BadReading` after the last attempt, `NoAnswer` if nobody can answer.
        """
        found_c = ask_temperature(
            self._person,
            f"{key}/thermometer" if self._of == "block" else f"{key}/{self._of}_thermometer",
            _PLACES[self._of],
            self._minimum_c,
            self._maximum_c,
            lambda typed_c: message(
                f"{typed_c:g} °C is outside the thermometer's {self._minimum_c:g} to {self._maximum_c:g} °C."
            ),
            self._of,
        )
        if found_c is not None:
            return found_c
        raise BadReading(
            self.name,
            f"no temperature within its range in {ATTEMPTS} attempts",
            "check the thermometer and its range in the bench file, then repeat this step",
        )
