"""One program at an instrument: whoever opens it holds a lock of the operating system in a folder of the user's.

A lock is of a file that its program has open: when that ends, however it ends, the lock is free. Beside it stands
who holds it since when, for the refusal to name. It guards against programs of the same user on this computer;
against other users and computers only an instrument's own lock does (`Connection.take_own_lock`).
"""

from __future__ import annotations

import getpass
import hashlib
import json
import os
import re
import socket
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Final

from filelock import FileLock, Timeout
from pyvisa.rname import InvalidResourceName, ResourceName

from drivers.clock import utc_now
from drivers.interfaces import InstrumentRefused

_ADAPTER: Final = re.compile(r"prologix://(/\S+|COM\d+|[^\s/:]+(?::\d+)?)/\d{1,2}", re.IGNORECASE)
_PORT: Final = re.compile(r"ASRL(/\S+|COM\d+)::INSTR", re.IGNORECASE)
_SERIAL: Final = re.compile(r"/|COM\d+$", re.IGNORECASE)
_KINDS: Final = ("INSTR", "SOCKET", "INTFC")
_ADAPTER_PORT: Final = ":1234"
_NO_LOCKS: Final = (OSError, NotImplementedError)
"""What comes of a folder that cannot be written, or whose file system has no locks: then nothing is held."""


def normalised(resource: str) -> str:
    """Return one name for all the ways in which a resource may be written.

    An adapter stands for all instruments behind it, a serial port for the device that its links lead to; a host's
    name is not looked up.
    """
    if (adapter := _ADAPTER.fullmatch(resource)) is not None:
        place = adapter[1]
        if _SERIAL.match(place):
            return _device(place)
        return f"adapter {_host(place).removesuffix(_ADAPTER_PORT)}"
    if (port := _PORT.fullmatch(resource)) is not None:
        return _device(port[1])
    parts = [part.upper() if part.upper() in _KINDS else part for part in resource.split("::")]
    interface = re.match(r"[A-Za-z-]+\d*", parts[0])
    if interface is not None:
        parts[0] = interface[0].upper() + parts[0][interface.end() :]
    with suppress(InvalidResourceName, ValueError):
        parts = str(ResourceName.from_string("::".join(parts))).split("::")
    return "::".join(_number(part) or _host(part) for part in parts)


def _device(port: str) -> str:
    return f"port {os.path.realpath(port) if port.startswith('/') else port.upper()}"


def _host(text: str) -> str:
    return re.sub(r"^localhost\b", "127.0.0.1", text.lower())


def _number(text: str) -> str:
    """Return a number as decimal: USB writes its own in either way."""
    return str(int(text, 16)) if re.fullmatch(r"0[xX][0-9a-fA-F]+", text) else ""


class Holding:
    """The locks of this program, in `folder`; an instrument that it opens twice it holds once."""

    _held: Final[dict[Path, tuple[FileLock, int]]] = {}
    _guard: Final = threading.Lock()

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def take(self, name: str, resource: str, called: str = "") -> None:
        """Hold the instrument `name`. Raises `InstrumentRefused` with who holds it already.

        The refusal has the resource by what it is `called`, where it is a name that nobody has typed.
        """
        path = self._path(resource)
        with self._guard:
            lock, times = self._held.get(path, (None, 0))
            if lock is None:
                try:
                    self._folder.mkdir(parents=True, exist_ok=True)
                    lock = FileLock(path, thread_local=False)
                    lock.acquire(timeout=0.0)
                except Timeout:
                    raise self._refusal(name, called or resource, path) from None
                except _NO_LOCKS:
                    return
                self._say_who(path)
            self._held[path] = (lock, times + 1)

    def release(self, resource: str) -> None:
        """Let an instrument go that was taken; never raises."""
        path = self._path(resource)
        with self._guard, suppress(*_NO_LOCKS):
            lock, times = self._held.pop(path, (None, 0))
            if lock is not None and times > 1:
                self._held[path] = (lock, times - 1)
            elif lock is not None:
                path.with_suffix(".json").unlink(missing_ok=True)
                lock.release()

    def _path(self, resource: str) -> Path:
        return self._folder / f"{hashlib.sha256(normalised(resource).encode()).hexdigest()[:24]}.lock"

    @staticmethod
    def _say_who(path: Path) -> None:
        with suppress(OSError):
            text = json.dumps({"who": _who(), "since": utc_now().astimezone().strftime("%Y-%m-%d %H:%M:%S")})
            part = path.with_suffix(f".{os.getpid()}")
            part.write_text(text, encoding="utf-8")
            part.replace(path.with_suffix(".json"))

    @staticmethod
    def _refusal(name: str, resource: str, path: Path) -> InstrumentRefused:
        try:
            told = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
            holder = f"{told['who']} since {told['since']}"
        except (OSError, ValueError, KeyError, TypeError):
            holder = "another program"  # it has only just begun
        return InstrumentRefused(name, f"{resource} is in use by {holder}", "end that program or wait for it")


def _who() -> str:
    """Say which program this is: its command, user, computer and process."""
    try:
        user = getpass.getuser()
    except (OSError, KeyError):
        user = "somebody"
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])[:120]
    shown = "".join(c if c.isprintable() else "?" for c in command)
    return f"'{shown}' ({user} on {socket.gethostname()}, process {os.getpid()})"
