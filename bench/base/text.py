"""Formatting of text: escaping and shortening of untrusted text, words for quantities, C source."""

from __future__ import annotations

import math
import re
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import PurePath
from typing import TYPE_CHECKING, Final

from bench.base.languages import message

if TYPE_CHECKING:
    import numpy as np

# --- untrusted text: made harmless before it reaches a terminal, a page or a log ---------------------

QUOTED: Final = 80
"""The largest number of characters of an untrusted text that a message quotes."""

_ENDLESS: Final = re.compile(r"\S{1000,}")
_LINE: Final = 5000
"""The longest line of a message: longer than the longest path, which is 4096 bytes."""

_ACTS: Final = re.compile(
    "[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f"  # C0 and C1 control characters, including escape
    "\u061c\u200b\u200e\u200f\u202a-\u202e\u2060-\u206f"  # bidirectional and invisible format characters
    "\u2028\u2029\ufeff\ufff9-\ufffb\U000e0000-\U000e007f"  # Unicode line separators, marks, tags
    "\ud800-\udfff]"  # lone surrogates, which no UTF-8 file can hold
    "|\r(?!\n)"
)


def visible(text: str) -> str:
    r"""Return the text with control and invisible characters as escapes: `\x1b`, `\u202e`, `\ud800`.

    Line ends and tabs stay, as do all visible characters.
    """
    return _ACTS.sub(_escape, text)


def as_typed(name: object) -> str:
    """Return a name or path as a shell takes it: in quotes if it has blanks or characters with a meaning.

    A path that begins with a dash would be taken for an option, so it begins with "./".
    """
    typed = str(name)
    return shlex.quote(f"./{typed}" if typed.startswith("-") else typed)


def shown_path(path: str) -> str:
    """Return a path as a page shows it: only the last name of an absolute path, to hide the user's folders."""
    return PurePath(path).name if PurePath(path).is_absolute() else path


def civil_minute(time: str) -> str:
    """Return an ISO 8601 time as people write it: "2026-11-24 00:12 UTC"; any other text is returned unchanged."""
    try:
        when = datetime.fromisoformat(time)
    except ValueError:
        return time
    zone = when.strftime(" %Z") if when.tzinfo else ""
    return f"{when:%Y-%m-%d %H:%M}{zone}"


def cause_of(error: Exception) -> str:
    """Return the cause of an error for a message, without Python's type names, error numbers and paths."""
    match error:
        case KeyError():
            return message(f"{error} is missing")
        case TypeError() | AttributeError():
            return message("a value of the wrong type")
        case OSError():
            return error.strerror or str(error)
    return str(error)


def shortened(text: str) -> str:
    """Return a text cut to 80 characters (`QUOTED`), followed by "…" if it was longer."""
    return text if len(text) <= QUOTED else f"{text[:QUOTED]}…"


def bounded(text: str) -> str:
    """Return a message after shortening words of 1000 or more characters and lines of more than 5000."""
    text = _ENDLESS.sub(lambda word: shortened(word[0]), text)
    return "\n".join(line if len(line) <= _LINE else f"{line[:_LINE]}…" for line in text.split("\n"))


def _escape(found: re.Match[str]) -> str:
    code = ord(found[0])
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def in_json(text: str) -> str:
    r"""Return a JSON text of equal value in which control and invisible characters are escapes (`\u001b`)."""
    return _ACTS.sub(_json_escape, text)


def _json_escape(found: re.Match[str]) -> str:
    units = found[0].encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[k : k + 2].hex()}" for k in range(0, len(units), 2))


# --- words for durations, angles and directions -----------------------------------------------------

APPROACH: Final[Mapping[int, str]] = {1: "rising", -1: "falling"}
"""The direction in which an angle or a temperature was approached: +1 from below, -1 from above."""

_SECONDS: Final = ((3600.0, "h"), (60.0, "min"), (1.0, "s"))


def repeated(words: Iterable[str]) -> list[str]:
    """Return the words that occur more than once, in the order of their first occurrence."""
    return [word for word, times in Counter(words).items() if times > 1]


LISTED: Final = 8
"""Largest number of entries of a list in a result."""
LISTED_IN_SENTENCE: Final = 4
"""Largest number of entries that one sentence lists."""


def listed(names: Sequence[str]) -> str:
    """Return names joined for a sentence: "Kxx, Kxy and Kxz"."""
    if len(names) < 2:
        return "".join(names)
    return message(f"{', '.join(names[:-1])} and {names[-1]}")


def duration(seconds: float) -> str:
    """Return a duration in the largest unit in which it is a whole number: "1 h", "90 s"."""
    for size, unit in _SECONDS:
        if seconds >= size and seconds % size == 0.0:
            return f"{seconds / size:g} {unit}"
    return f"{seconds:g} s"


def exact_duration(seconds: float) -> str:
    """Return a duration for a file, in the unit that `duration` chooses, with all its digits."""
    if seconds and seconds % 60.0 == 0:
        return duration(seconds)
    return f"{seconds!r} s" if seconds % 1 else f"{seconds:.0f} s"


def degrees(angle_rad: float) -> str:
    """Return an angle for display, with at most six significant digits and six decimals: "45°"."""
    return f"{round(math.degrees(angle_rad), 6):g}°"


def exact_degrees(angle_rad: float) -> str:
    """Return an angle for a file, with its unit: "45 deg"."""
    return f"{math.degrees(angle_rad):.9g} deg"


# --- C source ---------------------------------------------------------------------------------------


def one_line(text: str) -> str:
    """Return an untrusted name on one line that cannot end a C comment or control a terminal."""
    return visible(" ".join(text.replace("*/", "* /").split())).rstrip("\\")


def comment(lines: Iterable[str]) -> str:
    """Return lines as the inside of a C block comment, each prefixed with " * "."""
    return "\n".join(f" * {line}".rstrip() for line in lines)


def single(value: np.float32) -> str:
    """Return a C literal of type float that reads back to the same number."""
    text = f"{float(value):.9g}"
    return f"{text}f" if any(mark in text for mark in ".en") else f"{text}.0f"


def double(value: float) -> str:
    """Return a C literal of type double that reads back to the same number."""
    return repr(float(value))
