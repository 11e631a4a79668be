"""How bytes become messages to an instrument and replies become bytes, whatever carries them.

Three layers apart: a `Transport` moves bytes, a `Framer` cuts messages out of them, a `Dialect` understands
them. A `Session` is one client at one instrument.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator

DEVICE_CLEAR: Final = b"\x03"
TERMINATOR: Final = b"\n"

_INPUT_BUFFER: Final = 65536
_SETTLE_LOOKS: Final = 2000
_SETTLE_LOOK_S: Final = 0.001


class Dialect(Protocol):
    """An instrument as the wire sees it: messages in, reply lines out, both without terminators."""

    def handle(self, message: bytes, interrupted: Callable[[], bool]) -> bytes | None:
        """Carry out a message; return the reply, None if there is none.

        While it waits it asks `interrupted` whether a device clear has come in, and then gives up.
        """
        ...

    def device_clear(self) -> None:
        """Stop what is under way."""
        ...

    def input_overflow(self) -> None:
        """Take note that a message was too long to be kept."""
        ...


class Transport(Protocol):
    """One client's wire. `terminator` ends each reply on it. Any method may raise `OSError`."""

    terminator: bytes

    def wait(self) -> None:
        """Wait until there is input, or the wire is closed."""
        ...

    def receive(self) -> bytes:
        """Return the input that is there; empty when the wire is closed."""
        ...

    def has_input(self) -> bool:
        """Whether `receive` would return at once."""
        ...

    def send(self, data: bytes) -> None:
        """Send all of `data`."""
        ...

    def close(self) -> None:
        """Close the wire, and wake whoever waits on it."""
        ...


@dataclass(frozen=True)
class WireFault:
    """What a broken wire does to one exchange: what is sent in place of the reply, and what then happens.

    `raw` goes out as it is, without a terminator of its own; `drop` closes the connection after it,
    `refuse` also refuses new ones until the server is told to `accept_again`.
    """

    raw: bytes = b""
    drop: bool = False
    refuse: bool = False

    @classmethod
    def cut(cls, reply: bytes | None, keep: int) -> WireFault:
        """Only the first `keep` bytes of the reply arrive, and no terminator."""
        return cls((reply or b"")[:keep])

    @classmethod
    def garble(cls, reply: bytes | None) -> WireFault:
        """The reply arrives with its line end, every character in it wrong."""
        return cls(bytes(0x40 | (byte & 0x1F) for byte in reply or b"") + TERMINATOR)


SILENCE: Final = WireFault()
"""The command was carried out, the reply is lost."""

DROP: Final = WireFault(drop=True)
"""The connection is closed in place of the reply."""

REFUSE: Final = WireFault(drop=True, refuse=True)
"""The connection is closed, and new ones are refused."""

FaultHook = Callable[[bytes, bytes | None], WireFault | None]
"""Called with each request and its reply (None: there is none); returns what the wire does instead."""


class Overflow:
    """What a framer yields in place of a message that was too long."""


class Framer:
    """Cuts messages at LF, a CR before it dropped. A device clear discards what came before it."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._too_long = False

    def feed(self, data: bytes) -> None:
        """Take bytes from the wire."""
        self._buffer += data

    @property
    def device_clear_pending(self) -> bool:
        """Whether a device clear has come in and was not taken yet."""
        return DEVICE_CLEAR in self._buffer

    def take(self) -> bytes | Overflow | None:
        """Return the next message, `DEVICE_CLEAR`, an `Overflow`; None when no message is complete."""
        _, clear, after = self._buffer.rpartition(DEVICE_CLEAR)
        if clear:
            self._buffer = after
            self._too_long = False
            return DEVICE_CLEAR
        line, end, rest = self._buffer.partition(TERMINATOR)
        if not end:
            if len(self._buffer) > _INPUT_BUFFER:
                self._buffer.clear()
                self._too_long = True
            return None
        self._buffer = rest
        if self._too_long or len(line) > _INPUT_BUFFER:
            self._too_long = False
            return Overflow()
        return bytes(line.removesuffix(b"\r"))


class _Doing(Enum):
    """What a session does at the moment, as `Traffic` sees it."""

    LISTENING = "waiting for input"
    WORKING = "carrying out a message"
    WAITING = "waiting for time to pass, or for another client"


class Traffic:
    """Knows what all the sessions of a bench do, so that time moves only when none has work left.

    Without it, a virtual clock could jump past a measurement whose start is still on another wire.
    """

    def __init__(self) -> None:
        self._sessions: set[Session] = set()
        self._changed = threading.Condition()
        self._current = threading.local()

    def settle(self) -> None:
        """Wait until each session but the caller's listens with no input, or waits itself.

        A client that does not take its replies cannot hold the bench up for ever: after a few seconds
        it is passed over.
        """
        own: Session | None = getattr(self._current, "session", None)
        with self._waiting(own):
            for _ in range(_SETTLE_LOOKS):
                with self._changed:
                    busy = [s for s in self._sessions if s is not own and s.has_work()]
                    if not busy:
                        return
                    self._changed.wait(_SETTLE_LOOK_S)

    def enter(self, session: Session) -> None:
        """A session begins in the calling thread."""
        self._current.session = session
        with self._changed:
            self._sessions.add(session)

    def leave(self, session: Session) -> None:
        """A session ends."""
        with self._changed:
            self._sessions.discard(session)
            self._changed.notify_all()

    def mark(self, session: Session, doing: _Doing) -> None:
        """Say what a session does from now on."""
        session.doing = doing
        if doing is not _Doing.WORKING:
            with self._changed:
                self._changed.notify_all()

    @contextmanager
    def _waiting(self, session: Session | None) -> Iterator[None]:
        if session is None:
            yield
            return
        self.mark(session, _Doing.WAITING)
        try:
            yield
        finally:
            self.mark(session, _Doing.WORKING)


class Session:
    """One client at one instrument; `lock` is the instrument's: one message at a time is carried out."""

    def __init__(
        self,
        transport: Transport,
        dialect: Dialect,
        lock: threading.Lock,
        traffic: Traffic,
        fault: FaultHook | None,
        on_refuse: Callable[[], None],
    ) -> None:
        self.doing = _Doing.LISTENING
        self._transport = transport
        self._dialect = dialect
        self._lock = lock
        self._traffic = traffic
        self._fault = fault
        self._on_refuse = on_refuse
        self._framer = Framer()

    def has_work(self) -> bool:
        """Whether this session works, or has input to work on. The input is looked at first: see `run`."""
        if self.doing is _Doing.WAITING:
            return False
        try:
            pending = self._transport.has_input()
        except OSError:
            pending = False
        return pending or self.doing is _Doing.WORKING

    def run(self) -> None:
        """Serve the client until it leaves. A wire that breaks ends the session and nothing else."""
        self._traffic.enter(self)
        try:
            while True:
                self._transport.wait()
                # Marked before the input is taken: at no moment has the session work that cannot be seen.
                self._traffic.mark(self, _Doing.WORKING)
                if not self._receive() or not self._answer_all():
                    return
                self._traffic.mark(self, _Doing.LISTENING)
        except OSError:
            return
        finally:
            self._traffic.leave(self)
            self._transport.close()

    def _receive(self) -> bool:
        data = self._transport.receive()
        self._framer.feed(data)
        return bool(data)

    def _interrupted(self) -> bool:
        if self._transport.has_input():
            self._receive()
        return self._framer.device_clear_pending

    def _answer_all(self) -> bool:
        """Carry out the messages that are complete; False when the connection is to be closed."""
        while (message := self._framer.take()) is not None:
            if not self._lock.acquire(blocking=False):
                self._traffic.mark(self, _Doing.WAITING)
                self._lock.acquire()
                self._traffic.mark(self, _Doing.WORKING)
            try:
                if isinstance(message, Overflow):
                    self._dialect.input_overflow()
                    continue
                if message == DEVICE_CLEAR:
                    self._dialect.device_clear()
                    continue
                reply = self._dialect.handle(message, self._interrupted)
            finally:
                self._lock.release()
            if not self._answer(message, reply):
                return False
        return True

    def _answer(self, message: bytes, reply: bytes | None) -> bool:
        fault = self._fault(message, reply) if self._fault else None
        if fault is None:
            if reply is not None:
                self._transport.send(reply + self._transport.terminator)
            return True
        if fault.raw:
            self._transport.send(fault.raw)
        if fault.refuse:
            self._on_refuse()
        return not fault.drop
