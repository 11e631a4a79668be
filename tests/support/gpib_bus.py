"""Three 34401A on a GPIB bus, behind a simulated adapter."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from bench.model import Block, ForwardModel
from bench.model.geometry import INSTALLATION_1
from drivers.interfaces import Channel
from sim.agilent_34401a import Agilent34401A
from sim.bench import SimulatedBench
from sim.wires.prologix import GpibAdapter
from sim.world.clock import VirtualClock
from sim.world.world import World, WorldSettings

IDENTITY = "HEWLETT-PACKARD,34401A,0,11-5-2"
ADDRESSES: dict[Channel, int] = {"x": 22, "y": 23, "z": 24}
NO_ERROR = '+0,"No error"'


def a_world() -> World:
    block = Block(
        np.array([[-2.177, 0.011, 0.021], [0.006, -2.142, 0.033], [0.012, 0.024, -2.163]]),
        np.array([0.07, -0.2, -0.41]),
    )
    return World(WorldSettings(block, ForwardModel({"1": INSTALLATION_1}), {}, seed=5), VirtualClock())


class Bus:
    """Three 34401A on a GPIB bus, and its adapter."""

    def __init__(self, **options: object) -> None:
        self.world = a_world()
        self.adapter = GpibAdapter(self.world.clock, **options)  # type: ignore[arg-type]
        self.meters = {
            channel: self.adapter.attach(a, self._meter(channel)) for channel, a in ADDRESSES.items()
        }

    def _meter(self, channel: Channel) -> Callable[[object], Agilent34401A]:
        def make(clock: object) -> Agilent34401A:
            return Agilent34401A(
                self.world.terminals(channel),
                clock,  # type: ignore[arg-type]
                interface="gpib",
                noise=False,
            )

        return make


@contextmanager
def served(bus: Bus) -> Iterator[SimulatedBench]:
    with SimulatedBench(bus.world, {"adapter": bus.adapter}) as bench:
        yield bench
