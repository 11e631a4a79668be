"""The transport over real sockets: what goes wrong ends in one sentence."""

import importlib.util
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial

import pytest

from drivers.interfaces import BadReading, BenchError, Identity, InstrumentLost, InstrumentRefused
from drivers.wire import pyvisa_connection
from drivers.wire.visa import MessageSession, ProvedInstrument
from tests.support.patience import together
from tests.support.scripted_session import ScriptedSession

NAME = "voltmeter.x"
READING = r"[+-]\d\.\d{8}E[+-]\d\d"
SHORT_S = 0.2
LONG_S = 60.0
"""Far beyond what a test may take: who notices at once need not wait for it."""

Handler = Callable[[socket.socket, str], None]


@contextmanager
def served(handler: Handler, greeting: Callable[[socket.socket], None] | None = None) -> Iterator[str]:
    """Serve one TCP port; `handler` gets each line of each connection. Yields the resource string."""
    listener = socket.create_server(("127.0.0.1", 0))
    connections: list[socket.socket] = []

    def talk(connection: socket.socket) -> None:
        with suppress(OSError, ValueError), connection, connection.makefile("r", newline="\n") as lines:
            if greeting is not None:
                greeting(connection)
            for line in lines:
                handler(connection, line.rstrip("\r\n"))

    def accept() -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            connections.append(connection)
            threading.Thread(target=talk, args=(connection,), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    try:
        yield f"TCPIP::127.0.0.1::{listener.getsockname()[1]}::SOCKET"
    finally:
        listener.close()
        for connection in connections:
            connection.close()


@contextmanager
def session(resource: str, timeout_s: float = SHORT_S, **options: object) -> Iterator[MessageSession]:
    made = MessageSession(NAME, resource, timeout_s=timeout_s, **options)  # type: ignore[arg-type]
    try:
        yield made
    finally:
        made.close()


def hang_up(connection: socket.socket) -> None:
    connection.shutdown(socket.SHUT_RDWR)


def answer(connection: socket.socket, line: str) -> None:
    """A well-behaved instrument: *IDN? and readings."""
    replies = {"*IDN?": b"MAKER,MODEL,0,1\n", "READ?": b"+1.23456780E+00\n", "OTHER?": b"-9.00000000E+00\n"}
    if line in replies:
        connection.sendall(replies[line])


def one_sentence(error: BenchError) -> str:
    text = str(error)
    assert text.startswith(f"{NAME}: ")
    assert "\n" not in text
    assert "Traceback" not in text
    assert error.remedy
    return text


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


# --- well -------------------------------------------------------------------------------------------


def test_writes_queries_and_logs_the_wire() -> None:
    log: list[tuple[str, str, str]] = []
    with (
        served(answer) as resource,
        session(resource, wire=lambda name, way, text: log.append((name, way, text))) as s,
    ):
        s.open()
        s.write("CONF")
        assert s.query("READ?", pattern=READING) == "+1.23456780E+00"
    assert log == [(NAME, ">", "CONF"), (NAME, ">", "READ?"), (NAME, "<", "+1.23456780E+00")]


def test_carriage_return_and_pieces_are_let_pass() -> None:
    def in_pieces(connection: socket.socket, line: str) -> None:
        for piece in (b"+1.2345", b"6780E+00", b"\r", b"\n"):
            connection.sendall(piece)
            time.sleep(0.01)

    with served(in_pieces) as resource, session(resource, LONG_S) as s:
        s.open()
        assert s.query("READ?", pattern=READING) == "+1.23456780E+00"


def test_long_reply_comes_whole() -> None:
    text = ",".join(["+1.23456780E+00"] * 512)
    with (
        served(lambda connection, line: connection.sendall(text.encode() + b"\n")) as resource,
        session(resource, LONG_S) as s,
    ):
        s.open()
        assert s.query("FETC?") == text


def test_nagle_is_off_on_the_socket_that_is_used() -> None:
    with served(answer) as resource, session(resource) as s:
        s.open()
        assert s._connection is not None
        interface = s._connection._interface
        assert isinstance(interface, socket.socket)
        assert interface.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) != 0


def test_threads_get_their_own_answers() -> None:
    wrong: list[str] = []
    with (
        served(lambda connection, line: connection.sendall(f"{line}!\n".encode())) as resource,
        session(resource, LONG_S) as s,
    ):
        s.open()

        def ask(who: int) -> None:
            for i in range(50):
                command = f"Q{who}/{i}?"
                reply = s.query(command)
                if reply != f"{command}!":
                    wrong.append(reply)

        together(*(partial(ask, who) for who in range(4)))
    assert wrong == []


# --- cannot be opened -------------------------------------------------------------------------------


def test_refused_port_is_found_when_opening() -> None:
    with session(f"TCPIP::127.0.0.1::{free_port()}::SOCKET", LONG_S) as s:
        with pytest.raises(InstrumentLost) as caught:
            s.open()
        assert "refused the connection; check that the instrument is on" in one_sentence(caught.value)
        assert s.connection is None


@pytest.mark.parametrize(
    ("resource", "cause"),
    [
        ("TCPIP::no-such-host.invalid::5025::SOCKET", "unknown host"),
        ("ASRL/dev/no-such-port::INSTR", "does not exist on this computer"),
        ("some meter", "is not a valid address"),
        pytest.param(
            "GPIB0::22::INSTR",
            "needs a GPIB library",
            marks=pytest.mark.skipif(
                any(importlib.util.find_spec(module) for module in ("gpib", "gpib_ctypes")),
                reason="a GPIB library is installed",
            ),
        ),
    ],
)
def test_what_cannot_be_opened_says_why(resource: str, cause: str) -> None:
    with session(resource, 5.0) as s:
        with pytest.raises(InstrumentLost) as caught:
            s.open()
        text = one_sentence(caught.value)
    assert cause in text
    assert resource in text


def test_opening_that_blocks_is_given_up_and_closed_when_it_comes_late(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    release, discarded = threading.Event(), threading.Event()

    class Blocking:
        def open_resource(self, resource: str, open_timeout: int) -> object:
            release.wait()
            return "late"

    monkeypatch.setattr(pyvisa_connection, "_resource_manager", Blocking)
    monkeypatch.setattr(pyvisa_connection, "_discard", lambda visa: discarded.set())
    with session("TCPIP::slow-name-server::5025::SOCKET", 0.05) as s:
        with pytest.raises(InstrumentLost, match="cannot be reached"):
            s.open()
        assert not discarded.is_set()
        release.set()
        assert discarded.wait(LONG_S)


def test_loading_the_library_is_outside_the_time_of_opening(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a slow computer the first imports alone would exceed it, as if the instrument were unreachable."""
    made_by = []
    real = pyvisa_connection._resource_manager

    def manager() -> object:
        made_by.append(threading.current_thread())
        return real()

    monkeypatch.setattr(pyvisa_connection, "_resource_manager", manager)
    with served(answer) as resource, session(resource) as s:
        s.open()
    assert made_by == [threading.current_thread()]


def test_exchange_before_open_and_after_close_is_refused() -> None:
    with served(answer) as resource, session(resource) as s:
        with pytest.raises(InstrumentLost, match="is not open"):
            s.query("READ?")
        s.open()
        s.close()
        s.close()
        with pytest.raises(InstrumentLost, match="is not open"):
            s.write("INIT")


# --- goes wrong in an exchange ----------------------------------------------------------------------


def first_then_well(first: Callable[[socket.socket], None]) -> Handler:
    """Do `first` on the first line of all, and be well-behaved afterwards."""
    done = threading.Event()

    def handle(connection: socket.socket, line: str) -> None:
        if not done.is_set():
            done.set()
            first(connection)
        else:
            answer(connection, line)

    return handle


@pytest.mark.parametrize(
    ("first", "kind", "cause", "timeout_s"),
    [
        (lambda c: None, InstrumentLost, "did not answer OTHER? within 0.2 s", SHORT_S),
        (lambda c: c.sendall(b"+1.234"), BadReading, "cut short after '+1.234'", SHORT_S),
        (lambda c: c.sendall(b"\xff\x00garbage\n"), BadReading, "not one reading", LONG_S),
        (lambda c: c.sendall(b"\n"), BadReading, "is '', not one reading", LONG_S),
        (lambda c: c.sendall(b"56789E+00\n"), BadReading, "'56789E+00', not one reading", LONG_S),
        (lambda c: c.sendall(b"-9.00000000E+00\n" * 2), BadReading, "more than one reply", LONG_S),
        (lambda c: c.sendall(b"OTHER?\r\n"), BadReading, "sends the command OTHER? back", LONG_S),
        (
            lambda c: c.sendall(b"OTHER?\n+1.00000000E+00\n"),
            BadReading,
            "sends the command OTHER? back",
            LONG_S,
        ),
        (hang_up, InstrumentLost, "closed the connection at the command OTHER?", LONG_S),
        (lambda c: (c.sendall(b"+1.23"), hang_up(c)), InstrumentLost, "after '+1.23'", LONG_S),
    ],
    ids=[
        "silence",
        "cut",
        "garbage",
        "blank",
        "tail",
        "twice",
        "echo",
        "echo and reply",
        "hung up",
        "hung up in a reply",
    ],
)
def test_bad_reply_is_one_sentence_and_the_next_exchange_is_clean(
    first: Callable[[socket.socket], None], kind: type[BenchError], cause: str, timeout_s: float
) -> None:
    with served(first_then_well(first)) as resource, session(resource, timeout_s) as s:
        s.open()
        assert s.connection == 1
        with pytest.raises(kind) as caught:
            s.query("OTHER?", pattern=READING, expected="one reading")
        assert cause in one_sentence(caught.value)
        assert s.connection is None
        assert s.query("READ?", timeout_s=LONG_S, pattern=READING) == "+1.23456780E+00"
        assert s.connection == 2


@pytest.mark.parametrize("command", ["SET 40 °C", "\x01\x03\x80"])
def test_a_command_that_is_not_ascii_is_a_mistake_of_the_driver_and_keeps_the_connection(
    command: str,
) -> None:
    with served(answer) as resource, session(resource, LONG_S) as s:
        s.open()
        for send in (s.write, s.query):
            with pytest.raises(ValueError, match="sends ASCII text only, not"):
                send(command)
        assert s.connection == 1


def test_late_reply_is_never_the_answer_to_the_next_query() -> None:
    asked_again = threading.Event()

    def late(connection: socket.socket, line: str) -> None:
        if line == "OTHER?":
            asked_again.wait()
            connection.sendall(b"-9.00000000E+00\n")
        else:
            asked_again.set()
            answer(connection, line)

    with served(late) as resource, session(resource) as s:
        s.open()
        with pytest.raises(InstrumentLost):
            s.query("OTHER?", pattern=READING)
        assert s.query("READ?", timeout_s=LONG_S, pattern=READING) == "+1.23456780E+00"
        assert s.query("READ?", timeout_s=LONG_S, pattern=READING) == "+1.23456780E+00"


def test_what_came_unasked_is_refused_before_anything_is_sent() -> None:
    sent: list[str] = []
    with (
        served(
            lambda connection, line: sent.append(line), greeting=lambda c: c.sendall(b"hello\n")
        ) as resource,
        session(resource) as s,
    ):
        s.open()
        assert s._connection is not None
        assert s._connection.wait(LONG_S)
        with pytest.raises(BadReading, match="'hello' came unasked before INIT"):
            s.write("INIT")
    assert sent == []


def test_instrument_that_left_while_idle_is_noticed_by_a_write() -> None:
    with served(answer, greeting=hang_up) as resource, session(resource) as s:
        s.open()
        assert s._connection is not None
        assert s._connection.wait(LONG_S)
        with pytest.raises(InstrumentLost, match="closed the connection before INIT"):
            s.write("INIT")


def test_instrument_that_is_gone_for_good_is_lost_at_each_exchange() -> None:
    with served(first_then_well(hang_up)) as resource, session(resource, LONG_S) as s:
        s.open()
        with pytest.raises(InstrumentLost):
            s.query("READ?")
        s.resource = f"TCPIP::127.0.0.1::{free_port()}::SOCKET"
        for _ in range(2):
            with pytest.raises(InstrumentLost, match="refused the connection"):
                s.query("READ?")


def test_waiting_for_a_lost_peer_takes_no_processor_time() -> None:
    with served(lambda connection, line: None) as resource, session(resource, 0.5) as s:
        s.open()
        before_s = time.thread_time()
        with pytest.raises(InstrumentLost):
            s.query("READ?")
        assert time.thread_time() - before_s < 0.25


def test_interrupted_exchange_leaves_no_reply_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    with served(answer) as resource, session(resource, LONG_S) as s:
        s.open()
        with monkeypatch.context() as patch:

            def interrupt(connection: object) -> None:
                raise KeyboardInterrupt

            patch.setattr(pyvisa_connection.Connection, "take", interrupt)
            with pytest.raises(KeyboardInterrupt):
                s.query("OTHER?")
        assert s.query("READ?", pattern=READING) == "+1.23456780E+00"


def test_close_lets_go_of_everything_even_when_the_library_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    with served(answer) as resource, session(resource) as s:
        s.open()
        assert s._connection is not None
        visa, interface = s._connection._visa, s._connection._interface
        sessions = pyvisa_connection._sessions(visa)
        kept = len(sessions)

        def fail() -> None:
            raise RuntimeError

        monkeypatch.setattr(visa, "close", fail)
        s.close()
        assert interface.fileno() == -1
        assert len(sessions) == kept - 1


def test_close_ends_a_wait_in_another_thread() -> None:
    asked = threading.Event()
    raised: list[BaseException] = []

    with served(lambda connection, line: asked.set()) as resource, session(resource, SHORT_S) as s:
        s.open()

        def wait() -> None:
            try:
                s.query("FETC?", timeout_s=LONG_S)
            except BenchError as error:
                raised.append(error)

        waiting = threading.Thread(target=wait)
        waiting.start()
        assert asked.wait(LONG_S)
        s.close()
        assert s.connection is None
        waiting.join(LONG_S)
    assert [type(error) for error in raised] == [InstrumentLost]


class Numbered(ProvedInstrument):
    """An instrument that tells its serial number, and nothing else."""

    def _prove(self):
        self._identity = Identity("made up", "M1", self._session.command("SERIAL?", r"\d+", "a number"))


def test_an_instrument_exchanged_between_two_connections_is_refused():
    session = ScriptedSession([("SERIAL?", "17"), ("SERIAL?", "17"), ("SERIAL?", "18")])
    instrument = Numbered("chamber", session, session.clock)
    assert instrument.open().serial == "17"
    session.connection = None
    instrument.open()
    session.connection = None
    with pytest.raises(
        InstrumentRefused, match="chamber: was made up M1 17 and is now made up M1 18; connect"
    ):
        instrument.open()
