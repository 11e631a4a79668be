"""Numbers in metrological format: rounded to two digits of u, with true minus signs and SI prefixes.

Source of the rounding: JCGM 100:2008, 7.2.6.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

MINUS: Final = "−"
FIGURE_SPACE: Final = "\N{FIGURE SPACE}"
PUNCTUATION_SPACE: Final = "\N{PUNCTUATION SPACE}"
PLACES_WITHOUT_U: Final = 9
MOST_PLACES: Final = 15

_MOST_OFF: Final = 0.03
"""Rounding down may lower an uncertainty by at most this fraction."""

_PREFIXES: Final = (("", 1.0), ("m", 1e-3), ("µ", 1e-6), ("n", 1e-9))
_PRINTED: Final = {"m/s^2": "m/s²"}
_TAKES_PREFIX: Final = frozenset({"V", "g", "m/s^2"})
_SUPERSCRIPT: Final = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
_EXPONENTIAL: Final = re.compile(r"(?<![\w.])([+-]?)(\d+(?:\.\d+)?)e([+-]?\d+)\b")
_NEGATIVE: Final = re.compile(r"(?<![\w.-])-(?=\d)")


@dataclass(frozen=True)
class Scale:
    """A unit for printed numbers: the printed number is the number in SI units divided by `size`."""

    unit: str
    size: float

    @property
    def per_g(self) -> str:
        """The unit of a scale factor printed on this scale: "µV/g"."""
        return f"({self.unit})/g" if "/" in self.unit else f"{self.unit}/g"


def scale_for(largest: float, unit: str) -> Scale:
    """Return the scale with the best prefix for `largest`: µV for 9.8e-5 V. Counts have no prefix."""
    printed = _PRINTED.get(unit, unit)
    if unit not in _TAKES_PREFIX or not math.isfinite(largest) or largest == 0.0:
        return Scale(printed, 1.0)
    for prefix, size in _PREFIXES:
        if abs(largest) >= size:
            return Scale(prefix + printed, size)
    prefix, size = _PREFIXES[-1]
    return Scale(prefix + printed, size)


def read_number(text: str) -> float:
    """Return the number in a text of ASCII digits with a dot and an exponent; nan and inf are accepted.

    Raises `ValueError` also for forms that `float` accepts: digits of other alphabets, `1_000`.
    """
    if "_" in text or not text.isascii():
        raise ValueError("not a number in plain digits")
    return float(text)


def places(u: float) -> int:
    """Return the number of decimals for two significant digits of `u`, negative from 99.5 on.

    It is `PLACES_WITHOUT_U` unless `u` is finite and above 0.
    """
    if not math.isfinite(u) or u <= 0.0:
        return PLACES_WITHOUT_U
    return min(MOST_PLACES, 1 - int(f"{u:.1e}".split("e")[1]))


def fixed(value: float, decimals: int, *, sign: bool = False) -> str:
    """Return `value` with this many decimals (-1 rounds to tens); "–" if it is not finite.

    `sign` also writes a plus sign.
    """
    if not math.isfinite(value):
        return "–"
    shown = round(value, decimals) if decimals < 0 else value
    text = f"{abs(shown):.{max(decimals, 0)}f}"
    if not text.strip("0."):
        return text
    return (MINUS if shown < 0 else "+" if sign else "") + text


def rounded(value: float, u: float, *, sign: bool = False) -> str:
    """Return the value rounded to two significant digits of its uncertainty."""
    return fixed(value, places(u), sign=sign)


def two_digits(size: float) -> str:
    """Return a non-negative number with two significant digits, "–" if it is negative or NaN."""
    return fixed(size, places(size)) if size > 0 else "0" if size == 0 else "–"


def uncertainty(u: float) -> str:
    """Return an uncertainty u or U with two significant digits, rounded up if rounding would lower it by over 3 %.

    So 10.47 gives 11 and 28.05 gives 28, as in JCGM 100:2008, 7.2.6. `rounded` rounds the estimate to the same
    decimal place.
    """
    if not math.isfinite(u) or u <= 0.0:
        return two_digits(u)
    decimals = places(u)
    step = 10.0**-decimals
    return fixed(u + step if round(u, decimals) < (1.0 - _MOST_OFF) * u else u, decimals)


def figures(value: float, digits: int = 3, *, down: bool = False, up: bool = False) -> str:
    """Return a number with this many significant digits; a large number has no exponent: "1860".

    With `down`, a positive number is rounded down, for a limit that must not be exceeded. With `up`, a positive
    number is rounded up.
    """
    if (down or up) and value > 0.0:
        step = 10.0 ** (math.floor(math.log10(value)) - digits + 1)
        steps = value / step
        value = step * (math.floor(steps * (1.0 + 1e-9)) if down else math.ceil(steps * (1.0 - 1e-9)))
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if abs(float(text)) >= 10.0**digits else text


def concise(value: float, u: float) -> str:
    """Return value and u in concise form: −2.177087(16) with u in the last digits; 12.3(1.2) if u is 1 or more."""
    if not math.isfinite(u) or u <= 0.0:
        return rounded(value, u)
    text = uncertainty(u)
    if u < 1.0:
        text = text.replace(".", "").lstrip("0")
    return f"{rounded(value, u)}({text})"


def quantity(value: float, unit: str) -> str:
    """Return a non-negative quantity with two significant digits and the best prefix: "98 µV"."""
    scale = scale_for(value, unit)
    return f"{two_digits(value / scale.size)} {scale.unit}"


def probability(p: float) -> str:
    """Return a probability as text: "p = 0.34", "p < 0.0001"."""
    if p < 1e-4:
        return "p < 0.0001"
    return f"p = {p:.2f}" if p >= 0.1 else f"p = {p:.2g}"


def aligned(column: Sequence[str]) -> list[str]:
    """Return numbers for a right-aligned column, padded on the right so that their decimal points align."""
    tails = [len(text.partition(".")[2]) for text in column]
    longest = max(tails, default=0)
    return [
        text + FIGURE_SPACE * (longest - tail) + (PUNCTUATION_SPACE if longest and "." not in text else "")
        for text, tail in zip(column, tails, strict=True)
    ]


def typeset(text: str) -> str:
    """Return a sentence with numbers and units typeset: −1·10⁻⁵ for -1e-05, m/s² for m/s^2."""

    def power(match: re.Match[str]) -> str:
        sign = match[1].replace("-", MINUS)
        return f"{sign}{match[2]}·10{str(int(match[3])).translate(_SUPERSCRIPT)}"

    text = _EXPONENTIAL.sub(power, text).replace("m/s^2", "m/s²")
    return _NEGATIVE.sub(MINUS, text)


def without_infinity(value: Any) -> Any:
    """Return nested dicts and lists with None in place of NaN and infinity, which JSON does not have."""
    if isinstance(value, Mapping):
        return {key: without_infinity(of) for key, of in value.items()}
    if isinstance(value, list | tuple):
        return [without_infinity(of) for of in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
