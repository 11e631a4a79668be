"""What the interfaces of this computer offer: VISA resources and serial ports. No instrument is addressed.

As of pyvisa-py 0.8.1 a search takes some two seconds, in which it waits for answers from the network. It needs
optional packages for GPIB, USB and parts of the network, and cannot find raw SCPI sockets, as these do not
announce themselves.
"""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

_PACKAGES: Final = {
    "psutil": "only the network of the default interface was searched (install psutil to search all)",
    "zeroconf": "instruments that announce themselves as HiSLIP were not searched (install zeroconf)",
}
"""By the package that pyvisa-py misses and warns of, what was not searched without it."""
_LIBRARIES: Final = {
    ("gpib", "gpib_ctypes"): "GPIB boards were not searched (install linux-gpib or gpib-ctypes)",
    ("usb",): "USB was not searched (install pyusb)",
}
"""By the packages of which pyvisa-py silently misses each, what was not searched without them."""
SOCKETS: Final = (
    "raw SCPI sockets (TCPIP::HOST::5025::SOCKET), chambers and heads on a network cannot be found this way: "
    "see the address on the instrument's own display"
)


@dataclass(frozen=True)
class SerialPort:
    """A serial port: its VISA name, its name on this computer, what is known of its adapter."""

    resource: str
    device: str
    description: str


@dataclass(frozen=True)
class Offer:
    """What was found; `notes` says what could not be searched, and why."""

    resources: tuple[str, ...]
    serial_ports: tuple[SerialPort, ...]
    notes: tuple[str, ...]


def discover(
    list_resources: Callable[[], tuple[str, ...]] | None = None,
    list_ports: Callable[[], tuple[SerialPort, ...]] | None = None,
) -> Offer:
    """Search all interfaces. Never raises: an interface that cannot be searched is a note."""
    notes: list[str] = []
    resources: tuple[str, ...] = ()
    ports: tuple[SerialPort, ...] = ()
    with warnings.catch_warnings(record=True) as missed:
        warnings.simplefilter("always")
        try:
            resources = (list_resources or _visa_resources)()
        except Exception as error:  # the libraries beneath raise anything
            notes.append(f"VISA resources could not be searched ({type(error).__name__}: {error})")
    try:
        ports = (list_ports or _serial_ports)()
    except Exception as error:
        notes.append(f"serial ports could not be searched ({type(error).__name__}: {error})")
    said = " ".join(str(warning.message) for warning in missed)
    notes += [text for package, text in _PACKAGES.items() if package in said]
    notes += [text for names, text in _LIBRARIES.items() if not any(map(importlib.util.find_spec, names))]
    # Each serial port is also offered as a GPIB adapter, whatever is plugged into it.
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
