"""The institute's schemas, where the user has them: a document is checked against them before it leaves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from lxml import etree

from bench.api.errors import Refused
from bench.certificate.dcc.nodes import SI_VERSION, SIGNATURE, VERSION
from bench.certificate.dcc.rules import parser

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
        stated = _version(path)
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


def _version(path: Path) -> str | None:
    try:
        return etree.parse(str(path), parser()).getroot().get("version")
    except (etree.XMLSyntaxError, OSError) as error:
        raise Refused(f"{path}: cannot be read ({error})") from error
