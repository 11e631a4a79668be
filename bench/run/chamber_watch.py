"""Watches a chamber on its way to a demand: one that hardly moves is told of while the soak still goes on.

A chamber whose compressor is off or whose door stands open takes a demand as any other does; without this it would
be found out hours later, at the end of the soak.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from bench.run.events import EventType
from drivers.clock import Clock
from drivers.interfaces import BenchError, ThermalChamber

SLOW_AFTER_S: Final = 300.0
"""When it is looked at where the bench file says nothing."""
LEAST_SHARE: Final = 0.2
LEAST_WAY_K: Final = 2.0
"""A shorter way says nothing: a sensor's noise and the air's lag are of its size."""


@dataclass
class ChamberWatch:
    """Looks `slow_after_s` after each demand where the air is; `tell` is told of less than 20 % of the way."""

    clock: Clock
    slow_after_s: float
    tell: Callable[[EventType, dict[str, Any]], None]
    _way_c: tuple[float, float] | None = field(default=None, init=False)
    _begun_s: float = field(default=0.0, init=False)

    def begin(self, chamber: ThermalChamber, target_c: float, key: str) -> None:
        """Take note of where the air is when a temperature has been demanded; a person is not asked."""
        self._way_c = None
        if chamber.asks_person:
            return
        try:
            start_c = chamber.temperature(key, settling=True)
        except BenchError:
            return  # the step that needs the temperature will meet it
        if abs(target_c - start_c) >= LEAST_WAY_K:
            self._way_c, self._begun_s = (start_c, target_c), self.clock.now_s()

    @property
    def due(self) -> bool:
        """Whether it is time to look."""
        return self._way_c is not None and self.clock.now_s() - self._begun_s >= self.slow_after_s

    def look(self, chamber: ThermalChamber | None, key: str) -> None:
        """Look where the air is, when it is time to."""
        if chamber is None or not self.due:
            return
        try:
            self.take(chamber.name, chamber.temperature(key, settling=True))
        except BenchError:
            self._way_c = None  # as above

    def take(self, name: str, air_c: float) -> None:
        """Judge a temperature of the air that was read for something else, when it is time to."""
        if self._way_c is None or not self.due:
            return
        (start_c, target_c), self._way_c = self._way_c, None
        if (air_c - start_c) / (target_c - start_c) < LEAST_SHARE:
            after_s = self.clock.now_s() - self._begun_s
            way = {"start_c": start_c, "air_c": air_c, "target_c": target_c}
            self.tell(EventType.CHAMBER_SLOW, {"chamber": name, "after_s": round(after_s, 3), **way})
