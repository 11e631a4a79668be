"""VISA resources of this computer: their discovery, and locks against use by two programs at once."""

from __future__ import annotations

import getpass
import hashlib
import importlib.util
import json
import os
import re
import socket
import sys
import threading
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from filelock import FileLock, Timeout
from pyvisa.rname import InvalidResourceName, ResourceName

from drivers.clock import utc_now
from drivers.interfaces import InstrumentRefused, message

# --- discovery --------------------------------------------------------------------------------------
# As of pyvisa-py 0.8.1 a search takes some two seconds, waiting for replies from the network. It needs optional
# packages for GPIB, USB and parts of the network. It cannot find raw SCPI sockets, which do not announce
# themselves.

_PACKAGES: Final = {
    "psutil": message(
        "only the network of the default interface was searched (install psutil to search all)"
    ),
    "zeroconf": message(
        "instruments that announce themselves as HiSLIP were not searched (install zeroconf)"
    ),
}
"""What is not searched without an optional package, by the package that pyvisa-py warns about."""
_LIBRARIES: Final = {
    ("gpib", "gpib_ctypes"): message("GPIB boards were not searched (install linux-gpib or gpib-ctypes)"),
    ("usb",): message("USB was not searched (install pyusb)"),
}
"""What is not searched if none of several packages is installed; pyvisa-py does not report their absence."""
SOCKETS: Final = message(
    "raw SCPI sockets (TCPIP::HOST::5025::SOCKET), chambers and heads on a network cannot be found this way: "
    "see the address on the instrument's own display"
)


@dataclass(frozen=True)
class SerialPort:
    """A serial port: its VISA name, its device name, and a description of its adapter."""

    resource: str
    device: str
    description: str


@dataclass(frozen=True)
class Offer:
    """The resources found; `notes` says which interfaces could not be searched, and why."""

    resources: tuple[str, ...]
    serial_ports: tuple[SerialPort, ...]
    notes: tuple[str, ...]


def discover(
    list_resources: Callable[[], tuple[str, ...]] | None = None,
    list_ports: Callable[[], tuple[SerialPort, ...]] | None = None,
) -> Offer:
    """Search all interfaces and return the resources found. Never raises: failures become notes.

    The arguments replace the searches for VISA resources and serial ports, for tests.
    """
    notes: list[str] = []
    resources: tuple[str, ...] = ()
    ports: tuple[SerialPort, ...] = ()
    with warnings.catch_warnings(record=True) as missed:
        warnings.simplefilter("always")
        try:
            resources = (list_resources or _visa_resources)()
        except Exception as error:  # the underlying libraries may raise anything
            notes.append(message(f"VISA resources could not be searched ({type(error).__name__}: {error})"))
    try:
        ports = (list_ports or _serial_ports)()
    except Exception as error:
        notes.append(message(f"serial ports could not be searched ({type(error).__name__}: {error})"))
    said = " ".join(str(warning.message) for warning in missed)
    notes += [text for package, text in _PACKAGES.items() if package in said]
    notes += [text for names, text in _LIBRARIES.items() if not any(map(importlib.util.find_spec, names))]
    # pyvisa-py also lists each serial port as a Prologix GPIB adapter, whatever is plugged in.
    own = {port.resource for port in ports}
    resources = tuple(r for r in resources if not r.startswith("PRLGX") and r not in own)
    return Offer(resources, ports, (*notes, SOCKETS))


def _visa_resources() -> tuple[str, ...]:
    import pyvisa

    return pyvisa.ResourceManager("@py").list_resources("?*")


def _serial_ports() -> tuple[SerialPort, ...]:
    from serial.tools import list_ports

    return tuple(
        SerialPort(
            f"ASRL{port.device}::INSTR", port.device, "" if port.description == "n/a" else port.description
        )
        for port in sorted(list_ports.comports())
    )


# --- one program at an instrument -------------------------------------------------------------------
# A lock is on a file that the program holds open, so it is released however the program ends. A second file beside
# it names the holder and the time, for the refusal. It guards against programs of the same user on this computer;
# against other users and computers only an instrument's own lock helps (`Connection.take_own_lock`).

_ADAPTER: Final = re.compile(r"prologix://(/\S+|COM\d+|[^\s/:]+(?::\d+)?)/\d{1,2}", re.IGNORECASE)
_PORT: Final = re.compile(r"ASRL(/\S+|COM\d+)::INSTR", re.IGNORECASE)
_SERIAL: Final = re.compile(r"/|COM\d+$", re.IGNORECASE)
_KINDS: Final = ("INSTR", "SOCKET", "INTFC")
_ADAPTER_PORT: Final = ":1234"
_NO_LOCKS: Final = (OSError, NotImplementedError)
"""Errors of a folder that cannot be written, or of a file system without locks: then nothing is locked."""


def normalised(resource: str) -> str:
    """Return one name for all usual spellings of a resource.

    The case, optional parts, hexadecimal or decimal numbers, and localhost or 127.0.0.1 make no difference.
    Leading zeros make a difference (`GPIB0::022`, `GPIB0::22`), and so do a host's name and its address,
    because host names are not resolved. Instruments behind one adapter share the adapter's name. A serial
    port is named after the device to which its symbolic links resolve.
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
    """Return a hexadecimal number as decimal ("" for other text): USB resources may be written either way."""
    return str(int(text, 16)) if re.fullmatch(r"0[xX][0-9a-fA-F]+", text) else ""


class Holding:
    """The locks of this program, as files in `folder`; a resource locked twice must be released twice."""

    _held: Final[dict[Path, tuple[FileLock, int]]] = {}
    _guard: Final = threading.Lock()

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def take(self, name: str, resource: str, called: str = "") -> None:
        """Lock the resource of instrument `name`; if files in the folder cannot be locked, lock nothing.

        Raises `InstrumentRefused`, which names the holder, if another program has locked it. The message
        calls the resource `called`, if that is not empty, for example for a resource that no person typed.
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
        """Release a resource locked by `take`. Never raises."""
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
            holder = "another program"  # it has not yet written its name
        return InstrumentRefused(name, f"{resource} is in use by {holder}", "end that program or wait for it")


def _who() -> str:
    """Return a description of this program: its command, user, computer and process number."""
    try:
        user = getpass.getuser()
    except (OSError, KeyError):
        user = "somebody"
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])[:120]
    shown = "".join(c if c.isprintable() else "?" for c in command)
    return f"'{shown}' ({user} on {socket.gethostname()}, process {os.getpid()})"
