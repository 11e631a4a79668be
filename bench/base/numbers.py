"""Numbers as a metrologist writes them: rounded to two digits of u, with true minus signs and SI prefixes.

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
"""Rounding lowers an uncertainty by at most this fraction."""

_PREFIXES: Final = (("", 1.0), ("m", 1e-3), ("µ", 1e-6), ("n", 1e-9))
_PRINTED: Final = {"m/s^2": "m/s²"}
_TAKES_PREFIX: Final = frozenset({"V", "g", "m/s^2"})
_SUPERSCRIPT: Final = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
_EXPONENTIAL: Final = re.compile(r"(?<![\w.])([+-]?)(\d+(?:\.\d+)?)e([+-]?\d+)\b")
_NEGATIVE: Final = re.compile(r"(?<![\w.-])-(?=\d)")


@dataclass(frozen=True)
class Scale:
    """A unit as printed; a number in it is the SI number over `size`."""

    unit: str
    size: float

    @property
    def per_g(self) -> str:
        """The unit of a scale factor on the same scale: "µV/g"."""
        return f"({self.unit})/g" if "/" in self.unit else f"{self.unit}/g"


def scale_for(largest: float, unit: str) -> Scale:
    """Return the scale on which `largest` reads best: 9.8e-5 V in µV. Counts take no prefix."""
    printed = _PRINTED.get(unit, unit)
    if unit not in _TAKES_PREFIX or not math.isfinite(largest) or largest == 0.0:
        return Scale(printed, 1.0)
    for prefix, size in _PREFIXES:
        if abs(largest) >= size:
            return Scale(prefix + printed, size)
    prefix, size = _PREFIXES[-1]
    return Scale(prefix + printed, size)


def read_number(text: str) -> float:
    """Return the number in a text: digits 0 to 9, a dot, an exponent; of nan and inf what they are.

    Raises `ValueError` for what only Python takes for one: digits of other alphabets, `1_000`.
    """
    if "_" in text or not text.isascii():
        raise ValueError("no number")
    return float(text)


def places(u: float) -> int:
    """Decimals that show two significant digits of `u`; negative where u is 100 or more."""
    if not math.isfinite(u) or u <= 0.0:
        return PLACES_WITHOUT_U
    return min(MOST_PLACES, 1 - int(f"{u:.1e}".split("e")[1]))


def fixed(value: float, decimals: int, *, sign: bool = False) -> str:
    """Return the number with that many decimals (tens and hundreds where negative); `sign` writes + too."""
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
    """Return a size with two significant digits."""
    return fixed(size, places(size)) if size > 0 else "0" if size == 0 else "–"


def uncertainty(u: float) -> str:
    """Return u or U with two significant digits; up where the nearest would take more than 3 % off it.

    So 10.47 is written 11, and 28.05 is written 28, as in JCGM 100:2008, 7.2.6. `rounded` rounds the estimate to
    the same place: rounding up never reaches the next power of ten.
    """
    if not math.isfinite(u) or u <= 0.0:
        return two_digits(u)
    decimals = places(u)
    step = 10.0**-decimals
    return fixed(u + step if round(u, decimals) < (1.0 - _MOST_OFF) * u else u, decimals)


def figures(value: float, digits: int = 3, *, down: bool = False) -> str:
    """Return a size with so many significant digits, large ones without a power of ten: "1860".

    `down` rounds towards zero, as one rounds what must not be exceeded.
    """
    if down and value > 0.0:
        step = 10.0 ** (math.floor(math.log10(value)) - digits + 1)
        value = step * math.floor(value / step * (1.0 + 1e-9))
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if abs(float(text)) >= 10.0**digits else text


def concise(value: float, u: float) -> str:
    """Return value and u in one: −2.177087(16), u in units of the last digit; 12.3(1.2) where u exceeds 1."""
    if not math.isfinite(u) or u <= 0.0:
        return rounded(value, u)
    text = uncertainty(u)
    if u < 1.0:
        text = text.replace(".", "").lstrip("0")
    return f"{rounded(value, u)}({text})"


def quantity(value: float, unit: str) -> str:
    """Return a size with two significant digits and the prefix that reads best: "98 µV"."""
    scale = scale_for(value, unit)
    return f"{two_digits(value / scale.size)} {scale.unit}"


def probability(p: float) -> str:
    """Return a probability as text: "p = 0.34", "p < 0.0001"."""
    if p < 1e-4:
        return "p < 0.0001"
    return f"p = {p:.2f}" if p >= 0.1 else f"p = {p:.2g}"


def aligned(column: Sequence[str]) -> list[str]:
    """Pad numbers on the right so that their decimal points stand in line when set flush right."""
    tails = [len(text.partition(".")[2]) for text in column]
    longest = max(tails, default=0)
    return [
        text + FIGURE_SPACE * (longest - tail) + (PUNCTUATION_SPACE if longest and "." not in text else "")
        for text, tail in zip(column, tails, strict=True)
    ]


def typeset(text: str) -> str:
    """Return a sentence with its numbers as printed: −1·10⁻⁵ for -1e-05, m/s² for m/s^2."""

    def power(match: re.Match[str]) -> str:
        sign = match[1].replace("-", MINUS)
        return f"{sign}{match[2]}·10{str(int(match[3])).translate(_SUPERSCRIPT)}"

    text = _EXPONENTIAL.sub(power, text).replace("m/s^2", "m/s²")
    return _NEGATIVE.sub(MINUS, text)


def without_infinity(value: Any) -> Any:
    """Return a value of dicts and lists with None for what is no finite number: JSON has none."""
    if isinstance(value, Mapping):
        return {key: without_infinity(of) for key, of in value.items()}
    if isinstance(value, list | tuple):
        return [without_infinity(of) for of in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
