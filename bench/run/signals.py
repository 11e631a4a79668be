"""Ctrl-C, SIGTERM and SIGHUP, heard where they do no harm.

A signal may come between any two instructions: one that came while an event was being written would tear
the record, and one that came while the bench is left safe would leave it unsafe. A signal is therefore held
back while something must not be torn, and from the beginning of the way out it raises nothing any more: a
further one only shortens the waiting for instruments that do not answer.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

from drivers.wire.haste import Haste

# the terminal's window closed counts as well, where the system has that signal
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

Handler = Callable[[int, FrameType | None], Any] | int | None


class Interrupts:
    """Within its context the first Ctrl-C, SIGTERM or SIGHUP raises `KeyboardInterrupt`, outside any `shield`.

    After `hold`, and after the first, none does; `haste` is then what a further one asks for.
    """

    def __init__(self) -> None:
        self.haste = Haste()
        self._shielded = 0
        self._pending = False
        self._heard = False
        self._held = False
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
        # not where something failed: that stops the run as well, and is the cause
        if self._pending and not self._shielded and not self._held:
            self._pending = False
            raise KeyboardInterrupt

    def hold(self) -> None:
        """Begin the way out: until the end of the context no signal raises anything."""
        self._held = True

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._heard or self._held:
            self._heard = self.haste.asked = True
            with suppress(Exception):  # the terminal may be what went, or be written to just now
                print("stopping: the bench is being left safe, a moment", file=sys.stderr)
            return
        self._heard = True
        if self._shielded:
            self._pending = True
        else:
            raise KeyboardInterrupt
