"""The DCC of a certificate: its administrative data and its measurement results."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from importlib import metadata
from typing import Final

import numpy as np
from lxml import etree

from bench.base.arrays import Floats, u_of
from bench.calibration.budget.whole import dof_through
from bench.calibration.conformity import Statement
from bench.calibration.intrinsic import joint_factor
from bench.calibration.verification import Verification
from bench.certificate.content import (
    Before,
    Certificate,
    Condition,
    Instrument,
    Issue,
    RunFindings,
    Value,
    Values,
    rule_said,
    stated,
)
from bench.certificate.dcc.nodes import (
    CELSIUS,
    DEGREE,
    NAMESPACES,
    ONE,
    PER_MS2,
    SECOND,
    SI_UNITS,
    VERSION,
    VOLT_PER_MS2,
    Node,
    byte_data,
    ellipsoidal,
    in_languages,
    node,
    plain,
    real,
    real_list,
    said,
)
from bench.certificate.laboratory import Contact, Laboratory, Order, Texts, UnitOrder, in_each
from bench.readings.table import Readings
from bench.results.parts import joint_of

_XSI: Final = "http://www.w3.org/2001/XMLSchema-instance"
_PLACE: Final = f"{NAMESPACES['dcc']} {NAMESPACES['dcc']}/v{VERSION}/dcc.xsd"


def document_of(certificate: Certificate) -> bytes:
    """Return the unsigned DCC (XML) of a numbered certificate; the same certificate always gives the same bytes.

    Raises `ValueError` without laboratory, order, unit, dates or number.
    """
    laboratory, order, unit, issue, days = (
        certificate.laboratory, certificate.order, certificate.unit, certificate.issue, certificate.calibrated,
    )  # fmt: skip
    if laboratory is None or order is None or unit is None or issue is None or days is None:
        raise ValueError(
            "the XML of a certificate cannot be written without laboratory, order, unit, dates and "
            "number; give all of them"
        )
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
                if laboratory.accreditation is None or certificate.simulated
                else node("dcc:calibrationLaboratoryCode", laboratory.accreditation.number),
                contact("dcc:contact", laboratory),
            ),
            node("dcc:respPersons", *_persons(issue, certificate.found.operator)),
            contact("dcc:customer", order.customer),
            node("dcc:statements", *_statements(certificate, order, unit, issue)),
        )
    )
    measured = [_measured(certificate, certificate.found, "found-")]
    if certificate.as_found is not None:
        measured.insert(0, _measured(certificate, certificate.as_found, "before-"))
    root.append(node("dcc:measurementResults", *measured))
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
    for name, role, signs in ((who.name, who.role, "true"), (operator, "operator", "false")):
        if name:
            yield node(
                "dcc:respPerson",
                node("dcc:person", node("dcc:name", plain(name))),
                None if role is None else node("dcc:role", role),
                node("dcc:mainSigner", signs),
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
    reason = certificate.why_untraced
    yield node(
        "dcc:statement",
        node("dcc:name", *said(texts, "traceability")),
        node("dcc:traceable", "false" if reason or certificate.simulated else "true"),
        node(
            "dcc:declaration",
            *said(texts, "traceability_text"),
            *(said(texts, "untraced_text", reason=reason) if reason else ()),
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


# --- measurement results ------------------------------------------------------------------------------

_LATEX: Final = (
    r"\vec{U} = K\,\vec{a} + \vec{U}_0,\quad \vec{a} = N\,(\vec{U} - \vec{U}_0),\quad N = K^{-1},\quad "
    r"\Delta g = |\vec{a}| - 1"
)
_CONFORMITY: Final = {
    Statement.PASS: "pass",
    Statement.CONDITIONAL_PASS: "conditionalPass",
    Statement.CONDITIONAL_FAIL: "conditionalFail",
    Statement.INCONCLUSIVE: "noPass",
    Statement.NOT_COMPLETE: "noPass",
    Statement.MISFIT: "noPass",
    Statement.FAIL: "fail",
}
"""The DCC's word for each statement; `noPass` if no statement can be made, and the declaration states why."""


def _measured(certificate: Certificate, found: RunFindings, prefix: str) -> Node:
    texts, before = certificate.texts, found is not certificate.found
    adjusted = certificate.unit is not None and certificate.unit.adjusted is not None
    status = ("beforeAdjustment" if before else "afterAdjustment") if adjusted else ""
    verification = found.verification
    return node(
        "dcc:measurementResult",
        node("dcc:name", *said(texts, "before" if before else "results")),
        node("dcc:usedMethods", _method(texts, found)),
        node("dcc:measuringEquipments", *(_instrument(texts, one) for one in found.instruments)),
        node("dcc:influenceConditions", *(_condition(texts, one, status) for one in found.conditions)),
        node("dcc:results", *_results(certificate, found, prefix)),
        node(
            "dcc:measurementMetaData",
            _uncertainty(certificate),
            None if verification is None else _conformity(texts, verification),
            *(node("dcc:metaData", node("dcc:declaration", plain(note))) for note in found.notes),
        ),
        id=f"{prefix}result",
        refType="bench_before" if before else "bench_found",
    )


def _method(texts: Sequence[Texts], found: RunFindings) -> Node:
    method = found.method
    procedure, plan = method.procedure or in_each(texts, "procedure_unknown"), method.plan_hash or "–"
    told = {"procedure": procedure, "plan": plan, "estimator": method.estimator, "model": method.model}
    words = said(texts, "method_text", **told)
    return node(
        "dcc:usedMethod",
        node("dcc:name", *said(texts, "method")),
        node("dcc:description", *words, node("dcc:formula", node("dcc:latex", _LATEX))),
        node("dcc:norm", "JCGM 100:2008"),
        node("dcc:norm", "JCGM 106:2012"),
        refType="bench_method",
    )


def _instrument(texts: Sequence[Texts], one: Instrument) -> Node:
    held = one.certificate
    certificate = None
    if held is not None:
        until = "" if held.valid_until is None else f", – {held.valid_until}"
        certificate = node(
            "dcc:certificate",
            node("dcc:referral", plain(f"{held.laboratory}, {held.date}{until}")),
            node("dcc:referralID", held.number),
            node("dcc:procedure", "none"),
            node("dcc:value", "none"),
            node("dcc:inValidityRange", "false" if one.expired or one.later else "true"),
            node("dcc:traceable", "false" if one.foreign else "true"),
        )
    told = [("manufacturer", one.serial)] if one.serial else []
    told += [("other", one.identity)] if one.identity else []
    known = [node("dcc:identification", node("dcc:issuer", by), node("dcc:value", text)) for by, text in told]
    return node(
        "dcc:measuringEquipment",
        node("dcc:name", plain(one.name)),
        None if held is not None else node("dcc:description", *said(texts, "no_certificate")),
        certificate,
        node("dcc:identifications", *known) if known else None,
        refType=f"bench_{one.role}",
    )


def _condition(texts: Sequence[Texts], one: Condition, status: str) -> Node:
    unit = SI_UNITS[one.unit]
    shown = [real(end, unit, one.u) for end in dict.fromkeys((one.low, one.high))]
    ends = ["value"] if len(shown) == 1 else ["minimum", "maximum"]
    quantities = [_quantity(end, quantity, plain(end)) for end, quantity in zip(ends, shown, strict=True)]
    return node(
        "dcc:influenceCondition",
        node("dcc:name", *said(texts, one.key, rail=one.about)),
        node("dcc:description", plain(one.source)) if one.source else None,
        node("dcc:status", status) if status else None,
        node("dcc:data", *quantities),
        refType=f"bench_{one.key}",
    )


def _results(certificate: Certificate, found: RunFindings, prefix: str) -> Iterator[Node]:
    texts = certificate.texts
    for key, values in (
        ("coefficients", found.coefficients),
        ("coefficients_si", _per_ms2(found)),
        ("inverse", found.inverse),
        ("misalignments", found.misalignments),
        ("intrinsic", found.intrinsic),
    ):
        listed, about = _listed(values, certificate), said(texts, f"{key}_text")
        yield _result(texts, key.removesuffix("_si"), key, prefix, listed, about)
    if found.verification is not None:
        yield _result(texts, "delta_g", "delta_g", prefix, _checked(texts, found.verification))
    yield _result(texts, "readings", "readings", prefix, _table(texts, found.result.source.as_read))
    if found is certificate.found:
        (result,) = (one for one in certificate.attachments if one.name == "result.json")
        yield _result(texts, "results", "file", prefix, byte_data(result))


def _result(
    texts: Sequence[Texts], name: str, ref: str, prefix: str, data: Node, about: Iterable[Node] = ()
) -> Node:
    described = tuple(about)
    return node(
        "dcc:result",
        node("dcc:name", *said(texts, name)),
        node("dcc:description", *described) if described else None,
        node("dcc:data", data),
        id=f"{prefix}{ref}",
        refType=f"bench_{ref}",
    )


def _per_ms2(found: RunFindings) -> Values:
    """Return the coefficients with K per m/s² instead of per g; the covariance includes the u of local g."""
    own = found.result.calibration
    scale = np.concatenate([np.full(9, 1.0 / own.g_m_s2), np.ones(3)])
    values = own.block.vector * scale
    of_g = np.where(np.arange(12) < 9, values, 0.0) * own.gravity_u
    covariance = own.covariance * np.outer(scale, scale) + np.outer(of_g, of_g)
    per = {"V": VOLT_PER_MS2, "m/s^2": ONE}.get(own.unit, PER_MS2)
    sizes = zip(values.tolist(), u_of(covariance).tolist(), strict=True)
    dof = dof_through(own, np.diag(scale), of_g**2).tolist()
    found_per = (
        Value(
            one.name, value, u, one.k * u, one.k, nu, SI_UNITS[own.unit] if one.name.startswith("U0") else per
        )
        for one, (value, u), nu in zip(found.coefficients.values, sizes, dof, strict=True)
    )
    return Values(tuple(found_per), covariance)


def _listed(values: Values, certificate: Certificate) -> Node:
    """Return results as one D-SI list: names, values, U with k, and covariance matrix."""
    members = values.values
    spelt = [one.unit if "\\" in one.unit else SI_UNITS[one.unit] for one in members]
    coverage = certificate.coverage
    u, nu = np.array([(one.u, one.dof) for one in members]).T
    joint = joint_of(u, nu, coverage).k
    listed = real_list(
        [one.value for one in members],
        spelt,
        [one.name for one in members],
        ([one.U for one in members], [one.k for one in members], [coverage] * len(members)),
        ellipsoidal(values.covariance.tolist(), spelt, joint, coverage),
    )
    dof = _freedom(members)
    return node("dcc:quantity", listed, node("dcc:measurementMetaData", dof) if dof is not None else None)


def _freedom(members: Sequence[Value]) -> Node | None:
    """Return the list of the finite degrees of freedom; None if all are infinite."""
    finite = [(one.name, one.dof) for one in members if math.isfinite(one.dof)]
    if not finite:
        return None
    listed = real_list([dof for _, dof in finite], [ONE], [f"nu_{name}" for name, _ in finite])
    return node("dcc:metaData", node("dcc:data", node("dcc:quantity", listed)), refType="bench_dof")


def _checked(texts: Sequence[Texts], verification: Verification) -> Node:
    """Return Δg at the verification points with U and covariance, the limit, the risks, and the statements."""
    points = verification.points
    coverage = [math.erf(math.sqrt(2.0))] * len(points)
    one = [ONE] * len(points)
    covariance: Floats = verification.covariance
    delta = real_list(
        [p.delta_g for p in points],
        one,
        [f"series{p.series}-" * (p.series > 1) + f"pass{p.pass_number}-point{p.point}" for p in points],
        ([p.U for p in points], [p.k for p in points], coverage),
        ellipsoidal(covariance.tolist(), one, joint_factor(len(points), level=coverage[0]).k, coverage[0]),
    )
    accepted = verification.passed or verification.left_open
    risks = {
        "p_false_accept": verification.p_outside if accepted else None,
        "p_false_reject": 1.0 - verification.p_outside if verification.rejected else None,
    }
    statements = " ".join(_CONFORMITY[one] for one in stated(verification)[1])
    return node(
        "dcc:list",
        _quantity("angle", real_list([p.angle_deg for p in points], [DEGREE]), plain("angle")),
        node(
            "dcc:quantity",
            node("dcc:name", *said(texts, "delta_g")),
            delta,
            node("dcc:measurementMetaData", node("dcc:metaData", node("dcc:conformityXMLList", statements))),
            refType="bench_delta_g",
        ),
        _quantity("limit", real(verification.limit_g, ONE), *said(texts, "limit")),
        *(_quantity(key, real(p, ONE), *said(texts, key)) for key, p in risks.items() if p is not None),
    )


def _quantity(ref: str, quantity: Node, *name: Node) -> Node:
    return node("dcc:quantity", node("dcc:name", *name), quantity, refType=f"bench_{ref}")


def _conformity(texts: Sequence[Texts], verification: Verification) -> Node:
    statement, _ = stated(verification)
    say = partial(in_each, texts)
    points, limit = len(verification.points), f"{verification.limit_g:g}"
    told = say("conformity_text", points=points, limit=limit, statement=say(str(statement)))
    accepted = say("accepted" if verification.passed else "not_accepted")
    parts = zip(told, rule_said(say, verification.decision), accepted, strict=True)
    words = in_languages(texts, (f"{whole} {rule}; {verdict}." for whole, rule, verdict in parts))
    return node(
        "dcc:metaData",
        node("dcc:name", *said(texts, "conformity")),
        node("dcc:norm", "JCGM 106:2012"),
        node("dcc:norm", "ILAC-G8:09/2019"),
        node("dcc:declaration", *words),
        node("dcc:conformity", _CONFORMITY[statement]),
        refType="bench_conformity",
    )


def _uncertainty(certificate: Certificate) -> Node:
    k, coverage = f"{certificate.k:.4g}", certificate.coverage_percent
    told = said(certificate.texts, "uncertainty_text", k=k, coverage=coverage)
    return node("dcc:metaData", node("dcc:declaration", *told), refType="bench_uncertainty")


def _table(texts: Sequence[Texts], readings: Readings) -> Node:
    """Return the uncorrected readings, with a list for each column."""
    unit = SI_UNITS[readings.unit]
    columns: dict[str, tuple[Floats, str]] = {
        "series": (readings.series.astype(float), ONE),
        "pass": (readings.pass_number.astype(float), ONE),
        "point": (readings.point.astype(float), ONE),
        "angle": (np.asarray(np.round(np.degrees(readings.angle_rad), 12), dtype=np.float64), DEGREE),
        "direction": (readings.direction.astype(float), ONE),
        "time": (readings.time_s, SECOND),
        "temperature": (readings.temperature_c, CELSIUS),
        **{f"u{axis}": (readings.signal[:, i], unit) for i, axis in enumerate("xyz")},
    }
    labels = node("dcc:charsXMLList", " ".join(readings.installation.tolist()))
    return node(
        "dcc:list",
        node("dcc:name", *said(texts, "readings")),
        _quantity("installation", labels, plain("installation")),
        *(
            _quantity(name, real_list(values.tolist(), [of]), plain(name))
            for name, (values, of) in columns.items()
            if not np.isnan(values).all()
        ),
    )
