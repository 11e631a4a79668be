"""Is the XML of certificates valid by the institute's schemas? They are the user's, and not part of this program.

    python -m benchmarks.certificate_schema --schema DIR

DIR has dcc.xsd (3.3.0) and SI_Format.xsd (2.2.1), anywhere below it; what they import of others (QUDT quantity
kinds, the core of XML signatures) may be there, else stand-ins take its place. Certificates in one and two
languages, amended and replaced, after an adjustment, with and without a verification, signed and not, are checked
by the schemas and by our own rules; then changed documents, which the schemas must refuse, so that they are seen to
look. Exit status 1 where one is not as it should be.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from lxml import etree

from bench.certificate.content import Before, Certificate, Issue
from bench.certificate.dcc.document import document_of
from bench.certificate.dcc.nodes import Schemas, broken_rules, parser, read_schemas
from bench.certificate.gather import certificate_of
from bench.certificate.laboratory import Adjusted, texts_of
from bench.certificate.life import Desk
from bench.certificate.signatory import new_certificate_key, signatory_of
from bench.certificate.signatures import sign_xml
from benchmarks.campaign import arguments
from benchmarks.certificate_desk import prepare
from drivers.clock import utc_now

CHANGES = (
    ("<dcc:typeOfChange>amended", "<dcc:typeOfChange>changed"),
    ("<si:coverageFactorXMLList>2.0 ", "<si:coverageFactorXMLList>0.5 "),
    ("<dcc:issueDate>", "<dcc:issueDate>the "),
    ("dcc:customer>", "dcc:client>"),
    ("<dcc:conformityXMLList>", "<dcc:conformityXMLList>good "),
)
"""Text of the amended certificate that no schema takes when it is changed."""


def certificates(desk: Desk, name: str) -> Iterator[tuple[str, Certificate]]:
    """Yield certificates of all kinds with what each is."""
    laboratory, order = desk.laboratory, desk.order
    now = utc_now().isoformat(timespec="seconds")
    issue = Issue("SIM-2026-0002", now, laboratory.authorised[0], signed_by="Laboratory")
    plain = certificate_of(name, desk.runs, laboratory, order, issue)
    yield "plain", plain
    yield "two languages", replace(plain, texts=(texts_of("en"), texts_of("de")))
    for kind in ("amended", "replaced"):
        before = Before(kind, "SIM-2026-0001", "2026-01-02", "the customer's name", "0" * 64)
        yield kind, replace(plain, issue=replace(issue, before=before))
    if plain.unit is not None:
        unit = plain.unit.model_copy(update={"state": "as left", "adjusted": Adjusted(what="trimmed")})
        yield "adjusted", replace(plain, unit=unit, as_found=replace(plain.found))
    yield "no verification", replace(plain, found=replace(plain.found, verdict=None))


def main(argv: list[str] | None = None) -> int:
    asked = arguments(__doc__, argv, schema={"type": Path, "required": True, "metavar": "DIR"})
    schemas = read_schemas(asked.schema)
    print(f"schemas in {asked.schema}; stand-ins for: {', '.join(schemas.stood_in) or 'nothing'}")
    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        desk, (name,) = prepare(Path(folder), 1)
        key = Path(folder) / "keys" / "laboratory.pem"
        new_certificate_key(key, "Laboratory", None, utc_now())
        signatory = signatory_of(str(key), None, lambda: b"", utc_now())
        for run in (name, "source"):
            for kind, certificate in certificates(desk, run):
                document = document_of(certificate)
                for state, text in (
                    ("", document), (", signed", sign_xml(document, signatory, utc_now())),
                ):  # fmt: skip
                    found = [*schemas.mistakes(text), *broken_rules(text)]
                    wrong += bool(found)
                    print(f"{run}, {kind}{state}: {'valid' if not found else found[0]}")
                if kind == "amended":
                    wrong += refused(document.decode(), schemas)
    return 1 if wrong else 0


def refused(document: str, schemas: Schemas) -> int:
    """Return how many changed documents the schemas take."""
    changed = [document.replace(old, new) for old, new in CHANGES if old in document]
    taken = sum(is_xml(text) and not schemas.mistakes(text.encode()) for text in changed)
    print(f"  changed: {len(changed) - taken} of {len(changed)} refused")
    return taken


def is_xml(text: str) -> bool:
    """Whether a text is XML at all."""
    try:
        etree.fromstring(text.encode(), parser())
    except etree.XMLSyntaxError:
        return False
    return True


if __name__ == "__main__":
    sys.exit(main())
