"""Clocks of a simulated bench: one that skips waiting times, and one that runs faster than real time."""

from __future__ import annotations

import math
import threading
from typing import TYPE_CHECKING

from drivers.clock import SystemClock

if TYPE_CHECKING:
    from collections.abc import Callable

    from drivers.clock import Clock

SLICE_S = 0.05
"""Interval at which a wait on a real clock checks for an interruption, s of real time."""


class VirtualClock:
    """A clock that advances only when someone waits on it, and then at once; implements `drivers.clock.Clock`.

    `before_advance`, if set, is called before each advance. A simulated bench uses this call to finish every
    command that is already on a wire, so that results do not depend on the scheduling of threads.
    """

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = float(start_s)
        self._lock = threading.Lock()
        self.before_advance: Callable[[], None] | None = None

    def now_s(self) -> float:
        """Return the simulated time, s."""
        with self._lock:
            return self._now_s

    def sleep(self, duration_s: float) -> None:
        """Advance the simulated time by `duration_s` at once; a negative duration counts as zero."""
        self._settle()
        with self._lock:
            self._now_s += max(0.0, duration_s)

    def advance_to(self, time_s: float) -> None:
        """Advance the simulated time to `time_s` at once; a time in the past has no effect."""
        self._settle()
        with self._lock:
            self._now_s = max(self._now_s, time_s)

    def return_to(self, time_s: float) -> None:
        """Set the simulated time back to `time_s`, as if the actions since then had taken no time."""
        self._settle()
        with self._lock:
            self._now_s = float(time_s)

    def _settle(self) -> None:
        if self.before_advance is not None:
            self.before_advance()


class ScaledClock:
    """A clock that runs `speed` times faster than `real` and starts at 0; implements `drivers.clock.Clock`.

    Raises `ValueError` for a speed that is not a positive number.
    """

    def __init__(self, speed: float = 1.0, real: Clock | None = None) -> None:
        if not 0.0 < speed < math.inf:
            raise ValueError(f"give a positive speed such as 60, not {speed:g}")
        self.speed = speed
        self._real = real or SystemClock()
        self._start_s = self._real.now_s()

    def now_s(self) -> float:
        """Return the simulated time, s."""
        return (self._real.now_s() - self._start_s) * self.speed

    def sleep(self, duration_s: float) -> None:
        """Wait until `duration_s` of simulated time has passed."""
        self._real.sleep(max(0.0, duration_s) / self.speed)


def wait_until(clock: Clock, time_s: float, interrupted: Callable[[], bool]) -> bool:
    """Wait on any clock until `time_s`; return False if `interrupted` became true meanwhile.

    Waits of several threads on one virtual clock overlap: the clock advances to the latest time, not by the sum.
    """
    if isinstance(clock, VirtualClock):
        clock.advance_to(time_s)
        return not interrupted()
    slice_s = SLICE_S * (clock.speed if isinstance(clock, ScaledClock) else 1.0)
    while (left_s := time_s - clock.now_s()) > 0.0:
        if interrupted():
            return False
        clock.sleep(min(left_s, slice_s))
    return not interrupted()
