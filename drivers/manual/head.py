"""A dividing head that a person turns and reads: asked by prompts, checked for the classic slips."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from drivers.angles import ROUNDING_RAD, format_dms, parse_angle, read_angle
from drivers.interfaces import Direction, HeadPosition, Identity, LimitExceeded, Prompt, PromptKind

if TYPE_CHECKING:
    from drivers.interfaces import Person

_APPROACH: Final[dict[Direction, str]] = {
    1: "approach with the angle rising, from below",
    -1: "approach with the angle falling, from above",
}


class ManualHead:
    """A `DividingHead` whose motor and encoder are a person.

    The angle that comes back is the one read on the scale after clamping, never the target: it is what
    the calibration takes. `tolerance_rad` is how far it may lie from the target. Where
    `enter_accepts_target`, an empty answer is the target; else the angle must be typed.
    """

    def __init__(
        self,
        name: str,
        person: Person,
        *,
        tolerance_rad: float,
        enter_accepts_target: bool = True,
        max_attempts: int = 5,
    ) -> None:
        self.name = name
        self._person = person
        self._tolerance_rad = tolerance_rad
        self._enter_accepts_target = enter_accepts_target
        self._max_attempts = max_attempts

    def open(self) -> Identity:
        """Return what stands in the record for a head without electronics; nothing is asked."""
        return Identity(maker="manual", model="dividing head")

    def close(self) -> None:
        """Nothing to release: the person leaves the head clamped."""

    def move(self, target_rad: float, direction: Direction, key: str) -> HeadPosition:
        """Ask the person to turn to `target_rad` from the stated side; return the angle read.

        A reading outside the tolerance is never accepted: it is asked again, naming the probable slip.
        Raises `LimitExceeded` after the last attempt, `NoAnswer` when there is nobody to ask.
        """
        trouble = ""
        for attempt in range(1, self._max_attempts + 1):
            prompt = self._prompt(target_rad, direction, f"{key}#{attempt}", trouble)
            answer = self._person.ask(prompt)
            if answer.prompt_id != prompt.id:
                trouble = "That answer belonged to an earlier question."
                continue
            typed = answer.text.strip() or prompt.default or ""
            try:
                return HeadPosition(read_angle(typed, target_rad, self._tolerance_rad), direction)
            except ValueError as error:
                trouble = str(error)
        raise LimitExceeded(
            self.name,
            f"no reading within {format_dms(self._tolerance_rad)} of {_scale_text(target_rad)} "
            f"in {self._max_attempts} attempts ({trouble.rstrip('.')})",
            "check the clamp, the scale and the procedure's angle, then take this point again",
        )

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
