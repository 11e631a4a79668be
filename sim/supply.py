"""What simulated power supplies have in common: their outputs, as the world has them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim.world.power import Shown, Stage
    from sim.world.world import World


class Outputs:
    """The outputs of a supply in a world, by name; `limits` are what its facts say of each.

    `preset` says how an output is after switching on and *RST. When the mains come back, the supply is as
    `returned` makes it. With `one_switch` its outputs are switched together.
    """

    def __init__(
        self,
        world: World,
        limits: Mapping[str, Mapping[str, Any]],
        preset: Callable[[str], dict[str, Any]],
        returned: Callable[[], None],
        *,
        one_switch: bool = False,
    ) -> None:
        self._world = world
        self._preset = preset
        self._returned = returned
        self._back_s: float | None = None
        self.limits = limits
        self.names = tuple(limits)
        world.power.returned = self._come_back
        world.power.one_switch = one_switch
        self.reset()

    @property
    def has_mains(self) -> bool:
        """Whether the supply has power itself: without, it says nothing."""
        return self._world.power.has_mains(self._now_s)

    @property
    def _now_s(self) -> float:
        """The time at which things are done: that of the mains' return while that is under way."""
        return self._world.clock.now_s() if self._back_s is None else self._back_s

    def span(self, name: str, what: str) -> tuple[float, float]:
        """Return the nearest to zero and the farthest of what an output may be set to."""
        low, high = sorted((float(value) for value in self.limits[name][what]), key=abs)
        return low, high

    def stage(self, name: str) -> Stage:
        """Return how an output is set and switched now."""
        return self._world.power.stage(name, self._now_s)

    def shown(self, name: str) -> Shown:
        """Return what an output gives now, as the supply measures it: in its steps."""
        shown, limits = self._world.power.shown(name, self._now_s), self.limits[name]
        return replace(
            shown,
            voltage_v=_rounded(shown.voltage_v, limits["voltage_step_v"]),
            current_a=_rounded(shown.current_a, limits["current_step_a"]),
        )

    def change(self, name: str, **changes: object) -> None:
        """Change an output."""
        self._world.power.change(name, self._now_s, **changes)

    def switch(self, name: str, on: bool) -> None:
        """Switch an output; one that has tripped stays off."""
        if not on or self.stage(name).tripped is None:
            self.change(name, on=on)

    def clear_trips(self) -> None:
        """Forget what has tripped; the outputs stay off."""
        for name in self.names:
            self.change(name, tripped=None)

    def reset(self) -> None:
        """Set every output off and as preset."""
        for name in self.names:
            self.change(name, on=False, tripped=None, **self._preset(name))

    def _come_back(self, now_s: float) -> None:
        self._back_s = now_s
        try:
            self._returned()
        finally:
            self._back_s = None


def _rounded(value: float, step: float) -> float:
    return round(value / step) * step
