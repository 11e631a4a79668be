"""Levels the platform, and reads the level in two positions half a turn apart: its own zero drops out.

With the head at 0° the level shows along the shaft zero + α1, across it zero + α2 + α4 and the angle on the head's
scale; half a turn on, zero - α1 and so on. Half the difference is the inclination, half the sum the zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from bench.base.arrays import ARCSEC
from bench.run.answers import confirm
from bench.run.events import Levelled
from drivers.angles import wrapped_rad
from drivers.interfaces import (
    BadReading,
    BenchError,
    HeadPosition,
    Inclination,
    Level,
    LimitExceeded,
    Person,
    Prompt,
    PromptKind,
)

if TYPE_CHECKING:
    from bench.config.procedure.plan import Level as LevelStep
    from bench.run.workbench import Instruments

MOST_ATTEMPTS: Final = 5
MOST_PAIRS: Final = 3
ZERO_MOVED: Final = 5.0
"""A zero that is further than so many standard uncertainties from the one before is read again."""


@dataclass
class Levelling:
    """One levelling with the level of a bench; `setting_u_rad` is how exactly its head is set.

    `zero` is the level's own as it was found before, afterwards as it was found now; `position` is where the
    head was left.
    """

    instruments: Instruments
    person: Person
    setting_u_rad: float
    zero: Inclination | None = None
    position: HeadPosition | None = field(default=None, init=False)

    def carry_out(self, step: LevelStep) -> Levelled:
        """Level the platform where the step says so, read the level, return what is left.

        Raises `LimitExceeded` for a platform that is not level after all attempts, and what level, head and
        person raise.
        """
        level = self.instruments.level
        if level is None:
            raise BenchError(
                "level",
                f"{step.key}: the procedure levels the platform, but the bench has no level",
                "add one to the bench file, or take a procedure without levelling",
            )
        self._set_head(step, 1)
        if step.within_rad is None:
            return self._measured(step, level, 1)
        off = ""
        for attempt in range(1, MOST_ATTEMPTS + 1):
            self._have_levelled(step, attempt, off)
            found = self._measured(step, level, attempt)
            if max(abs(found.alpha1_arcsec), abs(found.alpha2_arcsec)) <= step.within_rad / ARCSEC:
                return found
            off = f"α1 = {found.alpha1_arcsec:+.1f}″ along the shaft and α2 = {found.alpha2_arcsec:+.1f}″ across it"
        raise LimitExceeded(
            level.name,
            f"after {MOST_ATTEMPTS} attempts the platform is still off by {off}, more than "
            f"{step.within_rad / ARCSEC:g}″",
            "free its screws and level it again, or allow more in the procedure",
        )

    def _have_levelled(self, step: LevelStep, attempt: int, off: str) -> None:
        text = "Level the platform by its screws, along the shaft and across it, and confirm"
        confirm(
            self.person,
            Prompt(
                id=f"{step.key}/platform{attempt}",
                kind=PromptKind.CONFIRM,
                text=f"It is off by {off}. {text}" if off else text,
                action={
                    "do": "level_platform",
                    "installation": step.installation,
                    "series": step.series,
                },
            ),
        )

    def _set_head(self, step: LevelStep, number: int) -> HeadPosition:
        self.position = self.instruments.head.move(0.0, 1, f"{step.key}/zero{number}")
        return self.position

    def _measured(self, step: LevelStep, level: Level, attempt: int) -> Levelled:
        rows, along, across, zeros = [], [], [], []
        for number in range(1, step.settings + 1):
            position = self.position if number == 1 and self.position else self._set_head(step, number)
            head_rad = wrapped_rad(position.angle_rad)
            first, second = self._pair(level, f"{step.key}/{attempt}.{number}")
            rows.append((head_rad, first.along_rad, first.across_rad, second.along_rad, second.across_rad))
            along.append((first.along_rad - second.along_rad) / 2.0)
            across.append((first.across_rad - second.across_rad) / 2.0 - head_rad)
            zeros.append(_zero(first, second))
        n, sizes = step.settings, level.sizes
        alpha1, alpha2 = sum(along) / n, sum(across) / n
        reading = sizes.reading_rad / math.sqrt(2.0 * n)
        u1 = math.hypot(reading, sizes.scale * alpha1, sizes.cross * alpha2)
        setting = self.setting_u_rad / math.sqrt(n)
        u2 = math.hypot(reading, sizes.scale * alpha2, sizes.cross * alpha1, setting)
        return Levelled(
            level_of=step.installation,
            level_series=step.series,
            adjusted=step.within_rad is not None,
            alpha1_arcsec=_arcsec(alpha1),
            u_alpha1_arcsec=_arcsec(u1),
            alpha2_arcsec=_arcsec(alpha2),
            u_alpha2_arcsec=_arcsec(u2),
            level_zero_arcsec=(
                _arcsec(sum(zero.along_rad for zero in zeros) / n),
                _arcsec(sum(zero.across_rad for zero in zeros) / n),
            ),
            level_readings=tuple(tuple(map(_arcsec, row)) for row in rows),
        )

    def _pair(self, level: Level, key: str) -> tuple[Inclination, Inclination]:
        """Read both positions; again where the zero is another than before: then one of them was misread."""
        for attempt in range(1, MOST_PAIRS + 1):
            first = self._read(level, f"{key}/first{attempt}", turned=False)
            second = self._read(level, f"{key}/turned{attempt}", turned=True)
            before, self.zero = self.zero, _zero(first, second)
            if before is None or _agree(before, self.zero, level.sizes.reading_rad):
                return first, second
        raise BadReading(
            level.name,
            f"its zero came out otherwise each time, at last at {_arcsec(self.zero.along_rad):+.1f}″ along and "
            f"{_arcsec(self.zero.across_rad):+.1f}″ across"
            if self.zero
            else "its zero is not known",
            "let it and the platform come to one temperature, see that it sits firmly, then take this step again",
        )

    def _read(self, level: Level, key: str, *, turned: bool) -> Inclination:
        """Have an electronic level placed; a bubble's own questions say how it is laid."""
        if not level.asks_person:
            how = (
                "half a turn from its first position" if turned else "in its first position, along the shaft"
            )
            confirm(
                self.person,
                Prompt(
                    id=f"{key}/place",
                    kind=PromptKind.CONFIRM,
                    text=f"Put the level on the platform {how}, let go of it, and confirm",
                    action={"do": "place_level", "turned": turned},
                ),
            )
        return level.inclination(key, turned=turned)


def _zero(first: Inclination, second: Inclination) -> Inclination:
    return Inclination(
        (first.along_rad + second.along_rad) / 2.0, (first.across_rad + second.across_rad) / 2.0
    )


def _agree(one: Inclination, other: Inclination, reading_rad: float) -> bool:
    most_rad = ZERO_MOVED * reading_rad  # of a difference of means of two, each of this size
    return max(abs(one.along_rad - other.along_rad), abs(one.across_rad - other.across_rad)) <= most_rad


def _arcsec(angle_rad: float) -> float:
    return round(angle_rad / ARCSEC, 4)
