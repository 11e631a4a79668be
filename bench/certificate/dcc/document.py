"""The complete DCC of a certificate, and its administrative data."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Iterator, Sequence
from importlib import metadata
from typing import Final

from lxml import etree

from bench.certificate.content import Before, Certificate, Issue, uncertified
from bench.certificate.dcc.nodes import NAMESPACES, VERSION, Node, byte_data, node, plain, said
from bench.certificate.dcc.results import measurement_results
from bench.certificate.laboratory import Contact, Laboratory, Order, Texts, UnitOrder

_XSI: Final = "http://www.w3.org/2001/XMLSchema-instance"
_PLACE: Final = f"{NAMESPACES['dcc']} {NAMESPACES['dcc']}/v{VERSION}/dcc.xsd"


def document_of(certificate: Certificate) -> bytes:
    """Return the unsigned DCC (XML) of a complete, numbered certificate, always the same. Raises `ValueError`."""
    laboratory, order, unit, issue, days = (
        certificate.laboratory, certificate.order, certificate.unit, certificate.issue, certificate.calibrated,
    )  # fmt: skip
    if laboratory is None or order is None or unit is None or issue is None or days is None:
        raise ValueError("give a machine-readable certificate a laboratory, an order, dates and a number")
    root = etree.Element(
        f"{{{NAMESPACES['dcc']}}}digitalCalibrationCertificate", nsmap={**NAMESPACES, "xsi": _XSI}
    )
    root.set("schemaVersion", VERSION)
    root.set(f"{{{_XSI}}}schemaLocation", _PLACE)
    root.append(
        node(
            "dcc:administrativeData",
            node("dcc:dccSoftware", software()),
            _core(certificate.texts, laboratory, order, unit, issue, days),
            _items(certificate, unit),
            node(
                "dcc:calibrationLaboratory",
                None
                if laboratory.accreditation is None
                else node("dcc:calibrationLaboratoryCode", laboratory.accreditation.number),
                contact("dcc:contact", laboratory),
            ),
            node("dcc:respPersons", *_persons(issue, certificate.found.operator)),
            contact("dcc:customer", order.customer),
            node("dcc:statements", *_statements(certificate, order, unit, issue)),
        )
    )
    root.append(measurement_results(certificate))
    etree.cleanup_namespaces(root, top_nsmap={**NAMESPACES, "xsi": _XSI})
    etree.indent(root, " ")
    return bytes(etree.tostring(root, xml_declaration=True, encoding="UTF-8")) + b"\n"


def software() -> Node:
    """Return the element that describes this program as software."""
    return node(
        "dcc:software",
        node("dcc:name", plain("triaxial-bench")),
        node("dcc:release", metadata.version("triaxial-bench")),
        node("dcc:type", "application"),
    )


def contact(name: str, of: Contact) -> Node:
    """Return the element `name` with the contact data of a company: its name, e-mail, telephone, address."""
    address = of.address
    return node(
        name,
        node("dcc:name", plain(of.name)),
        None if of.email is None else node("dcc:eMail", of.email),
        None if of.phone is None else node("dcc:phone", of.phone),
        node(
            "dcc:location",
            node("dcc:street", address.street),
            node("dcc:postCode", address.post_code),
            node("dcc:city", address.city),
            node("dcc:countryCode", address.country),
        ),
    )


def _core(
    texts: Sequence[Texts], laboratory: Laboratory, order: Order, unit: UnitOrder, issue: Issue,
    days: tuple[datetime.date, datetime.date],
) -> Node:  # fmt: skip
    languages = [one.language for one in texts]
    return node(
        "dcc:coreData",
        node("dcc:countryCodeISO3166_1", laboratory.address.country),
        *(node("dcc:usedLangCodeISO639_1", one) for one in languages),
        node("dcc:mandatoryLangCodeISO639_1", languages[0]),
        node("dcc:uniqueIdentifier", issue.number),
        node("dcc:identifications", _identification(texts, "customer", order.number, "order")),
        node("dcc:receiptDate", str(unit.received)),
        node("dcc:beginPerformanceDate", str(days[0])),
        node("dcc:endPerformanceDate", str(days[1])),
        node("dcc:performanceLocation", "laboratory" if order.place is None else "other"),
        node("dcc:issueDate", issue.day),
        *(_before(texts, issue.before) if issue.before else ()),
    )


def _before(texts: Sequence[Texts], before: Before) -> Iterator[Node]:
    yield node(
        "dcc:reportAmendedSubstituted",
        node("dcc:typeOfChange", "amended" if before.kind == "amended" else "substituted"),
        node("dcc:replacedUniqueIdentifier", before.number),
    )
    yield node(
        "dcc:previousReport",
        node("dcc:referral", *said(texts, "title")),
        node("dcc:referralID", before.number),
        node("dcc:procedure", "SHA-256"),
        node("dcc:value", before.sha256),
        node("dcc:description", plain(before.reason)),
    )


def _identification(texts: Sequence[Texts], issuer: str, value: str, key: str) -> Node:
    return node(
        "dcc:identification",
        node("dcc:issuer", issuer),
        node("dcc:value", value),
        node("dcc:name", *said(texts, key)),
    )


def _items(certificate: Certificate, unit: UnitOrder) -> Node:
    item, texts = certificate.found.item, certificate.texts
    reference, maker = unit.reference, unit.manufacturer
    return node(
        "dcc:items",
        node(
            "dcc:item",
            node("dcc:name", plain(item.type)),
            node("dcc:description", node("dcc:name", *said(texts, "condition")), plain(unit.condition)),
            None if maker is None else node("dcc:manufacturer", node("dcc:name", plain(maker))),
            node("dcc:model", item.type),
            node(
                "dcc:identifications",
                _identification(texts, "manufacturer", item.serial, "serial"),
                None if reference is None else _identification(texts, "customer", reference, "reference"),
            ),
            id="item",
        ),
    )


def _persons(issue: Issue, operator: str) -> Iterator[Node]:
    who = issue.authorised_by
    yield node(
        "dcc:respPerson",
        node("dcc:person", node("dcc:name", plain(who.name))),
        None if who.role is None else node("dcc:role", who.role),
        node("dcc:mainSigner", "true"),
    )
    if operator:
        yield node(
            "dcc:respPerson",
            node("dcc:person", node("dcc:name", plain(operator))),
            node("dcc:role", "operator"),
            node("dcc:mainSigner", "false"),
        )


def _statements(certificate: Certificate, order: Order, unit: UnitOrder, issue: Issue) -> Iterator[Node]:
    texts = certificate.texts
    if certificate.simulated:
        yield _statement("simulated", *said(texts, "simulated"))
    signing = "unsigned" if certificate.unsigned else "signed"
    yield _statement(signing, *said(texts, f"statement_{signing}", name=issue.signed_by))
    for key in (*certificate.terms, "statement_supplied", "statement_recalibration"):
        yield _statement(key, *said(texts, key))
    for head, told in certificate.origins.items():
        for key, blanks in told:
            yield _statement(head, *said(texts, key, **blanks), name=said(texts, head))
    traceable = not uncertified(certificate.found) and not certificate.simulated
    reason = order.without_certificates
    yield node(
        "dcc:statement",
        node("dcc:name", *said(texts, "traceability")),
        node("dcc:traceable", "true" if traceable else "false"),
        node(
            "dcc:declaration",
            *said(texts, "traceability_text"),
            *(() if reason is None else said(texts, "untraced_text", reason=reason)),
        ),
        refType="bench_traceability",
    )
    yield _statement("state", *said(texts, unit.state.replace(" ", "_")), name=said(texts, "state"))
    stated = [("place", certificate.place)]
    stated += [(one.key, text) for one in certificate.stated for text in one.texts]
    for key, text in stated:
        if text:
            yield _statement(key, plain(text), name=said(texts, key))
    yield _record(certificate)


def _statement(ref: str, *words: Node, name: Iterable[Node] = ()) -> Node:
    heading = tuple(name)
    return node(
        "dcc:statement",
        node("dcc:name", *heading) if heading else None,
        node("dcc:declaration", *words),
        refType=f"bench_{ref}",
    )


def _record(certificate: Certificate) -> Node:
    """Return the statement that identifies the run's record, with the seal as an embedded file."""
    record, texts = certificate.found.record, certificate.texts
    sealed = said(texts, "seal_text", sealed=record.sealed) if record.sealed else said(texts, "no_seal")
    about = said(texts, "record_text", run=record.run, events=record.events, head=record.head)
    (seal,) = (one for one in certificate.attachments if one.name == "seal.json")
    return node(
        "dcc:statement",
        node("dcc:name", *said(texts, "record")),
        node("dcc:reference", f"SHA-256 {record.head}"),
        node("dcc:declaration", *about, *sealed),
        node("dcc:data", byte_data(seal)),
        refType="bench_record",
    )
