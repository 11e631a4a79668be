"""Reading of any DCC, whichever program made it: texts, embedded files, lists of real quantities."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.base.text import visible
from bench.certificate.dcc.nodes import DCC, NAMESPACES, SI, Node, read_unit
from bench.services.coefficients import impossible

Dimension = tuple[tuple[str, int], ...]


class NotRead(ValueError):
    """Raised for an embedded file that is not Base64, or a list that violates D-SI; the message says which."""


def said(root: Node, path: str) -> str:
    """Return the text at `path` in one line, with control characters visible; "" if there is none."""
    return " ".join(visible(root.findtext(path, "", NAMESPACES)).split())


def files_in(root: Node) -> dict[str, bytes]:
    """Return the files embedded in a document, by name. Raises `NotRead` for one that is not Base64."""
    files = {}
    for one in root.iter(f"{{{DCC}}}byteData"):
        name = said(one, "dcc:fileName")
        try:
            text = one.findtext("dcc:dataBase64", "", NAMESPACES)
            files[name] = base64.b64decode(text.strip(), validate=True)
        except binascii.Error as error:
            raise NotRead(f"line {one.sourceline}: the file {name} cannot be decoded") from error
    return files


@dataclass(frozen=True)
class RealList:
    """A list of quantities in a document; `values` (n,) and `covariance` (n, n) are converted to SI units.

    `units` (n) are the document's units; `factors` (n,) convert them to SI, and `dimensions` (n) map SI bases to
    exponents. `uncertainty` is U, in the document's units, and k, each of shape (n,), or (1,) for all.
    `uncertainty` and `covariance` are None if the document does not state them. `roles` are the words in refType of
    the list and of its enclosing elements.
    """

    line: int
    labels: tuple[str, ...]
    values: Floats
    units: tuple[str, ...]
    factors: Floats
    dimensions: tuple[Dimension, ...]
    covariance: Floats | None
    uncertainty: tuple[Floats, Floats] | None
    roles: frozenset[str]

    @property
    def u(self) -> Floats | None:
        """The standard uncertainties in SI units, shape (n,); None if the document does not state them."""
        if self.uncertainty is None:
            return None
        U, k = self.uncertainty
        return np.asarray(U / k * np.abs(self.factors), dtype=np.float64)

    @property
    def words(self) -> str:
        """A description of the list, for use in a sentence."""
        named = f": {' '.join(self.labels[:12])}" if self.labels else ""
        return f"line {self.line}, {len(self.values)} values{named}"


def real_lists(root: Node) -> Iterator[RealList]:
    """Yield every list of quantities of a document, XMLList or realList. Raises `NotRead` if one violates D-SI."""
    for element in root.iter(f"{{{SI}}}realListXMLList"):
        values = _floats(element, "si:valueXMLList")
        units = _words(element, "si:unitXMLList")
        units = units * len(values) if len(units) == 1 else units
        yield _made(element, _words(element, "si:labelXMLList"), values, units, _uncertainties(element))
    for element in root.iter(f"{{{SI}}}realList"):
        members = element.findall("si:real", NAMESPACES)
        common = element.findtext("si:listUnit", "", NAMESPACES)
        labels = [one.findtext("si:label", "", NAMESPACES).strip() for one in members]
        values = np.array([_number(one, _text(one, "si:value")) for one in members])
        units = [one.findtext("si:unit", common, NAMESPACES) for one in members]
        known = [one for one in map(_uncertainty_of, members) if one is not None]
        U, k = np.reshape(known, (-1, 2)).T
        stated = (U, k) if len(known) == len(members) else None
        yield _made(element, labels if all(labels) else [], values, units, stated)


def _made(
    element: Node,
    labels: list[str],
    values: Floats,
    units: list[str],
    uncertainty: tuple[Floats, Floats] | None,
) -> RealList:
    """Return the list of quantities in an element; converts `values` (n,) from `units` to SI."""
    factors, dimensions = _units(element, units, len(values))
    for stated in uncertainty or ():
        if len(stated) not in {1, len(values)}:
            raise NotRead(f"line {element.sourceline}: {len(values)} values, but {len(stated)} uncertainties")
    columns = [
        (_floats(column, ".//si:valueXMLList"), _words(column, ".//si:unitXMLList"))
        for column in element.findall(".//si:covarianceMatrixXMLList/si:columnXMLList", NAMESPACES)
    ]
    columns += [
        (
            np.array([_number(one, _text(one, "si:value")) for one in column]),
            [_text(one, "si:unit") for one in column],
        )
        for column in element.findall(".//si:covarianceMatrix/si:column", NAMESPACES)
    ]
    within = [element, *element.iterancestors(f"{{{DCC}}}*")]
    return RealList(
        int(str(element.sourceline or 0)),
        tuple(labels),
        values * factors,
        tuple(units),
        factors,
        dimensions,
        _covariance(element, columns, dimensions) if columns else None,
        uncertainty,
        frozenset(word for one in within for word in (one.get("refType") or "").split()),
    )


_UNCERTAINTIES: Final = (
    ("valueExpandedMU", "coverageFactor"), ("uncertainty", "coverageFactor"), ("valueStandardMU", ""),
    ("standardUnc", ""),
)  # fmt: skip
"""Elements that state an uncertainty, each with the element of its k; in a list, both names end in XMLList."""


def _uncertainties(element: Node) -> tuple[Floats, Floats] | None:
    """Return U and k in a list: one per value, or one for all; None if there is none."""
    for name, factor in _UNCERTAINTIES:
        text = element.findtext(f"si:*//si:{name}XMLList", None, NAMESPACES)
        if text is not None:
            k = _floats(element, f"si:*//si:{factor}XMLList") if factor else np.ones(1)
            return _numbers(element, text), k
    return None


def _uncertainty_of(element: Node) -> tuple[float, float] | None:
    """Return U and k of a single value; None if the document states none."""
    for name, factor in _UNCERTAINTIES:
        size = element.findtext(f".//si:{name}", None, NAMESPACES)
        if size is not None:
            k = _number(element, _text(element, f".//si:{factor}")) if factor else 1.0
            return _number(element, size), k
    return None


def _units(element: Node, units: list[str], count: int) -> tuple[Floats, tuple[Dimension, ...]]:
    if len(units) != count:
        raise NotRead(f"line {element.sourceline}: {count} values, but {len(units)} units")
    try:
        read = [read_unit(unit) for unit in units]
    except ValueError as error:
        raise NotRead(f"line {element.sourceline}: {error}") from None
    return np.array([factor for factor, _ in read]), tuple(tuple(sorted(d.items())) for _, d in read)


def _covariance(
    element: Node, columns: list[tuple[Floats, list[str]]], dimensions: tuple[Dimension, ...]
) -> Floats:
    """Return the covariance (n, n) in SI units. Raises `NotRead` for columns of the wrong size or unit."""
    count = len(dimensions)
    if len(columns) != count or any(len(values) != count for values, _ in columns):
        raise NotRead(f"line {element.sourceline}: {count} values, but a covariance of another size")
    matrix = np.zeros((count, count))
    for j, (values, units) in enumerate(columns):
        factors, found = _units(element, units * count if len(units) == 1 else units, count)
        for i in range(count):
            if found[i] != _times(dimensions[i], dimensions[j]):
                raise NotRead(
                    f"line {element.sourceline}: the covariance of values {i + 1} and {j + 1} has another unit "
                    "than their product"
                )
        matrix[:, j] = values * factors
    if not np.isfinite(matrix).all():
        raise NotRead(f"line {element.sourceline}: the covariance has a number that is not finite")
    if why := impossible(matrix):
        raise NotRead(f"line {element.sourceline}: {why}")
    return matrix


def _times(first: Dimension, second: Dimension) -> Dimension:
    powers = dict(first)
    for base, power in second:
        powers[base] = powers.get(base, 0) + power
    return tuple(sorted((base, power) for base, power in powers.items() if power))


def _text(element: Node, path: str) -> str:
    text = element.findtext(path, None, NAMESPACES)
    if text is None:
        raise NotRead(f"line {element.sourceline}: it has no {path.rsplit(':', 1)[-1]}")
    return text


def _words(element: Node, path: str) -> list[str]:
    return (element.findtext(path, "", NAMESPACES)).split()


def _floats(element: Node, path: str) -> Floats:
    return _numbers(element, _text(element, path))


def _numbers(element: Node, text: str) -> Floats:
    return np.array([_number(element, word) for word in text.split()])


def _number(element: Node, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = float("nan")
        if word.strip() != "NaN":
            raise NotRead(f"line {element.sourceline}: {word[:40]!r} is not a number") from None
    return value
