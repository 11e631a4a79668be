"""Injected clocks: the only module of the drivers and the application that reads the system time."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import Final, Protocol

HASTY_S: Final = 1.0
"""Longest wait for a reply in haste, s: enough for an instrument that is present."""


class Clock(Protocol):
    """Bench time in seconds; its zero is arbitrary and it never runs backwards.

    A real bench uses `SystemClock`; a simulated bench uses a virtual clock that skips waiting times.
    """

    def now_s(self) -> float:
        """Return the bench time, s."""

    def sleep(self, duration_s: float) -> None:
        """Let `duration_s` seconds of bench time pass."""


class SystemClock:
    """The computer's monotonic clock."""

    def now_s(self) -> float:
        """Return the monotonic time, s."""
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        """Sleep for `duration_s` seconds."""
        time.sleep(max(0.0, duration_s))


def utc_now() -> datetime:
    """Return the current UTC time, for the record only; durations are never measured with it."""
    return datetime.now(tz=UTC)


class Haste:
    """A flag, `asked`, that sessions share: while it is true, a wait for a reply lasts at most `HASTY_S`."""

    def __init__(self) -> None:
        self.asked = False

    def limited_s(self, timeout_s: float) -> float:
        """Return the time to wait, s: `timeout_s`, but at most `HASTY_S` if `asked` is true."""
        return min(timeout_s, HASTY_S) if self.asked else timeout_s
