"""Time of a simulated bench: a clock on which hours pass at once, and one that runs faster than the real one."""

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
    """A clock that moves only when someone waits on it, and then at once; implements `drivers.clock.Clock`.

    `before_advance`, when set, is called before each step forward: a simulated bench lets every command
    that is already on a wire be carried out first, so that what happens when does not depend on which
    thread the computer favours.
    """

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = float(start_s)
        self._lock = threading.Lock()
        self.before_advance: Callable[[], None] | None = None

    def now_s(self) -> float:
        """Return the bench time, s."""
        with self._lock:
            return self._now_s

    def sleep(self, duration_s: float) -> None:
        """Let `duration_s` seconds of bench time pass, at once; a negative duration is none."""
        self._settle()
        with self._lock:
            self._now_s += max(0.0, duration_s)

    def advance_to(self, time_s: float) -> None:
        """Let bench time pass until `time_s`; a time that has passed changes nothing."""
        self._settle()
        with self._lock:
            self._now_s = max(self._now_s, time_s)

    def _settle(self) -> None:
        if self.before_advance is not None:
            self.before_advance()


class ScaledClock:
    """A clock that runs `speed` times faster than `real` and starts at 0; implements `drivers.clock.Clock`.

    Raises `ValueError` for a speed that is not a positive number.
    """

    def __init__(self, speed: float = 1.0, real: Clock | None = None) -> None:
        if not 0.0 < speed < math.inf:
            raise ValueError(f"a clock runs at a positive speed such as 60, not {speed:g}")
        self.speed = speed
        self._real = real or SystemClock()
        self._start_s = self._real.now_s()

    def now_s(self) -> float:
        """Return the bench time, s."""
        return (self._real.now_s() - self._start_s) * self.speed

    def sleep(self, duration_s: float) -> None:
        """Let `duration_s` seconds of bench time pass."""
        self._real.sleep(max(0.0, duration_s) / self.speed)


def wait_until(clock: Clock, time_s: float, interrupted: Callable[[], bool]) -> bool:
    """Wait on any clock until `time_s`; return False when `interrupted` became true meanwhile.

    Several waiters on one virtual clock wait side by side: it goes to the latest time, not to the sum.
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
