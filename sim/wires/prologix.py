"""A simulated GPIB adapter of the Prologix kind, with simulated instruments on its bus.

The adapter is a dialect, served like an instrument on its own port. It passes each line to the instrument at the
selected address. On a read command it returns the instrument's reply if this is ready within the timeout, which is
3 s at most.
Source: Prologix GPIB-ETHERNET Controller User Manual, chapters 7 "Data Transmission" and 8 "Commands".
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, TypeVar

from sim.scpi import ScpiInstrument, never
from sim.wires.session import LineEnds, PlainDialect
from sim.world.clock import VirtualClock, wait_until

if TYPE_CHECKING:
    from collections.abc import Callable

    from drivers.clock import Clock
    from sim.wires.session import Dialect

VERSION: Final = "Prologix GPIB-ETHERNET Controller version 01.06.06.00"
UNRECOGNIZED: Final = b"Unrecognized command\r"

_INTERRUPTED: Final = -410
_UNTERMINATED: Final = -420

_HALF_ESCAPED: Final = re.compile(rb"(?:^|[^\x1b])(?:\x1b\x1b)*\x1b\Z", re.DOTALL)
_LINE_FEED: Final = 10
_TERMINATORS: Final = (b"\r\n", b"\r", b"\n", b"")

_RANGES: Final = {
    "addr": (0, 30),
    "auto": (0, 1),
    "eoi": (0, 1),
    "eos": (0, 3),
    "eot_char": (_LINE_FEED, _LINE_FEED),
    "eot_enable": (0, 1),
    "mode": (0, 1),
    "read_tmo_ms": (1, 3000),
    "savecfg": (0, 1),
}
"""Allowed values of each setting. The simulation supports only LF as the end-of-transmission character."""


@dataclass
class AdapterSettings:
    """The settings of an adapter; an adapter as shipped reads from the instrument after each command (`auto`)."""

    addr: int = 5
    auto: int = 1
    eoi: int = 1
    eos: int = 0
    eot_char: int = _LINE_FEED
    eot_enable: int = 0
    mode: int = 1
    read_tmo_ms: int = 200
    savecfg: int = 1


class LookaheadClock(VirtualClock):
    """The clock of one instrument on a bus, which may be ahead of the bench's clock.

    The instrument carries out commands at once and without waiting. Its clock then shows the time at which the
    reply is ready. The bench's time advances only while the adapter waits for that reply.
    """

    def __init__(self, bench: Clock) -> None:
        super().__init__()
        self._bench = bench
        self._ahead_s = -math.inf

    def now_s(self) -> float:
        """Return the later of the instrument's time and the bench's time, s."""
        return max(self._bench.now_s(), self._ahead_s)

    def sleep(self, duration_s: float) -> None:
        """Advance this clock by `duration_s`; the bench's clock does not advance."""
        self.advance_to(self.now_s() + max(0.0, duration_s))

    def advance_to(self, time_s: float) -> None:
        """Advance this clock to `time_s`; the bench's clock does not advance."""
        self._ahead_s = max(self._ahead_s, time_s)

    def return_to_present(self) -> None:
        """Set this clock back to the bench's time."""
        self._ahead_s = -math.inf


class _BusDevice:
    """An instrument on the bus, with its unfinished input, its reply and the time at which the reply is ready."""

    def __init__(self, instrument: ScpiInstrument, clock: LookaheadClock) -> None:
        self.instrument = instrument
        self.dialect: Dialect = instrument
        self.ready_s = 0.0
        self.reply: bytes | None = None
        self._clock = clock
        self._input = b""

    def listen(self, data: bytes, ended: bool) -> None:
        """Receive data; a message ends at LF or, if `ended` (EOI), at the end of the data."""
        *messages, self._input = (self._input + data).split(b"\n")
        if ended and self._input:
            messages.append(self._input)
            self._input = b""
        for message in messages:
            self.carry_out(message)

    def carry_out(self, message: bytes) -> None:
        """Carry out one message; a previous reply that was not read is lost (-410)."""
        if self.reply is not None:
            self.reply = None
            self.instrument.report(_INTERRUPTED)
        self.reply = self.dialect.handle(message, never)
        self.ready_s = self._clock.now_s()

    def return_to_present(self) -> None:
        """Set the instrument's clock back to the bench's time."""
        self._clock.return_to_present()
        self.ready_s = min(self.ready_s, self._clock.now_s())

    def clear(self) -> None:
        """Carry out a selected device clear."""
        self.reply = None
        self._input = b""
        self._clock.return_to_present()
        self.dialect.device_clear()


_Instrument = TypeVar("_Instrument", bound=ScpiInstrument)


class GpibAdapter(PlainDialect):
    """A GPIB adapter on the bench's `clock`; `attach` puts instruments on its bus.

    `version` is the reply to ++ver. An AR488 replies "AR488 version 6.102" or "Prologix AR488 HRK version 6.101"
    (Twilight-Logic/AR488 issues 22 and 50), and its ++savecfg saves at once. With `nul` the adapter sends a NUL
    after the LF of each reply, as a GPIB-USB does (pymeasure issue 954).
    `settings` are those at switch-on. `writes_to_memory` counts how often settings were saved (savecfg 1), because
    each write wears the adapter's memory.
    """

    model = "GPIB adapter"

    def __init__(
        self,
        clock: Clock,
        *,
        version: str = VERSION,
        nul: bool = False,
        settings: AdapterSettings | None = None,
    ) -> None:
        self._nul = nul
        self.settings = settings or AdapterSettings()
        self.writes_to_memory = 0
        self._saved = replace(self.settings)
        self._clock = clock
        self._version = version
        self._devices: dict[int, _BusDevice] = {}
        self._half = b""
        self._interrupted: Callable[[], bool] = never
        self._commands: dict[str, Callable[[list[str]], bytes | None]] = {
            "clr": self._clear,
            "read": self._read,
            "ver": lambda _: self._line(self._version),
        }

    def attach(self, address: int, make: Callable[[Clock], _Instrument]) -> _Instrument:
        """Make an instrument with `make`, which gets its clock; put it on the bus and return it.

        Raises `ValueError` for an address that is in use or not in 0…30.
        """
        low, high = _RANGES["addr"]
        if not low <= address <= high or address in self._devices:
            raise ValueError(f"GPIB address {address} is taken or not in {low} to {high}")
        clock = LookaheadClock(self._clock)
        instrument = make(clock)
        self._devices[address] = _BusDevice(instrument, clock)
        return instrument

    def return_to_present(self) -> None:
        """Set the clocks of all instruments back to the bench's time."""
        for device in self._devices.values():
            device.return_to_present()

    def let_through(self, address: int, dialect: Dialect) -> None:
        """Route messages for the instrument at `address` through `dialect`, for example one with faults."""
        self._devices[address].dialect = dialect

    def power_cycle(self) -> None:
        """Switch the adapter off and on; unsaved settings are lost."""
        self.settings = replace(self._saved)
        self._half = b""

    # --- called by the wire -------------------------------------------------------------------------

    @property
    def line_ends(self) -> LineEnds:
        """The line ends: LF for messages and replies; with `nul`, a NUL follows each reply."""
        return LineEnds(reply=b"\n\0") if self._nul else LineEnds()

    def handle(self, message: bytes, interrupted: Callable[[], bool] = never) -> bytes | None:
        """Process one line, a command to the adapter (++) or data for the bus; return the reply or None."""
        self._interrupted = interrupted
        message, self._half = self._half + message, b""
        if _HALF_ESCAPED.search(message):
            self._half = message + b"\n"  # the LF that ended the line was escaped
            return None
        if message.startswith(b"++"):
            name, *arguments = message[2:].decode("ascii", "replace").split() or [""]
            return self._command(name, arguments)
        return self._write(re.sub(rb"\x1b(.)", rb"\1", message, flags=re.DOTALL)) if message else None

    # --- the bus ------------------------------------------------------------------------------------

    @property
    def _addressed(self) -> _BusDevice | None:
        return self._devices.get(self.settings.addr) if self.settings.mode else None

    def _write(self, data: bytes) -> bytes | None:
        device = self._addressed
        if device is not None:
            device.listen(data + _TERMINATORS[self.settings.eos], bool(self.settings.eoi))
        return self._read(["eoi"]) if self.settings.auto else None

    def _read(self, arguments: list[str]) -> bytes | None:
        """Read the reply of the addressed instrument, within the timeout.

        An instrument without a reply reports an error (-420). Without an argument the adapter waits for the whole
        timeout, because no EOI ends the read.
        """
        if arguments not in ([], ["eoi"], [str(_LINE_FEED)]):
            return UNRECOGNIZED
        device = self._addressed
        deadline_s = self._clock.now_s() + self.settings.read_tmo_ms / 1000.0
        if device is not None and device.reply is None:
            device.instrument.report(_UNTERMINATED)
        if device is None or device.reply is None or device.ready_s > deadline_s:
            wait_until(self._clock, deadline_s, self._interrupted)
            return None
        wait_until(self._clock, device.ready_s, self._interrupted)
        if not arguments:
            wait_until(self._clock, deadline_s, self._interrupted)
        reply, device.reply = device.reply, None
        # The wire appends one LF, which stands for the instrument's LF; `eot_enable` adds another at EOI.
        return reply + b"\n" if self.settings.eot_enable else reply

    def _clear(self, _arguments: list[str]) -> None:
        if self._addressed is not None:
            self._addressed.clear()

    # --- commands -----------------------------------------------------------------------------------

    def _command(self, name: str, arguments: list[str]) -> bytes | None:
        if name in self._commands:
            return self._commands[name](arguments)
        if name == "savecfg" and "AR488" in self._version:
            self._saved = replace(self.settings)
            self.writes_to_memory += 1
            return None
        if name not in _RANGES:
            return UNRECOGNIZED
        if not arguments:
            return self._line(getattr(self.settings, name))
        low, high = _RANGES[name]
        if not arguments[0].isdecimal() or not low <= int(arguments[0]) <= high:
            return UNRECOGNIZED
        setattr(self.settings, name, int(arguments[0]))
        if self.settings.savecfg and name != "addr" and "AR488" not in self._version:
            self._saved = replace(self.settings)
            self.writes_to_memory += 1
        return None

    @staticmethod
    def _line(value: object) -> bytes:
        """Return a reply of the adapter itself, which ends in CR LF; the wire adds the LF."""
        return f"{value}\r".encode("ascii")
