"""Sees that the computer slept, or that its civil time was set: the two clocks of a run no longer go together."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from typing import Final

GAP_S: Final = 30.0
"""What the two may differ by between two events: a civil clock is set by less all the time."""


class ClockWatch:
    """Compares civil time, as `civil` gives it, with the bench's, `now_s` in s, from event to event.

    While a computer sleeps its civil time goes on; the clock by which the bench waits does not, on most systems.
    """

    def __init__(self, civil: Callable[[], datetime], now_s: Callable[[], float]) -> None:
        self._civil = civil
        self._now_s = now_s
        self._last: tuple[datetime, float] | None = None

    def gap_s(self) -> float:
        """Return by how much civil time has gone ahead since the last call, s; 0 where that is little."""
        civil, now_s = self._civil(), self._now_s()
        last, self._last = self._last, (civil, now_s)
        if last is None:
            return 0.0
        ahead_s = (civil - last[0]).total_seconds() - (now_s - last[1])
        return ahead_s if abs(ahead_s) >= GAP_S else 0.0
