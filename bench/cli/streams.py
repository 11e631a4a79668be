"""The standard streams of the program: a command goes on when nobody reads them any more.

This module is imported before Ctrl-C is handled, so it imports nothing heavy.
"""

from __future__ import annotations

import io
import os
import sys

TYPE_CHECKING = False  # as in bench.cli.program
if TYPE_CHECKING:
    from typing import Any


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

    A character that the terminal cannot encode is shown as an escape.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115, PTH123 - until the end
        elif mode == "w" and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
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
