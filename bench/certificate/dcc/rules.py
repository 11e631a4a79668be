"""Rules for documents of ours that the institute's schemas cannot state, and these schemas where they are given."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from lxml import etree

from bench.certificate.dcc.nodes import DCC, NAMESPACES, SI, SI_VERSION, SIGNATURE, VERSION, Node, read_unit
from bench.certificate.laboratory import SIMULATED_SERIES
from bench.services.coefficients import impossible
from bench.services.errors import Refused


def broken_rules(document: bytes) -> tuple[str, ...]:
    """Return what a document of ours must not be, a sentence each with its line; nothing for a good one."""
    try:
        root = etree.fromstring(document, parser())
    except etree.XMLSyntaxError as error:
        return (f"not XML: {error}",)
    return tuple(dict.fromkeys(told for rule in _RULES for told in rule(root)))


def parser() -> etree.XMLParser:
    """Return the parser of documents from elsewhere: no entities, no DTD, nothing from a network."""
    return etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)


def local(element: Node) -> str:
    """Return the name of an element without its namespace; empty for a comment."""
    return etree.QName(element).localname if isinstance(element.tag, str) else ""


def _at(element: Node, text: str) -> str:
    return f"line {element.sourceline}, {local(element)}: {text}"


def _elements(root: Node) -> Iterator[Node]:
    """Yield the elements that are ours to check: all but signatures."""
    yield from root.iter(f"{{{DCC}}}*", f"{{{SI}}}*")


def _version(root: Node) -> Iterator[str]:
    """The document is a DCC of the version that is written here."""
    if root.tag != f"{{{DCC}}}digitalCalibrationCertificate" or root.get("schemaVersion") != VERSION:
        yield _at(root, f"not a DCC {VERSION}")


def _languages(root: Node) -> Iterator[str]:
    """Where a text is said in one of the languages it is said in all of them."""
    used = {one.text for one in root.iter(f"{{{DCC}}}usedLangCodeISO639_1")}
    for element in _elements(root):
        said = [one.get("lang") for one in element.findall("dcc:content", NAMESPACES)]
        spoken = {language for language in said if language is not None}
        if spoken and spoken != used:
            yield _at(element, f"said in {', '.join(sorted(spoken))}, not in all languages used")


def _lists(root: Node) -> Iterator[str]:
    """The parts of a list are as many as its values, its units known."""
    for element in root.iter(f"{{{SI}}}realListXMLList"):
        words = {local(one): (one.text or "").split() for one in element.iter(f"{{{SI}}}*") if one.text}
        count = len((element.findtext("si:valueXMLList", "", NAMESPACES)).split())
        units = (element.findtext("si:unitXMLList", "", NAMESPACES)).split()
        if len(units) not in {1, count}:
            yield _at(element, f"{count} values, but {len(units)} units")
        for name in ("labelXMLList", "valueExpandedMUXMLList"):
            if name in words and len(words[name]) != count:
                yield _at(element, f"{count} values, but {len(words[name])} in {name}")
        for unit in units:
            try:
                read_unit(unit)
            except ValueError as error:
                yield _at(element, str(error))


def _covariances(root: Node) -> Iterator[str]:
    """A covariance is square, symmetric and possible, and U is k times the root of its diagonal."""
    for element in root.iter(f"{{{SI}}}realListXMLList"):
        columns = element.findall(".//si:covarianceXMLList/si:valueXMLList", NAMESPACES)
        if not columns:
            continue
        count = len((element.findtext("si:valueXMLList", "", NAMESPACES)).split())
        rows = [[float(word) for word in (column.text or "").split()] for column in columns]
        if len(rows) != count or any(len(row) != count for row in rows):
            yield _at(element, f"{count} values, but a covariance of {[len(row) for row in rows]}")
            continue
        covariance = np.array(rows)
        if why := impossible(covariance):
            yield _at(element, why)
        path = ".//si:expandedMUXMLList/si:{}"
        U, k = (
            [float(word) for word in (element.findtext(path.format(name), "", NAMESPACES)).split()]
            for name in ("valueExpandedMUXMLList", "coverageFactorXMLList")
        )
        u = np.sqrt(np.abs(np.diag(covariance)))
        if len(U) == len(k) == count and not np.allclose(
            np.array(U), np.array(k) * u, rtol=1e-9, atol=1e-300
        ):
            yield _at(element, "U is not k times the root of the covariance's diagonal")


def _days(root: Node) -> Iterator[str]:
    """Received, calibrated, issued: in this order."""
    core = root.find("dcc:administrativeData/dcc:coreData", NAMESPACES)
    names = ("receiptDate", "beginPerformanceDate", "endPerformanceDate", "issueDate")
    days = [] if core is None else [core.findtext(f"dcc:{name}", "", NAMESPACES) for name in names]
    if days != sorted(days):
        yield f"{', '.join(names)} are not in this order: {', '.join(days)}"


def _simulation(root: Node) -> Iterator[str]:
    """What is simulated says so and is numbered in its own series; what is not is in none of these."""
    number = root.findtext("dcc:administrativeData/dcc:coreData/dcc:uniqueIdentifier", "", NAMESPACES)
    said = root.find(".//dcc:statement[@refType='bench_simulated']", NAMESPACES) is not None
    if said != number.startswith(SIMULATED_SERIES):
        yield f"number {number}: those that begin with {SIMULATED_SERIES} are of simulated runs, and say so"


def _statements(root: Node) -> Iterator[str]:
    """Statements of conformity are as many as the values that they are on."""
    for element in root.iter(f"{{{DCC}}}conformityXMLList"):
        quantity = next(element.iterancestors(f"{{{DCC}}}quantity"), None)
        values = "" if quantity is None else quantity.findtext(".//si:valueXMLList", "", NAMESPACES)
        if len((element.text or "").split()) != len(values.split()):
            yield _at(element, "not a statement for each value")


def _signed(root: Node) -> Iterator[str]:
    """Nothing stands outside the two name spaces but signatures at the end."""
    for element in root.iter():
        if not isinstance(element.tag, str):
            yield f"line {element.sourceline}: a comment or an instruction, which nobody signs for"
        elif etree.QName(element).namespace not in {DCC, SI}:
            within = [element, *element.iterancestors()]
            if not any(one.tag == f"{{{SIGNATURE}}}Signature" for one in within):
                yield _at(element, "of no name space of a DCC")


_RULES: Final[tuple[Callable[[Node], Iterator[str]], ...]] = (
    _version, _languages, _lists, _covariances, _days, _simulation, _statements, _signed,
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
"""What the two import from elsewhere, where the folder lacks it: of it only signatures stand in a document."""


@dataclass(frozen=True)
class Schemas:
    """The schemas of a folder, ready to check with; `stood_in` names the files that were not there."""

    folder: Path
    checker: etree.XMLSchema
    stood_in: tuple[str, ...]

    def mistakes(self, document: bytes) -> tuple[str, ...]:
        """Return what the schemas find wrong with a document, a sentence each."""
        root = etree.fromstring(document, parser())
        if self.checker.validate(root):
            return ()
        log: Any = self.checker.error_log
        return tuple(f"line {error.line}: {error.message}" for error in log)


def read_schemas(folder: Path) -> Schemas:
    """Read dcc.xsd, SI_Format.xsd and what they import from anywhere below a folder; nothing from a network.

    Raises `Refused` where one is missing, of another version or cannot be read.
    """
    there = {path.name.lower(): path for path in sorted(folder.rglob("*.xsd"))}
    for name, version in _FILES.items():
        path = there.get(name.lower())
        if path is None:
            raise Refused(
                f"--schema {folder}: there is no {name}; give the folder with the institute's schemas"
            )
        stated = _version_of(path)
        if stated != version:
            raise Refused(f"{path}: version {stated}, but certificates are written by {version}")
    stood_in: list[str] = []

    base: Any = etree.Resolver

    class Local(base):  # type: ignore[misc]
        def resolve(self, url: str, _public: str, context: Any) -> Any:
            name = url.rsplit("/", 1)[-1]
            path = there.get(name.lower())
            if path is not None:
                return self.resolve_filename(str(path), context)
            space, content = _STAND_INS.get(name, ("", ""))
            stood_in.append(name)
            text = (
                f'<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" targetNamespace="{space}">{content}'
                "</xs:schema>"
            )
            return self.resolve_string(text, context)

    reader = parser()
    reader.resolvers.add(Local())
    try:
        checker = etree.XMLSchema(etree.parse(str(there["dcc.xsd"]), reader))
    except (etree.XMLSchemaParseError, etree.XMLSyntaxError, OSError) as error:
        raise Refused(f"--schema {folder}: cannot be used ({error})") from error
    return Schemas(folder, checker, tuple(stood_in))


def _version_of(path: Path) -> str | None:
    try:
        return etree.parse(str(path), parser()).getroot().get("version")
    except (etree.XMLSyntaxError, OSError) as error:
        raise Refused(f"{path}: cannot be read ({error})") from error
