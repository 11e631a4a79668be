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
    """One accepted TCP connection. Replies end in LF unless the dialect defines another end.

    Nagle's algorithm and delayed acknowledgement are off, so that small packets are not held back.
    """

    terminator = TERMINATOR

    def __init__(self, connection: socket.socket) -> None:
        self.source: int | socket.socket = connection
        self._socket = connection
        connection.setblocking(True)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._acknowledge_quickly()

    def wait(self) -> None:
        """Wait for input or for the connection to be closed."""
        self._socket.recv(1, socket.MSG_PEEK)

    def receive(self) -> bytes:
        """Return the available input, or empty bytes if the client has left."""
        data = self._socket.recv(_CHUNK)
        self._acknowledge_quickly()
        return data

    def has_input(self) -> bool:
        """Return whether `receive` would return at once."""
        try:
            return bool(select.select([self._socket], [], [], 0.0)[0])
        except ValueError as error:
            raise OSError("the connection was closed by the server") from error

    def send(self, data: bytes, interrupted: Callable[[], bool]) -> None:
        """Send all of `data`; blocks while the client reads nothing, whatever `interrupted` returns."""
        self._socket.sendall(data)

    def close(self) -> None:
        """Close the connection and wake the thread that waits on it."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _acknowledge_quickly(self) -> None:
        # A client with Nagle's algorithm waits for our acknowledgement before it sends its next command. Linux
        # resets this option at each use; other systems do not have it.
        option = getattr(socket, "TCP_QUICKACK", None)
        if option is not None:
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.IPPROTO_TCP, option, 1)


class InstrumentServer(ABC):
    """A context manager that serves one instrument on a wire."""

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
        """Start serving. Raises `OSError` if the wire is not available."""

    @abstractmethod
    def stop(self) -> None:
        """Close the wire and wait for its threads."""

    def _accept_later(self, duration_s: float, accept: Callable[[], None]) -> None:
        """Call `accept` after `duration_s`; for 0, never."""
        if duration_s > 0.0:
            self._later = threading.Timer(duration_s, accept)
            self._later.daemon = True
            self._later.start()

    def _forget_later(self) -> None:
        if self._later is not None:
            self._later.cancel()


class TcpServer(InstrumentServer):
    """A listening TCP port for one instrument; a context manager.

    `port` 0 selects a free port. The default host is loopback, because any client that reaches the port can
    command the instrument.
    """

    def __init__(self, instrument: ServedInstrument, *, host: str = "127.0.0.1", port: int = 0) -> None:
        super().__init__(instrument)
        self.host = host
        self.port = port
        self._listener: socket.socket | None = None
        self._accepting: threading.Thread | None = None
        self._clients: dict[threading.Thread, tuple[Session, TcpTransport]] = {}

    @property
    def fault(self) -> FaultHook | None:
        """The fault hook of the instrument, shared by all its wires."""
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
        """The VISA resource of the port."""
        return f"TCPIP0::{self.host}::{self.port}::SOCKET"

    def start(self) -> None:
        """Start listening. Raises `OSError` if the port is in use."""
        listener = socket.create_server((self.host, self.port), backlog=_BACKLOG)
        self.port = listener.getsockname()[1]
        self._listener = listener
        accepting = threading.Thread(
            target=self._accept, args=(listener,), name=f"accept {self.port}", daemon=True
        )
        accepting.start()
        self._accepting = accepting  # set after start(): `refuse` in another thread joins it

    def stop(self) -> None:
        """Stop listening, close all connections, and wait for their threads."""
        self.refuse()
        self._forget_later()
        with self._state_lock:
            clients = dict(self._clients)
        for _, transport in clients.values():
            transport.close()
        for thread in clients:
            if thread is not threading.current_thread():
                thread.join(_JOIN_S)

    def drop_connections(self) -> None:
        """Close all open connections and continue to listen."""
        with self._state_lock:
            clients = list(self._clients.values())
        for _, transport in clients:
            transport.close()

    def refuse(self, duration_s: float = 0.0) -> None:
        """Refuse new connections for `duration_s`, s; if that is 0, until `accept_again` is called."""
        self._accept_later(duration_s, self._try_again)
        listener, self._listener = self._listener, None
        if listener is None:
            return
        # On some systems closing does not wake a thread in accept(), but a connection does.
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
        with contextlib.suppress(OSError):  # another program took the port: it stays refused
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
            earlier = [one for one, _ in self._clients.values()]
            self._clients[thread] = session, transport
        self.instrument.traffic.wait_for(earlier)  # their threads may be slow to begin with what has arrived
        thread.start()


TERMINALS: Final = hasattr(os, "openpty")
"""Whether this system has pseudo-terminals."""

_PTY_CHUNK: Final = 4096
_LOOK_S: Final = 0.05
_PTY_JOIN_S: Final = 5.0


class TerminalTransport:
    """The instrument's end of a pseudo-terminal; replies end in CR LF unless the dialect defines another end.

    The terminal outlives the transport: `close` only ends the waits of this transport, for good.
    """

    terminator = b"\r\n"

    def __init__(self, master: int) -> None:
        self.source: int | socket.socket = master
        self._master = master
        self._wake_read, self._wake_write = os.pipe()
        self._closed = False

    def wait(self) -> None:
        """Wait for input. Raises `OSError` if the transport is closed."""
        self._ready(None)

    def receive(self) -> bytes:
        """Return the available input."""
        return os.read(self._master, _PTY_CHUNK)

    def has_input(self) -> bool:
        """Return whether `receive` would return at once. Raises `OSError` if the transport is closed."""
        return self._ready(0.0)

    def send(self, data: bytes, interrupted: Callable[[], bool]) -> None:
        """Send all of `data`; discard the rest if the client reads none and `interrupted` returns True."""
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
        """End all waits of this transport; may be called from any thread."""
        if not self._closed:
            self._closed = True
            os.write(self._wake_write, b"x")

    def release(self) -> None:
        """Close the transport's wake-up pipe, once no thread waits on it."""
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _ready(self, timeout_s: float | None) -> bool:
        if not self._closed:
            readable = select.select([self._master, self._wake_read], [], [], timeout_s)[0]
            if not self._closed:
                return bool(readable)
        raise OSError("the terminal was closed by the server")


class TerminalServer(InstrumentServer):
    """A pseudo-terminal for one instrument; a context manager. Clients open `path`.

    Several clients may open and close `path`, in turn or at once; the terminal stays. Dropping the
    connections discards the data on the wire. While connections are refused, nothing is read or sent.
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
        """The VISA resource of the terminal."""
        return f"ASRL{self.path}::INSTR"

    def start(self) -> None:
        """Open a pseudo-terminal and serve it. Raises `OSError` if the system provides none."""
        import tty  # here, because systems without terminals lack this module

        self._master, self._slave = os.openpty()
        # Our own descriptor of the slave keeps the terminal alive between clients. Without raw mode it would
        # echo the instrument's replies back to the instrument.
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
        """Close the terminal and wait for its thread."""
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
        """Discard the data on the wire and continue to serve."""
        with self._state_lock:
            if self._transport is not None:
                self._transport.close()
                self._discard()

    def refuse(self, duration_s: float = 0.0) -> None:
        """Neither read nor send for `duration_s`, s; if that is 0, until `accept_again` is called."""
        self._accepts.clear()
        self._accept_later(duration_s, self.accept_again)
        self.drop_connections()

    def accept_again(self) -> None:
        """Serve the wire again after `refuse`; input sent meanwhile is discarded."""
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
        """Discard the data on the wire in both directions."""
        import termios

        if self._master < 0:
            return
        termios.tcflush(self._master, termios.TCIOFLUSH)
        with contextlib.suppress(BlockingIOError):
            while os.read(self._master, _PTY_CHUNK):
                pass
