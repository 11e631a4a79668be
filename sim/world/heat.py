"""How warm the chamber's air and the block are, in closed form over time.

The air is set at once, or follows a ramp behind a first-order lag; the block follows the air behind a lag
of its own. Nothing is integrated: the temperature at any time, past or to come, is one formula.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Final

_LEAST_SPREAD: Final = 1e-6
"""Two lags must differ by this fraction: the formula for the block divides by their difference."""


@dataclass(frozen=True)
class _Stretch:
    """From `since_s` on the air is base + slope·s + excess·exp(-s/lag), s the time elapsed.

    `block_c` is the block's temperature at its beginning.
    """

    since_s: float
    base_c: float
    slope_c_s: float
    excess_c: float
    lag_s: float
    block_c: float

    def air_c(self, time_s: float) -> float:
        elapsed_s = max(0.0, time_s - self.since_s)
        return self.base_c + self.slope_c_s * elapsed_s + self.excess_c * math.exp(-elapsed_s / self.lag_s)

    def block_c_at(self, time_s: float, block_lag_s: float) -> float:
        """Solve block' = (air - block) / block_lag for the air of this stretch."""
        elapsed_s = max(0.0, time_s - self.since_s)
        carried_c = self.excess_c * self.lag_s / (self.lag_s - block_lag_s) if self.excess_c else 0.0
        left_c = self.block_c - (self.base_c - self.slope_c_s * block_lag_s + carried_c)
        return (
            self.base_c
            + self.slope_c_s * (elapsed_s - block_lag_s)
            + carried_c * math.exp(-elapsed_s / self.lag_s)
            + left_c * math.exp(-elapsed_s / block_lag_s)
        )


class Heat:
    """The air of a chamber and the block in it, both at `ambient_c` from `now_s` on.

    `block_lag_s` is the time constant of the block behind the air. A demand holds until the next one.
    """

    def __init__(self, now_s: float, ambient_c: float, block_lag_s: float) -> None:
        self._block_lag_s = block_lag_s
        self._stretches = [_Stretch(now_s, ambient_c, 0.0, 0.0, 1.0, ambient_c)]

    def air_c(self, time_s: float) -> float:
        """Return the air's temperature at a time, °C."""
        return self._at(time_s).air_c(time_s)

    def block_c(self, time_s: float) -> float:
        """Return the block's temperature at a time, °C."""
        return self._at(time_s).block_c_at(time_s, self._block_lag_s)

    def set_air(self, now_s: float, target_c: float) -> None:
        """The air is at `target_c` from now on, at once."""
        self._go_on(now_s, target_c, 0.0, 0.0, 1.0)

    def relax_air(self, now_s: float, target_c: float, lag_s: float) -> None:
        """The air drifts to `target_c` with a time constant, as in a chamber that is switched off."""
        self._go_on(now_s, target_c, 0.0, self.air_c(now_s) - target_c, lag_s)

    def ramp_air(self, now_s: float, target_c: float, rate_c_s: float, lag_s: float) -> None:
        """A demand runs from the present air to `target_c` at `rate_c_s`; the air follows it with its lag."""
        start_c = self.air_c(now_s)
        slope_c_s = math.copysign(rate_c_s, target_c - start_c)
        end_s = now_s + abs(target_c - start_c) / rate_c_s
        self._go_on(now_s, start_c - slope_c_s * lag_s, slope_c_s, slope_c_s * lag_s, lag_s)
        self._go_on(end_s, target_c, 0.0, self.air_c(end_s) - target_c, lag_s)

    def _go_on(self, since_s: float, base_c: float, slope_c_s: float, excess_c: float, lag_s: float) -> None:
        """Begin a stretch; those that were to begin later are given up."""
        if math.isclose(lag_s, self._block_lag_s, rel_tol=_LEAST_SPREAD):
            lag_s = self._block_lag_s * (1.0 + _LEAST_SPREAD)
        block_c = self.block_c(since_s)
        kept = [stretch for stretch in self._stretches if stretch.since_s <= since_s]
        self._stretches = [*kept, _Stretch(since_s, base_c, slope_c_s, excess_c, lag_s, block_c)]

    def _at(self, time_s: float) -> _Stretch:
        index = bisect_right(self._stretches, time_s, key=lambda stretch: stretch.since_s) - 1
        return self._stretches[max(0, index)]
