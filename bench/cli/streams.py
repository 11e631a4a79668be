"""The standard streams of the program: a command goes on when nobody reads them any more.

This module is imported before Ctrl-C is handled, so it imports nothing heavy.
"""

from __future__ import annotations

import codecs
import io
import os
import sys

TYPE_CHECKING = False  # as in bench.cli.program
if TYPE_CHECKING:
    from typing import Any

_IN_ASCII = "bench.in_ascii"
_SIGNS = {
    "\N{MINUS SIGN}": "-", "\N{EN DASH}": "-", "\N{EM DASH}": "-", "±": "+-", "×": "x", "·": "*",
    "≤": "<=", "≥": ">=", "→": "->", "µ": "u", "\N{GREEK SMALL LETTER MU}": "u", "…": "...", "“": '"', "”": '"',
    "\N{LEFT SINGLE QUOTATION MARK}": "'", "\N{RIGHT SINGLE QUOTATION MARK}": "'", "\N{NO-BREAK SPACE}": " ",
}  # fmt: skip
_RAISED = "⁰¹²³⁴⁵⁶⁷⁸⁹⁻"
_WORDS = {
    "°": "deg", "\N{PRIME}": "arcmin", "″": "arcsec", "Ω": "ohm", "√": "sqrt", "Δ": "delta", "χ": "chi",
    "\N{GREEK SMALL LETTER SIGMA}": "sigma", "✓": "ok", "✗": "not ok",
}  # fmt: skip


class _Outlet(io.FileIO):
    """A descriptor whose output is dropped when the reader of its pipe has ended, such as `head` or `tee`."""

    def write(self, data: Any, /) -> int:
        """Write bytes; return how many were written."""
        try:
            return super().write(data)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            return super().write(data)


def keep_writable() -> None:
    """Replace standard streams so that neither a closed one nor a pipe without a reader stops a command.

    A character that the terminal cannot encode is shown in ASCII.
    """
    codecs.register_error(_IN_ASCII, in_ascii)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115, PTH123 - until the end
        elif mode == "w" and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=_IN_ASCII)
            if isinstance(getattr(stream.buffer, "raw", stream.buffer), io.FileIO):
                setattr(sys, name, _on_outlet(stream))


def _on_outlet(stream: io.TextIOWrapper) -> io.TextIOWrapper:
    outlet = _Outlet(stream.fileno(), "w", closefd=False)
    return io.TextIOWrapper(
        outlet if stream.write_through else io.BufferedWriter(outlet),  # as Python is asked not to buffer
        stream.encoding,
        stream.errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )


def in_ascii(error: UnicodeError) -> tuple[str, int]:
    """Return text in ASCII for the characters that an encoding lacks, and where to continue (`codecs`).

    An unknown character is shown as an escape.
    """
    if not isinstance(error, UnicodeEncodeError):
        raise error
    shown = (_shown(error.object, place) for place in range(error.start, error.end))
    return "".join(shown), error.end


def _shown(text: str, place: int) -> str:
    character, before, after = text[place], text[:place][-1:], text[place + 1 :][:1]
    if character in _WORDS:  # apart from letters and digits beside it
        return " " * _is_of_a_word(before) + _WORDS[character] + " " * _is_of_a_word(after)
    if character in _RAISED:
        return "^" * (before not in _RAISED) + "0123456789-"[_RAISED.index(character)]
    return _SIGNS.get(character) or character.encode("ascii", "backslashreplace").decode()


def _is_of_a_word(character: str) -> bool:
    return character.isalnum() and character not in _RAISED
