"""Time, injected: the only module of the drivers and the application that asks the system for it."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import Final, Protocol

HASTY_S: Final = 1.0
"""Long enough for an instrument that is there: its reply is waited for no longer in haste."""


class Clock(Protocol):
    """Bench time in seconds; its zero is arbitrary and it never runs backwards.

    A real bench has `SystemClock`; a simulated one a virtual clock on which hours pass at once.
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
    """Return the civil time, for the record only; nothing is timed with it."""
    return datetime.now(tz=UTC)


class Haste:
    """Whether waiting is to be cut short; what was to be sent is sent all the same."""

    def __init__(self) -> None:
        self.asked = False

    def limited_s(self, timeout_s: float) -> float:
        """Return the time to wait, s: `timeout_s`, or less in haste."""
        return min(timeout_s, HASTY_S) if self.asked else timeout_s
