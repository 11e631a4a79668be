"""The program `bench` from start to end.

Ctrl-C ends the program with one line in place of a traceback. The program continues if the reader of its output has
ended. This module handles Ctrl-C before anything heavy is imported.
"""

from __future__ import annotations

import codecs
import gc
import io
import os
import signal
import sys
from contextlib import suppress

TYPE_CHECKING = False  # the import of typing would delay the handling of Ctrl-C
if TYPE_CHECKING:
    from types import FrameType
    from typing import Any

_STOPPED = 2
_SAID = "stopped by Ctrl-C"


def main() -> None:
    """Run the command line of `sys.argv` and exit with its status.

    A Ctrl-C during the import of the commands is handled as well. A second Ctrl-C ends the program at once; a
    Ctrl-C while the message is printed is ignored. Code that must leave a bench safe handles signals itself
    (`bench.run.interrupts`).
    """
    gc.set_threshold(50_000, 20, 20)  # garbage collection in imports would take a tenth of a short command
    try:
        try:
            signal.signal(signal.SIGINT, _once)
            from bench.run.interrupts import Interrupts

            with Interrupts([signal.SIGINT]) as interrupts:
                interrupts.release(_SAID)
                keep_writable()
                from bench.cli.app import main as command_line

                command_line()
        finally:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
    except KeyboardInterrupt as stop:
        if isinstance(stop.__context__, SystemExit):
            raise stop.__context__ from None  # Ctrl-C came while the program was exiting: keep its status
        print(f"bench: {_SAID}", file=sys.stderr)
        _leave()
    except SystemExit as end:
        if end.code == _STOPPED and Interrupts.heard:
            _leave()
        raise


def _leave() -> None:
    """End the process at once, without the slow teardown of imported modules."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):  # the terminal may have been closed
            stream.flush()
    os._exit(_STOPPED)


def _once(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt


# --- standard streams --------------------------------------------------------------------------------


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
    """A descriptor whose output is dropped when the reader of its pipe has ended, such as `head` or `tee`.

    On standard error it is dropped on a full disk, too: the exit status still says how the command ended.
    """

    forgiven: type[OSError] = BrokenPipeError

    def write(self, data: Any, /) -> int:
        """Write bytes; return how many were written."""
        try:
            return super().write(data)
        except self.forgiven:
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
                setattr(sys, name, _on_outlet(stream, OSError if name == "stderr" else BrokenPipeError))


def _on_outlet(stream: io.TextIOWrapper, forgiven: type[OSError]) -> io.TextIOWrapper:
    outlet = _Outlet(stream.fileno(), "w", closefd=False)
    outlet.forgiven = forgiven
    return io.TextIOWrapper(
        outlet if stream.write_through else io.BufferedWriter(outlet),  # as Python is asked not to buffer
        stream.encoding,
        stream.errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )


def in_ascii(error: UnicodeError) -> tuple[str, int]:
    """Return ASCII text for the characters that an encoding lacks, and the position at which to continue.

    This error handler of `codecs` writes a character without an ASCII spelling as an escape.
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
