"""Watches a head on its way: outside its limits, away from its target or stalled, it is found out at once.

A controller with a wrong sign takes its axis away from the target for as long as it is let: what shows that is
the scale, at every sample of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from drivers.angles import format_dms
from drivers.interfaces import BenchError, InstrumentRefused, WentAstray

if TYPE_CHECKING:
    from drivers.motion import Travel

NOISE_RAD: Final = math.radians(0.05)
"""A scale may fall back by this much on the way: its noise, the play that is taken up at the start."""
STALLED_S: Final = 5.0
"""A head that takes its load along has gone on by then."""
_LEAST_OF_SPEED: Final = 0.05
"""Slower than this part of its speed it does not go on."""


@dataclass
class TravelWatch:
    """One movement from `start_rad` to `target_rad` of the head `name`, begun at `begun_s` of the clock.

    Near its target, by half of what it backs off, a head may swing through it; there it may also stand: whether
    it comes to rest within the tolerance is decided elsewhere.
    """

    name: str
    travel: Travel
    start_rad: float
    target_rad: float
    begun_s: float

    def __post_init__(self) -> None:
        """Begin with the whole way before it."""
        self._left_rad = abs(self.target_rad - self.start_rad)
        self._progress_rad, self._progress_s = self._left_rad, self.begun_s
        self._near_rad = 0.5 * self.travel.backoff_rad
        self._was_near = self._left_rad <= self._near_rad

    def take(self, angle_rad: float, now_s: float) -> None:
        """Look at a sample of the scale. Raises `WentAstray`, and `InstrumentRefused` for a head that stalled."""
        if not self.travel.contains(angle_rad, self.travel.tolerance_rad):
            raise self._astray(angle_rad, f"outside its limits, {self.travel.text}")
        left_rad = abs(self.target_rad - angle_rad)
        self._was_near = self._was_near or left_rad <= self._near_rad
        noise_rad = max(NOISE_RAD, 4.0 * self.travel.tolerance_rad)
        farthest_rad = self._near_rad + noise_rad if self._was_near else self._left_rad + noise_rad
        if left_rad > farthest_rad:
            raise self._astray(angle_rad, "away from its target")
        self._left_rad = min(self._left_rad, left_rad)
        if self._progress_rad - self._left_rad >= _LEAST_OF_SPEED * self.travel.speed_rad_s * STALLED_S:
            self._progress_rad, self._progress_s = self._left_rad, now_s
        elif now_s - self._progress_s >= STALLED_S and not self._was_near:
            raise self._stalled(angle_rad, now_s - self._progress_s)

    def _astray(self, angle_rad: float, where: str) -> BenchError:
        return WentAstray(
            self.name,
            f"it moved {where}: sent from {format_dms(self.start_rad)} to {format_dms(self.target_rad)} it was at "
            f"{format_dms(angle_rad)} and was stopped",
            "check the sign and the scale of the axis in the controller and the bench file before it moves again, "
            "minding the cables",
        )

    def _stalled(self, angle_rad: float, stood_s: float) -> BenchError:
        return InstrumentRefused(
            self.name,
            f"it stalled at {format_dms(angle_rad)}, sent to {format_dms(self.target_rad)}: no progress in "
            f"{stood_s:.0f} s",
            "check that nothing blocks the head, and its load, then take this step again",
        )
