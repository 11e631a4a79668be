"""What an exception of the wire means to the operator, and how patient the wire is."""

from __future__ import annotations

import errno
import socket
from collections.abc import Iterator
from typing import Final

from pyvisa.constants import StatusCode
from pyvisa.errors import VisaIOError

Cause = tuple[str, str]

_PORT_GONE: Final = (
    "is gone: the port failed",
    "check that the serial adapter is plugged in and start again",
)
_CLOSED_IN_USE: Final = ("was closed while it was in use", "open the instrument and take this step again")
_CHECK_POWER: Final = "check that it is on and its cable sits, then start again"

_BY_ERRNO: Final[dict[int, Cause]] = {
    errno.ECONNREFUSED: (
        "refused the connection",
        "check that the instrument is on and that address and port in the bench file are right",
    ),
    errno.EHOSTUNREACH: ("cannot be reached", "check the network cable and the address in the bench file"),
    errno.ENETUNREACH: ("cannot be reached", "check the network cable and the address in the bench file"),
    errno.ETIMEDOUT: ("cannot be reached", "check the network cable and the address in the bench file"),
    errno.ECONNRESET: ("broke the connection", _CHECK_POWER),
    errno.ECONNABORTED: ("broke the connection", _CHECK_POWER),
    errno.EPIPE: ("broke the connection", _CHECK_POWER),
    errno.ENOENT: (
        "does not exist on this computer",
        "plug the serial adapter in, and check the port's name in the bench file",
    ),
    errno.EACCES: (
        "may not be opened by this user",
        "give the user the right to it (on Linux: the group dialout) and log in again",
    ),
    errno.EBUSY: ("is in use by another program", "close the other program and start again"),
    errno.EBADF: _CLOSED_IN_USE,
    errno.EIO: _PORT_GONE,
    errno.ENXIO: _PORT_GONE,
    errno.ENODEV: _PORT_GONE,
}

_BY_STATUS: Final[dict[int, Cause]] = {
    StatusCode.error_timeout: ("did not respond in time", _CHECK_POWER),
    StatusCode.error_connection_lost: ("broke the connection", _CHECK_POWER),
    StatusCode.error_resource_not_found: (
        "was not found",
        "check that the instrument is on and its address in the bench file is right",
    ),
    StatusCode.error_invalid_resource_name: (
        "is not an address that can be understood",
        "write it like TCPIP::192.0.2.5::5025::SOCKET, GPIB0::22::INSTR or ASRL/dev/ttyUSB0::INSTR",
    ),
    StatusCode.error_resource_locked: (
        "is locked by another program or computer",
        "end the program that uses it, or wait for it",
    ),
    StatusCode.error_no_listeners: (
        "has no listener on the GPIB bus",
        "check the instrument's GPIB address, its power and the cable",
    ),
}

_BY_LIBRARY: Final[dict[str, Cause]] = {
    "gpib": (
        "needs a GPIB library, which this computer lacks",
        "install linux-gpib or gpib-ctypes, or connect the instrument by LAN or RS-232",
    ),
    "pyusb": ("needs pyusb, which this computer lacks", "install pyusb, or connect by LAN or RS-232"),
}

_BY_CLASS: Final[dict[str, Cause]] = {  # by name: termios cannot be imported where there are no terminals
    "termios.error": (
        "does not take these serial settings",
        "use a real serial port, or 8 data bits without parity on the instrument and in the bench file",
    ),
    "serial.serialutil.SerialException": _PORT_GONE,
    "pyvisa.errors.InvalidSession": _CLOSED_IN_USE,
}

_UNKNOWN_HOST: Final = (
    "names a host that is not known",
    "check the host name in the bench file, or write the numerical address",
)


class WireError(Exception):
    """What went wrong on a wire of our own making: cause and remedy are known where it is raised."""

    def __init__(self, cause: str, remedy: str) -> None:
        super().__init__(f"{cause}; {remedy}")
        self.cause = cause
        self.remedy = remedy


def probable_cause(error: BaseException) -> Cause:
    """Return (what happened, what to do) for an exception out of pyvisa, pyvisa-py, pyserial, a socket.

    The first half continues a sentence that begins with the resource. pyvisa-py wraps some causes in a
    plain `Exception`, so those that it was raised from are looked at as well.
    """
    for link in _chain(error):
        cause = _known(link)
        if cause is not None:
            return cause
    first_line = (str(error).splitlines() or [""])[0] or "no more is known"
    return f"failed with {type(error).__name__} ({first_line})", _CHECK_POWER


def _known(error: BaseException) -> Cause | None:
    match error:
        case WireError():
            return error.cause, error.remedy
        case socket.gaierror():
            return _UNKNOWN_HOST
        case VisaIOError():
            return _BY_STATUS.get(error.error_code)
        case OSError():
            # a bare TimeoutError, without a number, is our own giving up
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


HASTY_S: Final = 1.0
"""Long enough for an instrument that is there: its reply is waited for no longer in haste."""


class Haste:
    """Whether waiting is to be cut short; what was to be sent is sent all the same."""

    def __init__(self) -> None:
        self.asked = False

    def limited_s(self, timeout_s: float) -> float:
        """Return how long to wait for what may otherwise take `timeout_s`."""
        return min(timeout_s, HASTY_S) if self.asked else timeout_s
