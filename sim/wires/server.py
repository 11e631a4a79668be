"""Instruments served on TCP ports and pseudo-terminals."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Final, Self

from sim.wires.session import TERMINATOR, Session

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.wires.session import FaultHook, ServedInstrument


_CHUNK: Final = 65536
_BACKLOG: Final = 16
_JOIN_S: Final = 5.0


class TcpTransport:
    """One accepted connection. Replies end in LF, if in nothing else, and small packets leave at once both ways."""

    terminator = TERMINATOR

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        connection.setblocking(True)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._acknowledge_quickly()

    def wait(self) -> None:
        """Wait until there is input, or the connection is closed."""
        self._socket.recv(1, socket.MSG_PEEK)

    def receive(self) -> bytes:
        """Return the input that is there; empty when the client has left."""
        data = self._socket.recv(_CHUNK)
        self._acknowledge_quickly()
        return data

    def has_input(self) -> bool:
        """Whether `receive` would return at once."""
        try:
            return bool(select.select([self._socket], [], [], 0.0)[0])
        except ValueError as error:
            raise OSError("the connection was closed by the server") from error

    def send(self, data: bytes, interrupted: Callable[[], bool]) -> None:
        """Send all of `data`; a client that takes none holds up nobody but itself, and may leave."""
        self._socket.sendall(data)

    def close(self) -> None:
        """Close the connection, and wake the thread that waits on it."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _acknowledge_quickly(self) -> None:
        # A client that has left Nagle's algorithm on waits for our acknowledgement before it sends its next
        # command; Linux forgets the option with each use, other systems do not have it.
        option = getattr(socket, "TCP_QUICKACK", None)
        if option is not None:
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.IPPROTO_TCP, option, 1)


class InstrumentServer(ABC):
    """A wire for one instrument, open while its context lasts."""

    def __init__(self, instrument: ServedInstrument) -> None:
        self.instrument = instrument
        self._state_lock = threading.Lock()
        self._later: threading.Timer | None = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @abstractmethod
    def start(self) -> None:
        """Serve. Raises `OSError` when the wire is not to be had."""

    @abstractmethod
    def stop(self) -> None:
        """Close the wire, and wait for its threads."""

    def _accept_later(self, duration_s: float, accept: Callable[[], None]) -> None:
        """Accept connections again after a while; 0: not before somebody says so."""
        if duration_s > 0.0:
            self._later = threading.Timer(duration_s, accept)
            self._later.daemon = True
            self._later.start()

    def _forget_later(self) -> None:
        if self._later is not None:
            self._later.cancel()


class TcpServer(InstrumentServer):
    """A listening port for one instrument; a context manager.

    `port` 0 takes a free one. Loopback is the default, as whoever reaches the port commands the instrument.
    """

    def __init__(self, instrument: ServedInstrument, *, host: str = "127.0.0.1", port: int = 0) -> None:
        super().__init__(instrument)
        self.host = host
        self.port = port
        self._listener: socket.socket | None = None
        self._accepting: threading.Thread | None = None
        self._clients: dict[threading.Thread, TcpTransport] = {}

    @property
    def fault(self) -> FaultHook | None:
        """The fault hook of the instrument, for this port and all its other wires."""
        return self.instrument.fault

    @fault.setter
    def fault(self, hook: FaultHook | None) -> None:
        self.instrument.fault = hook

    @property
    def address(self) -> str:
        """Host and port, such as "127.0.0.1:5025"."""
        return f"{self.host}:{self.port}"

    @property
    def resource(self) -> str:
        """The VISA name of the port."""
        return f"TCPIP0::{self.host}::{self.port}::SOCKET"

    def start(self) -> None:
        """Listen. Raises `OSError` when the port is taken."""
        listener = socket.create_server((self.host, self.port), backlog=_BACKLOG)
        self.port = listener.getsockname()[1]
        self._listener = listener
        accepting = threading.Thread(
            target=self._accept, args=(listener,), name=f"accept {self.port}", daemon=True
        )
        accepting.start()
        self._accepting = accepting  # only now: another thread that refuses meanwhile joins it

    def stop(self) -> None:
        """Stop listening, close all connections, and wait for their threads."""
        self.refuse()
        self._forget_later()
        with self._state_lock:
            clients = dict(self._clients)
        for transport in clients.values():
            transport.close()
        for thread in clients:
            if thread is not threading.current_thread():
                thread.join(_JOIN_S)

    def drop_connections(self) -> None:
        """Close the connections that are open, and go on listening."""
        with self._state_lock:
            transports = list(self._clients.values())
        for transport in transports:
            transport.close()

    def refuse(self, duration_s: float = 0.0) -> None:
        """Stop listening: new connections are refused from now on, for a while or until `accept_again`."""
        self._accept_later(duration_s, self._try_again)
        listener, self._listener = self._listener, None
        if listener is None:
            return
        # Closing does not wake a thread in accept() on every system; a connection of our own does.
        with contextlib.suppress(OSError), socket.create_connection((self.host, self.port), timeout=1.0):
            pass
        if self._accepting is not None and self._accepting is not threading.current_thread():
            self._accepting.join(_JOIN_S)
        listener.close()

    def accept_again(self) -> None:
        """Listen on the same port again after `refuse`."""
        if self._listener is None:
            self.start()

    def _try_again(self) -> None:
        with contextlib.suppress(OSError):  # the port went to somebody else: it stays refused
            self.accept_again()

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            if self._listener is not listener:
                connection.close()
                return
            self._serve(connection)

    def _serve(self, connection: socket.socket) -> None:
        try:
            transport = TcpTransport(connection)
        except OSError:
            connection.close()
            return
        session = Session(transport, self.instrument, self.refuse)

        def run() -> None:
            try:
                session.run()
            finally:
                with self._state_lock:
                    self._clients.pop(threading.current_thread(), None)

        thread = threading.Thread(target=run, name=f"client of {self.port}", daemon=True)
        with self._state_lock:
            self._clients[thread] = transport
        thread.start()


TERMINALS: Final = hasattr(os, "openpty")
"""Whether this system has pseudo-terminals."""

_PTY_CHUNK: Final = 4096
_LOOK_S: Final = 0.05
_PTY_JOIN_S: Final = 5.0


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
        return os.read(self._master, _PTY_CHUNK)

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


class TerminalServer(InstrumentServer):
    """A pseudo-terminal for one instrument; a context manager. `path` is what clients open.

    Several clients may open it, one after the other or at once, and leave: the terminal stays. A connection
    that is dropped loses what was on the wire; while it is refused, the wire is dead.
    """

    def __init__(self, instrument: ServedInstrument) -> None:
        super().__init__(instrument)
        self.path = ""
        self._master = self._slave = -1
        self._stopping = False
        self._accepts = threading.Event()
        self._accepts.set()
        self._transport: TerminalTransport | None = None
        self._thread: threading.Thread | None = None

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
        self._forget_later()
        self.drop_connections()
        if self._thread is not None:
            self._thread.join(_PTY_JOIN_S)
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
        self._accept_later(duration_s, self.accept_again)
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
            while os.read(self._master, _PTY_CHUNK):
                pass
