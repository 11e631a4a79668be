"""What an SCPI instrument knows of its own state: the error queue and the status registers.

Source: IEEE Std 488.2, 11; 34401A User's Guide (34401-90004), chapters 4 "The SCPI Status Model" and 5.
"""

from __future__ import annotations

from collections import deque
from typing import Final

OPERATION_COMPLETE: Final = 1
QUERY_ERROR: Final = 4
DEVICE_ERROR: Final = 8
EXECUTION_ERROR: Final = 16
COMMAND_ERROR: Final = 32
POWER_ON: Final = 128

QUESTIONABLE_SUMMARY: Final = 8
EVENT_SUMMARY: Final = 32
REQUEST_SERVICE: Final = 64

ERRORS: Final[dict[int, str]] = {
    0: "No error",
    -101: "Invalid character",
    -102: "Syntax error",
    -103: "Invalid separator",
    -104: "Data type error",
    -108: "Parameter not allowed",
    -109: "Missing parameter",
    -112: "Program mnemonic too long",
    -113: "Undefined header",
    -121: "Invalid character in number",
    -123: "Numeric overflow",
    -124: "Too many digits",
    -131: "Invalid suffix",
    -138: "Suffix not allowed",
    -148: "Character data not allowed",
    -151: "Invalid string data",
    -158: "String data not allowed",
    -211: "Trigger ignored",
    -213: "Init ignored",
    -214: "Trigger deadlock",
    -221: "Settings conflict",
    -222: "Data out of range",
    -223: "Too much data",
    -224: "Illegal parameter value",
    -230: "Data stale",
    -350: "Too many errors",
    -410: "Query INTERRUPTED",
    -420: "Query UNTERMINATED",
}
"""The texts of the standard's numbers; an instrument adds its own, which are positive."""


class ScpiError(Exception):
    """A command could not be parsed or carried out; `number` goes into the error queue."""

    def __init__(self, number: int) -> None:
        super().__init__(str(number))
        self.number = number


class ErrorQueue:
    """First in, first out; when it is full the newest entry becomes -350 and further errors are lost."""

    DEPTH: Final = 20

    def __init__(self) -> None:
        self._numbers: deque[int] = deque()

    def __len__(self) -> int:
        return len(self._numbers)

    def push(self, number: int) -> None:
        """Add an error."""
        if len(self._numbers) < self.DEPTH:
            self._numbers.append(number)
        else:
            self._numbers[-1] = -350

    def pop(self) -> int:
        """Take out the oldest error, 0 when there is none."""
        return self._numbers.popleft() if self._numbers else 0

    def clear(self) -> None:
        """Forget all errors."""
        self._numbers.clear()


class StatusRegisters:
    """Standard event, questionable data and status byte, with their enable masks.

    After power-on the masks are as `power_on_clear` (*PSC) says; the event register shows POWER_ON.
    """

    def __init__(self) -> None:
        self.event = POWER_ON
        self.event_enable = 0
        self.questionable = 0
        self.questionable_enable = 0
        self.service_enable = 0
        self.power_on_clear = True

    def power_cycle(self) -> None:
        """Set the registers as switching off and on does."""
        self.event = POWER_ON
        self.questionable = 0
        self.questionable_enable = 0
        if self.power_on_clear:
            self.event_enable = 0
            self.service_enable = 0

    def clear(self) -> None:
        """Clear the event registers; the masks stay (*CLS)."""
        self.event = 0
        self.questionable = 0

    def note_error(self, number: int) -> None:
        """Set the event bit of an error's class (-1xx command, -2xx execution, -4xx query, else device)."""
        if -200 < number <= -100:
            self.event |= COMMAND_ERROR
        elif -300 < number <= -200:
            self.event |= EXECUTION_ERROR
        elif -500 < number <= -400:
            self.event |= QUERY_ERROR
        else:
            self.event |= DEVICE_ERROR

    def take_event(self) -> int:
        """Read and clear the standard event register (*ESR?)."""
        value, self.event = self.event, 0
        return value

    def take_questionable(self) -> int:
        """Read and clear the questionable data register (STATus:QUEStionable:EVENt?)."""
        value, self.questionable = self.questionable, 0
        return value

    @property
    def status_byte(self) -> int:
        """The status byte (*STB?). Replies leave at once, so that "message available" is never set."""
        byte = 0
        if self.questionable & self.questionable_enable:
            byte |= QUESTIONABLE_SUMMARY
        if self.event & self.event_enable:
            byte |= EVENT_SUMMARY
        if byte & self.service_enable:
            byte |= REQUEST_SERVICE
        return byte
