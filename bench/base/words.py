"""Words for durations, angles and directions, once: in sentences, in lists, in files that a program writes.

And words that stand twice.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Final

from bench.base.arrays import HOUR, MINUTE

APPROACH: Final[Mapping[int, str]] = {1: "rising", -1: "falling"}
"""From which side an angle or a temperature was reached: +1 from below, -1 from above."""

_SECONDS: Final = ((HOUR, "h"), (MINUTE, "min"), (1.0, "s"))


def repeated(words: Iterable[str]) -> list[str]:
    """Return the words that stand more than once, in the order of their first place."""
    return [word for word, times in Counter(words).items() if times > 1]


def duration(seconds: float) -> str:
    """Return a duration in the largest unit in which it is a plain number: "1 h", "90 s"."""
    for size, unit in _SECONDS:
        if seconds >= size and seconds % size == 0.0:
            return f"{seconds / size:g} {unit}"
    return f"{seconds:g} s"


def exact_duration(seconds: float) -> str:
    """Return a duration for a file: as `duration`, but with every digit of it."""
    if seconds and seconds % MINUTE == 0:
        return duration(seconds)
    return f"{seconds!r} s" if seconds % 1 else f"{seconds:.0f} s"


def degrees(angle_rad: float) -> str:
    """Return an angle as a person reads it, to a millionth of a degree: "45°"."""
    return f"{round(math.degrees(angle_rad), 6):g}°"


def exact_degrees(angle_rad: float) -> str:
    """Return an angle for a file, with its unit: "45 deg"."""
    return f"{math.degrees(angle_rad):.9g} deg"
