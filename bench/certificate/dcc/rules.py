"""Lists and files in any DCC, whichever program made it; rules and schemas that check a DCC before it is issued."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from lxml import etree

from bench.base.arrays import Floats, u_of
from bench.base.text import cause_of, visible
from bench.certificate.dcc.nodes import DCC, NAMESPACES, SI, VERSION, Node, read_unit
from bench.certificate.laboratory import SIMULATED_SERIES
from bench.certificate.signatures import SIGNATURE, parser
from bench.services.coefficients import impossible
from bench.services.errors import Refused

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


# --- rules --------------------------------------------------------------------------------------------

SI_VERSION: Final = "2.2.1"


def broken_rules(document: bytes) -> tuple[str, ...]:
    """Return a sentence, with the line number, for each violation of this program's own rules for a DCC."""
    try:
        root = etree.fromstring(document, parser())
    except etree.XMLSyntaxError as error:
        return (f"not XML: {error}",)
    return tuple(dict.fromkeys(told for rule in _RULES for told in rule(root)))


def _at(element: Node, text: str) -> str:
    return f"line {element.sourceline}, {etree.QName(element).localname}: {text}"


def _version(root: Node) -> Iterator[str]:
    if root.tag != f"{{{DCC}}}digitalCalibrationCertificate" or root.get("schemaVersion") != VERSION:
        yield _at(root, f"not a DCC {VERSION}")


def _languages(root: Node) -> Iterator[str]:
    """Yield a fault for each text that is not stated in every language of the document."""
    used = {one.text for one in root.iter(f"{{{DCC}}}usedLangCodeISO639_1")}
    for element in root.iter(f"{{{DCC}}}*", f"{{{SI}}}*"):
        said = [one.get("lang") for one in element.findall("dcc:content", NAMESPACES)]
        spoken = {language for language in said if language is not None}
        if spoken and spoken != used:
            yield _at(element, f"said in {', '.join(sorted(spoken))}, not in all languages used")


def _lists(root: Node) -> Iterator[str]:
    """Yield a fault for each list whose labels or U contradict its values, and for the first that violates D-SI."""
    try:
        for one in real_lists(root):
            if one.labels and len(one.labels) != len(one.values):
                yield f"line {one.line}: {len(one.values)} values, but {len(one.labels)} in labelXMLList"
            if (
                one.covariance is not None
                and one.u is not None
                and not np.allclose(one.u, u_of(one.covariance), rtol=1e-9, atol=1e-300)
            ):
                yield f"line {one.line}: U is not k times the root of the covariance's diagonal"
    except NotRead as error:
        yield str(error)


def _days(root: Node) -> Iterator[str]:
    """Yield a fault unless the days of receipt, calibration and issue are in chronological order."""
    core = root.find("dcc:administrativeData/dcc:coreData", NAMESPACES)
    names = ("receiptDate", "beginPerformanceDate", "endPerformanceDate", "issueDate")
    days = [] if core is None else [core.findtext(f"dcc:{name}", "", NAMESPACES) for name in names]
    if days != sorted(days):
        yield f"{', '.join(names)} are not in this order: {', '.join(days)}"


def _simulation(root: Node) -> Iterator[str]:
    """Yield a fault if certificate number and statements disagree on whether the run was simulated."""
    number = root.findtext("dcc:administrativeData/dcc:coreData/dcc:uniqueIdentifier", "", NAMESPACES)
    said = root.find(".//dcc:statement[@refType='bench_simulated']", NAMESPACES) is not None
    if said != number.startswith(SIMULATED_SERIES):
        yield f"number {number}: those that begin with {SIMULATED_SERIES} are of simulated runs, and say so"


def _statements(root: Node) -> Iterator[str]:
    """Yield a fault for each list with unequal numbers of conformity statements and values."""
    for element in root.iter(f"{{{DCC}}}conformityXMLList"):
        quantity = next(element.iterancestors(f"{{{DCC}}}quantity"), None)
        values = "" if quantity is None else quantity.findtext(".//si:valueXMLList", "", NAMESPACES)
        if len((element.text or "").split()) != len(values.split()):
            yield _at(element, "not a statement for each value")


def _signed(root: Node) -> Iterator[str]:
    """Yield a fault for each comment, and for each element of another namespace outside a signature."""
    for element in root.iter():
        if not isinstance(element.tag, str):
            yield f"line {element.sourceline}: a comment or an instruction, which no signature covers"
        elif etree.QName(element).namespace not in {DCC, SI}:
            within = [element, *element.iterancestors()]
            if not any(one.tag == f"{{{SIGNATURE}}}Signature" for one in within):
                yield _at(element, "not in the name space of a DCC")


_RULES: Final[tuple[Callable[[Node], Iterator[str]], ...]] = (
    _version, _languages, _lists, _days, _simulation, _statements, _signed,
)  # fmt: skip


_FILES: Final = {"dcc.xsd": VERSION, "SI_Format.xsd": SI_VERSION}
_STAND_INS: Final = {
    "quantitykind.xsd": (
        "http://qudt.org/vocab/",
        '<xs:simpleType name="quantitykind"><xs:restriction base="xs:string"/></xs:simpleType>',
    ),
    "xmldsig-core-schema.xsd": (
        SIGNATURE,
        '<xs:element name="Signature"><xs:complexType><xs:sequence><xs:any processContents="skip" '
        'maxOccurs="unbounded"/></xs:sequence><xs:anyAttribute processContents="skip"/></xs:complexType>'
        "</xs:element>",
    ),
}
"""Minimal replacements for imported schemas that the folder lacks, by file name: namespace and content."""


def against_schemas(schemas: etree.XMLSchema, document: bytes) -> tuple[str, ...]:
    """Return a sentence for each violation of the schemas in a document."""
    if schemas.validate(etree.fromstring(document, parser())):
        return ()
    log: Any = schemas.error_log
    return tuple(f"line {error.line}: {error.message}" for error in log)


def read_schemas(folder: Path) -> etree.XMLSchema:
    """Compile dcc.xsd, SI_Format.xsd and the schemas that these two import, found anywhere below a folder.

    Nothing is fetched from a network; an empty or minimal schema replaces an imported one that is missing.
    Raises `Refused` if dcc.xsd or SI_Format.xsd is missing or has another version, or if one is unreadable.
    """
    there = {path.name.lower(): path for path in sorted(folder.rglob("*.xsd"))}
    for name, version in _FILES.items():
        path = there.get(name.lower())
        if path is None:
            raise Refused(
                f"--schema {folder}: the folder has no {name}; give the folder with PTB's schemas of DCC and "
                f"D-SI ({', '.join(_FILES)})"
            )
        stated = _version_of(path)
        if stated != version:
            raise Refused(
                f"{path}: the schema has version {stated}, but certificates follow {version}; give the schemas "
                f"of {version}"
            )
    base: Any = etree.Resolver

    class Local(base):  # type: ignore[misc]
        def resolve(self, url: str, _public: str, context: Any) -> Any:
            name = url.rsplit("/", 1)[-1]
            path = there.get(name.lower())
            if path is not None:
                return self.resolve_filename(str(path), context)
            space, content = _STAND_INS.get(name, ("", ""))
            text = (
                f'<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" targetNamespace="{space}">{content}'
                "</xs:schema>"
            )
            return self.resolve_string(text, context)

    reader = parser()
    reader.resolvers.add(Local())
    try:
        return etree.XMLSchema(etree.parse(str(there["dcc.xsd"]), reader))
    except (etree.XMLSchemaParseError, etree.XMLSyntaxError, OSError) as error:
        raise Refused(f"--schema {folder}: cannot be used ({error}); download the schemas again") from error


def _version_of(path: Path) -> str | None:
    try:
        return etree.parse(str(path), parser()).getroot().get("version")
    except etree.XMLSyntaxError as error:
        raise Refused(f"{path}: not XML ({error}); download the schemas again") from error
    except OSError as error:
        raise Refused(f"{path}: cannot be read ({cause_of(error)}); check name and permissions") from error
