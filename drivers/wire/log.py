"""The wire log: every message between the program and its instruments, one line each, as it passes."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from drivers.clock import utc_now


class WireLog:
    r"""A wire log as a `drivers.wire.visa.MessageSession` takes it; safe to use from several threads.

    A line is the time (UTC), the instrument, `>` (sent) or `<` (received), and the text, its control
    characters escaped; where the wire failed, `!`, when it did (`connecting`, `before sending` anything,
    `after sending`) and the error:

        2026-11-21T09:15:41.123456+00:00 voltmeter.x > *IDN?
        2026-11-21T09:15:44.123456+00:00 voltmeter.x ! after sending: InstrumentLost: … did not answer …; check …

    A file that is there is added to. Each line is with the system before the message goes on. Where one cannot
    be written (a full disk), a note on standard error says so, the log ends there, and the run goes on. Raises
    `OSError` when the file cannot be opened.
    """

    def __init__(self, path: Path, now: Callable[[], datetime] = utc_now) -> None:
        self.path = path
        self._now = now
        self._lock = threading.Lock()
        self._file = path.open("ab", buffering=0)
        self._ended = False

    def __call__(self, instrument: str, direction: str, text: str) -> None:
        """Write one message. Never raises."""
        with self._lock:
            if self._ended:
                return
            stamp = self._now().isoformat(timespec="microseconds")
            line = f"{stamp} {instrument} {direction} {escaped(text)}\n".encode()
            try:
                while line:
                    line = line[self._file.write(line) :]
            except OSError as error:
                self._ended = True
                print(
                    f"note: the wire log {self.path} ends here ({error.strerror or error}); the run goes on",
                    file=sys.stderr,
                )

    def close(self) -> None:
        """End the log. Never raises, may be called twice."""
        with self._lock, contextlib.suppress(OSError):
            self._ended = True
            self._file.close()


def escaped(text: str) -> str:
    r"""Return the text with what cannot be printed as an escape: `\x03`, `\r`, `\u2028`."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


@contextmanager
def logged_wire(path: Path | None) -> Iterator[WireLog | None]:
    """Keep a wire log while the context lasts; none without a path. Raises `OSError`."""
    if path is None:
        yield None
        return
    log = WireLog(path)
    try:
        yield log
    finally:
        log.close()
