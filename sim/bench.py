"""A whole simulated bench: meters on real sockets, coupled by one world and one clock."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sim.agilent_34401a import Agilent34401A, Interface
from sim.clock import VirtualClock
from sim.server import TcpServer
from sim.session import Traffic

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import TracebackType

    from drivers.interfaces import Channel
    from sim.agilent_34401a_converter import Accuracy
    from sim.session import FaultHook
    from sim.world import World


@dataclass(frozen=True)
class SimulatedMeter:
    """One 34401A: the channel it is wired to, and what it is like (see `Agilent34401A`)."""

    channel: Channel
    interface: Interface = "lan"
    noise: bool = True
    accuracy: Accuracy | None = None
    line_hz: float = 50.0
    port: int = 0
    fault: FaultHook | None = None


class SimulatedBench:
    """Serves the meters of a world on loopback while its context lasts.

    `meters` gives each by its name on the bench. Within the context `resources` holds the VISA name of
    each, `meters` the instruments and `servers` their servers. A virtual clock of the world then waits,
    before it moves, until every command that is on a wire has been carried out.
    """

    def __init__(self, world: World, meters: Mapping[str, SimulatedMeter]) -> None:
        self.world = world
        self.traffic = Traffic()
        self.meters = {
            name: Agilent34401A(
                world.terminals(meter.channel),
                world.clock,
                interface=meter.interface,
                noise=meter.noise,
                accuracy=meter.accuracy,
                line_hz=meter.line_hz,
            )
            for name, meter in meters.items()
        }
        self.servers = {
            name: TcpServer(self.meters[name], port=meter.port, fault=meter.fault, traffic=self.traffic)
            for name, meter in meters.items()
        }
        self._stack = ExitStack()

    def __enter__(self) -> SimulatedBench:
        with ExitStack() as stack:
            for server in self.servers.values():
                stack.enter_context(server)
            clock = self.world.clock
            if isinstance(clock, VirtualClock):
                clock.before_advance = self.traffic.settle
                stack.callback(setattr, clock, "before_advance", None)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def resources(self) -> dict[str, str]:
        """The VISA resource name of each meter, such as "TCPIP0::127.0.0.1::40123::SOCKET"."""
        return {name: server.resource for name, server in self.servers.items()}
