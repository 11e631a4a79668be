"""Rules and schemas that check a DCC before it is issued."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from lxml import etree

from bench.base.arrays import u_of
from bench.base.text import cause_of
from bench.certificate.dcc.lists import NotRead, real_lists
from bench.certificate.dcc.nodes import DCC, NAMESPACES, SI, VERSION, Node
from bench.certificate.laboratory import SIMULATED_SERIES
from bench.certificate.signatures import SIGNATURE, parser
from bench.services.errors import Refused

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
