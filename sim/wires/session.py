"""Client sessions: splitting of bytes into messages, sending of replies, and a register of busy sessions."""

from __future__ import annotations

import re
import select
import threading
from collections.abc import Callable
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final, Protocol

from drivers.clock import SystemClock

if TYPE_CHECKING:
    import socket
    from collections.abc import Collection, Iterator


_SETTLE_LOOKS: Final = 2000
_SETTLE_LOOK_S: Final = 0.001
_EARLIER_LOOKS: Final = 20


class Doing(Enum):
    """The activity of a session, as recorded in `Traffic`."""

    LISTENING = "waiting for input"
    WORKING = "carrying out a message"
    WAITING = "waiting for time to pass, or for another client"


class Traffic:
    """A register of what each session of a bench does; a virtual clock advances only if none has work.

    Without it, a virtual clock could advance past a measurement whose start command is still on another wire.
    """

    def __init__(self) -> None:
        self._sessions: set[Session] = set()
        self._changed = threading.Condition()
        self._current = threading.local()

    def settle(self) -> None:
        """Wait until every session except the caller's is waiting, or listening without unread input.

        The wait ends after a few seconds in any case, so that a client that never reads its replies cannot stop
        the bench.
        """
        own: Session | None = getattr(self._current, "session", None)
        if own is None:
            self._wait_for_others(None)
            return
        self.mark(own, Doing.WAITING)
        try:
            self._wait_for_others(own)
        finally:
            self.mark(own, Doing.WORKING)

    def _wait_for_others(self, own: Session | None) -> None:
        for _ in range(_SETTLE_LOOKS):
            with self._changed:
                if not self._others_work(own):
                    return
                self._changed.wait(_SETTLE_LOOK_S)

    def _others_work(self, own: Session | None) -> bool:
        others = [session for session in self._sessions if session is not own]
        with suppress(OSError, ValueError):  # a wire is closed, or there is none
            # nearly always nothing is there, which one look at all wires shows
            if not select.select([session.source for session in others], [], [], 0.0)[0]:
                return any(session.doing is Doing.WORKING for session in others)
        return any(session.has_work() for session in others)

    def wait_for(self, earlier: Collection[Session]) -> None:
        """Wait, for some hundredths of a second at most, until none of these sessions has work."""
        for _ in range(_EARLIER_LOOKS):
            with self._changed:
                if not any(session.has_work() for session in earlier):
                    return
                self._changed.wait(_SETTLE_LOOK_S)

    def enter(self, session: Session) -> None:
        """Register a session, which runs in the calling thread."""
        self._current.session = session
        with self._changed:
            self._sessions.add(session)

    def leave(self, session: Session) -> None:
        """Remove a session that has ended."""
        with self._changed:
            self._sessions.discard(session)
            self._changed.notify_all()

    def mark(self, session: Session, doing: Doing) -> None:
        """Set the activity of a session from now on."""
        session.doing = doing
        if doing is not Doing.WORKING:
            with self._changed:
                self._changed.notify_all()


DEVICE_CLEAR: Final = b"\x03"
TERMINATOR: Final = b"\n"

_INPUT_BUFFER: Final = 65536
_WITHIN_HOLD_OFF: Final = 10
"""Number of characters that an instrument still accepts after it has signalled its hold-off."""
_LATE_SLICE_S: Final = 0.02
_LOOK_S: Final = 0.05
LEAVING_S: Final = 2.0
"""How long a command continues after its client has closed the sending side, s of real time."""


@dataclass(frozen=True)
class LineEnds:
    """The line ends of an instrument: each of `messages` ends a message, `reply` is appended to each reply.

    If `reply` is None, the wire's own terminator is appended. `frame`, if given, replaces `reply`: it
    converts a reply to the bytes that are sent. If LF ends a message, a CR before it is dropped. With
    `clears` False, ETX is an ordinary character, not a device clear. A message longer than `buffer` bytes
    overflows. With `loses_early` the instrument keeps only the first 10 characters that arrive between a
    query and the end of its reply, as if the sender ignored the flow control.
    """

    messages: tuple[bytes, ...] = (TERMINATOR,)
    reply: bytes | None = None
    frame: Callable[[bytes], bytes] | None = None
    clears: bool = True
    buffer: int = _INPUT_BUFFER
    loses_early: bool = False


class Dialect(Protocol):
    """An instrument as the wire sees it: messages in, replies out, both without terminators.

    One with line ends other than LF also has `line_ends`. One whose commands may run for hours has
    `sent_by(left)`, which stores whether the client of the next message has disconnected: such a command is
    aborted, even if another client already waits for its end.
    """

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Carry out a message and return the reply, or None if there is none.

        A dialect that waits polls `interrupted`, and gives up when that returns True.
        """

    def device_clear(self) -> None:
        """Abort the command in progress."""

    def input_overflow(self) -> None:
        """Report a message that exceeded the input buffer."""


class PlainDialect:
    """The base of dialects that carry out each message at once and ignore device clears and overlong messages."""

    def device_clear(self) -> None:
        """Do nothing: no command is ever in progress."""

    def input_overflow(self) -> None:
        """Ignore a line that was too long."""


def line_ends_of(dialect: Dialect) -> LineEnds:
    """Return the line ends of a dialect; the default is LF for messages and the wire's terminator for replies."""
    ends: LineEnds = getattr(dialect, "line_ends", LineEnds())
    return ends


class Transport(Protocol):
    """The wire of one client. `terminator` ends each reply unless the dialect defines another end.

    Input arrives at `source`, for `select`. Any method may raise `OSError`.
    """

    terminator: bytes
    source: int | socket.socket

    def wait(self) -> None:
        """Wait for input or for the wire to be closed."""

    def receive(self) -> bytes:
        """Return the available input, or empty bytes if the wire is closed."""

    def has_input(self) -> bool:
        """Return whether `receive` would return at once."""

    def send(self, data: bytes, interrupted: Callable[[], bool]) -> None:
        """Send all of `data`; discard the rest if the client accepts none and `interrupted` returns True."""

    def close(self) -> None:
        """Close the wire and wake every thread that waits on it."""


@dataclass(frozen=True)
class WireFault:
    """The effect of a faulty wire on one exchange: the bytes sent in place of the reply, and the consequences.

    After `delay_s` of real time the wire sends `raw` unchanged, then each of `lines` with its terminator. `drop`
    then closes the connection. `refuse` also refuses new connections: for `refuse_s` of real time or, if that is 0,
    until the server's `accept_again` is called.
    """

    raw: bytes = b""
    lines: tuple[bytes, ...] = ()
    delay_s: float = 0.0
    drop: bool = False
    refuse: bool = False
    refuse_s: float = 0.0

    @classmethod
    def cut(cls, reply: bytes | None, keep: int) -> WireFault:
        """Return the fault that sends only the first `keep` bytes of the reply, without terminator."""
        return cls((reply or b"")[:keep])

    @classmethod
    def garble(cls, reply: bytes | None) -> WireFault:
        """Return the fault that sends the reply with every character wrong, with its terminator."""
        return cls(lines=(bytes(0x40 | (byte & 0x1F) for byte in reply or b""),))


SILENCE: Final = WireFault()
"""The command is carried out; the reply is lost."""

DROP: Final = WireFault(drop=True)
"""The connection is closed without a reply."""

REFUSE: Final = WireFault(drop=True, refuse=True)
"""The connection is closed, and new ones are refused."""

FaultHook = Callable[[bytes, bytes | None], WireFault | None]
"""Called with each request and its reply (or None); returns the fault of the wire, or None.

Calls for one instrument never overlap; they have the order in which its messages were carried out.
"""


class Overflow:
    """The mark that `Framer.take` returns in place of a message that was too long."""


class Framer:
    """Splits input into messages at any of `ends`; drops a CR before LF, and all input before a device clear."""

    def __init__(
        self, ends: tuple[bytes, ...] = (TERMINATOR,), *, clears: bool = True, buffer: int = _INPUT_BUFFER
    ) -> None:
        self._clears = clears
        self._longest = buffer
        longest_first = sorted(ends, key=len, reverse=True)
        self._end = re.compile(b"|".join(map(re.escape, longest_first)))
        self._buffer = bytearray()
        self._too_long = False

    def feed(self, data: bytes) -> None:
        """Append bytes from the wire."""
        self._buffer += data

    def lose(self) -> bool:
        """Discard device clears and all but the input's first 10 characters; return whether any were lost."""
        lost = len(self._buffer) > _WITHIN_HOLD_OFF or DEVICE_CLEAR in self._buffer
        self._buffer = self._buffer[:_WITHIN_HOLD_OFF].replace(DEVICE_CLEAR, b"")
        return lost

    @property
    def device_clear_pending(self) -> bool:
        """Whether the input contains a device clear that `take` has not returned yet."""
        return self._clears and DEVICE_CLEAR in self._buffer

    def take(self) -> bytes | Overflow | None:
        """Return the next message, `DEVICE_CLEAR` or an `Overflow`, or None if no message is complete."""
        _, clear, after = self._buffer.rpartition(DEVICE_CLEAR)
        if clear and self._clears:
            self._buffer = after
            self._too_long = False
            return DEVICE_CLEAR
        end = self._end.search(self._buffer)
        if end is None:
            if len(self._buffer) > self._longest:
                self._buffer.clear()
                self._too_long = True
            return None
        line, self._buffer = self._buffer[: end.start()], self._buffer[end.end() :]
        if self._too_long or len(line) > self._longest:
            self._too_long = False
            return Overflow()
        return bytes(line.removesuffix(b"\r") if end[0] == TERMINATOR else line)


class ServedInstrument:
    """A dialect shared by all its wires: it carries out one message at a time, from any wire.

    `fault` may be set or removed at any time. All instruments of a bench on a virtual clock share one `traffic`.
    """

    def __init__(
        self, dialect: Dialect, traffic: Traffic | None = None, fault: FaultHook | None = None
    ) -> None:
        self.dialect = dialect
        self.traffic = traffic or Traffic()
        self.fault = fault
        self._sent_by: Callable[[Callable[[], bool]], None] | None = getattr(dialect, "sent_by", None)
        self._lock = threading.Lock()
        self._clearing: set[Session] = set()

    def exchange(
        self, session: Session, message: bytes, interrupted: Callable[[], bool]
    ) -> tuple[bytes | None, WireFault | None]:
        """Carry out a message; return the reply and the wire's fault for this exchange, each None if none."""

        def cleared() -> bool:
            return bool(self._clearing) or interrupted()

        with self._held(session):
            if self._sent_by is not None:
                self._sent_by(session.has_left)
            reply = self.dialect.handle(message, cleared)
            return reply, self.fault(message, reply) if self.fault else None

    def device_clear(self, session: Session) -> None:
        """Abort the command in progress, even one of another client, because all share one instrument."""
        self._clearing.add(session)
        try:
            with self._held(session):
                self.dialect.device_clear()
        finally:
            self._clearing.discard(session)

    def input_overflow(self, session: Session) -> None:
        """Report a message that exceeded the input buffer."""
        with self._held(session):
            self.dialect.input_overflow()

    @contextmanager
    def held(self) -> Iterator[None]:
        """Block messages from all wires within the context, so that the instrument can be changed safely."""
        with self._lock:
            yield

    @contextmanager
    def _held(self, session: Session) -> Iterator[None]:
        if not self._lock.acquire(blocking=False):
            self.traffic.mark(session, Doing.WAITING)
            # The holder of the lock may be waiting for a measurement of this client, which may have left.
            while not self._lock.acquire(timeout=_LOOK_S):
                session.look_whether_left()
            self.traffic.mark(session, Doing.WORKING)
        try:
            yield
        finally:
            self._lock.release()


class Session:
    """One client of one instrument.

    If a fault refuses new clients, the session calls `on_refuse` with the duration, s; 0 means without limit.
    """

    def __init__(
        self,
        transport: Transport,
        instrument: ServedInstrument,
        on_refuse: Callable[[float], None],
    ) -> None:
        self.doing = Doing.LISTENING
        self.source = transport.source
        self._transport = transport
        self._instrument = instrument
        self._traffic = instrument.traffic
        self._on_refuse = on_refuse
        self._clock = SystemClock()
        self._silent_since_s: float | None = None
        self._left = False
        ends = line_ends_of(instrument.dialect)
        self._framer = Framer(ends.messages, clears=ends.clears, buffer=ends.buffer)
        self._loses_early = ends.loses_early
        terminator = transport.terminator if ends.reply is None else ends.reply
        self._framed = ends.frame or (lambda reply: reply + terminator)

    def has_work(self) -> bool:
        """Return whether this session is working or has unread input.

        The input is checked before the activity, because `run` changes them in the opposite order.
        """
        if self.doing is Doing.WAITING:
            return False
        try:
            pending = self._transport.has_input()
        except OSError:
            pending = False
        return pending or self.doing is Doing.WORKING

    def has_left(self) -> bool:
        """Return whether the client is known to have left for good; may be called from any thread."""
        return self._left

    def look_whether_left(self) -> None:
        """Update whether the client has left for good; only the session's own thread may call this."""
        try:
            self._interrupted()
        except OSError:
            self._left = True  # commands that it sent before are still carried out

    def run(self) -> None:
        """Serve the client until it leaves. A wire that breaks ends only this session."""
        self._traffic.enter(self)
        try:
            while True:
                self._transport.wait()
                # Marked before the input is read, so that `has_work` never misses work.
                self._traffic.mark(self, Doing.WORKING)
                if not self._receive() or not self._answer_all():
                    return
                self._traffic.mark(self, Doing.LISTENING)
        except OSError:
            return
        finally:
            self._left = True
            self._traffic.leave(self)
            self._transport.close()

    def _receive(self) -> bool:
        data = self._transport.receive()
        self._framer.feed(data)
        return bool(data)

    def _interrupted(self) -> bool:
        """Return whether to give up the command in progress: after a device clear, or if the client has left.

        A client that closed only its sending side counts as present for `LEAVING_S`, to read the reply.
        """
        if self._silent_since_s is None and self._transport.has_input() and not self._receive():
            self._silent_since_s = self._clock.now_s()
        if self._silent_since_s is not None and self._clock.now_s() - self._silent_since_s >= LEAVING_S:
            self._left = True
        return self._left or (self._framer.device_clear_pending and not self._loses_early)

    def _answer_all(self) -> bool:
        """Carry out all complete messages; return False if the connection is to be closed."""
        while (message := self._framer.take()) is not None:
            if isinstance(message, Overflow):
                self._instrument.input_overflow(self)
            elif message == DEVICE_CLEAR:
                self._instrument.device_clear(self)
            elif not self._answer(*self._instrument.exchange(self, message, self._interrupted)):
                return False
        return True

    def _answer(self, reply: bytes | None, fault: WireFault | None) -> bool:
        if self._loses_early and reply is not None:
            if self._transport.has_input():
                self._receive()
            if self._framer.lose():
                self._instrument.input_overflow(self)
        if fault is None:
            if reply is not None:
                self._transport.send(self._framed(reply), self._interrupted)
            return True
        if self._in_time(fault.delay_s):
            data = fault.raw + b"".join(self._framed(line) for line in fault.lines)
            if data:
                self._transport.send(data, self._interrupted)
        if fault.refuse:
            self._on_refuse(fault.refuse_s)
        return not fault.drop

    def _in_time(self, delay_s: float) -> bool:
        """Wait in real time before a late reply; return False if a device clear or a leaving client cancels it."""
        if delay_s <= 0.0:
            return True
        self._traffic.mark(self, Doing.WAITING)
        end_s = self._clock.now_s() + delay_s
        try:
            while not self._interrupted():
                left_s = end_s - self._clock.now_s()
                if left_s <= 0.0:
                    return True
                self._clock.sleep(min(left_s, _LATE_SLICE_S))
            return False
        finally:
            self._traffic.mark(self, Doing.WORKING)
