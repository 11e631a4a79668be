"""Sessions on wires: bytes to messages, replies to bytes, and the track of busy sessions."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final, Protocol, runtime_checkable

from drivers.clock import Clock, SystemClock

if TYPE_CHECKING:
    from collections.abc import Iterator


_SETTLE_LOOKS: Final = 2000
_SETTLE_LOOK_S: Final = 0.001


class Doing(Enum):
    """The present activity of a session, for `Traffic`."""

    LISTENING = "waiting for input"
    WORKING = "carrying out a message"
    WAITING = "waiting for time to pass, or for another client"


class Busy(Protocol):
    """A session, as far as time is concerned. `doing` is set through `Traffic.mark`."""

    doing: Doing

    def has_work(self) -> bool:
        """Whether it works, or has input to work on."""


class Traffic:
    """The activities of all sessions of a bench: time moves only when none has work left.

    Without it, a virtual clock could jump past a measurement whose start is still on another wire.
    """

    def __init__(self) -> None:
        self._sessions: set[Busy] = set()
        self._changed = threading.Condition()
        self._current = threading.local()

    def settle(self) -> None:
        """Wait until each session but the caller's listens with no input, or waits itself.

        A client that does not take its replies cannot hold the bench up for ever: after a few seconds
        it is passed over.
        """
        own: Busy | None = getattr(self._current, "session", None)
        with self._waiting(own):
            for _ in range(_SETTLE_LOOKS):
                with self._changed:
                    busy = [s for s in self._sessions if s is not own and s.has_work()]
                    if not busy:
                        return
                    self._changed.wait(_SETTLE_LOOK_S)

    def enter(self, session: Busy) -> None:
        """A session begins in the calling thread."""
        self._current.session = session
        with self._changed:
            self._sessions.add(session)

    def leave(self, session: Busy) -> None:
        """A session ends."""
        with self._changed:
            self._sessions.discard(session)
            self._changed.notify_all()

    def mark(self, session: Busy, doing: Doing) -> None:
        """Set the activity of a session from now on."""
        session.doing = doing
        if doing is not Doing.WORKING:
            with self._changed:
                self._changed.notify_all()

    @contextmanager
    def _waiting(self, session: Busy | None) -> Iterator[None]:
        if session is None:
            yield
            return
        self.mark(session, Doing.WAITING)
        try:
            yield
        finally:
            self.mark(session, Doing.WORKING)


DEVICE_CLEAR: Final = b"\x03"
TERMINATOR: Final = b"\n"

_INPUT_BUFFER: Final = 65536
_LATE_SLICE_S: Final = 0.02
_LOOK_S: Final = 0.05
LEAVING_S: Final = 2.0
"""How long a reply is still worked on for a client that sends no more, s of real time."""


@dataclass(frozen=True)
class LineEnds:
    """How the lines of an instrument end: each of `messages` ends a message, `reply` is sent after each reply.

    Where `reply` is None the wire has its own. A CR before an LF that ends a message is dropped; of the bytes
    around other ends none is. Where `frame` is given it makes of a reply what is sent. Where ETX is a character
    as any other it is no device clear: `clears` is False.
    """

    messages: tuple[bytes, ...] = (TERMINATOR,)
    reply: bytes | None = None
    frame: Callable[[bytes], bytes] | None = None
    clears: bool = True


class Dialect(Protocol):
    """An instrument as the wire sees it: messages in, reply lines out, both without terminators.

    One whose lines end otherwise than in LF says so (`HasLineEnds`).
    """

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Carry out a message; return the reply, None if there is none.

        While it waits it asks `interrupted` whether a device clear has come in, and then gives up.
        """

    def device_clear(self) -> None:
        """Stop what is under way."""

    def input_overflow(self) -> None:
        """Take note that a message was too long to be kept."""


class PlainDialect:
    """The base of dialects that carry out each message at once: there is nothing to clear or to note."""

    def device_clear(self) -> None:
        """Nothing is ever under way."""

    def input_overflow(self) -> None:
        """A line that was too long is passed over."""


@runtime_checkable
class Forsakable(Protocol):
    """A dialect that may be busy for hours with what one client wanted of it."""

    def sent_by(self, left: Callable[[], bool]) -> None:
        """Take note of who sends the next message: `left` tells, at any time, whether that client has left.

        What was begun for one that has left is given up, also while another's message waits for it.
        """


@runtime_checkable
class HasLineEnds(Protocol):
    """A dialect that says how its lines end, on whatever wire."""

    @property
    def line_ends(self) -> LineEnds:
        """The line ends of the dialect."""


def line_ends_of(dialect: Dialect) -> LineEnds:
    """Return the line ends of a dialect; by default LF for messages, and those of the wire for replies."""
    return dialect.line_ends if isinstance(dialect, HasLineEnds) else LineEnds()


class Transport(Protocol):
    """One client's wire. `terminator` ends each reply where the dialect says nothing.

    Any method may raise `OSError`.
    """

    terminator: bytes

    def wait(self) -> None:
        """Wait until there is input, or the wire is closed."""

    def receive(self) -> bytes:
        """Return the input that is there; empty when the wire is closed."""

    def has_input(self) -> bool:
        """Whether `receive` would return at once."""

    def send(self, data: bytes, interrupted: Callable[[], bool]) -> None:
        """Send all of `data`, or give the rest up when the client takes none and `interrupted` is true."""

    def close(self) -> None:
        """Close the wire, and wake whoever waits on it."""


@dataclass(frozen=True)
class WireFault:
    """The effect of a broken wire on one exchange: the bytes in place of the reply, and the consequences.

    After `delay_s` of real time `raw` goes out as it is, then each of `lines` with the terminator of the wire.
    `drop` closes the connection after that; `refuse` also refuses new ones, for `refuse_s` of real time or,
    where that is 0, until the server is told to `accept_again`.
    """

    raw: bytes = b""
    lines: tuple[bytes, ...] = ()
    delay_s: float = 0.0
    drop: bool = False
    refuse: bool = False
    refuse_s: float = 0.0

    @classmethod
    def cut(cls, reply: bytes | None, keep: int) -> WireFault:
        """Only the first `keep` bytes of the reply arrive, and no terminator."""
        return cls((reply or b"")[:keep])

    @classmethod
    def garble(cls, reply: bytes | None) -> WireFault:
        """The reply arrives with its line end, every character in it wrong."""
        return cls(lines=(bytes(0x40 | (byte & 0x1F) for byte in reply or b""),))


SILENCE: Final = WireFault()
"""The command was carried out, the reply is lost."""

DROP: Final = WireFault(drop=True)
"""The connection is closed in place of the reply."""

REFUSE: Final = WireFault(drop=True, refuse=True)
"""The connection is closed, and new ones are refused."""

FaultHook = Callable[[bytes, bytes | None], WireFault | None]
"""Called with each request and its reply (None: there is none); returns what the wire does instead.

One call at a time for one instrument, in the order in which its messages were carried out."""


class Overflow:
    """A marker in place of a message that was too long."""


class Framer:
    """Cuts messages at one of `ends`, a CR before LF dropped. A device clear discards what came before it."""

    def __init__(self, ends: tuple[bytes, ...] = (TERMINATOR,), *, clears: bool = True) -> None:
        self._clears = clears
        longest_first = sorted(ends, key=len, reverse=True)
        self._end = re.compile(b"|".join(map(re.escape, longest_first)))
        self._buffer = bytearray()
        self._too_long = False

    def feed(self, data: bytes) -> None:
        """Take bytes from the wire."""
        self._buffer += data

    @property
    def device_clear_pending(self) -> bool:
        """Whether a device clear has come in and was not taken yet."""
        return self._clears and DEVICE_CLEAR in self._buffer

    def take(self) -> bytes | Overflow | None:
        """Return the next message, `DEVICE_CLEAR`, an `Overflow`; None when no message is complete."""
        _, clear, after = self._buffer.rpartition(DEVICE_CLEAR)
        if clear and self._clears:
            self._buffer = after
            self._too_long = False
            return DEVICE_CLEAR
        end = self._end.search(self._buffer)
        if end is None:
            if len(self._buffer) > _INPUT_BUFFER:
                self._buffer.clear()
                self._too_long = True
            return None
        line, self._buffer = self._buffer[: end.start()], self._buffer[end.end() :]
        if self._too_long or len(line) > _INPUT_BUFFER:
            self._too_long = False
            return Overflow()
        return bytes(line.removesuffix(b"\r") if end[0] == TERMINATOR else line)


class ServedInstrument:
    """A dialect as all its wires share it: one message at a time is carried out, whoever sent it.

    `fault` may be set and taken away at any time; `traffic` is shared by the instruments of a bench on a
    virtual clock.
    """

    def __init__(
        self, dialect: Dialect, traffic: Traffic | None = None, fault: FaultHook | None = None
    ) -> None:
        self.dialect = dialect
        self.traffic = traffic or Traffic()
        self.fault = fault
        self._forsakable = dialect if isinstance(dialect, Forsakable) else None
        self._lock = threading.Lock()
        self._clearing: set[Session] = set()

    def exchange(
        self, session: Session, message: bytes, interrupted: Callable[[], bool]
    ) -> tuple[bytes | None, WireFault | None]:
        """Carry a message out; return the reply and what the wire makes of it."""

        def cleared() -> bool:
            return bool(self._clearing) or interrupted()

        with self._held(session):
            if self._forsakable is not None:
                self._forsakable.sent_by(session.has_left)
            reply = self.dialect.handle(message, cleared)
            return reply, self.fault(message, reply) if self.fault else None

    def device_clear(self, session: Session) -> None:
        """Stop what is under way, also for another client: there is one instrument."""
        self._clearing.add(session)
        try:
            with self._held(session):
                self.dialect.device_clear()
        finally:
            self._clearing.discard(session)

    def input_overflow(self, session: Session) -> None:
        """Take note that a message was too long to be kept."""
        with self._held(session):
            self.dialect.input_overflow()

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep all wires off the instrument meanwhile, to do something to it from outside."""
        with self._lock:
            yield

    @contextmanager
    def _held(self, session: Session) -> Iterator[None]:
        if not self._lock.acquire(blocking=False):
            self.traffic.mark(session, Doing.WAITING)
            # Who has the instrument may wait for what this client began, and so for word that it has left.
            while not self._lock.acquire(timeout=_LOOK_S):
                session.look_whether_left()
            self.traffic.mark(session, Doing.WORKING)
        try:
            yield
        finally:
            self._lock.release()


class Session:
    """One client at one instrument. `on_refuse` is told for how long new clients are to be refused, s."""

    def __init__(
        self,
        transport: Transport,
        instrument: ServedInstrument,
        on_refuse: Callable[[float], None],
        clock: Clock | None = None,
    ) -> None:
        self.doing = Doing.LISTENING
        self._transport = transport
        self._instrument = instrument
        self._traffic = instrument.traffic
        self._on_refuse = on_refuse
        self._clock = clock or SystemClock()
        self._silent_since_s: float | None = None
        self._left = False
        ends = line_ends_of(instrument.dialect)
        self._framer = Framer(ends.messages, clears=ends.clears)
        terminator = transport.terminator if ends.reply is None else ends.reply
        self._framed = ends.frame or (lambda reply: reply + terminator)

    def has_work(self) -> bool:
        """Whether this session works, or has input to work on. The input is looked at first: see `run`."""
        if self.doing is Doing.WAITING:
            return False
        try:
            pending = self._transport.has_input()
        except OSError:
            pending = False
        return pending or self.doing is Doing.WORKING

    def has_left(self) -> bool:
        """Whether the client has left for good, as far as it was seen; to be called from any thread."""
        return self._left

    def look_whether_left(self) -> None:
        """See whether the client has left for good; to be called from the session's own thread."""
        try:
            self._interrupted()
        except OSError:
            self._left = True  # what it sent before is carried out all the same

    def run(self) -> None:
        """Serve the client until it leaves. A wire that breaks ends the session and nothing else."""
        self._traffic.enter(self)
        try:
            while True:
                self._transport.wait()
                # Marked before the input is taken: at no moment has the session work that cannot be seen.
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
        """Whether what is under way is to be given up: at a device clear, or when the client has left for good.

        One that only sends no more may still take its reply: it is given a moment.
        """
        if self._silent_since_s is None and self._transport.has_input() and not self._receive():
            self._silent_since_s = self._clock.now_s()
        if self._silent_since_s is not None and self._clock.now_s() - self._silent_since_s >= LEAVING_S:
            self._left = True
        return self._left or self._framer.device_clear_pending

    def _answer_all(self) -> bool:
        """Carry out the messages that are complete; False when the connection is to be closed."""
        while (message := self._framer.take()) is not None:
            if isinstance(message, Overflow):
                self._instrument.input_overflow(self)
            elif message == DEVICE_CLEAR:
                self._instrument.device_clear(self)
            elif not self._answer(*self._instrument.exchange(self, message, self._interrupted)):
                return False
        return True

    def _answer(self, reply: bytes | None, fault: WireFault | None) -> bool:
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
        """Let real time pass before a late reply; False when a device clear made it void meanwhile."""
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
