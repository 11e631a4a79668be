"""The general part of an SCPI instrument: command table, compound messages, errors, common commands.

A subclass adds `Command`s in the notation of the manual. A message may hold several commands: after `;` the next
one continues in the same subsystem, after `;:` it starts at the root. Replies are joined by `;` on one line.
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
    Boolean,
    ErrorQueue,
    EventRegister,
    Number,
    ScpiError,
    integer,
    notation_pattern,
    parse_parameters,
    quoted,
    split_outside_quotes,
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
    """A device clear arrived while a command waited; that command is aborted and has no reply."""


def never() -> bool:
    """Return False: a message that did not come over a wire is never interrupted by a device clear."""
    return False


@dataclass(frozen=True)
class Command:
    """One line of an instrument's command table.

    `notation` is that of the manual, such as "[SENSe:]VOLTage:DC:RANGe?". `action` is called with the values of the
    parameters that were sent; it returns the reply of a query, else None.
    """

    notation: str
    action: Callable[..., str | None]
    parameters: tuple[CommandParameter, ...] = ()


class ScpiInstrument:
    """The base of every simulated SCPI instrument, which parses messages and carries them out.

    `identity` is the reply to *IDN?. `errors` adds the instrument's own error texts, by number, to those of the
    standard.
    """

    def __init__(self, identity: str, errors: Mapping[int, str] | None = None) -> None:
        self.identity = identity
        self.errors = ErrorQueue()
        self.events = EventRegister()
        self._interrupted: Callable[[], bool] = never
        self._error_texts = {**ERRORS, **(errors or {})}
        self._table: list[tuple[re.Pattern[str], Command]] = []
        self._found: dict[str, Command] = {}
        self.add(self._common_commands())

    def add(self, commands: Sequence[Command]) -> None:
        """Add lines to the command table."""
        self._table.extend((notation_pattern(command.notation), command) for command in commands)

    # --- called by the wire -------------------------------------------------------------------------

    def handle(self, message: bytes, interrupted: Callable[[], bool] = never) -> bytes | None:
        """Carry out one message (without its terminator) and return the reply line, or None if there is none.

        A waiting command polls `interrupted` for a device clear. After a syntax error the remaining commands of the
        message are discarded; after an execution error they are carried out.
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
        """Do nothing; a subclass aborts its measurement in progress and keeps settings and errors."""

    def input_overflow(self) -> None:
        """Report a message that exceeded the input buffer (-223)."""
        self.report(-223)

    def power_cycle(self) -> None:
        """Switch off and on, which clears settings and errors."""
        self.errors.clear()
        self.events = EventRegister()
        self.reset()

    # --- to be overridden by an instrument ----------------------------------------------------------

    def admit(self, command: Command) -> None:
        """Do nothing; a subclass may wait or raise `ScpiError` here, before parameters are parsed."""

    def reset(self) -> None:
        """Carry out *RST; a subclass resets its settings."""

    def self_test(self) -> int:
        """Carry out *TST? and return 0 (passed); a subclass may return 1."""
        return 0

    def number(self, value: float) -> str:
        """Return `value` as a rounded number in the instrument's format: `+20`."""
        return integer(value)

    def device_clear_pending(self) -> bool:
        """Return whether a device clear has arrived since the present message began."""
        return self._interrupted()

    # --- errors -------------------------------------------------------------------------------------

    def report(self, number: int) -> None:
        """Put an error into the queue and set the bit of its class in the event register."""
        self.errors.push(number)
        self.events.note_error(number)

    def next_error(self) -> str:
        """Remove and return the oldest error: `-113,"Undefined header"`, or `+0,"No error"`."""
        number = self.errors.pop()
        return f"{self.number(number)},{quoted(self._error_texts[number])}"

    # --- parsing ------------------------------------------------------------------------------------

    def _units(self, message: bytes) -> list[str]:
        """Return the commands of a message. Raises `ScpiError` -101 for characters other than printable ASCII."""
        text = message.decode("latin-1").strip()
        if not text.isascii() or not text.replace("\t", " ").isprintable():
            raise ScpiError(-101)
        units = [unit.strip() for unit in split_outside_quotes(text, ";")]
        return [unit for unit in units if unit]

    def _execute(self, unit: str, path: str, replies: list[str]) -> str:
        """Carry out one command; return the path at which the next command starts.

        Raises `ScpiError` for a syntax error, so that the rest of the message is discarded.
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
        """Return the command for a header, and cache only it; raise `ScpiError` -113 if there is none."""
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
        return [
            Command("*CLS", self._clear_status),
            Command("*ESR?", lambda: self.number(self.events.take())),
            Command("*IDN?", lambda: self.identity),
            Command("*OPC?", lambda: "1"),
            Command("*RST", self.reset),
            Command("*STB?", lambda: self.number(0)),  # nothing can be enabled to show in it
            Command("*TST?", lambda: self.number(self.self_test())),
            Command("SYSTem:ERRor?", self.next_error),
        ]

    def _clear_status(self) -> None:
        self.errors.clear()
        self.events.bits = 0


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
    """An instrument with local and remote mode; `interface` is the interface that it is set to.

    Until it receives SYSTem:REMote, an instrument set to "rs232" refuses (+550) all commands except the
    SYSTem:REMote family and those for identification, errors and status. An instrument set to "gpib" always refuses
    this family (+514). An instrument set to "lan" refuses nothing.
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
        """Raise `ScpiError` for a command that the interface does not allow."""
        if self.interface == "gpib" and command.notation in _REMOTE_COMMANDS:
            raise ScpiError(514)
        if self.interface == "rs232" and not self._remote and command.notation not in _ALLOWED_IN_LOCAL:
            raise ScpiError(550)

    def input_overflow(self) -> None:
        """Report a message that exceeded the input buffer (+521)."""
        self.report(_OVERFLOW)

    def power_cycle(self) -> None:
        """Switch off and on: return to local, and lose all settings except those that a model stores."""
        super().power_cycle()
        self._set_remote(False)

    def press_local(self) -> None:
        """Press LOCAL on the front panel: over RS-232, commands are then refused until SYSTem:REMote.

        The key has no effect after SYSTem:RWLock.
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
    """Return command and query of the Boolean attribute `name`; each of the additional `words` sets it to False.

    `holder` returns the object that has the attribute; `changed` is called after the command.
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
    """Return the command and the query of a number, whose least and greatest values are `ends`.

    `put` sets the number and `get` returns it. Command and query accept MIN and MAX for the two `ends`.
    """
    words = dict(zip((MIN, MAX), ends, strict=True))
    return [
        Command(notation, lambda v: put(words[v] if isinstance(v, str) else v), (Number(unit),)),
        Command(f"{notation}?", lambda word="": f"{words.get(word, get()):+.6E}", (Number(optional=True),)),
    ]


def check_header(header: str) -> None:
    """Raise `ScpiError` for a malformed header: -101 (character), -103 (comma), -112 (too long), -102 (other)."""
    if not _HEADER_CHARACTERS.match(header):
        raise ScpiError(-101)
    if "," in header:
        raise ScpiError(-103)
    if not _HEADER.match(header):
        raise ScpiError(-102)
    if any(len(mnemonic) > _LONGEST_MNEMONIC for mnemonic in header.strip("*?").split(":")):
        raise ScpiError(-112)
