"""Handling of Ctrl-C, SIGTERM and SIGHUP at harmless moments.

This module is imported first, so it imports nothing heavy.
"""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, ClassVar, Final

from drivers.clock import Haste, SystemClock

# SIGHUP, if the system has it, is sent when the terminal's window is closed
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
NOT_DONE: Final = 2
"""Exit status of a program stopped by a signal."""
_OUTSIDE_S: Final = 0.01
"""Delay after which a callback that drops exceptions has certainly returned, s."""

Handler = Callable[[int, FrameType | None], Any] | int | None


def interrupt_main() -> None:
    """Interrupt the main thread as Ctrl-C does, even during a blocking system call."""
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, signal.SIGINT)
    else:
        _thread.interrupt_main()


class Interrupts:
    """A context in which the first signal among `numbers` raises `KeyboardInterrupt`; `shield` delays it.

    A second signal, or any signal after `hold`, only sets `haste`, which shortens waits for instruments. After
    `release`, a first signal raises as before, and a second one ends the program by `end(status)`. If Python drops
    the exception in a weak reference's callback or in `__del__`, the main thread is interrupted again. `heard` is
    the last signal that any instance received, 0 for none. After an `Exception` leaves a nested context, signals
    are ignored until the outer context ends, so that the error is reported.
    """

    heard: ClassVar[int] = 0
    _entered: ClassVar[int] = 0

    def __init__(self, numbers: Collection[int] = SIGNALS, end: Callable[[int], object] = os._exit) -> None:
        self.haste = Haste()
        self._numbers = numbers
        self._end = end
        self._shielded = 0
        self._pending = False
        self._interrupted = False
        self._held = False
        self._last_words: str | None = None
        self._before: dict[int, Handler] = {}
        self._told_before = sys.unraisablehook

    def __enter__(self) -> Interrupts:
        Interrupts._entered += 1
        self._told_before, sys.unraisablehook = sys.unraisablehook, self._dropped
        for number in self._numbers:
            self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        Interrupts._entered -= 1
        # an error that ends the program must be reported, so later signals are ignored
        ending = Interrupts._entered > 0 and isinstance(error, Exception)
        for number, handler in self._before.items():
            signal.signal(number, _unheard if ending else handler)
        sys.unraisablehook = self._told_before

    @contextmanager
    def shield(self) -> Iterator[None]:
        """Return a context that delays signals until its end."""
        self._shielded += 1
        try:
            yield
        finally:
            self._shielded -= 1
        # not reached after an exception: it stops the run as well, and must remain the reported cause
        if self._pending and not self._shielded and not self._held:
            self._pending = False
            raise KeyboardInterrupt

    def hold(self) -> None:
        """Begin the shutdown: from now on no signal raises an exception."""
        self._held = True

    def release(self, last_words: str) -> None:
        """End the shutdown, because the bench is safe: a signal raises `KeyboardInterrupt` again.

        A second signal then prints `last_words` and ends the program. Raises `KeyboardInterrupt` if a signal was
        received before.
        """
        self._last_words, self._held = last_words, False
        if self._interrupted:
            raise KeyboardInterrupt

    def _handle(self, number: int, frame: FrameType | None) -> None:
        again, self._interrupted = self._interrupted, True
        Interrupts.heard = number
        if self._last_words is not None:
            if again:
                self._end_at_once(self._last_words)
            raise KeyboardInterrupt
        if again or self._held:
            self.haste.asked = True
            with suppress(Exception):  # the terminal may be closed, or in the middle of a print
                from bench.base.languages import message, translated  # this module imports nothing heavy

                print(translated(message("stopping: making the bench safe, please wait")), file=sys.stderr)
        elif self._shielded:
            self._pending = True
        else:
            raise KeyboardInterrupt

    def _end_at_once(self, last_words: str) -> None:
        with suppress(Exception):  # the terminal may be closed
            from bench.base.languages import translated

            sys.stdout.flush()
            print(f"bench: {translated(last_words)}", file=sys.stderr, flush=True)
        self._end(NOT_DONE)

    def _dropped(self, dropped: sys.UnraisableHookArgs) -> None:
        """Raise `KeyboardInterrupt` again if Python had to drop it (see `sys.unraisablehook`)."""
        if not issubclass(dropped.exc_type, KeyboardInterrupt):
            self._told_before(dropped)
            return
        self._interrupted = False
        _thread.start_new_thread(_interrupt_soon, ())


def stopped_by() -> str:
    """Return in words which signal stopped the program; if none was received, name Ctrl-C."""
    from drivers.interfaces import message  # with dataclasses, which take long to import

    name = signal.Signals(Interrupts.heard or signal.SIGINT).name
    return message(f"stopped by {'Ctrl-C' if name == 'SIGINT' else name}")


def _unheard(number: int, frame: FrameType | None) -> None:
    """Ignore a signal; `SIG_IGN` would make Python print a message about a signal received just before."""


def _interrupt_soon() -> None:
    SystemClock().sleep(_OUTSIDE_S)
    interrupt_main()
