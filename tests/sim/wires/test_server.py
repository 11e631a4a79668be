"""The simulated bench over real sockets: framing, several clients, faults, shared virtual time."""

import os
import select
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import pytest

from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1
from drivers.wire.visa import MessageSession
from sim import voltmeters as line
from sim.bench import SimulatedBench
from sim.wires.faults import Fault, FaultKind
from sim.wires.server import TERMINALS, TcpServer
from sim.wires.session import REFUSE, Framer, LineEnds, Overflow, WireFault
from sim.world.clock import ScaledClock, VirtualClock
from sim.world.world import World, WorldSettings
from tests.support.patience import PATIENCE_S, together
from tests.support.simulated_stand import BLOCK, a_34401a, a_world

METERS = {f"voltmeter.{c}": a_34401a(c, noise=False) for c in ("x", "y", "z")}
IDENTITY = b"HEWLETT-PACKARD,34401A,0,11-5-2\n"


class Client:
    """A raw socket that reads lines; `tolerance_s` is how long it waits for one that may not come."""

    def __init__(self, port: int, tolerance_s: float = PATIENCE_S) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=tolerance_s)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.file = self.socket.makefile("rb")

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()
        self.socket.close()

    def write(self, message: bytes) -> None:
        self.socket.sendall(message)

    def ask(self, message: bytes) -> bytes:
        self.write(message)
        return self.file.readline()


@contextmanager
def a_bench() -> Iterator[SimulatedBench]:
    with SimulatedBench(a_world(), METERS) as bench:
        yield bench


@contextmanager
def one_meter(
    fault: Callable[[bytes, bytes | None], WireFault | None] | None = None, tolerance_s: float = PATIENCE_S
) -> Iterator[tuple[TcpServer, Client]]:
    with SimulatedBench(a_world(), {"v": a_34401a("x", noise=False)}) as bench:
        server = bench.servers["v"]
        if fault is not None:
            server.fault = fault
        with Client(server.port, tolerance_s) as client:
            yield server, client


# --- framing ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("chunks", "messages"),
    [
        ([b"*IDN?\n"], [b"*IDN?"]),
        ([b"*IDN?\r\n"], [b"*IDN?"]),
        ([b"A\nB\r\n", b"C"], [b"A", b"B"]),
        ([b"RE", b"AD", b"?\n"], [b"READ?"]),
        ([b"READ?\nINI\x03*CLS\n"], [b"\x03", b"*CLS"]),
        ([b"x" * 70000 + b"\nOK\n"], [Overflow, b"OK"]),
        ([b"x" * 70000, b"x\nOK\n"], [Overflow, b"OK"]),
    ],
)
def test_framing(chunks: list[bytes], messages: list[object]) -> None:
    framer = Framer()
    taken: list[object] = []
    for chunk in chunks:
        framer.feed(chunk)
        while (message := framer.take()) is not None:
            taken.append(Overflow if isinstance(message, Overflow) else message)
    assert taken == messages


# --- the wire ---------------------------------------------------------------------------------------


def test_replies_end_in_lf_and_every_terminator_is_taken() -> None:
    with one_meter() as (_, client):
        assert client.ask(b"*IDN?\n") == IDENTITY
        assert client.ask(b"*IDN?\r\n") == IDENTITY
        assert client.ask(b"*CLS\n:FUNC?;*OPC?\n") == b'"VOLT";1\n'


def test_two_clients_at_once_share_one_instrument_and_keep_their_own_replies() -> None:
    answers: dict[str, list[bytes]] = {"a": [], "b": []}
    with one_meter() as (server, _), Client(server.port) as a, Client(server.port) as b:

        def talk(name: str, client: Client, question: bytes) -> None:
            for _ in range(200):
                answers[name].append(client.ask(question))

        together(partial(talk, "a", a, b"*IDN?\n"), partial(talk, "b", b, b"VOLT:NPLC?\n"))
        a.write(b"VOLT:NPLC 100\n")
        assert a.ask(b"*OPC?\n") == b"1\n"
        assert b.ask(b"VOLT:NPLC?\n") == b"+1.000000E+02\n"
    assert set(answers["a"]) == {IDENTITY}
    assert set(answers["b"]) == {b"+1.000000E+01\n"}


def test_what_an_earlier_connection_sent_is_carried_out_before_a_later_one_is_heard() -> None:
    with one_meter() as (server, _):
        for number in range(300):
            nplc = (b"1", b"10")[number % 2]
            with Client(server.port) as leaving:
                leaving.write(b"VOLT:NPLC " + nplc + b"\n")
            with Client(server.port) as coming:
                assert float(coming.ask(b"VOLT:NPLC?\n")) == float(nplc)


def test_control_c_is_device_clear() -> None:
    with one_meter() as (_, client):
        client.write(b"TRIG:SOUR BUS;:INIT\n")
        client.write(b"\x03INIT\n")
        assert client.ask(b"SYST:ERR?\n") == b'+0,"No error"\n'


def test_a_client_that_leaves_in_mid_message_harms_nobody() -> None:
    with one_meter() as (server, client):
        for leaving in (b"", b"VOLT:NPLC 1", b"READ?\n", b"\x00\xff\n\n"):
            with Client(server.port) as other:
                other.write(leaving)
        assert client.ask(b"VOLT:NPLC?\n") == b"+1.000000E+01\n"


def test_stopping_closes_connections_and_frees_the_port() -> None:
    with one_meter() as (server, client):
        client.ask(b"*IDN?\n")
        server.stop()
        assert client.file.read() == b""
        with pytest.raises(ConnectionRefusedError):
            Client(server.port)
        server.start()
        with Client(server.port) as again:
            assert again.ask(b"*IDN?\n") == IDENTITY


# --- shared virtual time ----------------------------------------------------------------------------


def test_meters_started_together_sample_together_and_time_passes_once() -> None:
    with a_bench() as bench:
        clients = [Client(server.port) for server in bench.servers.values()]
        clock = bench.world.clock
        for client in clients:
            assert client.ask(b"CONF:VOLT:DC 10;:SAMP:COUN 10;*OPC?\n") == b"1\n"
        for round_number in range(1, 21):
            for client in clients:
                client.write(b"INIT\n")
            for client in clients:
                assert client.ask(b"FETC?\n").count(b",") == 9
            assert clock.now_s() == pytest.approx(round_number * 10 * 0.4015, abs=1e-9)
        for client in clients:
            client.__exit__()


def test_the_clock_is_free_again_after_the_bench() -> None:
    with a_bench() as bench:
        clock = bench.world.clock
    assert isinstance(clock, VirtualClock)
    assert clock.before_advance is None


# --- faults -----------------------------------------------------------------------------------------


def on_reading(
    fault: Callable[[bytes | None], WireFault],
) -> Callable[[bytes, bytes | None], WireFault | None]:
    return lambda request, reply: fault(reply) if request == b"READ?" else None


def test_refusal_lasts_until_the_server_accepts_again() -> None:
    with one_meter(on_reading(lambda _: REFUSE)) as (server, client):
        assert client.ask(b"READ?\n") == b""
        server.refuse()
        with pytest.raises(ConnectionRefusedError):
            Client(server.port)
        server.accept_again()
        with Client(server.port) as again:
            assert again.ask(b"*IDN?\n") == IDENTITY


def test_a_fault_can_be_set_and_taken_away_while_serving() -> None:
    with one_meter() as (server, client):
        server.fault = lambda _request, _reply: WireFault(b"late and wrong\n")
        assert client.ask(b"*IDN?\n") == b"late and wrong\n"
        server.fault = None
        assert client.ask(b"*IDN?\n") == IDENTITY
        server.drop_connections()
        assert client.file.readline() == b""


# --- leaving ----------------------------------------------------------------------------------------
# A client that asks a meter for hours of samples and leaves does not hold up the others.

HOURS = b"CONF:VOLT:DC 10\nVOLT:DC:NPLC 100\nTRIG:DEL 60\nSAMP:COUN 500\n*IDN?\n"
"""As many as the memory takes. Answered, so that what another client sets next comes after it."""


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch):
    """The port of a meter on real time, which is told at once of a client that has left."""
    monkeypatch.setattr("sim.wires.session.LEAVING_S", 0.0)
    world = World(WorldSettings(BLOCK, ForwardModel({"1": INSTALLATION_1}), {}, 5), ScaledClock())
    with SimulatedBench(world, {"v": a_34401a("x", noise=False)}) as bench:
        yield bench.servers["v"].port


@pytest.fixture
def waited_for(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Is set as soon as a message waits for a measurement."""
    waits, wait_until = threading.Event(), line.wait_until

    def seen(*given):
        waits.set()
        return wait_until(*given)

    monkeypatch.setattr(line, "wait_until", seen)
    return waits


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Is set as soon as a measurement is under way."""
    begins, measures_until = threading.Event(), line.MeasuringCycle._measures_until

    def seen(*given):
        measures_until(*given)
        begins.set()

    monkeypatch.setattr(line.MeasuringCycle, "_measures_until", seen)
    return begins


@pytest.mark.parametrize("command", [b"READ?\n", b"INIT\n", b"INIT\nFETC?\n", b"READ?\nREAD?\nREAD?\n"])
def test_the_next_client_is_served_when_one_that_wanted_hours_has_left(port, command):
    with Client(port) as impatient:
        assert impatient.ask(HOURS) == IDENTITY
        impatient.write(command)
    with Client(port) as other:
        assert other.ask(b"*IDN?\n") == IDENTITY
        other.write(b"*CLS\nCONF:VOLT:DC 10\nVOLT:DC:NPLC 0.02\n")
        assert len(other.ask(b"READ?\n")) > 10


@pytest.mark.parametrize("last_words", [b"", b"FETC?\n", b"*CLS\nREAD?\n"])
def test_one_that_waits_already_is_served_when_who_wanted_hours_leaves(port, begun, waited_for, last_words):
    with Client(port) as impatient, Client(port) as other:
        assert impatient.ask(HOURS) == IDENTITY
        impatient.write(b"INIT\n")
        assert begun.wait(PATIENCE_S)
        other.write(b"*IDN?\n")
        assert waited_for.wait(PATIENCE_S)
        impatient.write(last_words)
        impatient.file.close()
        impatient.socket.close()
        assert other.file.readline() == IDENTITY


def test_one_that_has_left_does_not_take_what_another_began_after_it(port, waited_for):
    with Client(port) as impatient, Client(port) as other:
        assert impatient.ask(b"CONF:VOLT:DC 10\nVOLT:DC:NPLC 0.02\n*IDN?\n") == IDENTITY
        impatient.write(b"INIT\n")
        assert impatient.ask(b"*IDN?\n") == IDENTITY
        waited_for.clear()
        other.write(b"VOLT:DC:NPLC 10\nREAD?\n")
        assert waited_for.wait(PATIENCE_S)
        impatient.file.close()
        impatient.socket.close()
        assert len(other.file.readline()) > 10


def test_one_that_has_left_long_ago_leaves_another_s_measurement_alone(port):
    with Client(port) as first, Client(port) as second:
        assert second.ask(b"*IDN?\n") == IDENTITY
        first.write(b"CONF:VOLT:DC 10\nVOLT:DC:NPLC 10\n")
        assert first.ask(b"*IDN?\n") == IDENTITY
        first.write(b"INIT\n")
        second.file.close()
        second.socket.close()
        assert float(first.ask(b"FETC?\n")) != 0.0


def test_one_that_only_sends_no_more_still_has_its_reply(port, monkeypatch):
    monkeypatch.setattr("sim.wires.session.LEAVING_S", 60.0)
    with Client(port) as client:
        client.write(b"CONF:VOLT:DC 10\nVOLT:DC:NPLC 1\nREAD?\n")
        client.socket.shutdown(socket.SHUT_WR)
        assert len(client.file.readline()) > 10


# --- line ends --------------------------------------------------------------------------------------
# Simulated instruments whose lines end otherwise than in LF, over TCP and over a pseudo-terminal.

WIRES = ["tcp", pytest.param("pty", marks=pytest.mark.skipif(not TERMINALS, reason="no pseudo-terminals"))]


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
    with SimulatedBench(a_world(), {"c": Counter(ends)}, with_terminals=TERMINALS) as bench:
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
