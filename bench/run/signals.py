"""Ctrl-C and SIGTERM, heard where they do no harm.

A signal may come between any two instructions: one that came while an event was being written would tear
the record. It is therefore held back while something must not be torn, and heard once: the way out, which
leaves the bench safe, is not cut short by a second one.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

# the terminal's window closed counts as well, where the system has that signal
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

Handler = Callable[[int, FrameType | None], Any] | int | None


class Interrupts:
    """Within its context the first Ctrl-C, SIGTERM or SIGHUP raises `KeyboardInterrupt`, outside any `shield`."""

    def __init__(self) -> None:
        self._shielded = 0
        self._pending = False
        self._heard = False
        self._before: dict[int, Handler] = {}

    def __enter__(self) -> Interrupts:
        for number in SIGNALS:
            self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    @contextmanager
    def shield(self) -> Iterator[None]:
        """Hold back a signal until the end of this context."""
        self._shielded += 1
        try:
            yield
        finally:
            self._shielded -= 1
            if self._pending and not self._shielded:
                self._pending = False
                raise KeyboardInterrupt

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._heard:
            print("stopping: the bench is being left safe, a moment", file=sys.stderr)
            return
        self._heard = True
        if self._shielded:
            self._pending = True
        else:
            raise KeyboardInterrupt
