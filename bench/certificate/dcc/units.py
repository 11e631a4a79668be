r"""Units as D-SI spells them: `\volt\metre\tothe{-1}\second\tothe{2}`, written and read.

Source: D-SI, after the SI brochure, 9th edition: units by their names, prefixes before them, `\tothe{n}` a power,
`\per` what the next unit is divided by.
"""

from __future__ import annotations

import math
import re
from typing import Final

VOLT: Final = r"\volt"
ONE: Final = r"\one"
PER_VOLT: Final = r"\volt\tothe{-1}"
VOLT_PER_MS2: Final = r"\volt\metre\tothe{-1}\second\tothe{2}"
RADIAN: Final = r"\radian"
DEGREE: Final = r"\degree"
SECOND: Final = r"\second"
CELSIUS: Final = r"\degreecelsius"
AMPERE: Final = r"\ampere"
MS2: Final = r"\metre\second\tothe{-2}"

_OURS: Final = {
    "V": VOLT, "V/g": VOLT, "g/V": PER_VOLT, "counts": ONE, "counts/g": ONE, "g/counts": ONE, "g": ONE, "g/g": ONE,
    "m/s^2": MS2, "m/s^2/g": MS2, "g/(m/s^2)": r"\metre\tothe{-1}\second\tothe{2}", "rad": RADIAN, "°C": CELSIUS,
    "A": AMPERE, "m/s²": MS2, "": ONE,
}  # fmt: skip
"""Our units as D-SI has them. Local g is the unit of what is a ratio to it, a quantity of dimension one."""

_PREFIXES: Final = {
    "quecto": -30, "ronto": -27, "yocto": -24, "zepto": -21, "atto": -18, "femto": -15, "pico": -12, "nano": -9,
    "micro": -6, "milli": -3, "centi": -2, "deci": -1, "deca": 1, "hecto": 2, "kilo": 3, "mega": 6, "giga": 9,
    "tera": 12, "peta": 15, "exa": 18, "zetta": 21, "yotta": 24, "ronna": 27, "quetta": 30,
}  # fmt: skip

_UNITS: Final[dict[str, tuple[float, dict[str, int]]]] = {
    "one": (1.0, {}), "percent": (0.01, {}), "ppm": (1e-6, {}), "metre": (1.0, {"m": 1}), "meter": (1.0, {"m": 1}),
    "second": (1.0, {"s": 1}), "minute": (60.0, {"s": 1}), "hour": (3600.0, {"s": 1}), "day": (86400.0, {"s": 1}),
    "volt": (1.0, {"V": 1}), "ampere": (1.0, {"A": 1}), "ohm": (1.0, {"V": 1, "A": -1}), "radian": (1.0, {}),
    "degree": (math.pi / 180.0, {}), "arcminute": (math.pi / 10800.0, {}), "arcsecond": (math.pi / 648000.0, {}),
    "kelvin": (1.0, {"K": 1}), "degreecelsius": (1.0, {"K": 1}), "hertz": (1.0, {"s": -1}),
}  # fmt: skip

_POWER: Final = re.compile(r"\\([a-z]+)(?:\\tothe\{(-?\d+)\})?")
_WORD: Final = re.compile(r"\\([a-z]+)(?:\{([+-]?\d+)\})?")


def si_unit(unit: str) -> str:
    """Return a unit of a result as D-SI has it. Raises `KeyError` for one that no result has."""
    return _OURS[unit]


def product(first: str, second: str) -> str:
    r"""Return the unit of a product of two of ours, as that of a covariance: `\volt\tothe{2}`."""
    powers: dict[str, int] = {}
    for name, power in _POWER.findall(first + second):
        if name != "one":
            powers[name] = powers.get(name, 0) + int(power or 1)
    kept = [
        rf"\{name}" if power == 1 else rf"\{name}\tothe{{{power}}}" for name, power in powers.items() if power
    ]
    return "".join(kept) or ONE


def read_unit(text: str) -> tuple[float, dict[str, int]]:
    r"""Return how many SI units a unit of D-SI is, and its dimension by base: `\milli\volt` is 0.001, {"V": 1}.

    An angle counts as a number. Raises `ValueError` for what is no unit that is known here.
    """
    if _WORD.sub("", text).strip() or not text.strip():
        raise ValueError(f"{text!r} is no unit of D-SI")
    factor = 1.0
    powers: dict[str, int] = {}
    for scale, name, power in _parts(text):
        if name not in _UNITS:
            raise ValueError(f"{text!r}: the unit {name} is not known here")
        size, dimension = _UNITS[name]
        factor *= (size * 10.0**scale) ** power
        for base, count in dimension.items():
            powers[base] = powers.get(base, 0) + count * power
    return factor, {base: count for base, count in powers.items() if count}


def _parts(text: str) -> list[tuple[int, str, int]]:
    """Return power of ten, name and power of each unit in a text. Raises `ValueError`."""
    parts: list[tuple[int, str, int]] = []
    scale, sign = 0, 1
    for word, power in _WORD.findall(text):
        if word == "per":
            sign = -1
        elif word == "tothe":
            if not parts or not power:
                raise ValueError(f"{text!r} is no unit of D-SI")
            before, name, first = parts.pop()
            parts.append((before, name, first * int(power)))
        elif word in _PREFIXES:
            scale += _PREFIXES[word]
        else:
            parts.append((scale, word, sign))
            scale, sign = 0, 1
    if scale or sign < 0:
        raise ValueError(f"{text!r} is no unit of D-SI")
    return parts
