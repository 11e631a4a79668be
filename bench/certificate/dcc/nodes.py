"""Elements of a DCC: texts, numbers, D-SI units, quantities."""

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
from bench.certificate.laboratory import Texts, in_each

ONE: Final = r"\one"
DEGREE: Final = r"\degree"
SECOND: Final = r"\second"
CELSIUS: Final = r"\degreecelsius"
PER_MS2: Final = r"\metre\tothe{-1}\second\tothe{2}"
VOLT_PER_MS2: Final = rf"\volt{PER_MS2}"

SI_UNITS: Final = {
    "V": r"\volt", "V/g": r"\volt", "g/V": r"\volt\tothe{-1}", "A": r"\ampere", "°C": CELSIUS, "deg": DEGREE,
    "rad": r"\radian", "g/(m/s^2)": PER_MS2,
    **dict.fromkeys(("m/s^2", "m/s^2/g", "m/s²"), r"\metre\second\tothe{-2}"),
    **dict.fromkeys(("counts", "counts/g", "g/counts", "g", "g/g", ""), ONE),
}  # fmt: skip
"""D-SI notation of each unit in results. Ratios to local g are quantities of dimension one."""

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

_WORD: Final = re.compile(r"\\([a-z]+)(?:\{([+-]?\d+)\})?")


def product(first: str, second: str) -> str:
    r"""Return the unit of the product of two units in `SI_UNITS`, as for a covariance: `\volt\tothe{2}`."""
    powers: dict[str, int] = {}
    for _, name, power in _parts(first + second):
        if name != "one":
            powers[name] = powers.get(name, 0) + power
    kept = [
        rf"\{name}" if power == 1 else rf"\{name}\tothe{{{power}}}" for name, power in powers.items() if power
    ]
    return "".join(kept) or ONE


def read_unit(text: str) -> tuple[float, dict[str, int]]:
    r"""Return the factor to SI and the dimension of a D-SI unit: `\milli\volt` -> 0.001, {"V": 1}.

    Angles are dimensionless, in radians. Raises `ValueError` for an unknown unit.
    """
    if _WORD.sub("", text).strip() or not text.strip():
        raise ValueError(f"'{visible(text)}' is not a unit of D-SI, such as \\metre")
    factor = 1.0
    powers: dict[str, int] = {}
    for scale, name, power in _parts(text):
        if name not in _UNITS:
            raise ValueError(f"'{visible(text)}': the unit {name} is unknown, unlike SI base units")
        size, dimension = _UNITS[name]
        factor *= (size * 10.0**scale) ** power
        for base, count in dimension.items():
            powers[base] = powers.get(base, 0) + count * power
    return factor, {base: count for base, count in powers.items() if count}


def _parts(text: str) -> list[tuple[int, str, int]]:
    """Return power of ten (prefix), name and exponent of each unit in a D-SI text. Raises `ValueError`."""
    parts: list[tuple[int, str, int]] = []
    scale, sign = 0, 1
    for word, power in _WORD.findall(text):
        if word == "per":
            sign = -1
        elif word == "tothe":
            if not parts or not power:
                raise ValueError(f"'{visible(text)}' is not a unit of D-SI, such as \\metre")
            before, name, first = parts.pop()
            parts.append((before, name, first * int(power)))
        elif word in _PREFIXES:
            scale += _PREFIXES[word]
        else:
            parts.append((scale, word, sign))
            scale, sign = 0, 1
    if scale or sign < 0:
        raise ValueError(f"'{visible(text)}' is not a unit of D-SI, such as \\metre")
    return parts


DCC: Final = "https://ptb.de/dcc"
SI: Final = "https://ptb.de/si"
VERSION: Final = "3.3.0"
NAMESPACES: Final = {"dcc": DCC, "si": SI}

Node = etree._Element


def node(name: str, *content: Node | str | None, **attributes: str) -> Node:
    """Return an element, such as "dcc:item" or "si:real", with text or children; a child None is left out."""
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
    """Return the qualified name of an element: "dcc:item" -> "{https://ptb.de/dcc}item"."""
    prefix, _, local = name.partition(":")
    return f"{{{NAMESPACES[prefix]}}}{local}"


def clean(text: str) -> str:
    """Return a text in one line without control characters or outer blanks; "–" for an empty text."""
    return " ".join(visible(text).split()) or "–"


def said(texts: Sequence[Texts], key: str, **values: object) -> tuple[Node, ...]:
    """Return the text `key` of a certificate as `dcc:content` elements, one for each language (see `in_each`)."""
    return in_languages(texts, in_each(texts, key, **values))


def in_languages(texts: Sequence[Texts], words: Iterable[str]) -> tuple[Node, ...]:
    """Return `words`, one wording for each language of `texts`, as `dcc:content` elements."""
    languages = (one.language for one in texts)
    return tuple(node("dcc:content", text, lang=of) for text, of in zip(words, languages, strict=True))


def plain(text: str) -> Node:
    """Return a text as a `dcc:content` element without a language, for names, numbers, customers' words."""
    return node("dcc:content", text)


def number(value: float) -> str:
    """Return a number in D-SI notation, which reads back as the same float; "NaN" if it is not finite."""
    return repr(float(value)) if math.isfinite(value) else "NaN"


def positional(value: float) -> str:
    """Return a number without an exponent; D-SI requires this form for coverage factors and probabilities."""
    return format(Decimal(repr(float(value))), "f")


def numbers(values: Iterable[float]) -> str:
    """Return numbers in D-SI notation, separated by blanks."""
    return " ".join(number(value) for value in values)


def real(value: float, unit: str, u: float | None = None) -> Node:
    """Return the element of a single quantity, with its standard uncertainty if `u` is given."""
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
    """Return the element of a list of quantities; a single unit in `units` applies to all of them.

    `expanded` holds U, k and coverage probability, each a sequence with one item per value. `covariance` is an
    element from `ellipsoidal`.
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
    """Return the element of the `covariance` (n, n) of quantities in `units` (n), written column by column.

    `k` and `probability` describe the coverage ellipsoid (x - m)ᵀ V⁻¹ (x - m) ≤ k².
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
    """Return a file as a `dcc:byteData` element (Base64)."""
    return node(
        "dcc:byteData",
        node("dcc:name", plain(file.description)),
        node("dcc:fileName", file.name),
        node("dcc:mimeType", file.media_type),
        node("dcc:dataBase64", base64.b64encode(file.content).decode()),
    )
