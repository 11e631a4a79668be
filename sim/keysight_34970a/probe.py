"""A temperature sensor on the block, wired to a channel of a simulated 34970A, and what the meter makes of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from drivers.agilent_34401a.facts import OVERLOAD_V
from drivers.keysight_34970a.sensors import SENSORS
from sim.keysight_34970a.multiplexer import Keysight34970A

if TYPE_CHECKING:
    import numpy as np

    from sim.world.world import World

_PLACE: Final = 3
"""Behind the three meters of the signals."""
_LEADS_OHM: Final = 0.5
_OHM_PER_K: Final = 0.385


class Probe:
    """A sensor of the kind `sensor` (`SENSORS`), off by `error_c`; `air_share` of what it feels is the air's.

    Its noise has the standard deviation `noise_c`. To a meter that measures volts there it is a short.
    """

    def __init__(
        self, world: World, sensor: str, *, error_c: float = 0.0, noise_c: float = 0.0, air_share: float = 0.0
    ) -> None:
        self._world = world
        self._sensor = SENSORS[sensor]
        self._error_c = error_c
        self._noise_c = noise_c
        self._air_share = air_share
        self._reading = 0

    @property
    def place(self) -> int:
        """Which of the bench's meters stands here, where it has one of its own."""
        return _PLACE

    @property
    def temperature_c(self) -> float:
        """The temperature of the room in which the meter stands, °C."""
        return self._world.settings.ambient_c

    def signal_v(self, time_s: float | None = None) -> float:
        """Return the voltage at the channel, V."""
        return 0.0

    def new_reading(self) -> None:
        """Say that a reading was triggered."""
        self._reading = self._world.count("thermometer")

    def random(self, purpose: str) -> np.random.Generator:
        """Return the generator for a purpose within the present reading."""
        return self._world.random(purpose, "thermometer", self._reading)

    def fixed_random(self, purpose: str) -> np.random.Generator:
        """Return the generator for something that the meter has for good."""
        return self._world.fixed_random(purpose, "thermometer")

    def shown_c(self, configured: str, time_s: float) -> float:
        """Return what a meter shows that takes it for the sensor that CONF:TEMP named, "FRTD,85", °C.

        As two wires a Pt100 with four has its leads in it; thermistor and Pt100 are out of each other's range.
        """
        block_c = self._world.block_c_at(time_s)
        felt_c = block_c + self._air_share * (self._world.chamber_c - block_c) + self._error_c
        felt_c += self._noise_c * float(self.random("thermometer noise").standard_normal())
        if configured == self._sensor.configured:
            return felt_c
        if configured == "RTD,85" and self._sensor.configured == "FRTD,85":
            return felt_c + _LEADS_OHM / _OHM_PER_K
        return OVERLOAD_V


def meter_with_probe(
    world: World,
    *,
    channel: int,
    sensor: str,
    error_c: float = 0.0,
    noise_c: float = 0.0,
    air_share: float = 0.0,
    **options: object,
) -> Keysight34970A:
    """Return a meter with nothing but a sensor on a channel."""
    probe = Probe(world, sensor, error_c=error_c, noise_c=noise_c, air_share=air_share)
    return Keysight34970A({channel: probe}, world.clock, **options)  # type: ignore[arg-type]
