"""Reads the line that answers a question, and lets something else be done until it is there."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable
from typing import Final, TextIO

SLICE_S: Final = 1.0


def read_line(answers: TextIO, meanwhile: Callable[[], None] | None = None) -> str:
    """Return the next line with its end; empty where the answers have ended.

    Until it is there `meanwhile` is called once a second; what that raises ends the question. All happens in one
    thread, and what is typed while `meanwhile` is busy waits in the terminal, so no answer is lost. A stream of
    no terminal, file or pipe of the system (nor any on Windows) cannot be waited for so: it is read as it comes.
    """
    descriptor = _descriptor(answers)
    if descriptor is None:
        return answers.readline()
    line = bytearray()
    # byte by byte: what a stream had read ahead, the system would not say to be there
    while not line.endswith(b"\n"):
        if meanwhile is not None and not select.select([descriptor], [], [], SLICE_S)[0]:
            meanwhile()
        elif byte := os.read(descriptor, 1):
            line += byte
        else:
            break
    return line.decode(answers.encoding or "utf-8", "backslashreplace")


def _descriptor(answers: TextIO) -> int | None:
    if sys.platform == "win32":  # which can wait for sockets alone
        return None
    try:
        return answers.fileno()
    except (OSError, ValueError):
        return None
