"""One simulated instrument on a real loopback socket, over a world on a virtual clock."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from bench.model import Block, Distribution, ForwardModel
from bench.model.geometry import INSTALLATION_1
from drivers.interfaces import Channel
from drivers.wire.visa import MessageSession, Wire
from sim.agilent_34401a import Agilent34401A
from sim.bench import SimulatedMeter
from sim.scpi import never
from sim.wires.server import TcpServer
from sim.wires.session import Dialect, FaultHook, ServedInstrument, Traffic
from sim.world.clock import VirtualClock
from sim.world.world import World, WorldSettings

BLOCK = Block(np.diag([-2.177, -2.142, -2.163]), np.array([0.07, -0.2, -0.41]))


class EndlessClock:
    """A clock that stays at 0 s; `entered` is set once somebody sleeps on it."""

    def __init__(self) -> None:
        self.entered = threading.Event()

    def now_s(self) -> float:
        return 0.0

    def sleep(self, _duration_s: float) -> None:
        self.entered.set()
        threading.Event().wait(0.001)


def a_world(setting_error_rad: float = 0.0, seed: int = 3) -> World:
    stand = {"setting_error": Distribution(setting_error_rad)} if setting_error_rad else {}
    return World(WorldSettings(BLOCK, ForwardModel({"1": INSTALLATION_1}), stand, seed), VirtualClock())


def tell(instrument: Dialect, *messages: str) -> str | None:
    """Pass messages to an instrument without a wire; return the last reply."""
    reply = None
    for message in messages:
        reply = instrument.handle(message.encode(), never)
    return None if reply is None else reply.decode()


def ask(instrument: Dialect, message: str) -> str:
    """Pass a message to an instrument, and return its reply; fail if there is none."""
    reply = tell(instrument, message)
    assert reply is not None, f"no reply to {message}: {tell(instrument, 'SYST:ERR?')}"
    return reply


def a_34401a(channel: Channel, **options: object) -> SimulatedMeter:
    """Return a 34401A on a channel of the block, for a `SimulatedBench`."""
    return SimulatedMeter(Agilent34401A, channel, options)


@contextmanager
def served(
    dialect: Dialect,
    name: str,
    world: World,
    *,
    read_termination: str = "\n",
    write_termination: str = "\n",
    fault: FaultHook | None = None,
    timeout_s: float = 2.0,
    log: list[tuple[str, str]] | None = None,
    wire: Wire | None = None,
) -> Iterator[MessageSession]:
    """Serve a dialect; yield a driver's session with it. `log` or `wire` receives the messages.

    The world's clock advances only after all messages on the wire have been carried out.
    """
    clock = world.clock
    assert isinstance(clock, VirtualClock)
    traffic = Traffic()
    clock.before_advance = traffic.settle
    if log is not None:
        wire = lambda _, way, text: log.append((way, text))  # noqa: E731
    with TcpServer(ServedInstrument(dialect, traffic, fault)) as server:
        session = MessageSession(
            name,
            server.resource,
            timeout_s=timeout_s,
            read_termination=read_termination,
            write_termination=write_termination,
            wire=wire,
        )
        try:
            yield session
        finally:
            session.close()
            clock.before_advance = None
