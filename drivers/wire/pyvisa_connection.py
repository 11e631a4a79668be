"""A connection through pyvisa-py with workarounds for defects of the library.

As of pyvisa-py 0.8.1: a refused connection counts as open until the first write; VI_ATTR_TCPIP_NODELAY cannot be
set; a read from a socket whose peer has closed busy-waits for the whole timeout; opening may block as long as a
name server does; a closed session is never freed. Library exceptions pass through.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import select
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Final, Literal, cast

import pyvisa
from pyvisa import constants
from pyvisa.constants import StatusCode
from pyvisa.errors import VisaIOError
from pyvisa.resources import (
    GPIBInstrument,
    MessageBasedResource,
    SerialInstrument,
    TCPIPInstrument,
    TCPIPSocket,
)

from drivers.clock import Clock, SystemClock
from drivers.interfaces import message

# --- causes of transport exceptions -----------------------------------------------------------------

Cause = tuple[str, str]
"""The cause of a failure and its remedy, as texts; `{0}` in the cause stands for the resource."""

_PORT_GONE: Final = (
    message("{0} was lost: the port failed"),
    message("check that the serial adapter is plugged in"),
)
_CLOSED_IN_USE: Final = (
    message("{0} was closed while it was in use"),
    message("open the instrument and take this step again"),
)
_CHECK_POWER: Final = message("check its power and its cable")
_BROKEN: Final = (message("{0} broke the connection"), _CHECK_POWER)

_BY_ERRNO: Final[dict[int, Cause]] = {
    errno.ECONNREFUSED: (
        message("{0} refused the connection"),
        message("check that the instrument is on and that address and port in the bench file are right"),
    ),
    **dict.fromkeys(
        (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ETIMEDOUT),
        (
            message("{0} cannot be reached"),
            message("check the network cable and the address in the bench file"),
        ),
    ),
    **dict.fromkeys((errno.ECONNRESET, errno.ECONNABORTED, errno.EPIPE), _BROKEN),
    errno.ENOENT: (
        message("{0} does not exist on this computer"),
        message("plug the serial adapter in, and check the port's name in the bench file"),
    ),
    errno.EACCES: (
        message("{0} may not be opened by this user"),
        message(
            "give the user access (on Linux: the group dialout for serial ports, a udev rule for USB) "
            "and log in again"
        ),
    ),
    errno.EBUSY: (
        message("{0} is in use by another program"),
        message("close the other program"),
    ),
    errno.EBADF: _CLOSED_IN_USE,
    errno.EIO: _PORT_GONE,
    errno.ENXIO: _PORT_GONE,
    errno.ENODEV: _PORT_GONE,
}

_BY_STATUS: Final[dict[int, Cause]] = {
    StatusCode.error_timeout: (message("{0} did not respond in time"), _CHECK_POWER),
    StatusCode.error_connection_lost: _BROKEN,
    StatusCode.error_resource_not_found: (
        message("{0} was not found"),
        message("check that the instrument is on and its address in the bench file is right"),
    ),
    StatusCode.error_invalid_resource_name: (
        message("{0} is not a valid address"),
        message("write it like TCPIP::192.0.2.5::5025::SOCKET, GPIB0::22::INSTR or ASRL/dev/ttyUSB0::INSTR"),
    ),
    StatusCode.error_resource_locked: (
        message("{0} is locked by another program or computer"),
        message("end the program that uses it, or wait for it"),
    ),
    StatusCode.error_no_listeners: (
        message("{0} has no listener on the GPIB bus"),
        message("check the instrument's GPIB address, its power and the cable"),
    ),
}

_BY_LIBRARY: Final[dict[str, Cause]] = {
    "gpib": (
        message("{0} needs a GPIB library, which this computer lacks"),
        message("install linux-gpib or gpib-ctypes, or connect the instrument by LAN or RS-232"),
    ),
    "pyusb": (
        message("{0} needs pyusb, which this computer lacks"),
        message("install pyusb, or connect by LAN or RS-232"),
    ),
    "no backend available": (
        message("{0} needs the library libusb, which this computer lacks"),
        message("install libusb 1.0, or connect by LAN or RS-232"),
    ),
}

_BY_CLASS: Final[dict[str, Cause]] = {  # by name: termios cannot be imported where there are no terminals
    "termios.error": (
        message("{0} does not accept these serial settings"),
        message(
            "use a real serial port, or 8 data bits without parity on the instrument and in the bench file"
        ),
    ),
    "serial.serialutil.SerialException": _PORT_GONE,
    "pyvisa.errors.InvalidSession": _CLOSED_IN_USE,
}

_UNKNOWN_HOST: Final = (
    message("{0} names an unknown host"),
    message("check the host name in the bench file, or write the numerical address"),
)


class WireError(Exception):
    """An error of a transport implemented in `drivers.wire`, with its cause and remedy."""

    def __init__(self, cause: str, remedy: str) -> None:
        super().__init__(f"{cause}; {remedy}")
        self.cause = cause
        self.remedy = remedy


def probable_cause(error: BaseException) -> Cause:
    """Return (what happened, what to do) for an exception from pyvisa, pyvisa-py, pyserial or a socket.

    In the first text, `{0}` stands for the resource. pyvisa-py wraps some causes in a
    plain `Exception`, so the chain of causes is searched, too.
    """
    for link in _chain(error):
        cause = _known(link)
        if cause is not None:
            return cause
    first_line = (str(error).splitlines() or [""])[0] or "no details"
    return f"{{0}} failed with {type(error).__name__} ({first_line})", _CHECK_POWER


def _known(error: BaseException) -> Cause | None:
    match error:
        case WireError():
            return error.cause, error.remedy
        case socket.gaierror():
            return _UNKNOWN_HOST
        case VisaIOError():
            return _BY_STATUS.get(error.error_code)
        case OSError():
            # a TimeoutError without errno comes from `_open_in_time`
            number = errno.ETIMEDOUT if isinstance(error, TimeoutError) else error.errno
            if number is not None:
                return _BY_ERRNO.get(number)
        case ValueError():
            text = str(error).lower()
            return next((cause for library, cause in _BY_LIBRARY.items() if library in text), None)
    return _BY_CLASS.get(f"{type(error).__module__}.{type(error).__name__}")


def _chain(error: BaseException) -> Iterator[BaseException]:
    link: BaseException | None = error
    while link is not None:
        yield link
        link = link.__cause__ or link.__context__


# --- the connection ---------------------------------------------------------------------------------

_QUIET_S: Final = 0.1
_OPENING_MARGIN_S: Final = 0.5
_CHUNK_BYTES: Final = 4096

_FLOW: Final = {
    "none": constants.ControlFlow.none,
    "xon_xoff": constants.ControlFlow.xon_xoff,
    "rts_cts": constants.ControlFlow.rts_cts,
    "dtr_dsr": constants.ControlFlow.dtr_dsr,
}


@dataclass(frozen=True, slots=True)
class SerialSettings:
    """Settings of a serial port; the defaults suit a 34401A set to 9600 baud, no parity.

    `flow` "dtr_dsr" leaves DTR asserted, as the meter requires; the port does the handshake itself.
    `device_clear` is sent after a lost reply, to keep the instrument from sending that reply late. Source: 34401A
    User's Guide, chapter 4, RS-232 interface configuration.
    """

    baud_rate: int = 9600
    data_bits: Literal[7, 8] = 8
    parity: Literal["none", "even", "odd"] = "none"
    stop_bits: Literal[1, 2] = 2
    flow: Literal["none", "xon_xoff", "rts_cts", "dtr_dsr"] = "dtr_dsr"
    device_clear: bytes = b"\x03"

    @property
    def character_time_s(self) -> float:
        """Transmission time of one character, including start, parity and stop bits, s."""
        bits = 1 + self.data_bits + (self.parity != "none") + self.stop_bits
        return bits / self.baud_rate


_PSEUDO_TERMINALS: Final = ("/dev/pts/", "/dev/ttys")
"""The paths of pseudo-terminals on Linux and on macOS."""


class Connection:
    """An open VISA resource. `by_bytes` says whether it delivers single bytes (True) or whole messages.

    Sockets and serial ports are read as bytes arrive; GPIB, USB and VXI-11 deliver whole messages.
    """

    def __init__(self, visa: MessageBasedResource) -> None:
        self._visa = visa
        self._interface = _interface(visa)
        self._socket = self._interface if isinstance(self._interface, socket.socket) else None
        self._end = b"\n"
        self._clock: Clock = SystemClock()
        self.by_bytes = _has_fileno(self._interface)

    @classmethod
    def open(
        cls, resource: str, *, timeout_s: float, read_termination: str, serial: SerialSettings
    ) -> Connection:
        """Open `resource`, verify that it is connected, set the port up and lock the instrument.

        The opening may take `timeout_s` + 0.5 s, the lock another `timeout_s`.
        """
        connection = cls(_open_in_time(resource, timeout_s))
        try:
            connection._prove_and_tune()
            connection._set_up(timeout_s, read_termination, serial)
            connection.take_own_lock(timeout_s)
        except BaseException:
            connection.close()
            raise
        return connection

    def close(self) -> None:
        """Close the resource, and the underlying port even if pyvisa fails to. Never raises."""
        _discard(self._visa)

    def take_own_lock(self, timeout_s: float) -> None:
        """Lock the instrument against other computers, if its interface has a lock (with pyvisa-py: VXI-11).

        Raises `VisaIOError` if another client has the lock. The end of the connection releases the lock.
        """
        if isinstance(self._visa, TCPIPInstrument):
            try:
                self._visa.lock_excl(timeout=timeout_s * 1000.0)
            except KeyError:  # an error code unknown to pyvisa-py: the instrument cannot be locked
                return
            except pyvisa.errors.VisaIOError as error:
                if error.error_code == constants.StatusCode.error_resource_locked:
                    raise

    def interrupt(self) -> None:
        """End another thread's wait on a socket, which closing the socket would not end. Never raises."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)

    def send(self, data: bytes, timeout_s: float) -> bool:
        """Send the bytes; return False if the peer accepts none within `timeout_s`.

        A socket is written to directly: pyvisa-py would wait for ever for such a peer, and is slow.
        """
        if self._socket is None:
            self._visa.write_raw(data)
            return True
        while data:
            try:
                data = data[self._socket.send(data) :]
            except BlockingIOError:
                if not select.select([], [self._socket], [], timeout_s)[1]:
                    return False
        return True

    def wait(self, timeout_s: float) -> bool:
        """Return whether bytes or the peer's close arrive within `timeout_s`; call it only if `by_bytes`."""
        return bool(select.select([self._interface], [], [], timeout_s)[0])

    def take(self) -> tuple[bytes, bool]:
        """Return the bytes received up to the end of a line, and whether more bytes follow.

        Call it after `wait` has returned True; empty bytes mean that the peer has closed. On a socket the bytes
        after the line end are lost, so the caller must then drop the connection.
        """
        if self._socket is not None:
            arrived = self.take_all()
            line_bytes = (arrived.find(self._end) + 1) or len(arrived)
            return arrived[:line_bytes], line_bytes < len(arrived)
        waiting = max(1, self._buffered())
        data = self._visa.read_bytes(waiting, break_on_termchar=True)
        return data, len(data) < waiting

    def take_all(self) -> bytes:
        """Return all bytes received, whether or not a line end is among them; empty bytes as in `take`."""
        if self._socket is not None:
            return self._socket.recv(_CHUNK_BYTES)
        return self._visa.read_bytes(max(1, self._buffered()))

    def take_message(self, timeout_s: float) -> bytes:
        """Return one whole message from an interface that marks its end (`by_bytes` is False)."""
        self._visa.timeout = timeout_s * 1000.0
        return self._visa.read_raw()

    def resynchronise(self, device_clear: bytes, timeout_s: float) -> bool:
        """Discard a late reply on GPIB or a serial port; return False if data keeps arriving for `timeout_s`.

        A socket is not cleared, because that might never end; a new socket begins a new stream anyway.
        """
        if isinstance(self._visa, GPIBInstrument):
            self._visa.clear()
        elif isinstance(self._visa, SerialInstrument):
            self._visa.write_raw(device_clear)
            deadline_s = self._clock.now_s() + timeout_s
            self._clock.sleep(_QUIET_S)
            while self._buffered():
                if self._clock.now_s() > deadline_s:
                    return False
                self._visa.flush(constants.BufferOperation.discard_read_buffer)
                self._clock.sleep(_QUIET_S)
        return True

    def _buffered(self) -> int:
        """Return the number of bytes waiting in a serial port."""
        return int(cast("SerialInstrument", self._visa).bytes_in_buffer)

    def _prove_and_tune(self) -> None:
        """On a socket, raise the `OSError` of a failed connection attempt and disable Nagle's algorithm.

        With Nagle's delay, a query after a write waits some 40 ms for the peer's acknowledgement.
        """
        if self._socket is not None:
            code = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
            if code:
                raise OSError(code, os.strerror(code))
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._socket.setblocking(False)

    def _on_pseudo_terminal(self) -> bool:
        """Return whether the port is a pseudo-terminal: it carries whole bytes, and refuses any other framing."""
        return self.by_bytes and os.ttyname(self._interface.fileno()).startswith(_PSEUDO_TERMINALS)

    def _set_up(self, timeout_s: float, read_termination: str, serial: SerialSettings) -> None:
        visa = self._visa
        visa.timeout = timeout_s * 1000.0
        self._end = read_termination[-1:].encode("ascii")
        if isinstance(visa, (TCPIPSocket, SerialInstrument)):
            visa.read_termination = read_termination
        if isinstance(visa, SerialInstrument):
            wanted: dict[str, object] = {
                "baud_rate": serial.baud_rate,
                "data_bits": serial.data_bits,
                "parity": constants.Parity[serial.parity],
                "stop_bits": constants.StopBits["one" if serial.stop_bits == 1 else "two"],
                "flow_control": _FLOW[serial.flow],
            }
            if self._on_pseudo_terminal():
                del wanted["data_bits"], wanted["parity"]
            for attribute, value in wanted.items():
                if getattr(visa, attribute) != value:  # a pseudo-terminal refuses even to set the same value
                    setattr(visa, attribute, value)


_manager: pyvisa.ResourceManager | None = None
_manager_lock = threading.Lock()


def _resource_manager() -> pyvisa.ResourceManager:
    """Return the one resource manager that all connections share."""
    global _manager  # noqa: PLW0603 - one per process, as pyvisa expects
    with _manager_lock:
        if _manager is None:
            _manager = pyvisa.ResourceManager("@py")
        return _manager


def _open_in_time(resource: str, timeout_s: float) -> MessageBasedResource:
    """Open the resource in a separate thread, within `timeout_s` (+ 0.5 s); close a resource that opens late.

    The resource manager is made before this time begins, because its imports can take seconds.
    """
    opened: Future[MessageBasedResource] = Future()
    manager = _resource_manager()

    def work() -> None:
        try:
            milliseconds = max(1, round(timeout_s * 1000.0))
            visa = manager.open_resource(resource, open_timeout=milliseconds)
            opened.set_result(cast("MessageBasedResource", visa))
        except Exception as error:
            opened.set_exception(error)  # re-raised in the caller's thread

    threading.Thread(target=work, name=f"open {resource}", daemon=True).start()
    try:
        return opened.result(timeout_s + _OPENING_MARGIN_S)
    except BaseException:
        opened.add_done_callback(_discard_late)
        raise


def _discard_late(opened: Future[MessageBasedResource]) -> None:
    if opened.exception() is None:
        _discard(opened.result())


def _discard(visa: MessageBasedResource) -> None:
    with contextlib.suppress(Exception):
        handle, sessions, interface = visa.session, _sessions(visa), _interface(visa)
        with contextlib.suppress(Exception):
            visa.close()
        sessions.pop(handle, None)
        if isinstance(interface, (io.IOBase, socket.socket)):
            interface.close()


def _sessions(visa: MessageBasedResource) -> dict[int, Any]:
    """Return pyvisa-py's table of sessions by handle."""
    return cast("dict[int, Any]", cast("Any", visa.visalib).sessions)


def _interface(visa: MessageBasedResource) -> Any:
    """Return the socket, pyserial port or other object on which pyvisa-py bases the resource."""
    return getattr(_sessions(visa).get(visa.session), "interface", None)


def _has_fileno(interface: Any) -> bool:
    """Return whether `select` can wait on the interface: not on GPIB, USB, VXI-11 or a Windows serial port."""
    if not isinstance(interface, (io.IOBase, socket.socket)):
        return False
    try:
        interface.fileno()
    except (AttributeError, io.UnsupportedOperation):
        return False
    return True
