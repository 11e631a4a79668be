"""Text from outside, where it leaves for a terminal, a page, a log or a spreadsheet: nothing in it acts there."""

from __future__ import annotations

import re
from typing import Final

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
    """Return a message whose words and lines a person can read: what is longer by far is cut."""
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
