"""Simulated instruments whose lines end otherwise than in LF, over TCP and over a pseudo-terminal."""

import os
import select
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from bench.model import Block, ForwardModel
from bench.model.geometry import INSTALLATION_1
from drivers.wire.visa import MessageSession
from sim.bench import SimulatedBench
from sim.wires.faults import Fault, FaultKind
from sim.wires.server import TERMINALS
from sim.wires.session import Framer, LineEnds
from sim.world.clock import VirtualClock
from sim.world.world import World, WorldSettings

WIRES = ["tcp", pytest.param("pty", marks=pytest.mark.skipif(not TERMINALS, reason="no pseudo-terminals"))]
BLOCK = Block(np.diag([-2.177, -2.142, -2.163]), np.zeros(3))


class Counter:
    """Answers Q with how many messages came, and with what the last one was."""

    def __init__(self, ends: LineEnds) -> None:
        self.line_ends = ends
        self._taken: list[bytes] = []

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        if message == b"Q":
            return b"%d %s" % (len(self._taken), self._taken[-1] if self._taken else b"-")
        self._taken.append(message)
        return None

    def device_clear(self) -> None:
        self._taken.clear()

    def input_overflow(self) -> None:
        pass


@contextmanager
def served(ends: LineEnds) -> Iterator[SimulatedBench]:
    world = World(WorldSettings(BLOCK, ForwardModel({"1": INSTALLATION_1}), {}, 5), VirtualClock())
    with SimulatedBench(world, {"c": Counter(ends)}, with_terminals=TERMINALS) as bench:
        yield bench


@contextmanager
def wired(bench: SimulatedBench, wire: str) -> Iterator[int]:
    """Open one of the instrument's wires; yield its descriptor."""
    if wire == "tcp":
        with socket.create_connection(("127.0.0.1", bench.servers["c"].port)) as connection:
            yield connection.fileno()
        return
    descriptor = os.open(bench.terminals["c"].path, os.O_RDWR | os.O_NOCTTY)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def ask(descriptor: int, message: bytes, reply: bytes) -> bytes:
    """Send bytes; return as many as the reply has."""
    os.write(descriptor, message)
    data = b""
    while len(data) < len(reply) and select.select([descriptor], [], [], 5.0)[0]:
        data += os.read(descriptor, len(reply) - len(data))
    return data


@pytest.mark.parametrize("wire", WIRES)
@pytest.mark.parametrize(
    ("ends", "sent", "reply"),
    [
        (LineEnds((b"\r",), b"\r"), b"A\rB\nC\rQ\r", b"2 B\nC\r"),
        (LineEnds((b"\r",), b"\r"), b"Q\rQ\r", b"0 -\r0 -\r"),
        (LineEnds((b"\r", b"\r\n", b"\n"), b"\r"), b"A\r\nB\rC\nQ\r", b"3 C\r"),
        (LineEnds((b";",), b"\r\n>"), b"A\r;Q;", b"1 A\r\r\n>"),
    ],
)
def test_lines_end_as_the_instrument_says_on_every_wire(ends, sent, reply, wire) -> None:
    with served(ends) as bench, wired(bench, wire) as descriptor:
        assert ask(descriptor, sent, reply) == reply


@pytest.mark.parametrize("wire", WIRES)
def test_what_an_instrument_leaves_open_is_as_the_wire_has_it(wire) -> None:
    reply = {"tcp": b"1 A\n", "pty": b"1 A\r\n"}[wire]
    with served(LineEnds()) as bench, wired(bench, wire) as descriptor:
        assert ask(descriptor, b"A\r\nQ\n", reply) == reply


@pytest.mark.parametrize("wire", WIRES)
def test_a_driver_speaks_with_an_instrument_that_ends_in_cr_alone(wire) -> None:
    with served(LineEnds((b"\r",), b"\r")) as bench:
        resource = (bench.servers if wire == "tcp" else bench.terminals)["c"].resource
        session = MessageSession("c", resource, read_termination="\r", write_termination="\r")
        session.open()
        session.write("A")
        assert session.query("Q") == "1 A"
        bench.arm(Fault(FaultKind.GARBLE, at=1, instrument="c"))
        assert session.query("Q") == "Q@A"
        session.close()


def test_a_message_that_comes_in_parts_ends_at_the_longest_end_there_is() -> None:
    framer = Framer((b"\r\n", b"\r"))
    framer.feed(b"A")
    assert framer.take() is None
    framer.feed(b"B\r\nC\r")
    assert [framer.take(), framer.take(), framer.take()] == [b"AB", b"C", None]
