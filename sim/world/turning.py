"""How the head of a simulated bench turns: at a finite speed, in closed form over time, and its faults."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

_ENDLESS_RAD: Final = 1000.0 * math.tau


@dataclass(frozen=True)
class HeadTurn:
    """A turn on the scale from `start_rad` to `end_rad`, begun at `since_s`, at `speed_rad_s`.

    With an infinite speed the head is there at once.
    """

    since_s: float
    start_rad: float
    end_rad: float
    speed_rad_s: float = math.inf

    @property
    def arrives_s(self) -> float:
        """The time from which on the head stands at its end."""
        return self.since_s + abs(self.end_rad - self.start_rad) / self.speed_rad_s

    def angle_rad(self, time_s: float) -> float:
        """Return the angle on the scale at a time, rad."""
        if time_s >= self.arrives_s:
            return self.end_rad
        turned_rad = max(0.0, time_s - self.since_s) * self.speed_rad_s
        return self.start_rad + math.copysign(turned_rad, self.end_rad - self.start_rad)

    def rate_rad_s(self, time_s: float) -> float:
        """Return the rate at a time, rad/s: signed while it turns, else zero."""
        if not self.since_s <= time_s < self.arrives_s:
            return 0.0
        return math.copysign(self.speed_rad_s, self.end_rad - self.start_rad)


@dataclass(frozen=True)
class HeadFault:
    """What is wrong with a motorised head, for the movements that begin while it is set.

    It sticks after it has turned by `sticks_after_rad` (0: it does not move at all), or it comes to rest
    `stops_off_rad` beside where it was sent, on its own scale. One that `runs_away`, as with a wrong sign, turns
    away from where it was sent until it is stopped.
    """

    sticks_after_rad: float | None = None
    stops_off_rad: float = 0.0
    runs_away: bool = False

    def end_rad(self, start_rad: float, target_rad: float) -> tuple[float, bool]:
        """Return where a movement really ends, and whether the head is stuck there."""
        if self.runs_away:
            return start_rad + math.copysign(_ENDLESS_RAD, start_rad - target_rad), True
        end_rad = target_rad + self.stops_off_rad
        if self.sticks_after_rad is None or abs(end_rad - start_rad) <= self.sticks_after_rad:
            return end_rad, False
        return start_rad + math.copysign(self.sticks_after_rad, end_rad - start_rad), True
