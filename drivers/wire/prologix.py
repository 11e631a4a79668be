"""GPIB through a Prologix adapter (GPIB-ETHERNET, GPIB-USB) or a compatible one.

A resource names both adapter and GPIB address: `prologix://192.0.2.10:1234/22` (default port 1234),
`prologix:///dev/ttyUSB0/22` or `prologix://COM3/22`. No other setup is needed; instruments whose resources
name the same adapter share its connection and its lock.

An adapter waits no longer than 3 s for a reply, but a reading may take minutes: the read is repeated until the
reply is complete. After each read the adapter is queried for its version. That line cannot come from an
instrument, so it marks the end of the read even if no reply came: a late reply is never taken for the reply
to a later query.
Source: Prologix GPIB-ETHERNET Controller User Manual and GPIB-USB Controller User Manual, chapters 7, 8.
"""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Iterator
from typing import Final

from pyvisa.constants import StatusCode
from pyvisa.errors import VisaIOError

from drivers.clock import Clock, SystemClock
from drivers.interfaces import message
from drivers.wire.pyvisa_connection import Connection, SerialSettings, WireError

SCHEME: Final = "prologix:"

READ_TIMEOUT_MS: Final = 1000
"""Timeout of the adapter for one read; between two reads the bus is free for other instruments."""

_RESOURCE: Final = re.compile(
    r"prologix://(?:(?P<device>/\S+|COM\d+)|(?P<host>[^\s/:]+)(?::(?P<port>\d{1,5}))?)"
    r"/(?P<address>\d{1,2})"
)
_PORT: Final = "1234"
_HIGHEST_ADDRESS: Final = 30

_SETTINGS: Final = (
    ("mode", "1"),  # controller of the bus
    ("auto", "0"),  # an instrument talks only after "++read"
    ("eoi", "1"),  # assert EOI at the end of a command
    ("eos", "2"),  # LF after each command
    ("eot_char", "10"),  # append LF when an instrument asserts EOI
    ("eot_enable", "1"),
    ("read_tmo_ms", str(READ_TIMEOUT_MS)),
)
_VERSION: Final = re.compile(rb"[\x20-\x7e]*(?:GPIB|AR488|Prologix)[\x20-\x7e]*", re.IGNORECASE)
_SAVES_EVERY_SETTING: Final = re.compile(rb"(?!.*AR488).*Prologix.*", re.IGNORECASE)
"""Matches the version text of a genuine Prologix; an AR488 may also have the word in its text."""
_ATTEMPTS: Final = 4
"""Queries for the version after opening: an Arduino adapter restarts then, and loses what it receives meanwhile."""
_ESCAPED: Final = re.compile(rb"([\r\n\x1b+])")
_SERIAL: Final = SerialSettings(baud_rate=115200, stop_bits=1, flow="none")
_MOST_BYTES: Final = 1 << 20
_NUL: Final = b"\0"
"""Some adapters send a NUL after a reply's LF; no instrument here sends one in a reply."""


class AdapterConnection:
    """A connection to one instrument behind an adapter, for `MessageSession`; it delivers whole messages."""

    def __init__(self, adapter: _Adapter, address: int, link_number: int) -> None:
        self._adapter = adapter
        self._address = address
        self._link_number = link_number
        self._interrupted = threading.Event()
        self._left = False
        self._clock: Clock = SystemClock()

    @classmethod
    def open(cls, resource: str, timeout_s: float) -> AdapterConnection:
        """Open a connection that shares the adapter's link; make the link first if there is none.

        Raises `WireError` for a malformed resource or a device that is no adapter, and the errors of
        `Connection.open`.
        """
        link_resource, address = parse(resource)
        adapter = _join(link_resource, timeout_s)
        try:
            return cls(adapter, address, adapter.linked())
        except BaseException:
            adapter.leave()
            raise

    @property
    def stands(self) -> bool:
        """Whether the adapter still has the link over which this connection was made.

        A failure at another instrument behind the adapter also drops the link.
        """
        return self._adapter.has_link(self._link_number)

    def close(self) -> None:
        """Release the adapter for this instrument; the last instrument closes the link.

        Never raises, may be called twice.
        """
        self._interrupted.set()
        if not self._left:
            self._left = True
            self._adapter.leave()

    def interrupt(self) -> None:
        """End another thread's wait for this instrument at its next read; other instruments are not affected."""
        self._interrupted.set()

    def send(self, data: bytes, timeout_s: float) -> bool:
        """Send one command; return False if the adapter accepts nothing within `timeout_s`."""
        with self._talking() as link:
            line = _ESCAPED.sub(b"\x1b\\1", data.rstrip(b"\r\n"))
            return link.send(b"++addr %d\n%b\n" % (self._address, line), timeout_s)

    def take_message(self, timeout_s: float) -> bytes:
        """Return one whole message, up to the end that the instrument marked (EOI).

        Raises `VisaIOError` if no message is complete within `timeout_s`.
        """
        deadline_s = self._clock.now_s() + timeout_s
        message = b""
        while True:
            with self._talking() as link:
                link.send(b"++addr %d\n++read eoi\n" % self._address, timeout_s)
                message += self._adapter.until_mark(link)
            if message.endswith(b"\n"):
                return message
            if self._clock.now_s() >= deadline_s or len(message) > _MOST_BYTES:
                raise VisaIOError(StatusCode.error_timeout)

    def resynchronise(self) -> bool:
        """Clear the instrument, which discards a late reply; return whether the adapter accepted the command."""
        with self._talking() as link:
            return link.send(b"++addr %d\n++clr\n" % self._address, self._adapter.timeout_s)

    @contextlib.contextmanager
    def _talking(self) -> Iterator[Connection]:
        if self._interrupted.is_set():
            raise WireError(
                message("{0} was closed while it was in use"),
                message("open the instrument and repeat this step"),
            )
        with self._adapter.talking(self._link_number) as link:
            yield link


class _Adapter:
    """An adapter, shared by its instruments.

    After any failure the link is dropped, and made again when an instrument is opened. Commands to other
    instruments over the old link may be lost, so their connections become invalid (`has_link`).
    """

    def __init__(self, resource: str, timeout_s: float) -> None:
        self.resource = resource
        self.timeout_s = timeout_s
        self.users = 0
        self._lock = threading.RLock()
        self._link: Connection | None = None
        self._link_number = 0
        self._version = b""
        self._clock: Clock = SystemClock()

    def leave(self) -> None:
        """Release the adapter for one instrument; the last one closes the link."""
        with _adapters_lock:
            self.users -= 1
            if self.users == 0:
                _adapters.pop(self.resource, None)
                self._drop()

    def linked(self) -> int:
        """Make the link if it is missing or broken; return its number."""
        with self._lock:
            if self._link is not None and not _is_quiet(self._link):
                self._drop()
            if self._link is None:
                self._link = self._make_link()
                self._link_number += 1
            return self._link_number

    def has_link(self, link_number: int) -> bool:
        """Return whether the current link has this number."""
        return self._link is not None and self._link_number == link_number

    @contextlib.contextmanager
    def talking(self, link_number: int) -> Iterator[Connection]:
        """Lock the adapter for one transaction over the link with this number; an exception drops the link."""
        with self._lock:
            if self._link is None or not self.has_link(link_number):
                raise WireError(
                    message("{0} lost the adapter's connection"),
                    message("check that the adapter is on, then repeat this step"),
                )
            try:
                if not _is_quiet(self._link):
                    raise WireError(
                        message("{0} broke the connection"),
                        message("check that no other program uses the adapter"),
                    )
                yield self._link
            except BaseException:
                self._drop()
                raise

    def until_mark(self, link: Connection) -> bytes:
        """Query the adapter's version as an end mark; return the bytes received before it."""
        link.send(b"++ver\n", self.timeout_s)
        deadline_s = self._clock.now_s() + READ_TIMEOUT_MS / 1000.0 + self.timeout_s
        data = b""
        while not (data.endswith(b"\n") and data.rstrip(b"\r\n").endswith(self._version)):
            data += self._more(link, deadline_s)
        return data.rstrip(b"\r\n").removesuffix(self._version)

    def _make_link(self) -> Connection:
        """Return a new link, after the adapter has reported its version and its settings are verified."""
        link = Connection.open(self.resource, timeout_s=self.timeout_s, read_termination="\n", serial=_SERIAL)
        try:
            self._version = self._first_version(link)
            if _SAVES_EVERY_SETTING.fullmatch(self._version):
                # A Prologix would save each setting in an EEPROM that wears out. Not sent to other adapters,
                # for which "++savecfg" means to save.
                link.send(b"++savecfg 0\n", self.timeout_s)
            for name, value in _SETTINGS:
                link.send(f"++{name} {value}\n++{name}\n".encode(), self.timeout_s)
                answer = self._line(link, re.compile(rb"\d+")).decode()
                if answer != value:
                    raise WireError(
                        f"{{0}} answers {answer} to ++{name}, not {value}, as a GPIB adapter",
                        message(
                            "check that it is a Prologix or compatible adapter, with its latest firmware"
                        ),
                    )
        except BaseException:
            link.close()
            raise
        return link

    def _first_version(self, link: Connection) -> bytes:
        """Query the adapter's version, repeatedly until it replies or the timeout passes; return the version."""
        for _ in range(_ATTEMPTS if link.by_bytes else 1):
            link.send(b"++ver\n", self.timeout_s)
            if link.by_bytes and link.wait(self.timeout_s / _ATTEMPTS):
                break
        return self._line(link, _VERSION)

    def _line(self, link: Connection, pattern: re.Pattern[bytes]) -> bytes:
        """Return the next line that matches; lines before it are late replies over an earlier link."""
        deadline_s = self._clock.now_s() + self.timeout_s
        data = b""
        while True:
            data += self._more(link, deadline_s)
            if data.endswith(b"\n"):
                line = data.rstrip(b"\r\n").rpartition(b"\n")[2]
                if pattern.fullmatch(line):
                    return line
                data = b""

    def _more(self, link: Connection, deadline_s: float) -> bytes:
        remaining_s = max(0.0, deadline_s - self._clock.now_s())
        if not link.by_bytes:  # a serial port of Windows
            return link.take_message(remaining_s).replace(_NUL, b"")
        if not link.wait(remaining_s):
            raise WireError(
                message("{0} did not answer as a GPIB adapter"),
                message("check the adapter's power, its address and the cable"),
            )
        chunk = link.take_all()
        if not chunk:
            raise WireError(
                message("{0} broke the connection"),
                message("check that the adapter is on, then repeat this step"),
            )
        return chunk.replace(_NUL, b"")

    def _drop(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()


_adapters: dict[str, _Adapter] = {}
"""The adapters in use, by the resource of their link: one object per adapter and process, as each has one bus."""

_adapters_lock = threading.Lock()


def _join(link_resource: str, timeout_s: float) -> _Adapter:
    with _adapters_lock:
        adapter = _adapters.setdefault(link_resource, _Adapter(link_resource, timeout_s))
        adapter.users += 1
        return adapter


def _is_quiet(link: Connection) -> bool:
    """Return whether only NUL bytes wait; other bytes show a broken link or another program at the adapter."""
    while link.by_bytes and link.wait(0.0):
        chunk = link.take_all()
        if not chunk or chunk.strip(_NUL):
            return False
    return True


def parse(resource: str) -> tuple[str, int]:
    """Return the VISA resource of the adapter's link and the GPIB address.

    Raises `WireError` for a malformed resource.
    """
    match = _RESOURCE.fullmatch(resource)
    if match is None or int(match["address"]) > _HIGHEST_ADDRESS:
        raise WireError(
            message("{0} is not a valid address"),
            "write it like prologix://192.0.2.10:1234/22 or prologix:///dev/ttyUSB0/22, "
            f"with a GPIB address of 0 to {_HIGHEST_ADDRESS}",
        )
    address = int(match["address"])
    device = match["device"]
    if device is not None:
        return f"ASRL{device.removeprefix('COM')}::INSTR", address  # VISA calls COM3 by its number
    return f"TCPIP0::{match['host']}::{match['port'] or _PORT}::SOCKET", address
