"""An SCPI instrument apart from what it measures: command table, compounds, errors, common commands.

An instrument adds `Command`s in the manual's own notation. A message may hold several, `;` going on in the
same subsystem, `;:` from the root; their replies come joined with `;` on one line.
Source: SCPI-1999 volume 1, 6; IEEE Std 488.2, 7 and 10; 34401A User's Guide, chapter 4.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from sim.scpi_values import (
    ERRORS,
    MAX,
    MIN,
    OPERATION_COMPLETE,
    Boolean,
    ErrorQueue,
    Number,
    ScpiError,
    StatusRegisters,
    integer,
    notation_pattern,
    parse_parameters,
    quoted,
    split_outside_quotes,
    within,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from sim.scpi_values import CommandParameter

_HEADER: Final = re.compile(
    r"(?:\*[A-Za-z][A-Za-z0-9_]*|:?[A-Za-z][A-Za-z0-9_]*(?::[A-Za-z][A-Za-z0-9_]*)*)\??\Z"
)
_HEADER_CHARACTERS: Final = re.compile(r"[A-Za-z0-9_:*?,'\"]*\Z")
_LONGEST_MNEMONIC: Final = 12


class DeviceClear(Exception):
    """A device clear came in while a command waited; what was under way is given up."""


def never() -> bool:
    """No device clear ever comes: for messages that no wire carried."""
    return False


@dataclass(frozen=True)
class Command:
    """One line of an instrument's command table.

    `notation` is the manual's ("[SENSe:]VOLTage:DC:RANGe?"); `action` is called with the values of the
    parameters that were sent and returns the reply of a query, or None where none comes.
    """

    notation: str
    action: Callable[..., str | None]
    parameters: tuple[CommandParameter, ...] = ()


class ScpiInstrument:
    """Parses messages and carries them out; the base of every simulated SCPI instrument.

    `identity` answers *IDN?; `errors` adds the instrument's own error texts to the standard's.
    """

    def __init__(self, identity: str, errors: Mapping[int, str] | None = None) -> None:
        self.identity = identity
        self.errors = ErrorQueue()
        self.status = StatusRegisters()
        self._interrupted: Callable[[], bool] = never
        self._error_texts = {**ERRORS, **(errors or {})}
        self._table: list[tuple[re.Pattern[str], Command]] = []
        self._found: dict[str, Command] = {}
        self.add(self._common_commands())
        self.add(self._status_commands())

    def add(self, commands: Sequence[Command]) -> None:
        """Add lines to the command table."""
        self._table.extend((notation_pattern(command.notation), command) for command in commands)

    # --- what the wire calls ------------------------------------------------------------------------

    def handle(self, message: bytes, interrupted: Callable[[], bool] = never) -> bytes | None:
        """Carry out one message (without its terminator) and return the reply line, None if there is none.

        `interrupted` tells, while a command waits, whether a device clear has come in. A message with a
        mistake in its form is not read further; an error in carrying a command out leaves the rest standing.
        """
        self._interrupted = interrupted
        replies: list[str] = []
        path = ""
        try:
            for unit in self._units(message):
                path = self._execute(unit, path, replies)
        except ScpiError as error:
            self.report(error.number)
        except DeviceClear:
            return None
        return ";".join(replies).encode("ascii") if replies else None

    def device_clear(self) -> None:
        """Abort the command or measurement in progress; settings, errors and status stay."""

    def input_overflow(self) -> None:
        """Take note that a message was longer than the input buffer."""
        self.report(-223)

    def power_cycle(self) -> None:
        """Switch off and on: settings and errors are gone."""
        self.errors.clear()
        self.status.power_cycle()
        self.reset()

    # --- what an instrument overrides ---------------------------------------------------------------

    def admit(self, command: Command) -> None:
        """Admit a command before its parameters are parsed: wait for a measurement, or raise `ScpiError`."""

    def reset(self) -> None:
        """Carry out *RST."""

    def self_test(self) -> int:
        """Carry out *TST? and return 0 (passed) or 1."""
        return 0

    def number(self, value: float) -> str:
        """Return a whole number as the instrument prints it: `+0`."""
        return integer(value)

    def device_clear_pending(self) -> bool:
        """Whether a device clear has come in since the present message began: what waits gives up."""
        return self._interrupted()

    # --- errors -------------------------------------------------------------------------------------

    def report(self, number: int) -> None:
        """Put an error into the queue and its class into the event register."""
        self.errors.push(number)
        self.status.note_error(number)

    def next_error(self) -> str:
        """Take the oldest error out of the queue: `-113,"Undefined header"`, `+0,"No error"`."""
        number = self.errors.pop()
        return f"{self.number(number)},{quoted(self._error_texts[number])}"

    # --- parsing ------------------------------------------------------------------------------------

    def _units(self, message: bytes) -> list[str]:
        """Return the commands of a message. Raises `ScpiError` -101 for what is not printable ASCII."""
        text = message.decode("latin-1").strip()
        if not text.isascii() or not text.replace("\t", " ").isprintable():
            raise ScpiError(-101)
        units = [unit.strip() for unit in split_outside_quotes(text, ";")]
        return [unit for unit in units if unit]

    def _execute(self, unit: str, path: str, replies: list[str]) -> str:
        """Carry out one command; return the path at which the next one starts.

        Raises `ScpiError` for a mistake in the command's form, so that the rest of the line is dropped.
        """
        header, *rest = unit.split(None, 1)
        check_header(header)
        if not header.startswith("*"):
            header = header[1:] if header.startswith(":") else f"{path}:{header}".lstrip(":")
            path = header.rpartition(":")[0]
        command = self._find(header.upper())
        try:
            self.admit(command)
            values = parse_parameters(command.parameters, rest[0] if rest else "")
            reply = command.action(*values)
        except ScpiError as error:
            if -200 < error.number <= -100:
                raise
            self.report(error.number)
        else:
            if reply is not None:
                replies.append(reply)
        return path

    def _find(self, header: str) -> Command:
        """Return the command of a header, -113 when there is none. Only hits are kept: they are few."""
        if header not in self._found:
            for pattern, command in self._table:
                if pattern.match(header):
                    self._found[header] = command
                    break
            else:
                raise ScpiError(-113)
        return self._found[header]

    # --- common commands ----------------------------------------------------------------------------

    def _common_commands(self) -> list[Command]:
        byte: tuple[CommandParameter, ...] = (Number(words=()),)
        return [
            Command("*CLS", self._clear_status),
            *self._mask_lines("*ESE", "event_enable", 255),
            Command("*ESR?", lambda: self.number(self.status.take_event())),
            Command("*IDN?", lambda: self.identity),
            Command("*OPC", self._operation_complete),
            Command("*OPC?", lambda: "1"),
            Command("*PSC", self._set_power_on_clear, byte),
            Command("*PSC?", lambda: str(int(self.status.power_on_clear))),
            Command("*RST", self.reset),
            *self._mask_lines("*SRE", "service_enable", 255),
            Command("*STB?", lambda: self.number(self.status.status_byte)),
            Command("*TST?", lambda: self.number(self.self_test())),
        ]

    def _status_commands(self) -> list[Command]:
        return [
            Command("SYSTem:ERRor?", self.next_error),
            Command("STATus:QUEStionable[:EVENt]?", lambda: self.number(self.status.take_questionable())),
            *self._mask_lines("STATus:QUEStionable:ENABle", "questionable_enable", 32767),
            Command("STATus:PRESet", lambda: setattr(self.status, "questionable_enable", 0)),
        ]

    def _mask_lines(self, notation: str, name: str, most: int) -> list[Command]:
        """Return command and query of a mask of the status registers, a whole number up to `most`."""
        return [
            Command(
                notation,
                lambda mask: setattr(self.status, name, round(within(mask, 0, most))),
                (Number(words=()),),
            ),
            Command(f"{notation}?", lambda: self.number(getattr(self.status, name))),
        ]

    def _clear_status(self) -> None:
        self.errors.clear()
        self.status.clear()

    def _operation_complete(self) -> None:
        self.status.event |= OPERATION_COMPLETE

    def _set_power_on_clear(self, flag: float) -> None:
        self.status.power_on_clear = round(flag) != 0


Interface = Literal["gpib", "rs232", "lan"]

_OVERFLOW: Final = 521
_REMOTE_ERRORS: Final = {
    514: "Command allowed only with RS-232",
    _OVERFLOW: "Input buffer overflow",
    550: "Command not allowed in local",
}
_REMOTE_COMMANDS: Final = ("SYSTem:LOCal", "SYSTem:REMote", "SYSTem:RWLock")
_ALLOWED_IN_LOCAL: Final = (*_REMOTE_COMMANDS, "SYSTem:ERRor?", "*IDN?", "*CLS", "*ESR?", "*STB?")


class RemoteInstrument(ScpiInstrument):
    """An instrument that is local or remote; `interface` is what it believes to be connected by.

    "rs232" refuses (+550) all but identification, errors and SYSTem:REMote until that was sent, "gpib" refuses
    the SYSTem:REMote family (+514), "lan" takes both and needs neither.
    """

    def __init__(self, identity: str, errors: Mapping[int, str], interface: Interface) -> None:
        super().__init__(identity, {**_REMOTE_ERRORS, **errors})
        self.interface = interface
        self._remote = self._locked = False
        self.add(
            [
                Command("SYSTem:LOCal", lambda: self._set_remote(False)),
                Command("SYSTem:REMote", lambda: self._set_remote(True)),
                Command("SYSTem:RWLock", lambda: self._set_remote(True, locked=True)),
            ]
        )

    def admit(self, command: Command) -> None:
        """Refuse what the interface does not allow."""
        if self.interface == "gpib" and command.notation in _REMOTE_COMMANDS:
            raise ScpiError(514)
        if self.interface == "rs232" and not self._remote and command.notation not in _ALLOWED_IN_LOCAL:
            raise ScpiError(550)

    def input_overflow(self) -> None:
        """Take note that a message was longer than the input buffer."""
        self.report(_OVERFLOW)

    def power_cycle(self) -> None:
        """Switch off and on: the settings are gone, all but what a model keeps."""
        super().power_cycle()
        self._set_remote(False)

    def press_local(self) -> None:
        """Press LOCAL on the front panel: over RS-232 commands are refused until SYSTem:REMote.

        Locked by SYSTem:RWLock the key does nothing.
        """
        if not self._locked:
            self._remote = False

    def _set_remote(self, remote: bool, locked: bool = False) -> None:
        self._remote, self._locked = remote, locked


def switch_lines(
    notation: str,
    holder: Callable[[], object],
    name: str,
    words: tuple[str, ...] = (),
    changed: Callable[[], None] = lambda: None,
) -> list[Command]:
    """Return command and query of an attribute that is on or off; one of the further `words` sets it off.

    `holder` returns the object that has the attribute now, `changed` is called after the command.
    """

    def switch(flag: str) -> None:
        setattr(holder(), name, flag == "1")
        changed()

    return [
        Command(notation, switch, (Boolean(words),)),
        Command(f"{notation}?", lambda: str(int(getattr(holder(), name)))),
    ]


def number_lines(
    notation: str,
    unit: str,
    ends: tuple[float, float],
    get: Callable[[], float],
    put: Callable[[float], None],
) -> list[Command]:
    """Return command and query of a number; MIN and MAX stand for its `ends`, in the query too."""
    words = dict(zip((MIN, MAX), ends, strict=True))
    return [
        Command(notation, lambda v: put(words[v] if isinstance(v, str) else v), (Number(unit),)),
        Command(f"{notation}?", lambda word="": f"{words.get(word, get()):+.6E}", (Number(optional=True),)),
    ]


def check_header(header: str) -> None:
    """Raise `ScpiError` for a header of the wrong form: -101, -103 (comma), -112 (too long), -102."""
    if not _HEADER_CHARACTERS.match(header):
        raise ScpiError(-101)
    if "," in header:
        raise ScpiError(-103)
    if not _HEADER.match(header):
        raise ScpiError(-102)
    if any(len(mnemonic) > _LONGEST_MNEMONIC for mnemonic in header.strip("*?").split(":")):
        raise ScpiError(-112)
