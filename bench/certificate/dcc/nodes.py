"""Elements of a DCC: names, texts in all languages, numbers, units as D-SI spells them."""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Iterable, Sequence
from decimal import Decimal
from typing import Final

from lxml import etree

from bench.base.text import visible
from bench.certificate.content import Attached
from bench.certificate.laboratory import Texts

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


DCC: Final = "https://ptb.de/dcc"
SI: Final = "https://ptb.de/si"
SIGNATURE: Final = "http://www.w3.org/2000/09/xmldsig#"
VERSION: Final = "3.3.0"
SI_VERSION: Final = "2.2.1"
NAMESPACES: Final = {"dcc": DCC, "si": SI}

Node = etree._Element


def node(name: str, *content: Node | str | None, **attributes: str) -> Node:
    """Return an element, "dcc:item" or "si:real", with text or children in their order; None is left out."""
    made = etree.Element(tag(name), nsmap=NAMESPACES)
    for key, value in attributes.items():
        made.set(key, value)
    for part in content:
        if isinstance(part, str):
            made.text = clean(part)
        elif part is not None:
            made.append(part)
    return made


def tag(name: str) -> str:
    """Return the name of an element with its namespace."""
    prefix, _, local = name.partition(":")
    return f"{{{NAMESPACES[prefix]}}}{local}"


def clean(text: str) -> str:
    """Return a text that XML can hold, in one line, without blanks at its ends; "–" for an empty one."""
    return " ".join(visible(text).split()) or "–"


def said(texts: Iterable[Texts], key: str, **values: object) -> tuple[Node, ...]:
    """Return a text of a certificate as `content`, once in each language."""
    return tuple(node("dcc:content", one.say(key, **values), lang=one.language) for one in texts)


def plain(text: str) -> Node:
    """Return a text that is of no language: a name, a number, what a customer wrote."""
    return node("dcc:content", text)


def number(value: float) -> str:
    """Return a number as D-SI has it: what reads back to the same float. NaN is the only word."""
    return repr(float(value)) if math.isfinite(value) else "NaN"


def positional(value: float) -> str:
    """Return a number without an exponent: coverage factors and probabilities have none."""
    return format(Decimal(repr(float(value))), "f")


def numbers(values: Iterable[float]) -> str:
    """Return a list of numbers."""
    return " ".join(number(value) for value in values)


def real(value: float, unit: str, u: float | None = None) -> Node:
    """Return a single quantity, with its standard uncertainty where there is one."""
    uncertain = None if u is None else node("si:standardMU", node("si:valueStandardMU", number(u)))
    return node(
        "si:real",
        node("si:value", number(value)),
        node("si:unit", unit),
        None if uncertain is None else node("si:measurementUncertaintyUnivariate", uncertain),
    )


def real_list(
    values: Sequence[float],
    units: Sequence[str],
    labels: Sequence[str] = (),
    expanded: tuple[Sequence[float], Sequence[float], Sequence[float]] | None = None,
    covariance: Node | None = None,
) -> Node:
    """Return a list of quantities; one unit in `units` is that of all.

    `expanded` are U, k and coverage probability, each of every value; `covariance` as `ellipsoidal` gives it.
    """
    univariate = None
    if expanded is not None:
        U, k, probability = expanded
        univariate = node(
            "si:measurementUncertaintyUnivariateXMLList",
            node(
                "si:expandedMUXMLList",
                node("si:valueExpandedMUXMLList", numbers(U)),
                node("si:coverageFactorXMLList", " ".join(map(positional, k))),
                node("si:coverageProbabilityXMLList", " ".join(map(positional, probability))),
            ),
        )
    return node(
        "si:realListXMLList",
        node("si:labelXMLList", " ".join(labels)) if labels else None,
        node("si:valueXMLList", numbers(values)),
        node("si:unitXMLList", " ".join(units)),
        univariate,
        covariance,
    )


def ellipsoidal(
    covariance: Sequence[Sequence[float]], units: Sequence[str], k: float, probability: float
) -> Node:
    """Return a covariance (n, n) of quantities in `units` (n), a unit for every entry, column by column.

    `k` and `probability` are those of the ellipsoid (x - m)ᵀ V⁻¹ (x - m) ≤ k².
    """

    columns = [
        node(
            "si:columnXMLList",
            node(
                "si:covarianceXMLList",
                node("si:valueXMLList", numbers(row[j] for row in covariance)),
                node("si:unitXMLList", " ".join(product(one, units[j]) for one in units)),
            ),
        )
        for j in range(len(units))
    ]
    return node(
        "si:measurementUncertaintyMultivariateXMLList",
        node(
            "si:ellipsoidalRegionMUXMLList",
            node("si:covarianceMatrixXMLList", *columns),
            node("si:coverageFactorXMLList", positional(k)),
            node("si:coverageProbabilityXMLList", positional(probability)),
        ),
    )


def byte_data(file: Attached) -> Node:
    """Return a file as a DCC holds it."""
    return node(
        "dcc:byteData",
        node("dcc:name", plain(file.description)),
        node("dcc:fileName", file.name),
        node("dcc:mimeType", file.media_type),
        node("dcc:dataBase64", base64.b64encode(file.content).decode()),
    )
