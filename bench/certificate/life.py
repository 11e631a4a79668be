"""The life cycle of a certificate: draft, issue, amendment, revocation; copies and checks of the register."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.base.files import read_json, read_regular, write_whole
from bench.base.languages import message
from bench.base.text import as_typed
from bench.base.yaml_files import Document, document_of, load_document, validated
from bench.certificate.content import Before, Certificate, Issue
from bench.certificate.gather import certificate_of, issued_at, missing
from bench.certificate.laboratory import (
    Laboratory,
    Order,
    Person,
    as_issued,
    laboratory_of,
    load_laboratory,
    load_order,
)
from bench.certificate.register import ISSUED, REVOKED, NumberStatus, Register
from bench.results.certificate import IssuedRun, RegisteredCertificate, RegisterResult
from bench.services.chain import Entry, opened
from bench.services.errors import Refused, sentence
from bench.services.requests.documents import CheckRegister, IssueCertificates, Issuing, RevokeCertificate
from bench.services.requests.shared import runs_folder
from drivers.clock import utc_now

if TYPE_CHECKING:
    from lxml import etree

    from bench.certificate.signatory import Signatory


@dataclass(frozen=True)
class Desk:
    """The inputs for issuing certificates: loaded files, authorising person, signatory, schemas and clock."""

    runs: Path
    laboratory_file: Document
    order_file: Document
    authorised_by: str
    now: Callable[[], datetime]
    signatory: Signatory | None = None
    schemas: etree.XMLSchema | None = None

    @cached_property
    def laboratory(self) -> Laboratory:
        """The laboratory file, validated. Raises `FileMistakes`."""
        return laboratory_of(self.laboratory_file)

    @cached_property
    def order(self) -> Order:
        """The order file, validated. Raises `FileMistakes`."""
        return validated(self.order_file, Order)

    def person(self) -> Person:
        """Return the authorising person. Raises `Refused` if that person may not authorise."""
        return self.laboratory.authorised_person(self.authorised_by)


def desk_of(request: Issuing, passphrase: Callable[[], bytes]) -> Desk:
    """Return the inputs for an issue. Raises `Refused` for missing options, `FileMistakes` for bad files."""
    needed = {
        "--laboratory FILE": request.laboratory,
        "--order FILE": request.order,
        "--authorised-by NAME": request.authorised_by,
    }
    laboratory, order, by = request.laboratory, request.order, request.authorised_by
    if laboratory is None or order is None or by is None:
        lacking = [option for option, given in needed.items() if given is None]
        raise Refused(
            f"a certificate needs {', '.join(lacking)}; add them, or make a draft with 'bench certificate issue "
            "RUN --draft', which needs none of them"
        )
    schemas = signatory = None
    if request.schema is not None:
        from bench.certificate.dcc.rules import read_schemas

        schemas = read_schemas(request.schema)
    if request.key is not None:
        from bench.certificate.signatory import signatory_of

        signatory = signatory_of(request.key, request.chain, passphrase, utc_now())
    files = load_document(laboratory), load_document(order)
    desk = Desk(runs_folder(request.runs), *files, by, utc_now, signatory, schemas)
    desk.person()
    return desk


def laboratory_in(file: Path | None) -> Laboratory:
    """Read a laboratory file. Raises `Refused` if `file` is None, `FileMistakes` for mistakes in the file."""
    if file is None:
        raise Refused("no laboratory file is named; give --laboratory FILE")
    return load_laboratory(file)


def _outcome(run: str, number: str | None = None, **told: Any) -> IssuedRun:
    """Return the outcome for a run; `told` are members that differ from their default values."""
    usual: dict[str, Any] = {"files": [], "why": None, "issued_before": False, "lacks": []}
    return IssuedRun(run=run, number=number, **{**usual, **told})


Bodies = dict[str, bytes]
"""The unsigned forms of a certificate by suffix of the file: "xml" and "pdf"."""


def _digests(bodies: Bodies) -> dict[str, str]:
    return {suffix: hashlib.sha256(body).hexdigest() for suffix, body in bodies.items()}


def issue_all(names: Sequence[str], desk: Desk) -> Iterator[IssuedRun]:
    """Issue a certificate for each run in turn; yield the outcomes. A failed run does not stop the others."""
    _ = desk.order  # mistakes in this file concern every run
    person, register = desk.person(), Register(desk.laboratory.register_folder)
    for name in names:
        yield _tried(name, lambda one: _issue(one, desk, person, register))


def drafts(request: IssueCertificates) -> Iterator[IssuedRun]:
    """Write a draft certificate (without a number) for each run, and yield the outcomes.

    A draft is `certificate-draft.pdf` in the run's folder, or `RUN-certificate-draft.pdf` in folder `out`.
    """
    laboratory = None if request.laboratory is None else load_laboratory(request.laboratory)
    order = None if request.order is None else load_order(request.order)

    def draft(name: str) -> IssuedRun:
        certificate = certificate_of(name, runs_folder(request.runs), laboratory, order)
        file = certificate.found.result.source.output("certificate-draft", ".pdf")
        if request.out is not None:
            file = request.out / f"{certificate.found.record.run}-{file.name}"
            request.out.mkdir(parents=True, exist_ok=True)
        write_whole(file, _body(certificate, b""))
        return _outcome(name, files=[str(file)], lacks=list(missing(certificate)))

    for name in request.names:
        yield _tried(name, draft)


def _tried(name: str, make: Callable[[str], IssuedRun]) -> IssuedRun:
    """Return the outcome of `make` for a run; an exception becomes an outcome and stops no other run."""
    try:
        return make(name)
    except Exception as error:
        return _outcome(name, why=sentence(error))


def _issue(name: str, desk: Desk, person: Person, register: Register) -> IssuedRun:
    certificate = _wanted(name, desk)
    with opened(register):
        head = certificate.found.record.head
        same = [one for one in register.standings.values() if one.entry.data["record"]["head"] == head]
        for known in same:
            if known.state == ISSUED:
                files = [str(register.folder / file) for file in known.entry.files]
                return _outcome(name, known.entry.number, files=files, issued_before=True)
        return _write(certificate, desk, person, register, _revoked_of(name, same, register))


def _revoked_of(name: str, same: Sequence[NumberStatus], register: Register) -> Before | None:
    """Return the revoked certificate that a new one of the run `name` replaces; None if the run never had one.

    `same` are the earlier certificates of the run. Raises `Refused` if another certificate in force replaced them.
    """
    if not same:
        return None
    last = same[-1]
    while last.state not in {ISSUED, REVOKED}:
        last = register.standings[last.by]
    entry = last.entry
    if last.state == ISSUED:
        raise Refused(
            f"{name}: its certificate {same[-1].entry.number} was replaced by {entry.number}; 'bench certificate "
            f"amend {entry.number} {as_typed(name)} --replace --reason TEXT' replaces the latter"
        )
    return Before("replaced", entry.number, entry.time[:10], last.by, entry.files[f"{entry.number}.xml"])


def _wanted(name: str, desk: Desk) -> Certificate:
    """Return a run's certificate. Raises `Refused` if the program lacks a required validation."""
    certificate = certificate_of(name, desk.runs, desk.laboratory, desk.order)
    if desk.laboratory.require_validation and not certificate.simulated:
        from bench.services.validated import refuse_unvalidated_certificate

        refuse_unvalidated_certificate(desk.laboratory_file.path)
    return certificate


def _same_house(stored: Mapping[str, Any], laboratory: Laboratory) -> bool:
    """Return whether a stored laboratory file is of this laboratory: with its name, address or accreditation.

    The name may be corrected, and a laboratory may have a file in each of two languages.
    """
    now = laboratory.model_dump(mode="json", include={"name", "address", "accreditation"})
    number = (stored.get("accreditation") or {}).get("number")
    return (
        str(stored["name"]).strip() == now["name"]
        or {key: str(part).strip() for key, part in stored["address"].items()} == now["address"]
        or (number is not None and str(number).strip() == (now["accreditation"] or {}).get("number"))
    )


def amend(number: str, name: str, desk: Desk, reason: str, *, replaced: bool) -> IssuedRun:
    """Issue a certificate for the run `name` that supersedes the certificate `number`.

    The old certificate becomes "replaced" (`replaced`) or "amended". The new certificate states the number of
    the old one and the `reason`. Raises `Refused` if the old certificate is not valid, is for another unit or,
    unless `replaced`, is for another run.
    """
    _require_reason(reason)
    person, certificate = desk.person(), _wanted(name, desk)
    with opened(Register(desk.laboratory.register_folder)) as register:
        old = holds(register, number).entry
        item = certificate.found.item
        if old.data["unit"] != {"type": item.type, "serial": item.serial}:
            raise Refused(
                f"{number}: the certificate is for another unit than {name}; name a run of the same unit"
            )
        stored = register.kept(old.data["made_from"]["laboratory"])
        house = document_of(desk.laboratory_file.path, stored).data
        if not _same_house(house, desk.laboratory):
            raise Refused(
                f"{number}: {house['name']} issued it, not {desk.laboratory.name}; name its file with --laboratory "
                "or, if it moved under a new name, revoke the certificate and issue a new one"
            )
        if not replaced and old.data["record"]["head"] != certificate.found.record.head:
            raise Refused(
                f"{number}: the certificate is for another run than {name} ({old.data['run']}); name that run, "
                "or add --replace if other results are to replace the old ones"
            )
        kind = "replaced" if replaced else "amended"
        before = Before(kind, number, old.time[:10], reason, old.files[f"{number}.xml"])
        return _write(certificate, desk, person, register, before)


def revoke(request: RevokeCertificate) -> None:
    """Record the revocation of a certificate. Raises `Refused` if it is not valid now."""
    laboratory = laboratory_in(request.laboratory)
    if request.authorised_by is None:
        raise Refused("nobody is named who authorises the revocation; give --authorised-by NAME")
    _require_reason(request.reason)
    person = laboratory.authorised_person(request.authorised_by)
    with opened(Register(laboratory.register_folder)) as register:
        holds(register, request.number)
        told = {"reason": request.reason}
        register.append(Entry(REVOKED, request.number, issued_at(utc_now()), person.name, told))


def _require_reason(reason: str) -> None:
    if not reason.strip():
        raise Refused("--reason: no text; state the reason, which the certificate or its register prints")


def holds(register: Register, number: str) -> NumberStatus:
    """Return the status of the certificate `number`. Raises `Refused` unless it is valid now."""
    standing = issued(register, number)
    if standing.state != ISSUED:
        told = (
            message(f"it was revoked: {standing.by}")
            if standing.state == REVOKED
            else message(f"it was {standing.state} by {standing.by}")
        )
        raise Refused(f"{number}: {told}; name a certificate that is in force")
    return standing


def issued(register: Register, number: str) -> NumberStatus:
    """Return the status of a certificate number. Raises `Refused` for a number that was never issued."""
    if number not in register.standings:
        latest = ", ".join(list(register.standings)[-3:])
        remedy = f"name one of the latest: {latest}" if latest else "check the folder in the laboratory file"
        raise Refused(f"{number}: no certificate of that number in {register.folder}; {remedy}")
    return register.standings[number]


def _write(
    certificate: Certificate, desk: Desk, person: Person, register: Register, before: Before | None
) -> IssuedRun:
    """Number, produce and issue a certificate in an open register; return the outcome."""
    laboratory, now = desk.laboratory, desk.now()
    simulated = certificate.simulated
    number = register.number_after(laboratory.number(n, now.year, simulated=simulated) for n in count(1))
    signed_by = None if desk.signatory is None else desk.signatory.name
    issue = Issue(number, issued_at(now), person, before, signed_by or "")
    whole = replace(certificate, issue=issue)
    lacking = [*missing(whole), *_clock_set_back(register, issue)]
    if lacking:
        raise Refused(f"{whole.found.record.run}: not issued; missing: {'; '.join(lacking)}")
    bodies = bodies_of(whole, desk.schemas)
    contents = signed(bodies, whole, desk.signatory, now)
    found = whole.found
    logo = laboratory.logo_file
    data: dict[str, Any] = {
        "role": person.role,
        "run": found.record.run,
        "record": {"events": found.record.events, "head": found.record.head},
        "unit": {"type": found.item.type, "serial": found.item.serial},
        "customer": None if whole.order is None else whole.order.customer.name,
        "simulated": simulated,
        "before": None if before is None else vars(before),
        "signed_by": signed_by,
        "bodies": _digests(bodies),
        "made_from": {
            "laboratory": register.keep(desk.laboratory_file.text.encode()),
            "order": register.keep(desk.order_file.text.encode()),
            "seal": register.keep(found.record.seal.encode()),
            "logo": None if logo is None else register.keep(read_regular(logo)),
        },
    }
    entry = Entry(ISSUED, number, issue.issued, person.name, data)
    register.issue(entry, contents)
    return _outcome(found.record.run, number, files=[str(register.folder / name) for name in contents])


def _clock_set_back(register: Register, issue: Issue) -> Iterator[str]:
    """Yield a sentence if a certificate in force is of a later day.

    A revoked one does not count: one issue by a clock that was fast would stop all others until its day.
    """
    entries = [one.entry for one in register.standings.values() if one.state == ISSUED]
    latest = max(entries, key=lambda entry: entry.time[:10], default=None)
    if latest is not None and issue.day < latest.time[:10]:
        yield message(
            f"the day of issue (7.8.2.1 j): this computer's clock shows {issue.day}, but {latest.number} was "
            f"issued on {latest.time[:10]} (set the clock or, if that day is wrong, revoke {latest.number})"
        )


def bodies_of(certificate: Certificate, schemas: etree.XMLSchema | None = None) -> Bodies:
    """Return a numbered certificate's unsigned XML and PDF. Raises `Refused` if the XML is no valid DCC."""
    from bench.certificate.dcc.document import document_of
    from bench.certificate.dcc.rules import against_schemas, broken_rules

    xml = document_of(certificate)
    wrong = [*broken_rules(xml), *(() if schemas is None else against_schemas(schemas, xml))]
    if wrong:
        raise Refused(
            f"{certificate.number}: the XML of the certificate is not a valid DCC; correct the laboratory and "
            f"order files: {'; '.join(wrong[:5])}"
        )
    return {"xml": xml, "pdf": _body(certificate, xml)}


def _body(certificate: Certificate, xml: bytes) -> bytes:
    from bench.certificate.page import body_of

    return body_of(certificate, xml)


def signed(
    bodies: Bodies, certificate: Certificate, signatory: Signatory | None, now: datetime
) -> dict[str, bytes]:
    """Return the files of a certificate by name, signed if there is a signatory; the PDF contains the XML."""
    number = certificate.number
    if signatory is None:
        return {f"{number}.{suffix}": body for suffix, body in bodies.items()}
    from bench.certificate.signatures import sign_pdf, sign_xml

    xml = sign_xml(bodies["xml"], signatory, now)
    title = certificate.texts[0].say("title")
    pdf = sign_pdf(_body(certificate, xml), signatory, now, f"{title} {number}", certificate.place)
    return {f"{number}.xml": xml, f"{number}.pdf": pdf}


def made_again(register: Register, number: str, runs: Path) -> Bodies:
    """Remake a certificate's unsigned XML and PDF. Raises `Refused` if record or stored inputs changed."""
    entry = issued(register, number).entry
    kept = entry.data["made_from"]
    paths = {name: register.folder / "made-from" / digest for name, digest in kept.items() if digest}
    for digest in filter(None, kept.values()):
        register.kept(digest)
    laboratory, order = as_issued(paths["laboratory"], paths["order"], paths.get("logo"))
    before = entry.data["before"]
    issue = Issue(
        number,
        entry.time,
        Person(name=entry.by, role=entry.data["role"]),
        None if before is None else Before(**before),
        entry.data["signed_by"] or "",
    )
    certificate = certificate_of(entry.data["run"], runs, laboratory, order, issue)
    if certificate.found.record.head != entry.data["record"]["head"]:
        raise Refused(
            f"{number}: the record of run {entry.data['run']} changed since the certificate was made; restore "
            "the run from a copy"
        )
    seal = register.kept(kept["seal"]).decode()
    record = replace(certificate.found.record, seal=seal, sealed=read_json(seal.encode())["sealed"])
    return bodies_of(replace(certificate, found=replace(certificate.found, record=record)))


def checked(request: CheckRegister) -> tuple[RegisterResult, list[Path]]:
    """Return the content of a register, for one certificate number or all numbers, and the files copied.

    The files are copied to `request.out`. With `request.again`, each certificate is reproduced from its record and
    compared. Raises `Refused` for a number that was never issued.
    """
    if request.out is not None and request.number is None:
        raise Refused(
            "--out hands out one certificate, but no number is given; add the number of the certificate"
        )
    folder = laboratory_in(request.laboratory).register_folder
    with opened(Register(folder)) as register:
        result = register_result(
            register, request.number, runs_folder(request.runs) if request.again else None
        )
        if request.out is None or request.number is None:
            return result, []
        return result, handed_out(register, request.number, request.out)


def register_result(register: Register, number: str | None, runs: Path | None) -> RegisterResult:
    """Return a register's content for one number or all; with `runs`, remake and compare certificates."""
    numbers = list(register.standings) if number is None else [issued(register, number).entry.number]
    problems = [problem for problem in register.damaged_files() if number is None or f"{number}." in problem]
    rows = []
    for one in numbers:
        standing = register.standings[one]
        entry, unit = standing.entry, standing.entry.data["unit"]
        again = {} if runs is None else {"made_again": _same(register, one, runs, problems)}
        rows.append(
            RegisteredCertificate.model_validate(
                {
                    **{name: entry.data[name] for name in ("customer", "run", "simulated", "signed_by")},
                    "number": one,
                    "issued": entry.time,
                    "authorised_by": entry.by,
                    "unit": f"{unit['type']} {unit['serial']}".strip(),
                    "state": standing.state,
                    "by": standing.by,
                    "files": entry.files,
                    **again,
                }
            )
        )
    return RegisterResult(
        register_=str(register.folder), head=register.head, certificates=rows, problems=problems
    )


def _same(register: Register, number: str, runs: Path, problems: list[str]) -> bool:
    """Return whether the remade unsigned XML and PDF equal the issued ones; add any failure to `problems`."""
    stated = register.standings[number].entry.data["bodies"]
    try:
        again = _digests(made_again(register, number, runs))
    except Exception as error:
        problems.append(
            f"{number}: cannot be made again; restore what changed from a copy: {sentence(error)}"
        )
        return False
    wrong = [name for name, digest in again.items() if stated[name] != digest]
    if wrong:
        problems.append(
            f"{number}: {' and '.join(wrong)} of the certificate, made again, differs from the issued file; "
            "compare the run and the program's version with those at issue, and restore what changed"
        )
    return not wrong


def handed_out(register: Register, number: str, folder: Path) -> list[Path]:
    """Copy the issued files of a certificate into a folder; return the paths of the copies.

    Raises `Refused` for an unknown number, a changed file or the register's own folder; `OSError` on failure.
    """
    entry = issued(register, number).entry
    contents = {name: register.file(name) for name in entry.files}
    if folder.absolute() == register.folder.absolute():
        raise Refused(f"--out {folder}: this is the register's own folder; name another folder")
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        write_whole(folder / name, content)
    return [folder / name for name in contents]
