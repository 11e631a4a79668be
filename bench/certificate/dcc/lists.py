"""Lists of real quantities in any DCC, whoever wrote it: names, values in SI units, and what is known of u."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.certificate.dcc.nodes import DCC, NAMESPACES, SI, Node, read_unit
from bench.services.coefficients import impossible

Dimension = tuple[tuple[str, int], ...]

_UNIVARIATE: Final = (
    ("si:valueExpandedMUXMLList", "si:coverageFactorXMLList"),
    ("si:uncertaintyXMLList", "si:coverageFactorXMLList"),
    ("si:valueStandardMUXMLList", ""),
    ("si:standardUncXMLList", ""),
)


class NotRead(ValueError):
    """A list is not what D-SI says; the text says where and why."""


@dataclass(frozen=True)
class RealList:
    """A list as it stands in a document: values (n,) in SI units, their dimensions, what is known of u.

    `covariance` (n, n) is None where the document states none, `u` (n,) where it states nothing univariate either.
    `roles` are the words of refType of it and of what it stands in.
    """

    line: int
    labels: tuple[str, ...]
    values: Floats
    dimensions: tuple[Dimension, ...]
    covariance: Floats | None
    u: Floats | None
    roles: frozenset[str]

    @property
    def words(self) -> str:
        """What it is, for a sentence."""
        named = f": {' '.join(self.labels[:12])}" if self.labels else ""
        return f"line {self.line}, {len(self.values)} values{named}"


def real_lists(root: Node) -> Iterator[RealList]:
    """Yield the lists of a document, of either form. Raises `NotRead` for one that is not what D-SI says."""
    for element in root.iter(f"{{{SI}}}realListXMLList"):
        yield _of_words(element)
    for element in root.iter(f"{{{SI}}}realList"):
        yield _of_members(element)


def _of_words(element: Node) -> RealList:
    values = _floats(element, "si:valueXMLList")
    units = _words(element, "si:unitXMLList")
    factors, dimensions = _units(element, units * len(values) if len(units) == 1 else units, len(values))
    u = None
    for name, factor in _UNIVARIATE:
        sizes = element.findtext(f"si:*//{name}", None, NAMESPACES)
        if sizes is not None:
            k = _floats(element, f"si:*//{factor}") if factor else np.ones(1)
            u = _broadcast(element, _numbers(element, sizes) / k, len(values)) * np.abs(factors)
            break
    columns = element.findall(".//si:covarianceMatrixXMLList/si:columnXMLList", NAMESPACES)
    rows = [
        (_numbers(column, _text(column, ".//si:valueXMLList")), _words(column, ".//si:unitXMLList"))
        for column in columns
    ]
    columns = element.findall(".//si:covarianceMatrix/si:column", NAMESPACES)
    rows += [
        (
            np.array([_number(one, _text(one, "si:value")) for one in column]),
            [_text(one, "si:unit") for one in column],
        )
        for column in columns
    ]
    covariance = _covariance(element, rows, dimensions) if rows else None
    return RealList(
        _line(element),
        tuple(_words(element, "si:labelXMLList")),
        values * factors,
        dimensions,
        covariance,
        u,
        _roles(element),
    )


def _of_members(element: Node) -> RealList:
    """Read a list of `si:real`, each with its own label, unit and uncertainty."""
    members = element.findall("si:real", NAMESPACES)
    common = element.findtext("si:listUnit", "", NAMESPACES)
    units = [one.findtext("si:unit", common, NAMESPACES) for one in members]
    factors, dimensions = _units(element, units, len(members))
    values = np.array([_number(one, _text(one, "si:value")) for one in members])
    sizes = [_u_of(one) for one in members]
    known = [size for size in sizes if size is not None]
    u = np.array(known) * np.abs(factors) if len(known) == len(members) else None
    rows = [
        (
            np.array([_number(one, _text(one, "si:value")) for one in column]),
            [_text(one, "si:unit") for one in column],
        )
        for column in element.findall(".//si:covarianceMatrix/si:column", NAMESPACES)
    ]
    labels = tuple(one.findtext("si:label", "", NAMESPACES).strip() for one in members)
    return RealList(
        _line(element),
        labels if all(labels) else (),
        values * factors,
        dimensions,
        _covariance(element, rows, dimensions) if rows else None,
        u,
        _roles(element),
    )


def _u_of(element: Node) -> float | None:
    for name, factor in (
        ("valueExpandedMU", "coverageFactor"), ("uncertainty", "coverageFactor"), ("valueStandardMU", ""),
        ("standardUnc", ""),
    ):  # fmt: skip
        size = element.findtext(f".//si:{name}", None, NAMESPACES)
        if size is not None:
            k = _number(element, _text(element, f".//si:{factor}")) if factor else 1.0
            return _number(element, size) / k
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
    """Return a covariance in SI units. Raises `NotRead` for a matrix that is none, or of other units."""
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
    if why := impossible(matrix):
        raise NotRead(f"line {element.sourceline}: {why}")
    return matrix


def _times(first: Dimension, second: Dimension) -> Dimension:
    powers = dict(first)
    for base, power in second:
        powers[base] = powers.get(base, 0) + power
    return tuple(sorted((base, power) for base, power in powers.items() if power))


def _roles(element: Node) -> frozenset[str]:
    within = [element, *element.iterancestors(f"{{{DCC}}}*")]
    return frozenset(word for one in within for word in (one.get("refType") or "").split())


def _broadcast(element: Node, values: Floats, count: int) -> Floats:
    if len(values) not in {1, count}:
        raise NotRead(f"line {element.sourceline}: {count} values, but {len(values)} uncertainties")
    return np.broadcast_to(values, (count,)).astype(np.float64)


def _line(element: Node) -> int:
    return int(str(element.sourceline or 0))


def _text(element: Node, path: str) -> str:
    text = element.findtext(path, None, NAMESPACES)
    if text is None:
        raise NotRead(f"line {element.sourceline}: there is no {path.rsplit(':', 1)[-1]}")
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
            raise NotRead(f"line {element.sourceline}: {word[:40]!r} is no number") from None
    return value
