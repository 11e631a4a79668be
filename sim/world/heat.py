"""Temperatures of the simulated bench: the room, the meters in it, the chamber's air and the block."""

from __future__ import annotations

import cmath
import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Room:
    """A room at `ambient_c` that swings by `swing_c` with a period; the voltmeters follow it with a lag."""

    ambient_c: float = 23.0
    swing_c: float = 0.0
    period_s: float = 86400.0
    meter_lag_s: float = 0.0

    def at_c(self, elapsed_s: float, lag_s: float = 0.0) -> float:
        """Return the temperature, °C, of what follows the room with a first-order lag, after the first swings."""
        rate = math.tau / self.period_s
        behind = math.sin(rate * elapsed_s - math.atan(rate * lag_s))
        return self.ambient_c + self.swing_c / math.hypot(1.0, rate * lag_s) * behind


_LEAST_SPREAD: Final = 1e-6
"""Smallest relative difference between the two lags: the formula for the block divides by their difference."""


@dataclass(frozen=True)
class _Stretch:
    """A period from `since_s` in which the air is base + slope·s + Re(excess·exp(-s/lag)), s the time elapsed.

    A complex lag is an air that rings. `block_c` is the block's temperature at the beginning.
    """

    since_s: float
    base_c: float
    slope_c_s: float
    excess_c: complex
    lag_s: complex
    block_c: float

    def air_c(self, time_s: float) -> float:
        elapsed_s = max(0.0, time_s - self.since_s)
        excess_c = self.excess_c * cmath.exp(-elapsed_s / self.lag_s)
        return self.base_c + self.slope_c_s * elapsed_s + excess_c.real

    def block_c_at(self, time_s: float, block_lag_s: float) -> float:
        """Return the solution of block' = (air - block) / block_lag for the air of this period, °C."""
        elapsed_s = max(0.0, time_s - self.since_s)
        carried_c = self.excess_c * self.lag_s / (self.lag_s - block_lag_s) if self.excess_c else 0.0
        left_c = self.block_c - (self.base_c - self.slope_c_s * block_lag_s + carried_c.real)
        return (
            self.base_c
            + self.slope_c_s * (elapsed_s - block_lag_s)
            + (carried_c * cmath.exp(-elapsed_s / self.lag_s)).real
            + left_c * math.exp(-elapsed_s / block_lag_s)
        )


class Heat:
    """The temperatures of the chamber air and of the block in it, both at `ambient_c` at time `now_s`.

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
        """Set the air to `target_c` at once."""
        self._go_on(now_s, target_c, 0.0, 0.0, 1.0)

    def relax_air(self, now_s: float, target_c: float, lag_s: float) -> None:
        """Let the air relax to `target_c` with a time constant, as in a chamber that is switched off."""
        self._go_on(now_s, target_c, 0.0, self.air_c(now_s) - target_c, lag_s)

    def ramp_air(
        self, now_s: float, target_c: float, rate_c_s: float, lag_s: float, ringing_s: float = 0.0
    ) -> None:
        """Ramp the demand from the present air to `target_c` at `rate_c_s`; the air follows with its lag.

        With a period `ringing_s` it overshoots the target, rings with this period and decays with the lag.
        """
        start_c = self.air_c(now_s)
        slope_c_s = math.copysign(rate_c_s, target_c - start_c)
        end_s = now_s + abs(target_c - start_c) / rate_c_s
        self._go_on(now_s, start_c - slope_c_s * lag_s, slope_c_s, slope_c_s * lag_s, lag_s)
        excess_c: complex = self.air_c(end_s) - target_c
        after_s: complex = lag_s
        if ringing_s and end_s > now_s:
            rate = 2.0 * math.pi / ringing_s
            rising_c_s = slope_c_s * (1.0 - math.exp(-(end_s - now_s) / lag_s))
            # The imaginary part makes the air's rate continuous at the end of the ramp.
            excess_c += 1j * (rising_c_s + excess_c.real / lag_s) / rate
            after_s = 1.0 / complex(1.0 / lag_s, rate)
        self._go_on(end_s, target_c, 0.0, excess_c, after_s)

    def _go_on(
        self, since_s: float, base_c: float, slope_c_s: float, excess_c: complex, lag_s: complex
    ) -> None:
        """Begin a new period at `since_s`; discard periods that were scheduled after it."""
        if cmath.isclose(lag_s, self._block_lag_s, rel_tol=_LEAST_SPREAD):
            lag_s = self._block_lag_s * (1.0 + _LEAST_SPREAD)
        block_c = self.block_c(since_s)
        kept = [stretch for stretch in self._stretches if stretch.since_s <= since_s]
        self._stretches = [*kept, _Stretch(since_s, base_c, slope_c_s, excess_c, lag_s, block_c)]

    def _at(self, time_s: float) -> _Stretch:
        index = bisect_right(self._stretches, time_s, key=lambda stretch: stretch.since_s) - 1
        return self._stretches[max(0, index)]
