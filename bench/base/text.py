"""Text for people and for programs: made visible, cut to length, in words, as C source."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import numpy as np

# --- text from outside: nothing in it acts where it leaves for a terminal, a page, a log ------------

QUOTED: Final = 80
"""Characters of a text from outside that a sentence quotes."""

_ENDLESS: Final = re.compile(r"\S{1000,}")
_LINE: Final = 5000
"""Longer than the longest path, which is 4096 bytes."""

_ACTS: Final = re.compile(
    "[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f"  # C0 and C1, escape among them
    "\u061c\u200b\u200e\u200f\u202a-\u202e\u2060-\u206f"  # what turns the direction of writing, or is not seen
    "\u2028\u2029\ufeff\ufff9-\ufffb\U000e0000-\U000e007f"  # ends of lines that are none, marks, tags
    "\ud800-\udfff]"  # halves of characters, which no file can hold
    "|\r(?!\n)"
)


def visible(text: str) -> str:
    r"""Return the text with characters that act, or are not seen, as escapes: `\x1b`, `\u202e`, `\ud800`.

    Ends of lines and tabs stay. What is visible already comes back as it is.
    """
    return _ACTS.sub(_escape, text)


def shortened(text: str) -> str:
    """Return a text as a sentence quotes it."""
    return text if len(text) <= QUOTED else f"{text[:QUOTED]}…"


def bounded(text: str) -> str:
    """Return a message with far too long words and lines cut, so that a person can read it."""
    text = _ENDLESS.sub(lambda word: shortened(word[0]), text)
    return "\n".join(line if len(line) <= _LINE else f"{line[:_LINE]}…" for line in text.split("\n"))


def _escape(found: re.Match[str]) -> str:
    code = ord(found[0])
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def in_json(text: str) -> str:
    r"""Return JSON text with the same characters as JSON writes them: `\u001b`. It reads back to the same."""
    return _ACTS.sub(_json_escape, text)


def _json_escape(found: re.Match[str]) -> str:
    units = found[0].encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[k : k + 2].hex()}" for k in range(0, len(units), 2))


# --- words for durations, angles and directions -----------------------------------------------------

APPROACH: Final[Mapping[int, str]] = {1: "rising", -1: "falling"}
"""From which side an angle or a temperature was reached: +1 from below, -1 from above."""

_SECONDS: Final = ((3600.0, "h"), (60.0, "min"), (1.0, "s"))


def repeated(words: Iterable[str]) -> list[str]:
    """Return the words that occur more than once, in the order of their first occurrence."""
    return [word for word, times in Counter(words).items() if times > 1]


def listed(names: Sequence[str]) -> str:
    """Return names joined for a sentence: "Kxx, Kxy and Kxz"."""
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def duration(seconds: float) -> str:
    """Return a duration in the largest unit in which it is a plain number: "1 h", "90 s"."""
    for size, unit in _SECONDS:
        if seconds >= size and seconds % size == 0.0:
            return f"{seconds / size:g} {unit}"
    return f"{seconds:g} s"


def exact_duration(seconds: float) -> str:
    """Return a duration for a file: as `duration`, but with every digit of it."""
    if seconds and seconds % 60.0 == 0:
        return duration(seconds)
    return f"{seconds!r} s" if seconds % 1 else f"{seconds:.0f} s"


def degrees(angle_rad: float) -> str:
    """Return an angle as a person reads it, to a millionth of a degree: "45°"."""
    return f"{round(math.degrees(angle_rad), 6):g}°"


def exact_degrees(angle_rad: float) -> str:
    """Return an angle for a file, with its unit: "45 deg"."""
    return f"{math.degrees(angle_rad):.9g} deg"


# --- C source ---------------------------------------------------------------------------------------


def one_line(text: str) -> str:
    """Return a name from outside so that it can neither end a comment, nor begin a line, nor act on a terminal."""
    return visible(" ".join(text.replace("*/", "* /").split())).rstrip("\\")


def comment(lines: Iterable[str]) -> str:
    """Return the inner lines of a block comment."""
    return "\n".join(f" * {line}".rstrip() for line in lines)


def single(value: np.float32) -> str:
    """Return a literal of type float."""
    text = f"{float(value):.9g}"
    return f"{text}f" if any(mark in text for mark in ".en") else f"{text}.0f"


def double(value: float) -> str:
    """Return a literal of type double that reads back to the same number."""
    return repr(float(value))
