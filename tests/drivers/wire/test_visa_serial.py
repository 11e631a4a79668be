"""The transport over a pseudo-terminal: serial settings, late replies, a port that goes."""

import os
import select
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from drivers.interfaces import InstrumentLost
from drivers.wire.pyvisa_connection import Connection
from drivers.wire.visa import MessageSession, SerialSettings

NAME = "voltmeter.x"
READING = r"[+-]\d\.\d{8}E[+-]\d\d"

pseudo_terminal = pytest.mark.skipif(not hasattr(os, "openpty"), reason="this system has no pseudo-terminals")


@contextmanager
def session(
    resource: str, timeout_s: float = 0.2, serial: SerialSettings | None = None
) -> Iterator[MessageSession]:
    made = MessageSession(NAME, resource, timeout_s=timeout_s, serial=serial)
    try:
        yield made
    finally:
        made.close()


class Terminal:
    """The instrument's end of a pseudo-terminal."""

    def __init__(self) -> None:
        tty = pytest.importorskip("tty")
        self.master, self._slave = os.openpty()
        tty.setraw(self.master)
        tty.setraw(self._slave)
        self.resource = f"ASRL{os.ttyname(self._slave)}::INSTR"

    def expect(self, wanted: bytes) -> None:
        data = b""
        while not data.endswith(wanted):
            assert select.select([self.master], [], [], 10.0)[0], f"only {data!r} came, not {wanted!r}"
            data += os.read(self.master, 100)

    def send(self, data: bytes) -> None:
        os.write(self.master, data)

    def close(self) -> None:
        for descriptor in (self.master, self._slave):
            if descriptor >= 0:
                os.close(descriptor)
        self.master = self._slave = -1


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    made = Terminal()
    yield made
    made.close()


@pseudo_terminal
def test_serial_query(terminal: Terminal) -> None:
    def instrument() -> None:
        terminal.expect(b"READ?\n")
        terminal.send(b"+1.23456780E+00\r\n")

    thread = threading.Thread(target=instrument)
    with session(terminal.resource, 10.0) as s:
        s.open()
        thread.start()
        assert s.query("READ?", pattern=READING) == "+1.23456780E+00"
        thread.join()
        assert s._connection is not None
        port = s._connection._interface
        assert (port.baudrate, port.bytesize, port.parity, port.stopbits) == (9600, 8, "N", 2)


@pseudo_terminal
def test_late_serial_reply_is_cleared_away_before_the_next_query(terminal: Terminal) -> None:
    def instrument() -> None:
        terminal.expect(b"OTHER?\n")
        terminal.expect(b"\x03")
        terminal.send(b"-9.00000000E+00\r\n")
        terminal.expect(b"READ?\n")
        terminal.send(b"+1.23456780E+00\r\n")

    thread = threading.Thread(target=instrument)
    with session(terminal.resource) as s:
        s.open()
        thread.start()
        with pytest.raises(InstrumentLost, match="did not answer"):
            s.query("OTHER?", pattern=READING)
        assert s.query("READ?", timeout_s=10.0, pattern=READING) == "+1.23456780E+00"
        thread.join()


@pseudo_terminal
def test_unplugged_serial_port_is_one_sentence(terminal: Terminal) -> None:
    with session(terminal.resource, 5.0) as s:
        s.open()
        terminal.close()
        with pytest.raises(InstrumentLost) as caught:
            s.query("READ?")
        assert "the port failed" in str(caught.value)
        assert "\n" not in str(caught.value)


@pseudo_terminal
def test_a_pseudo_terminal_has_no_framing_so_that_any_may_be_stated(terminal: Terminal) -> None:
    serial = SerialSettings(data_bits=7, parity="even")
    for _ in range(2):
        with session(terminal.resource, serial=serial) as s:
            s.open()


@pseudo_terminal
def test_settings_that_a_port_does_not_take_are_one_sentence(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Connection, "_on_pseudo_terminal", lambda self: False)
    serial = SerialSettings(data_bits=7, parity="even")
    with session(terminal.resource, serial=serial) as s:
        with pytest.raises(InstrumentLost) as caught:
            s.open()
        assert "does not accept these serial settings" in str(caught.value)
        assert s.connection is None


def test_character_time() -> None:
    """A 34401A's 7 data bits, even parity, 2 stop bits and a start bit at 9600 baud: 11 bits a character."""
    assert SerialSettings(data_bits=7, parity="even").character_time_s == pytest.approx(11 / 9600)
    assert SerialSettings(baud_rate=300).character_time_s == pytest.approx(11 / 300)
