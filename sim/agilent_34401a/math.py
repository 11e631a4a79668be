"""The math operations of a 34401A: null, dB, dBm, average, limit test.

Source: 34401A User's Guide (34401-90004), chapter 3 "Math Operations", chapter 4 CALCulate.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from drivers.facts.agilent_34401a import OVERLOAD_V
from sim.scpi import Command
from sim.scpi_values import MIN, Boolean, Choice, Number, ScpiError, Value, integer, next_above, within

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim.agilent_34401a.functions import Function

LIMIT_LOW: Final = 1 << 11
LIMIT_HIGH: Final = 1 << 12

_DBM_REFERENCES_OHM: Final = tuple(
    float(ohm)
    for ohm in (50, 75, 93, 110, 124, 125, 135, 150, 250, 300, 500, 600, 800, 900, 1000, 1200, 8000)
)
_DEFAULT_DBM_REFERENCE_OHM: Final = 600.0
_LARGEST: Final = 1.2e8
_LARGEST_DB: Final = 200.0


class Math:
    """The math register and its commands.

    `selected` returns the measuring function; `on_event` takes an error number (0: none) and bits of the
    questionable data register.
    """

    def __init__(self, selected: Callable[[], Function], on_event: Callable[[int, int], None]) -> None:
        self._selected = selected
        self._on_event = on_event
        self._minimum: float = math.inf
        self._maximum: float = -math.inf
        self.dbm_reference_ohm = _DEFAULT_DBM_REFERENCE_OHM
        self.preset()

    def preset(self) -> None:
        """Set what *RST, CONFigure and MEASure set: math off, registers cleared."""
        self.operation = "NULL"
        self.enabled = False
        self._null_offset: float | None = None
        self._db_reference_dbm: float | None = None
        self._low_limit = 0.0
        self._high_limit = 0.0
        self._clear_average()

    def drop_if_unfit(self) -> None:
        """Switch math off, with -221, when the function that is now selected cannot have it."""
        if self.enabled and not self._fits():
            self.enabled = False
            self._on_event(-221, 0)

    def apply(self, value: float) -> float:
        """Return what the operation makes of one reading; an overload passes through."""
        if not self.enabled:
            return value
        if abs(value) >= OVERLOAD_V:
            if self.operation == "NULL" and self._null_offset is None:
                self._on_event(540, 0)
            return value
        match self.operation:
            case "NULL":
                self._null_offset = value if self._null_offset is None else self._null_offset
                return value - self._null_offset
            case "DBM":
                return self._dbm(value)
            case "DB":
                dbm = self._dbm(value)
                self._db_reference_dbm = dbm if self._db_reference_dbm is None else self._db_reference_dbm
                return dbm - self._db_reference_dbm
            case "AVER":
                self._count += 1
                self._sum += value
                self._minimum = min(self._minimum, value)
                self._maximum = max(self._maximum, value)
            case _:
                low, high = value < self._low_limit, value > self._high_limit
                if low or high:
                    self._on_event(0, LIMIT_LOW if low else LIMIT_HIGH)
        return value

    def commands(self) -> list[Command]:
        """Return the CALCulate lines of the command table."""
        word = (Number(optional=True),)
        return [
            Command(
                "CALCulate:FUNCtion",
                self._set_operation,
                (Choice(("NULL", "DB", "DBM", "AVERage", "LIMit")),),
            ),
            Command("CALCulate:FUNCtion?", lambda: self.operation),
            Command("CALCulate:STATe", self._set_enabled, (Boolean(),)),
            Command("CALCulate:STATe?", lambda: str(int(self.enabled))),
            Command("CALCulate:AVERage:MINimum?", lambda: f"{self._minimum if self._count else 0.0:+.8E}"),
            Command("CALCulate:AVERage:MAXimum?", lambda: f"{self._maximum if self._count else 0.0:+.8E}"),
            Command("CALCulate:AVERage:AVERage?", lambda: f"{self._sum / max(1, self._count):+.8E}"),
            Command("CALCulate:AVERage:COUNt?", lambda: integer(self._count)),
            Command("CALCulate:NULL:OFFSet", self._set_null_offset, (Number("V"),)),
            Command("CALCulate:NULL:OFFSet?", lambda w="": _limited(w, self._null_offset, _LARGEST), word),
            Command("CALCulate:DB:REFerence", self._set_db_reference, (Number(),)),
            Command(
                "CALCulate:DB:REFerence?", lambda w="": _limited(w, self._db_reference_dbm, _LARGEST_DB), word
            ),
            Command("CALCulate:DBM:REFerence", self._set_dbm_reference, (Number("OHM"),)),
            Command("CALCulate:DBM:REFerence?", self._dbm_reference, word),
            Command("CALCulate:LIMit:LOWer", self._set_low_limit, (Number("V"),)),
            Command("CALCulate:LIMit:LOWer?", lambda w="": _limited(w, self._low_limit, _LARGEST), word),
            Command("CALCulate:LIMit:UPPer", self._set_high_limit, (Number("V"),)),
            Command("CALCulate:LIMit:UPPer?", lambda w="": _limited(w, self._high_limit, _LARGEST), word),
        ]

    def _dbm(self, value_v: float) -> float:
        # A dead short has no level in dB: the smallest reading stands in.
        return 10.0 * math.log10(max(value_v**2, 1e-16) / self.dbm_reference_ohm / 1e-3)

    def _fits(self) -> bool:
        name = self._selected().name
        if self.operation in ("DB", "DBM"):
            return name in ("VOLT", "VOLT:AC")
        return name not in ("CONT", "DIOD")

    def _clear_average(self) -> None:
        self._count = 0
        self._sum = 0.0
        self._minimum = math.inf
        self._maximum = -math.inf

    def _set_operation(self, name: str) -> None:
        self.operation = name
        self.drop_if_unfit()

    def _set_enabled(self, flag: str) -> None:
        if flag == "1" and not self._fits():
            raise ScpiError(-221)
        if flag == "1" and not self.enabled:
            # Switching on clears what an earlier use has left; the next reading becomes the reference.
            self._null_offset = None
            self._db_reference_dbm = None
            self._clear_average()
        self.enabled = flag == "1"

    def _reference(self, value: Value, largest: float) -> float:
        """Return the number for a reference register; the manual wants math on before that (-221)."""
        if not self.enabled:
            raise ScpiError(-221)
        return _bounded(value, largest)

    def _set_null_offset(self, value: Value) -> None:
        self._null_offset = self._reference(value, _LARGEST)

    def _set_db_reference(self, value: Value) -> None:
        self._db_reference_dbm = self._reference(value, _LARGEST_DB)

    def _set_low_limit(self, value: Value) -> None:
        self._low_limit = _bounded(value, _LARGEST)

    def _set_high_limit(self, value: Value) -> None:
        self._high_limit = _bounded(value, _LARGEST)

    def _set_dbm_reference(self, value: Value) -> None:
        if isinstance(value, str):
            self.dbm_reference_ohm = _DBM_REFERENCES_OHM[0 if value == MIN else -1]
        else:
            self.dbm_reference_ohm = next_above(within(value, 50.0, 8000.0), _DBM_REFERENCES_OHM)

    def _dbm_reference(self, word: str = "") -> str:
        if word:
            return f"{_DBM_REFERENCES_OHM[0 if word == MIN else -1]:+.8E}"
        return f"{self.dbm_reference_ohm:+.8E}"


def _bounded(value: Value, largest: float) -> float:
    """Return a register's number, MIN and MAX resolved. Raises `ScpiError` -222 outside ±`largest`."""
    if isinstance(value, str):
        return -largest if value == MIN else largest
    return within(value, -largest, largest)


def _limited(word: str, value: float | None, largest: float) -> str:
    """Format a register, or with MIN or MAX the ends of what it takes."""
    if word:
        return f"{-largest if word == MIN else largest:+.8E}"
    return f"{value or 0.0:+.8E}"
