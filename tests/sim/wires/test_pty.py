"""The simulated instruments on a pseudo-terminal, alone and beside TCP."""

import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from sim.agilent_34401a import Agilent34401A
from sim.bench import SimulatedBench
from sim.wires.server import TERMINALS, TerminalServer
from sim.wires.session import ServedInstrument
from sim.world.clock import VirtualClock
from tests.support.patience import PATIENCE_S
from tests.support.simulated_stand import a_34401a, a_world

pytestmark = pytest.mark.skipif(not TERMINALS, reason="this system has no pseudo-terminals")

IDENTITY = b"HEWLETT-PACKARD,34401A,0,11-5-2"


class Client:
    """A program that opens the terminal as a file."""

    def __init__(self, path: str) -> None:
        self.descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self.descriptor)

    def write(self, data: bytes) -> None:
        os.write(self.descriptor, data)

    def read_line(self, tolerance_s: float = PATIENCE_S) -> bytes:
        data = b""
        while not data.endswith(b"\n"):
            if not select.select([self.descriptor], [], [], tolerance_s)[0]:
                raise TimeoutError(f"only {data!r} came")
            data += os.read(self.descriptor, 4096)
        return data

    def ask(self, message: bytes) -> bytes:
        self.write(message)
        return self.read_line()


@contextmanager
def one_meter(interface: str = "lan") -> Iterator[tuple[SimulatedBench, str]]:
    meter = a_34401a("x", noise=False, interface=interface)  # type: ignore[arg-type]
    with SimulatedBench(a_world(), {"v": meter}, with_terminals=True) as bench:
        yield bench, bench.terminals["v"].path


def open_descriptors() -> int:
    return len(list(Path("/dev/fd").iterdir()))


def test_it_survives_clients_that_leave() -> None:
    with one_meter() as (_, path):
        for leaving in (b"", b"VOLT:NPLC 1;*OPC?\n", b"VOLT:RA"):
            with Client(path) as client:
                client.write(leaving)
        with Client(path) as client:
            assert client.read_line() == b"1\r\n"  # what nobody took still stands there, as in a serial port
            client.write(b"\x03")
            assert client.ask(b"VOLT:NPLC?;:SYST:ERR?\n") == b'+1.000000E+00;+0,"No error"\r\n'


def test_the_instrument_does_not_hear_itself() -> None:
    with one_meter() as (_, path), Client(path) as client:
        for _ in range(20):
            assert client.ask(b"*IDN?\n") == IDENTITY + b"\r\n"
        assert client.ask(b"SYST:ERR?\n") == b'+0,"No error"\r\n'


def test_a_reply_that_nobody_reads_is_given_up_at_a_device_clear() -> None:
    with one_meter() as (_, path), Client(path) as client:
        # 12 memories of 8 kB are more than any terminal buffers.
        client.write(b"SAMP:COUN 512;:VOLT:NPLC 0.02;:INIT\n" + b"FETC?\n" * 12)
        time.sleep(0.1)
        client.write(b"\x03")
        client.write(b"*IDN?\n")
        replies = b""  # first the beginning of what is given up
        while not replies.endswith(IDENTITY + b"\r\n"):
            replies += client.read_line()


def test_no_descriptor_is_left_over_and_it_starts_again() -> None:
    dialect = Agilent34401A(a_world().terminals("x"), VirtualClock())
    before = open_descriptors()
    server = TerminalServer(ServedInstrument(dialect))
    for _ in range(3):
        with server, Client(server.path) as client:
            assert client.ask(b"*IDN?\n") == IDENTITY + b"\r\n"
            server.drop_connections()
            assert client.ask(b"*IDN?\n") == IDENTITY + b"\r\n"
    assert open_descriptors() == before


def test_a_wire_that_is_dead_and_lives_again() -> None:
    with one_meter() as (bench, path), Client(path) as client:
        bench.terminals["v"].refuse()
        client.write(b"VOLT:NPLC 1\n*IDN?\n")
        with pytest.raises(TimeoutError):
            client.read_line(0.2)
        bench.terminals["v"].accept_again()
        assert client.ask(b"VOLT:NPLC?\n") == b"+1.000000E+01\r\n"


@pytest.mark.slow
def test_without_the_modules_of_a_terminal_everything_still_imports() -> None:
    """As on Windows: neither `pty` nor `tty` nor `termios`, and no `os.openpty`."""
    program = (
        "import os, sys\n"
        "for name in ('pty', 'tty', 'termios', 'fcntl'): sys.modules[name] = None\n"
        "del os.openpty\n"
        "import sim.bench, sim.wires.server, sim.control\n"
        "assert not sim.wires.server.TERMINALS\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=PATIENCE_S)  # noqa: S603 - our own program
