"""Elements of a DCC, short to write: names, texts in all languages, numbers as D-SI spells them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from decimal import Decimal
from typing import Final

from lxml import etree

from bench.base.visible import visible
from bench.certificate.texts import Texts

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


def real(
    value: float, unit: str, u: float | None = None, expanded: tuple[float, float, float] | None = None
) -> Node:
    """Return a single quantity, with its standard uncertainty, or with U, k and the coverage probability."""
    uncertain = None
    if expanded is not None:
        U, k, probability = expanded
        uncertain = node(
            "si:expandedMU",
            node("si:valueExpandedMU", number(U)),
            node("si:coverageFactor", positional(k)),
            node("si:coverageProbability", positional(probability)),
        )
    elif u is not None:
        uncertain = node("si:standardMU", node("si:valueStandardMU", number(u)))
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
    from bench.certificate.dcc.units import product

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
