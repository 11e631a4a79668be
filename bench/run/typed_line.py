"""Reads the line that answers a question, and lets something else be done until it is there."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable
from typing import Final, TextIO

SLICE_S: Final = 1.0


class LineReader:
    """Reads lines of a stream, one for each question.

    All happens in one thread, and what is typed while something else is done waits in the terminal, so no answer is
    lost. A stream of no terminal, file or pipe of the system (nor any on Windows) cannot be waited for so: it is
    read as it comes, and nothing is done until it is there.
    """

    def __init__(self, answers: TextIO) -> None:
        self._answers = answers
        self._descriptor = _descriptor(answers)
        self._begun = bytearray()

    def read(self, meanwhile: Callable[[], None] | None = None, slice_s: float = SLICE_S) -> str:
        """Return the next line with its end; empty where the answers have ended.

        Until it is there `meanwhile` is called every `slice_s`; what that raises ends the question, and the rest of
        a line that was begun for it is no answer to the next.
        """
        if self._descriptor is None:
            return self._answers.readline()
        while True:
            late = bool(self._begun)  # for a question that was ended
            line = self._rest_of_line(self._descriptor, meanwhile, slice_s)
            if late and line.endswith(b"\n"):
                continue
            return "" if late else line.decode(self._answers.encoding or "utf-8", "backslashreplace")

    def _rest_of_line(self, descriptor: int, meanwhile: Callable[[], None] | None, slice_s: float) -> bytes:
        # byte by byte: what a stream had read ahead, the system would not say to be there
        while not self._begun.endswith(b"\n"):
            if meanwhile is not None and not select.select([descriptor], [], [], slice_s)[0]:
                meanwhile()
            elif byte := os.read(descriptor, 1):
                self._begun += byte
            else:
                break
        line, self._begun = bytes(self._begun), bytearray()
        return line


def _descriptor(answers: TextIO) -> int | None:
    if sys.platform == "win32":  # which can wait for sockets alone
        return None
    try:
        return answers.fileno()
    except (OSError, ValueError):
        return None
