"""What a meter that is wired to one channel of the world sees."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bench.base.arrays import CHANNELS

if TYPE_CHECKING:
    import numpy as np

    from drivers.interfaces import Channel
    from sim.world.world import World


class Terminals:
    """One channel of the world, as the meter on it sees it (the `Source` of a simulated meter)."""

    def __init__(self, world: World, channel: Channel) -> None:
        self._world = world
        self._channel = channel
        self._reading = 0

    @property
    def place(self) -> int:
        """Which of the bench's meters stands here: 0 at channel x, 1 at y, 2 at z."""
        return CHANNELS.index(self._channel)

    @property
    def temperature_c(self) -> float:
        """The temperature of the room in which the meter stands, °C."""
        return self._world.settings.ambient_c

    def signal_v(self, time_s: float | None = None) -> float:
        """Return the voltage at the terminals now, or at `time_s` of the clock, V."""
        return self._world.signal_v(self._channel, time_s)

    def new_reading(self) -> None:
        """Say that a reading was triggered."""
        self._reading = self._world.new_reading(self._channel)

    def random(self, purpose: str) -> np.random.Generator:
        """Return the generator for a purpose within the present reading."""
        return self._world.random(purpose, self._channel, self._reading)

    def fixed_random(self, purpose: str) -> np.random.Generator:
        """Return the generator for something that the meter on this channel has for good."""
        return self._world.fixed_random(purpose, self._channel)
