"""Three 34401A on a GPIB bus, behind a simulated adapter."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from drivers.interfaces import Channel
from sim.agilent_34401a import Agilent34401A
from sim.bench import SimulatedBench
from sim.wires.prologix import GpibAdapter
from tests.support.simulated_stand import a_world

IDENTITY = "HEWLETT-PACKARD,34401A,0,11-5-2"
ADDRESSES: dict[Channel, int] = {"x": 22, "y": 23, "z": 24}
NO_ERROR = '+0,"No error"'


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
