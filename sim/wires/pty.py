"""Serves an instrument on a pseudo-terminal, as a meter's serial port; nothing is served where there are none.

A pseudo-terminal knows neither baud rate nor parity nor modem lines: what a client sets is accepted and
changes nothing.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
from typing import TYPE_CHECKING, Final

from sim.wires.session import Session

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from sim.wires.session import ServedInstrument

TERMINALS: Final = hasattr(os, "openpty")
"""Whether this system has pseudo-terminals."""

_CHUNK: Final = 4096
_LOOK_S: Final = 0.05
_JOIN_S: Final = 5.0


class TerminalTransport:
    """The instrument's end of a pseudo-terminal until it is closed; replies end in CR LF, if in nothing else.

    The terminal itself outlives it: `close` only ends the waiting of this transport, for good.
    """

    terminator = b"\r\n"

    def __init__(self, master: int) -> None:
        self._master = master
        self._wake_read, self._wake_write = os.pipe()
        self._closed = False

    def wait(self) -> None:
        """Wait until there is input. Raises `OSError` when the transport is closed."""
        self._ready(None)

    def receive(self) -> bytes:
        """Return the input that is there."""
        return os.read(self._master, _CHUNK)

    def has_input(self) -> bool:
        """Whether `receive` would return at once. Raises `OSError` when the transport is closed."""
        return self._ready(0.0)

    def send(self, data: bytes, interrupted: Callable[[], bool]) -> None:
        """Send all of `data`; a client that reads nothing is waited for until it sends a device clear."""
        while data:
            writable = select.select([self._wake_read], [self._master], [], _LOOK_S)[1]
            if self._closed:
                raise OSError("the terminal was closed by the server")
            if writable:
                with contextlib.suppress(BlockingIOError):
                    data = data[os.write(self._master, data) :]
            elif interrupted():
                return

    def close(self) -> None:
        """End the waiting of this transport, from any thread."""
        if not self._closed:
            self._closed = True
            os.write(self._wake_write, b"x")

    def release(self) -> None:
        """Give the transport's own descriptors back, when nobody waits on it any more."""
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _ready(self, timeout_s: float | None) -> bool:
        if not self._closed:
            readable = select.select([self._master, self._wake_read], [], [], timeout_s)[0]
            if not self._closed:
                return bool(readable)
        raise OSError("the terminal was closed by the server")


class TerminalServer:
    """A pseudo-terminal for one instrument; a context manager. `path` is what clients open.

    Several clients may open it, one after the other or at once, and leave: the terminal stays. A connection
    that is dropped loses what was on the wire; while it is refused, the wire is dead.
    """

    def __init__(self, instrument: ServedInstrument) -> None:
        self.instrument = instrument
        self.path = ""
        self._master = self._slave = -1
        self._stopping = False
        self._state_lock = threading.Lock()
        self._accepts = threading.Event()
        self._accepts.set()
        self._later: threading.Timer | None = None
        self._transport: TerminalTransport | None = None
        self._thread: threading.Thread | None = None

    def __enter__(self) -> TerminalServer:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    @property
    def resource(self) -> str:
        """The VISA name of the terminal."""
        return f"ASRL{self.path}::INSTR"

    def start(self) -> None:
        """Open a terminal. Raises `OSError` when the system gives none."""
        import tty  # a system without terminals has no such module

        self._master, self._slave = os.openpty()
        # Our own hold on the slave keeps the terminal alive between clients. Cooked, it would echo what the
        # instrument says back to the instrument.
        tty.setraw(self._master)
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._stopping = False
        self._transport = TerminalTransport(self._master)
        self._thread = threading.Thread(
            target=self._serve, args=(self._transport,), name=f"terminal {self.path}", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Close the terminal, and wait for its thread."""
        with self._state_lock:
            self._stopping = True
        self._accepts.set()
        if self._later is not None:
            self._later.cancel()
        self.drop_connections()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None
        for descriptor in (self._master, self._slave):
            if descriptor >= 0:
                os.close(descriptor)
        self._master = self._slave = -1

    def drop_connections(self) -> None:
        """Lose what is on the wire, and go on serving."""
        with self._state_lock:
            if self._transport is not None:
                self._transport.close()
                self._discard()

    def refuse(self, duration_s: float = 0.0) -> None:
        """Let the wire be dead from now on, for a while or until `accept_again`."""
        self._accepts.clear()
        if duration_s > 0.0:
            self._later = threading.Timer(duration_s, self.accept_again)
            self._later.daemon = True
            self._later.start()
        self.drop_connections()

    def accept_again(self) -> None:
        """Let the wire live again after `refuse`; what was sent into it meanwhile is lost."""
        with self._state_lock:
            if not self._accepts.is_set() and not self._stopping:
                self._discard()
            self._accepts.set()

    def _serve(self, transport: TerminalTransport) -> None:
        while True:
            Session(transport, self.instrument, self.refuse).run()
            self._accepts.wait()
            with self._state_lock:
                transport.release()
                self._transport = None
                if self._stopping:
                    return
                self._transport = transport = TerminalTransport(self._master)

    def _discard(self) -> None:
        """Throw away what is on the wire in both directions."""
        import termios

        if self._master < 0:
            return
        termios.tcflush(self._master, termios.TCIOFLUSH)
        with contextlib.suppress(BlockingIOError):
            while os.read(self._master, _CHUNK):
                pass
