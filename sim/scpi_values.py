"""Values and status of SCPI instruments: parameters, channel lists, replies, error queue, event register."""

from __future__ import annotations

import math
import re
from collections import deque
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Final, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence

# --- status -----------------------------------------------------------------------------------------
# Source: IEEE Std 488.2, 11; 34401A User's Guide (34401-90004), chapters 4 "The SCPI Status Model" and 5.

QUERY_ERROR: Final = 4
DEVICE_ERROR: Final = 8
EXECUTION_ERROR: Final = 16
COMMAND_ERROR: Final = 32
POWER_ON: Final = 128

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
"""The texts of the standard error numbers; an instrument adds its own, which are positive."""


class ScpiError(Exception):
    """A command could not be parsed or carried out; `number` goes into the error queue."""

    def __init__(self, number: int) -> None:
        super().__init__(str(number))
        self.number = number


class ErrorQueue:
    """A first-in, first-out queue of error numbers.

    If it is full, a new error is lost and the newest entry becomes -350.
    """

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
        """Remove and return the oldest error; 0 if there is none."""
        return self._numbers.popleft() if self._numbers else 0

    def clear(self) -> None:
        """Remove all errors."""
        self._numbers.clear()


class EventRegister:
    """The standard event register: reading clears it, and a power cycle sets the bit POWER_ON."""

    def __init__(self) -> None:
        self.bits = POWER_ON

    def note_error(self, number: int) -> None:
        """Set the bit of an error's class (-1xx command, -2xx execution, -4xx query, else device)."""
        if -200 < number <= -100:
            self.bits |= COMMAND_ERROR
        elif -300 < number <= -200:
            self.bits |= EXECUTION_ERROR
        elif -500 < number <= -400:
            self.bits |= QUERY_ERROR
        else:
            self.bits |= DEVICE_ERROR

    def take(self) -> int:
        """Read and clear the register (*ESR?)."""
        value, self.bits = self.bits, 0
        return value


# --- values -----------------------------------------------------------------------------------------

Value = float | str

MIN, MAX, DEF, INF = "MIN", "MAX", "DEF", "INF"

_MULTIPLIERS: Final = {
    "": 1.0, "G": 1e9, "MA": 1e6, "K": 1e3, "M": 1e-3, "U": 1e-6, "N": 1e-9, "P": 1e-12,
}  # fmt: skip
_UNITS_WHERE_M_IS_MEGA: Final = ("OHM", "HZ")
_NUMBER: Final = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([A-Za-z]*)$")
_NON_DECIMAL: Final = re.compile(r"#([HQBhqb])([0-9A-Fa-f]+)$")
_WORD: Final = re.compile(r"[A-Za-z][A-Za-z0-9_:]*$")
_MAX_DIGITS: Final = 255
_MAX_EXPONENT: Final = 32000


@cache
def notation_pattern(notation: str) -> re.Pattern[str]:
    """Compile a keyword in the manual's notation, such as "[SENSe:]VOLTage[:DC]:NPLCycles?".

    Capitals are the short form. The pattern matches only the short and the long form, in any case; parts in
    brackets are optional. Raises `ValueError` for unbalanced brackets.
    """
    if notation.count("[") != notation.count("]"):
        raise ValueError(f"the brackets of {notation!r} do not pair")

    def mnemonic(match: re.Match[str]) -> str:
        short, rest = match.group(1), match.group(2).upper()
        return f"{short}(?:{rest})?" if rest else short

    pattern = re.escape(notation).replace(r"\[", "(?:").replace(r"\]", ")?")
    return re.compile(re.sub(r"([A-Z*][A-Z0-9_]*)([a-z]*)", mnemonic, pattern) + r"\Z", re.IGNORECASE)


def split_outside_quotes(text: str, separator: str) -> list[str]:
    """Return the parts of a text between one-character separators outside quotes and parentheses.

    Raises `ScpiError` -151 for a string without its closing quote.
    """
    if '"' not in text and "'" not in text and "(" not in text:
        return text.split(separator)
    parts, start, quote, depth = [], 0, "", 0
    for position, character in enumerate(text):
        if quote:
            quote = "" if character == quote else quote
        elif character in "\"'":
            quote = character
        elif character in "()":
            depth = max(0, depth + (1 if character == "(" else -1))
        elif character == separator and depth == 0:
            parts.append(text[start:position])
            start = position + 1
    if quote:
        raise ScpiError(-151)
    return [*parts, text[start:]]


class CommandParameter(Protocol):
    """One parameter of a command, which converts the text received to a value."""

    @property
    def optional(self) -> bool:
        """Whether the parameter may be omitted."""

    def parse(self, text: str) -> Value:
        """Return the value. Raises `ScpiError` with the number that the standard assigns to the error."""


@dataclass(frozen=True)
class Number:
    """A number with an optional suffix of `unit` (none if empty), or one of the `words` MIN, MAX, DEF, INF."""

    unit: str = ""
    words: tuple[str, ...] = (MIN, MAX)
    optional: bool = False

    def parse(self, text: str) -> Value:
        """Return the number in the basic unit, or the short form of the word."""
        if text[:1] in ("'", '"'):
            raise ScpiError(-158)
        if _WORD.match(text):
            for word in self.words:
                if _number_word(word).match(text):
                    return word
            raise ScpiError(-148)
        if non_decimal := _NON_DECIMAL.match(text):
            return _non_decimal(*non_decimal.groups())
        match = _NUMBER.match(text)
        if match is None:
            raise ScpiError(-121)
        return _decimal(match.group(1)) * self._multiplier(match.group(2).upper())

    def _multiplier(self, suffix: str) -> float:
        if not suffix:
            return 1.0
        if not self.unit:
            raise ScpiError(-138)
        prefix = suffix.removesuffix(self.unit.upper())
        if prefix == "M" and suffix != "M" and self.unit.upper() in _UNITS_WHERE_M_IS_MEGA:
            return 1e6
        if prefix not in _MULTIPLIERS:
            raise ScpiError(-131)
        return _MULTIPLIERS[prefix]


@dataclass(frozen=True)
class Choice:
    """One of several words in the manual's notation; the value is the short form in capitals."""

    words: tuple[str, ...]
    optional: bool = False

    def parse(self, text: str) -> Value:
        """Return the word's short form."""
        if text[:1] in ("'", '"'):
            raise ScpiError(-158)
        if not _WORD.match(text):
            raise ScpiError(-104)
        for word in self.words:
            if notation_pattern(word).match(text):
                return short_form(word)
        raise ScpiError(-224)


@dataclass(frozen=True)
class Boolean:
    """ON, OFF, a number (false if it rounds to zero), or one of the additional `words` as in `Choice`."""

    words: tuple[str, ...] = ()
    optional: bool = False

    def parse(self, text: str) -> Value:
        """Return "1", "0", or the short form of one of the additional words."""
        if _WORD.match(text):
            word = Choice(("ON", "OFF", *self.words)).parse(text)
            return {"ON": "1", "OFF": "0"}.get(str(word), word)
        number = Number(words=()).parse(text)
        return "1" if math.floor(float(number) + 0.5) else "0"


@dataclass(frozen=True)
class Text:
    """A string in single or double quotes; inside it, the enclosing quote is doubled."""

    optional: bool = False

    def parse(self, text: str) -> Value:
        """Return the string without its quotes."""
        quote = text[:1]
        if quote not in ("'", '"'):
            raise ScpiError(-148 if _WORD.match(text) else -104)
        inner = text[1:-1]
        if len(text) < 2 or text[-1] != quote or quote in inner.replace(quote * 2, ""):
            raise ScpiError(-151)
        return inner.replace(quote * 2, quote)


@lru_cache
def _number_word(word: str) -> re.Pattern[str]:
    notation = {MIN: "MINimum", MAX: "MAXimum", DEF: "DEFault", INF: "INFinity"}[word]
    # The manual also writes INFinite.
    return re.compile(r"INF(?:INIT(?:E|Y))?\Z", re.IGNORECASE) if word == INF else notation_pattern(notation)


def _decimal(text: str) -> float:
    mantissa, _, exponent = text.lower().partition("e")
    if len(mantissa.strip("+-")) > _MAX_DIGITS:
        raise ScpiError(-124)
    if len(exponent) > 6 or abs(int(exponent or 0)) > _MAX_EXPONENT or math.isinf(float(text)):
        raise ScpiError(-123)
    return float(text)


def _non_decimal(base: str, digits: str) -> float:
    try:
        return float(int(digits, {"H": 16, "Q": 8, "B": 2}[base.upper()]))
    except ValueError:
        raise ScpiError(-121) from None
    except OverflowError:
        raise ScpiError(-123) from None


def parse_parameters(specified: Sequence[CommandParameter], text: str) -> list[Value]:
    """Return the values of a command's parameters, without those omitted at the end.

    Raises `ScpiError` -108 for too many, -109 for too few, and the errors of the parameters themselves.
    """
    texts = [part.strip() for part in split_outside_quotes(text, ",")] if text.strip() else []
    if len(texts) > len(specified):
        raise ScpiError(-108)
    if "" in texts or len(texts) < sum(not parameter.optional for parameter in specified):
        raise ScpiError(-109)
    return [parameter.parse(part) for parameter, part in zip(specified, texts, strict=False)]


def short_form(notation: str) -> str:
    """Return the short form of a word in the manual's notation: "IMMediate" gives "IMM"."""
    return "".join(character for character in notation if not character.islower())


def integer(value: float) -> str:
    """Format a signed integer, such as "+20"."""
    return f"{round(value):+d}"


def numbered(identity: str, place: int) -> str:
    """Return an identity (IEEE 488.2, 10.14) with its serial number increased by `place`."""
    maker, model, serial, firmware = identity.split(",", 3)
    digits = serial[len(serial.rstrip("0123456789")) :]
    ahead = serial.removesuffix(digits) + str(int(digits) + place).zfill(len(digits))
    return ",".join((maker, model, ahead, firmware))


def quoted(text: str) -> str:
    """Format a string reply in double quotes, with inner double quotes doubled."""
    return '"' + text.replace('"', '""') + '"'


def next_above(value: float, accepted: Sequence[float]) -> float:
    """Return the smallest of the `accepted` numbers (ascending) that is not below `value`.

    Raises `ScpiError` -222 if `value` is negative or above all of them. A relative tolerance of 1e-6 absorbs
    rounding in the transmitted number.
    """
    if value < 0.0:
        raise ScpiError(-222)
    for number in accepted:
        if value <= number * (1.0 + 1e-6):
            return number
    raise ScpiError(-222)


def next_below(value: float, accepted: Sequence[float]) -> float:
    """Return the largest of the `accepted` numbers (ascending) that is not above `value`.

    Raises `ScpiError` -222 if there is none. A relative tolerance of 1e-6 absorbs rounding in the transmitted
    number.
    """
    fitting = [number for number in accepted if number <= value * (1.0 + 1e-6)]
    if not fitting:
        raise ScpiError(-222)
    return fitting[-1]


def number_of(value: Value, low: float, high: float) -> float:
    """Return the number `value`, or `low` for MIN and `high` for MAX."""
    return {MIN: low, MAX: high}[value] if isinstance(value, str) else value


def within(value: float, low: float, high: float) -> float:
    """Return `value` if it lies in [low, high], else raise `ScpiError` -222."""
    if not low <= value <= high:
        raise ScpiError(-222)
    return value


_LIST: Final = re.compile(r"\(\s*@\s*([0-9:,\s]*)\)")
_ITEM: Final = re.compile(r"(\d)(?::(\d))?")
_MISSING: Final = -109
_OUT_OF_RANGE: Final = -222


class OutputList:
    """A list of outputs as a parameter; its value is the text, which `listed` converts to numbers."""

    optional = True

    def parse(self, text: str) -> Value:
        """Return the text unchanged. Raises `ScpiError` -104 for a malformed list."""
        if _LIST.fullmatch(text) is None:
            raise ScpiError(-104)
        return text


def list_spans(text: str, item: re.Pattern[str], wrong: int) -> list[tuple[int, int]]:
    """Return the first and last number of each item of a list: `(@1,3:4)` -> [(1, 1), (3, 4)].

    `item` matches one item, with the first and optionally the last number as groups. Raises `ScpiError` with the
    number `wrong` for a malformed list.
    """
    match = _LIST.fullmatch(text)
    inner = "" if match is None else match.group(1).replace(" ", "")
    items = [item.fullmatch(part) for part in inner.split(",")] if inner else []
    if match is None or None in items:
        raise ScpiError(wrong)
    return [(int(found[1]), int(found[2] or found[1])) for found in items if found is not None]


def listed(text: str, count: int) -> tuple[int, ...]:
    """Return the numbers in the order of the list: `(@1,3:4)` -> (1, 3, 4).

    Raises `ScpiError` -104 for a malformed list, -109 for an empty one, -222 for a number outside 1…`count`.
    """
    spans = list_spans(text, _ITEM, -104)
    numbers = [number for first, last in spans for number in range(first, last + 1)]
    if not spans:
        raise ScpiError(_MISSING)
    if not all(1 <= number <= count for number in numbers):
        raise ScpiError(_OUT_OF_RANGE)
    return tuple(numbers)
