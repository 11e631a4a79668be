"""The transport of all message-based instruments: a session with locking, reply checks and reconnection.

After anything but a complete, expected reply the connection is dropped and made again before the next exchange.
A late or partial reply is thus never mistaken for the answer to another command.
"""

from __future__ import annotations

import contextlib
import math
import re
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final, TypeVar

from drivers.clock import Clock, Haste, SystemClock
from drivers.interfaces import BadReading, BenchError, Identity, InstrumentLost, message
from drivers.wire.prologix import SCHEME, AdapterConnection
from drivers.wire.pyvisa_connection import Connection, SerialSettings, probable_cause
from drivers.wire.resources import Holding

if TYPE_CHECKING:
    from drivers.clock import Clock

# --- the session ------------------------------------------------------------------------------------

__all__ = ["MessageSession", "SerialSettings", "Wire"]

Wire = Callable[[str, str, str], None]
"""A wire log: called with the instrument's name, ">" (sent), "<" (received) or "!" (failed), and the text.

It must not raise."""

PRINTABLE: Final = r"[\x20-\x7e]+"
"""The default pattern of a reply: one line of printable ASCII."""

CONNECTING: Final = "connecting"
BEFORE_SENDING: Final = "before sending"
AFTER_SENDING: Final = "after sending"
"""The phase of a failure, as written to the wire log."""

_MAX_REPLY_BYTES: Final = 1 << 20
_SLICE_S: Final = 0.5
_RESTART: Final = message("switch the instrument off and on")
_RESTART_ADAPTER: Final = message("switch the GPIB adapter off and on")


class MessageSession:
    """A session with one instrument: it sends text commands and returns one line of text per query.

    `name` is the instrument's name on the bench. `resource` is a VISA resource string or, behind a GPIB adapter, a
    text such as `prologix://192.0.2.10:1234/22`. The terminations and `serial` apply to sockets and serial ports;
    GPIB, USB and VXI-11 mark the end of a message themselves. If `read_tail` bytes, such as a check sum, follow the
    termination of each reply, the reply is returned with termination and tail, one character per byte. `wire` logs
    the messages. `haste` can shorten the wait for replies. `holding` locks the instrument against other programs
    while the session is open. Thread-safe; open only one session per resource.
    """

    def __init__(
        self,
        name: str,
        resource: str,
        *,
        timeout_s: float = 3.0,
        read_termination: str = "\n",
        write_termination: str = "\n",
        read_tail: int = 0,
        serial: SerialSettings | None = None,
        wire: Wire | None = None,
        haste: Haste | None = None,
        holding: Holding | None = None,
    ) -> None:
        self.name = name
        self.resource = resource
        self.timeout_s = timeout_s
        self.serial = serial or SerialSettings()
        self._read_termination = read_termination
        self._write_termination = write_termination
        self._read_tail = read_tail
        self._wire = wire
        self._haste = haste or Haste()
        self._holding = holding
        self._holds = False
        self._lock = threading.RLock()
        self._clock: Clock = SystemClock()
        self._wanted = False
        self._desynchronised = False
        self._count = 0
        self._sent: deque[str] = deque(maxlen=2)
        self._connection: Connection | AdapterConnection | None = None

    @property
    def connection(self) -> int | None:
        """The number of the current connection, or None without a usable one.

        A driver stores this number with the settings that it sent; if the number has changed, the driver
        verifies the settings again.
        """
        return self._count if self._is_connected() else None

    def open(self) -> None:
        """Connect, unless connected already.

        Raises `InstrumentLost`, and `InstrumentRefused` if another program holds the instrument.
        """
        with self._lock:
            if self._holding is not None and not self._holds:
                self._holding.take(self.name, self.resource)
                self._holds = True
            self._wanted = True
            if self._connection is not None and not self._is_connected():
                self._give_up()
            self._connected()

    def close(self) -> None:
        """Disconnect. Never raises, may be called twice and while another thread waits for a reply.

        Another thread's exchange may still finish within the timeout, after which it is cut off.
        """
        self._wanted = False
        locked = self._lock.acquire(timeout=self.timeout_s)
        if not locked and (connection := self._connection) is not None:
            connection.interrupt()
            locked = self._lock.acquire(timeout=self.timeout_s)
        try:
            self._drop()
            self._let_go()
        finally:
            if locked:
                self._lock.release()

    def _let_go(self) -> None:
        held, self._holds = self._holds, False
        if held and self._holding is not None:
            self._holding.release(self.resource)

    def write(self, command: str) -> None:
        """Send a command that has no reply.

        Raises `InstrumentLost`, or `BadReading` if unsolicited data had arrived.
        """
        _refuse_unsendable(command)
        with self._exchange(command) as connection:
            self._send(connection, command)

    def query(
        self,
        command: str,
        timeout_s: float | None = None,
        pattern: str | re.Pattern[str] | None = None,
        expected: str = message("one line of text"),
        lines: int = 1,
    ) -> str:
        """Send a command and return its reply, of `lines` lines, without the termination.

        The whole reply must match `pattern` (default: printable ASCII), which `expected` describes in errors.
        Raises `InstrumentLost` if nothing arrives within `timeout_s` (None: the session's timeout), and
        `BadReading` for a reply that is truncated, garbled, or followed by another.
        """
        _refuse_unsendable(command)
        allowed_s = self.timeout_s if timeout_s is None else timeout_s
        with self._exchange(command) as connection:
            self._send(connection, command)
            reply = self._receive(connection, command, allowed_s, lines)
            fits = re.fullmatch(pattern or PRINTABLE, reply) is not None
            if not fits:  # the transport did not fail, so the wire log gets no "!" line
                self._give_up()
        if not fits:
            raise self._echo(reply) or BadReading(
                self.name,
                f"the reply to {command} is {_shown(reply)}, not {expected}",
                "try again, and if the fault returns, check cable and terminations",
            )
        return reply

    @contextlib.contextmanager
    def _exchange(self, command: str) -> Iterator[Connection | AdapterConnection]:
        """Hold the lock during one exchange and yield the connection; drop the connection on any exception."""
        with self._lock:
            if not self._wanted:
                raise InstrumentLost(
                    self.name,
                    f"{self.resource} is not open, {command} was not sent",
                    "open it first",
                )
            connection = self._connected()
            when = BEFORE_SENDING
            try:
                self._refuse_leftovers(connection, command)
                when = AFTER_SENDING
                yield connection
            except BaseException as error:  # after Ctrl-C in an exchange, its reply may arrive late
                self._give_up()
                failure = self._failed(when, error, command)
                if failure is error:
                    raise
                raise failure from error

    def _connected(self) -> Connection | AdapterConnection:
        """Return the connection; connect first if there is none."""
        if self._connection is None:
            try:
                connection = self._open()
                if self._desynchronised:
                    self._resynchronise(connection)
            except Exception as error:
                failure = self._failed(CONNECTING, error)
                if failure is error:
                    raise
                raise failure from error
            self._desynchronised = False
            self._count += 1
            self._connection = connection
        return self._connection

    def _is_connected(self) -> bool:
        """Return whether there is a connection, and no other instrument on the same adapter has broken it."""
        connection = self._connection
        return connection is not None and not (
            isinstance(connection, AdapterConnection) and not connection.stands
        )

    def _open(self) -> Connection | AdapterConnection:
        if self.resource.startswith(SCHEME):
            return AdapterConnection.open(self.resource, self._haste.limited_s(self.timeout_s))
        return Connection.open(
            self.resource,
            timeout_s=self._haste.limited_s(self.timeout_s),
            read_termination=self._read_termination,
            serial=self.serial,
        )

    def _resynchronise(self, connection: Connection | AdapterConnection) -> None:
        quiet = False
        try:
            if isinstance(connection, AdapterConnection):
                quiet = connection.resynchronise()
            else:
                quiet = connection.resynchronise(self.serial.device_clear, self.timeout_s)
        finally:
            if not quiet:
                connection.close()
        if not quiet and isinstance(connection, AdapterConnection):
            raise InstrumentLost(
                self.name, f"the adapter of {self.resource} accepts nothing", _RESTART_ADAPTER
            )
        if not quiet:
            raise InstrumentLost(self.name, f"{self.resource} keeps sending", _RESTART)

    def _give_up(self) -> None:
        self._desynchronised = True
        self._drop()

    def _drop(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _failed(self, when: str, error: BaseException, command: str = "") -> BaseException:
        """Log a failure with its phase `when`; return it, or for a foreign `Exception` an `InstrumentLost`."""
        if isinstance(error, Exception) and not isinstance(error, BenchError):
            cause, remedy = probable_cause(error)
            cause = cause.replace("{0}", self.resource)
            cause = message(f"{cause}, at the command {command}") if command else cause
            error = InstrumentLost(self.name, cause, remedy)
        why = f": {error.cause}; {error.remedy}" if isinstance(error, BenchError) else ""
        self._log("!", f"{when}: {type(error).__name__}{why}")
        return error

    def _send(self, connection: Connection | AdapterConnection, command: str) -> None:
        self._log(">", command)
        self._sent.append(command.strip())
        if not connection.send((command + self._write_termination).encode("ascii"), self.timeout_s):
            raise InstrumentLost(
                self.name,
                f"{self.resource} accepted nothing of {command} within {self.timeout_s:g} s",
                _RESTART_ADAPTER if isinstance(connection, AdapterConnection) else _RESTART,
            )

    def _receive(
        self, connection: Connection | AdapterConnection, command: str, allowed_s: float, lines: int
    ) -> str:
        """Return one decoded reply without its termination; with a tail (`read_tail`), the reply is unchanged.

        Raises `InstrumentLost` or `BadReading` if no complete reply to `command` arrives within `allowed_s`.
        """
        if isinstance(connection, Connection) and connection.by_bytes:
            data = self._read_lines(connection, command, allowed_s, lines)
        else:
            data = connection.take_message(self._haste.limited_s(allowed_s))
        reply = _text(data) if self._read_tail else _text(data).rstrip("\r\n")
        self._log("<", _text(data) if lines > 1 else reply)
        return data.decode("latin-1") if self._read_tail else reply

    def _read_lines(self, connection: Connection, command: str, allowed_s: float, lines: int) -> bytes:
        end = self._read_termination[-1:].encode("ascii")
        begun_s = self._clock.now_s()
        data = b""
        while not self._whole(data, end, lines):
            if len(data) > _MAX_REPLY_BYTES or not self._data_arrives(connection, begun_s, allowed_s):
                raise self._incomplete(command, data, self._haste.limited_s(allowed_s))
            if self._read_tail or lines > 1:
                chunk = connection.take_all()
                data, more = data + chunk, self._bytes_after(data + chunk, end, lines) > 0
            else:
                chunk, more = connection.take()
                data += chunk
            if not chunk:
                self._log("<", _text(data))
                raise self._closed(
                    message(f"{self.resource} closed the connection at the command {command}")
                    if not data
                    else message(
                        f"{self.resource} closed the connection at the command {command}, "
                        f"after {_shown(_text(data))}"
                    )
                )
            if more:
                self._log("<", _text(data))
                raise self._echo(_text(data)) or BadReading(
                    self.name,
                    f"more than one reply came to {command}, the first {_shown(_text(data).rstrip())}",
                    "try again, and check that no other program uses the instrument",
                )
        return data

    def _whole(self, data: bytes, end: bytes, lines: int) -> bool:
        if self._read_tail or lines > 1:
            return self._bytes_after(data, end, lines) >= 0
        return data.endswith(end)

    def _bytes_after(self, data: bytes, end: bytes, lines: int) -> int:
        """Return how many bytes of `data` follow a reply of `lines` lines; negative if it is incomplete."""
        at = -1
        for _ in range(lines):
            at = data.find(end, at + 1)
            if at < 0:
                return -1
        return len(data) - at - len(end) - self._read_tail

    def _data_arrives(self, connection: Connection, begun_s: float, allowed_s: float) -> bool:
        """Wait for bytes, in slices so that `haste` takes effect; return False if none arrive in time."""
        while True:
            left_s = begun_s + self._haste.limited_s(allowed_s) - self._clock.now_s()
            if connection.wait(max(0.0, min(left_s, _SLICE_S))):
                return True
            if left_s <= _SLICE_S:
                return False

    def _incomplete(self, command: str, data: bytes, allowed_s: float) -> BenchError:
        if not data:
            return InstrumentLost(
                self.name,
                f"{self.resource} did not answer {command} within {allowed_s:g} s",
                "check its power, its interface setting and the cable",
            )
        self._log("<", _text(data))
        return BadReading(
            self.name,
            f"the reply to {command} was cut short after {_shown(_text(data))}, "
            f"no end of line within {allowed_s:g} s",
            "try again, and if the fault returns, check cable and terminations",
        )

    def _closed(self, cause: str) -> InstrumentLost:
        return InstrumentLost(
            self.name,
            cause,
            "check that the instrument is on and nobody else uses it, then repeat this step",
        )

    def _refuse_leftovers(self, connection: Connection | AdapterConnection, command: str) -> None:
        """Raise an error if unsolicited data is waiting or the peer has closed; a write would not detect this."""
        if not isinstance(connection, Connection) or not connection.by_bytes or not connection.wait(0.0):
            return
        data, _ = connection.take()
        if not data:
            raise self._closed(message(f"{self.resource} closed the connection before {command}"))
        self._log("<", _text(data).rstrip("\r\n"))
        raise self._echo(_text(data)) or BadReading(
            self.name,
            f"{_shown(_text(data).rstrip())} came unasked before {command}",
            "repeat this step, and check that no other program uses the instrument",
        )

    def _echo(self, text: str) -> BadReading | None:
        """Return the error for an instrument that sends its last commands back; None for any other text."""
        echoed = next((line for line in text.splitlines() if line.strip()), "").strip()
        if echoed not in self._sent:
            return None
        return BadReading(
            self.name,
            f"{self.resource} sends the command {echoed} back",
            "switch the echo off at the instrument or its adapter",
        )

    def _log(self, direction: str, text: str) -> None:
        if self._wire is not None:
            self._wire(self.name, direction, text)


def _refuse_unsendable(command: str) -> None:
    """Raise `ValueError`, a mistake of the driver, for a command that is not ASCII text."""
    if not command.isascii():
        raise ValueError(f"a session sends ASCII text only, not {_shown(command)}")


def _text(data: bytes) -> str:
    return data.decode("ascii", "backslashreplace")


def _shown(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:40] + "…" + text[-15:])


# --- a session that proves its instrument -----------------------------------------------------------
# After a reconnection the instrument may have been switched off and on, or be another one: it is verified again.
# After a transport failure a query is repeated over a new connection; a command is sent only once.

ATTEMPTS: Final = 3

_T = TypeVar("_T")


class ProvedSession:
    """Commands and queries over a `MessageSession`; the instrument is verified first on every new connection.

    `prove` identifies the instrument through this session, and raises an error for any other instrument. The
    instrument needs a pause of `write_gap_s`, s, after a command without reply.
    """

    def __init__(
        self, session: MessageSession, clock: Clock, prove: Callable[[], object], *, write_gap_s: float = 0.0
    ) -> None:
        self._session = session
        self._clock = clock
        self._prove = prove
        self._write_gap_s = write_gap_s
        self._wrote_s = -math.inf
        self._proved: int | None = None
        self._proving = False

    @property
    def resource(self) -> str:
        """The resource string of the instrument."""
        return self._session.resource

    @property
    def opened(self) -> bool:
        """Whether the instrument was verified and the session has not been closed since."""
        return self._proved is not None

    def open(self) -> None:
        """Connect and verify the instrument. Raises `InstrumentLost`, `BadReading` and the errors of `prove`."""
        self._proved = None
        self._session.open()
        self.repeating(self.ensure_proved)

    def close(self) -> None:
        """Disconnect. Never raises."""
        self._proved = None
        self._session.close()

    def ensure_proved(self) -> None:
        """Verify the instrument, unless it was verified over the current connection."""
        if self._proving or (self._proved is not None and self._proved == self._session.connection):
            return
        self._proving = True
        try:
            self._prove()
            self._proved = self._session.connection
        finally:
            self._proving = False

    def repeating(self, exchange: Callable[[], _T]) -> _T:
        """Return the result of `exchange`, repeated over a new connection after a transport failure.

        There are at most three attempts. A second `InstrumentLost` ends them, because the instrument is then
        absent. A failure within `prove` repeats the whole verification, not the single exchange.
        """
        lost = 0
        for _ in range(ATTEMPTS - 1):
            try:
                return exchange()
            except (BadReading, InstrumentLost) as error:
                lost += isinstance(error, InstrumentLost)
                if self._proving or lost > 1:
                    raise
        return exchange()

    def ask(
        self, command: str, pattern: str, expected: str, timeout_s: float | None = None, lines: int = 1
    ) -> str:
        """Send a query that may be repeated and return its reply. Raises the errors of `MessageSession.query`."""
        return self.repeating(lambda: self.command(command, pattern, expected, timeout_s, lines))

    def command(
        self, command: str, pattern: str, expected: str, timeout_s: float | None = None, lines: int = 1
    ) -> str:
        """Send a command that has a reply, once only, and return the reply.

        Raises the errors of `MessageSession.query`.
        """
        self.ensure_proved()
        self._leave_alone()
        return self._session.query(command, timeout_s, pattern, expected, lines)

    def urgent(self, command: str, pattern: str, expected: str) -> str:
        """Send a command at once, such as a stop, even to an instrument not yet verified; return its reply."""
        return self._session.query(command, pattern=pattern, expected=expected)

    def write(self, command: str) -> None:
        """Send a command that has no reply, once only. Raises the errors of `MessageSession.write`."""
        self.ensure_proved()
        self._leave_alone()
        self._session.write(command)
        self._wrote_s = self._clock.now_s()

    def _leave_alone(self) -> None:
        left_s = self._wrote_s + self._write_gap_s - self._clock.now_s()
        if left_s > 0.0:
            self._clock.sleep(left_s)


UNKNOWN: Final = Identity("", "")


class ProvedInstrument(ABC):
    """The base class of instruments over a `ProvedSession`.

    `identity` is what is known of the instrument before it is verified.
    """

    def __init__(
        self,
        name: str,
        session: MessageSession,
        clock: Clock,
        identity: Identity = UNKNOWN,
        *,
        write_gap_s: float = 0.0,
    ) -> None:
        self.name = name
        self._session = ProvedSession(session, clock, self._prove_same, write_gap_s=write_gap_s)
        self._clock = clock
        self._identity = identity
        self._first: Identity | None = None

    def open(self) -> Identity:
        """Connect, verify the instrument and return its identity; nothing moves, and no output changes.

        Raises `InstrumentLost`, `BadReading`, `InstrumentRefused`.
        """
        self._session.open()
        return self._identity

    def close(self) -> str:
        """Disconnect; the instrument stays as it is. Never raises, may be called twice.

        Returns what a person must still do, an empty string for nothing.
        """
        self._session.close()
        return ""

    def _prove_same(self) -> None:
        """Call `_prove`; raise `InstrumentRefused` if the identity is not that of the first connection."""
        self._prove()
        if self._first is not None:
            self._first.refuse_other(self.name, self._identity)
        self._first = self._identity

    @abstractmethod
    def _prove(self) -> None:
        """Identify the instrument, verify its settings and set `_identity`. Raises `InstrumentRefused`."""
