"""Verification of a certificate: signatures, PDF against XML, and (if available) register and record."""

from __future__ import annotations

import binascii
import contextlib
import hashlib
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from bench.base.files import read_given, read_regular
from bench.calibration import CalibrationError
from bench.calibration.conformity import SIMPLE, DecisionRule
from bench.certificate.content import RunFindings
from bench.certificate.dcc.results import ShownValues, shown_of
from bench.certificate.gather import found_by
from bench.certificate.page import DCC, RELATIONS, faults_of
from bench.certificate.register import LINES, Register
from bench.certificate.signatory import certificates_in, fingerprint_of, name_of, why_not_trusted
from bench.certificate.signatures import (
    ORIGINAL,
    NoCertificate,
    NotIntact,
    SignedPdf,
    SignedXml,
    Unsigned,
    check_pdf,
    check_xml,
    unsigned_content,
)
from bench.results.certificate import RegisterSays, SignerPart, VerifyResult
from bench.run.events import MANIFEST, RecordError, sha256
from bench.run.folder import Run, find_run
from bench.run.seal import Seal
from bench.services.errors import Refused, refusing
from bench.services.verification import NOTHING_ASKED, VerdictOptions

if TYPE_CHECKING:
    from cryptography.x509 import Certificate

NOT_PROVED: Final = (
    "when it was signed: only the signer states the time; no authority stamped it",
    "that the signer's certificate had not been withdrawn: no list of withdrawn ones was checked",
)
NOT_MEASURED: Final = "that what was measured is true"
PAGES_NOT_READ: Final = "that the pages print what the data say: only the data were compared"
RECORD_NOT_HERE: Final = "that the record gives these results: the record is missing here"
REGISTER_NOT_HERE: Final = "that it still holds: the register of amended and revoked ones is missing here"
UNSIGNED: Final = (
    "who made it and that it is unchanged: it is unsigned; --laboratory FILE checks the register"
)
UNKNOWN: Final = (
    "who signed: anybody can write the name in its certificate; --trust FILE checks the laboratory's own, "
    "obtained from the laboratory"
)


@dataclass
class Verdict:
    """The findings on a certificate.

    `wrong` lists the reasons why the certificate is not intact, `agreed` the comparisons that succeeded.
    `not_signed` lists what the signature does not cover, `not_proved` what the verification cannot show.
    `why_not_trusted` is None without a trust file and "" for a trusted signer. `shown` are the values in the
    certificate, even if it is `unsigned`. `standing` is the status in the register, None if no register is
    available. `issued` is false for a file that cannot be an issued certificate.
    """

    file: str
    wrong: list[str] = field(default_factory=list)
    agreed: list[str] = field(default_factory=list)
    not_signed: list[str] = field(default_factory=list)
    not_proved: list[str] = field(default_factory=list)
    signer: str = ""
    fingerprint: str = ""
    signed_at: str = ""
    why_not_trusted: str | None = None
    shown: ShownValues | None = None
    unsigned: bool = False
    issued: bool = True
    standing: RegisterSays | None = None

    @property
    def intact(self) -> bool:
        """Whether the verification found nothing wrong."""
        return not self.wrong

    @property
    def accepted(self) -> bool:
        """Whether the certificate is intact, the signer trusted and the number valid, as far as each was checked.

        An unsigned certificate is accepted only if a register that the user named contains it. A register found in
        the file's folder is not enough, because anybody can write one.
        """
        holds = self.standing is None or self.standing.holds
        vouched = not self.unsigned or self._by_register
        return self.intact and holds and vouched and not self.why_not_trusted

    @property
    def _by_register(self) -> bool:
        """Whether the register that the user named contains this certificate."""
        return self.standing is not None and self.standing.named and self.standing.known

    @property
    def headline(self) -> str:
        """The verdict in one line."""
        if not self.intact:
            return "CHANGED" if self.issued else "NO CERTIFICATE"
        if self.unsigned:
            of_signer = "not signed" + (", unchanged since it was issued" if self._by_register else "")
        elif self.why_not_trusted is None:
            of_signer = "intact, signer unknown"
        else:
            trusted = not self.why_not_trusted
            of_signer = f"intact, signed by {self.signer}" if trusted else "intact, signer not trusted"
        return of_signer if self.standing is None else of_signer + self.standing.words

    def result(self) -> VerifyResult:
        """Return the result of `bench certificate verify`, with the certificate's values only if it is intact."""
        says = self.shown.says if self.shown is not None and self.intact else None
        return VerifyResult.from_object(
            self,
            verdict=self.headline,
            trusted=None if self.why_not_trusted is None else not self.why_not_trusted,
            signer=SignerPart(
                name=self.signer, certificate_sha256=self.fingerprint, signed_at=self.signed_at
            ),
            signed=None if self.unsigned else says,
            unsigned=says if self.unsigned else None,
            register_=self.standing,
        )


def verify_certificate(file: Path, trust: Path | None, runs: Path, register: Path | None = None) -> Verdict:
    """Verify a certificate (PDF or XML), and its other form in the same folder; return the findings.

    `trust` contains the certificates (PEM) of trusted signers or authorities. `register` is the folder of the
    laboratory's register; if it is None, a register in the folder of `file` is used. Raises `Refused` for a file
    that cannot be read, or for a damaged register.
    """
    trusted = None if trust is None else certificates_in(trust)
    content = _content(file)
    verdict = Verdict(str(file))
    try:
        if content.lstrip()[:1] == b"<":
            _verify_xml(verdict, content, trusted)
            beside, other = file.with_suffix(".pdf"), "PDF"
            if beside.is_file() and verdict.intact:
                _verify_pdf_beside(verdict, _content(beside), content, beside.name)
        else:
            attached = _verify_pdf(verdict, content, trusted)
            beside, other = file.with_suffix(".xml"), "XML"
            if beside.is_file() and verdict.intact:
                _same_xml(verdict, attached[DCC], _content(beside), beside.name)
        if not beside.is_file() and other == "PDF":
            verdict.not_proved.append(
                f"that there is a {other} with the same content: {beside.name} is not beside it"
            )
    except NotIntact as error:
        verdict.wrong.append(f"{error}; {ORIGINAL}")
        verdict.issued = not isinstance(error, NoCertificate)
    if verdict.shown is not None and verdict.intact:
        against_register(verdict, verdict.shown.says.number, file, content, register)
    if verdict.shown is not None and verdict.intact:
        against_record(verdict, verdict.shown, runs)
    if verdict.unsigned:
        verdict.why_not_trusted = None if trust is None else "nobody signed it"
    elif verdict.why_not_trusted is None:
        verdict.not_proved.insert(0, UNKNOWN)
    verdict.not_proved += () if verdict.unsigned else NOT_PROVED
    verdict.not_proved.append(NOT_MEASURED)
    if verdict.intact and verdict.unsigned and not (verdict.standing and verdict.standing.named):
        verdict.not_proved.append(UNSIGNED)
    elif verdict.intact and verdict.standing is None:
        verdict.not_proved.append(REGISTER_NOT_HERE)
    return verdict


def _content(file: Path) -> bytes:
    with refusing("check name and permissions", file, verb="read"):
        return read_given(file)


# --- the two forms ------------------------------------------------------------------------------------


def _verify_xml(verdict: Verdict, document: bytes, trusted: Sequence[Certificate] | None) -> SignedXml | None:
    """Verify an XML, recording signer and values in `verdict`; return its signed content, None if unsigned."""
    signed, content = _signed_or_not(document)
    if signed is not None:
        _name_signer(verdict, signed, trusted)
    verdict.unsigned = signed is None
    shown = shown_of(content)
    if verdict.unsigned is shown.says_signed:
        raise NotIntact(
            "it claims a signature but has none"
            if verdict.unsigned
            else "it claims to be unsigned but has a signature"
        )
    _agree_on_numbers(shown)
    verdict.shown = shown
    verdict.agreed.append("the coefficients of the digital certificate are those of its result")
    if signed is not None and signed.comments:
        verdict.not_signed.append(f"{signed.comments} comments in the XML, which are unsigned and not shown")
    return signed


def _signed_or_not(document: bytes) -> tuple[SignedXml | None, bytes]:
    """Return an XML's signature (None if it is unsigned) and its content."""
    try:
        signed = check_xml(document)
    except Unsigned:
        return None, unsigned_content(document)
    return signed, signed.content


def _verify_pdf(verdict: Verdict, file: bytes, trusted: Sequence[Certificate] | None) -> dict[str, bytes]:
    signed: SignedPdf | None = None
    with contextlib.suppress(Unsigned):
        signed = check_pdf(file)
        _name_signer(verdict, signed, trusted)
    if faults := faults_of(file):
        raise NotIntact(f"it is not PDF/A-3b, as certificates are: {'; '.join(faults)}")
    attached, title = _attached(file)
    if signed is None and set(attached) == set(RELATIONS) - {DCC}:
        raise NoCertificate("it is a draft and was never issued")
    if set(attached) != set(RELATIONS):
        raise NotIntact(
            f"attached are {', '.join(sorted(attached))}, and a certificate has {', '.join(sorted(RELATIONS))}"
        )
    try:
        digital = _verify_xml(verdict, attached[DCC], trusted)
    except NotIntact as error:
        raise NotIntact(f"the attached {DCC}: {error}") from error
    if signed is not None and digital is not None:
        verdict.signed_at = signed.signed_at.isoformat()
        _agree_on_signer(signed, digital)
    elif signed is not None or digital is not None:
        signer, other = ("the PDF", "the XML in it") if signed is not None else ("the XML in it", "the PDF")
        raise NotIntact(f"{signer} is signed, but not {other}")
    assert verdict.shown is not None  # noqa: S101 - what was verified is shown
    _agree(verdict, verdict.shown, attached, title)
    return attached


def _agree_on_signer(paper: SignedPdf, digital: SignedXml) -> None:
    """Raise `NotIntact` unless the same signer signed the XML first and then the PDF."""
    if fingerprint_of(paper.chain[0]) != fingerprint_of(digital.chain[0]):
        raise NotIntact(
            f"the PDF was signed by {name_of(paper.chain[0])}, its XML by {name_of(digital.chain[0])}"
        )
    if digital.signed_at > paper.signed_at:
        raise NotIntact("its XML states a later signature than the PDF")


def _agree(verdict: Verdict, shown: ShownValues, attached: dict[str, bytes], title: str) -> None:
    """Raise `NotIntact` unless PDF and XML have the same certificate number and the same attached files."""
    number = shown.says.number
    if not number or not title.endswith(f" {number}"):
        raise NotIntact(f"the PDF is of '{title}', its XML of certificate {number}")
    for name, content in shown.files.items():
        if attached.get(name) != content:
            raise NotIntact(f"the {name} in the XML differs from the one in the PDF")
    signer = "" if verdict.unsigned else "signer, "
    verdict.agreed.append(f"PDF and XML have {signer}number, result and seal in common")
    verdict.not_proved.append(PAGES_NOT_READ)


def _verify_pdf_beside(verdict: Verdict, file: bytes, document: bytes, name: str) -> None:
    """Verify the PDF beside an XML, and compare both. Raises `NotIntact` if it is not intact or differs."""
    apart = Verdict(name)
    try:
        attached = _verify_pdf(apart, file, None)
    except NotIntact as error:
        raise NotIntact(f"{name} beside it: {error}") from error
    _same_xml(verdict, attached[DCC], document, name)


def _same_xml(verdict: Verdict, attached: bytes, document: bytes, name: str) -> None:
    """Raise `NotIntact` unless the XML inside the PDF and the separate XML have the same content and signer."""
    try:
        forms = [_signed_or_not(one) for one in (attached, document)]
    except NotIntact as error:
        raise NotIntact(f"{name} beside it: {error}") from error
    signers = {None if signed is None else fingerprint_of(signed.chain[0]) for signed, _ in forms}
    if len({content for _, content in forms}) > 1 or len(signers) > 1:
        raise NotIntact(f"{name} beside it differs from the one in it")
    verdict.agreed.append(f"{name} beside it has the same content")


def _attached(file: bytes) -> tuple[dict[str, bytes], str]:
    import pikepdf

    try:
        with pikepdf.open(io.BytesIO(file)) as pdf:
            found = {name: one.get_file().read_bytes() for name, one in pdf.attachments.items()}
            with pdf.open_metadata(set_pikepdf_as_editor=False, update_docinfo=False) as told:
                return found, str(told.get("dc:title", ""))
    except (pikepdf.PdfError, ValueError, KeyError, AttributeError) as error:
        raise NotIntact("its attached files cannot be read") from error


def _name_signer(
    verdict: Verdict, signed: SignedPdf | SignedXml, trusted: Sequence[Certificate] | None
) -> None:
    verdict.signer, verdict.fingerprint = name_of(signed.chain[0]), fingerprint_of(signed.chain[0])
    verdict.signed_at = signed.signed_at.isoformat()
    if trusted is not None and not verdict.why_not_trusted:
        verdict.why_not_trusted = why_not_trusted(signed.chain, signed.signed_at, trusted)


# --- numbers ------------------------------------------------------------------------------------------


def _agree_on_numbers(shown: ShownValues) -> None:
    """Raise `NotIntact` unless the listed coefficients equal those of the attached `result.json`."""
    coefficients = shown.says.coefficients
    if not coefficients or "result.json" not in shown.files:
        raise NotIntact("the digital certificate lacks its coefficients or the result that states them")
    try:
        result = json.loads(shown.files["result.json"])
        covariance = tuple(tuple(float(one) for one in row) for row in result["covariance"])
        stated = {name: result["coefficients"][name] for name in result["order"]}
        values = {name: float(one["value"]) for name, one in stated.items()}
        u = {name: float(one["u"]) for name, one in stated.items()}
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise NotIntact("the result in the digital certificate cannot be read") from error
    if values != {name: one.value for name, one in coefficients.items()} or covariance != shown.covariance:
        raise NotIntact("the coefficients of the digital certificate differ from its result")
    if not all(math.isclose(one.U, one.k * u[name], rel_tol=1e-12) for name, one in coefficients.items()):
        raise NotIntact("U of a coefficient differs from k times its u")


# --- the record of its run, and the register ------------------------------------------------------------


def against_record(verdict: Verdict, shown: ShownValues, runs: Path) -> None:
    """Compare a certificate with the record of its run, if `runs` contains it.

    A run of the same name with other inputs (`run.json`) is a different record. In the same record, the chain
    of hashes must end as in the seal, and the readings must give the same result. On the same computer every
    digit must agree; on another, whose libraries may round differently, a small fraction of u is tolerated.
    """
    try:
        seal = Seal.from_json(json.loads(shown.files["seal.json"]))
        folder = runs / seal.run
        run = _recorded(seal, runs)
        differences = None if run is None else seal.differences(run)
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError, binascii.Error):
        verdict.wrong.append(
            "the seal in the digital certificate cannot be read; ask the laboratory for the original"
        )
        return
    except (RecordError, OSError):
        differences = None
    if differences is None:
        verdict.not_proved.append(RECORD_NOT_HERE)
        return
    if differences:
        verdict.wrong.append(f"{folder}: {'; '.join(differences)}")
        return
    try:
        k = next(iter(shown.says.coefficients.values())).k
        found = found_by(seal.run, runs, k, _asked(shown))
    except (Refused, RecordError, CalibrationError) as error:
        verdict.wrong.append(f"{folder}: the record gives no result ({error})")
        return
    told = f"the record in {folder} is unchanged"
    if found.result_json.encode() == shown.files["result.json"]:
        verdict.agreed.append(f"{told} and gives the same result to the last digit")
    elif _as_good_as(found, shown):
        verdict.agreed.append(
            f"{told} and gives the same result within {_SAME:g} u, within rounding of another computer"
        )
    elif shown.release != metadata.version("triaxial-bench"):
        verdict.agreed.append(told)
        verdict.not_proved.append(
            f"that the record gives these results: release {shown.release} evaluated it, not this one"
        )
    else:
        verdict.wrong.append(
            f"{folder}: the record gives another result than the certificate; ask the laboratory why"
        )


def _recorded(seal: Seal, runs: Path) -> Run | None:
    """Return the sealed run in the folder `runs`; None if the run or its inputs are not there."""
    if not seal.run or Path(seal.run).name != seal.run or not (runs / seal.run).is_dir():
        return None
    run = find_run(seal.run, runs)
    return run if seal.manifest_sha256 == sha256(read_regular(run.folder / MANIFEST)) else None


def _asked(shown: ShownValues) -> VerdictOptions:
    """Return verdict options with the decision rule of the certificate; the rule in the record may differ."""
    try:
        told = json.loads(shown.files["result.json"])["verification"]
        rule = DecisionRule.of_json(told) if told else DecisionRule()
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError):
        return NOTHING_ASKED  # a malformed result fails the comparison that follows
    if rule.guard_band is None:
        return NOTHING_ASKED
    return VerdictOptions(rule=rule.name, guard_band=None if rule.name == SIMPLE else rule.guard_band)


_SAME: Final = 1e-6
"""Largest difference, in units of u, that is attributed to rounding."""


def _as_good_as(found: RunFindings, shown: ShownValues) -> bool:
    """Return whether coefficients, covariance and verdict of record and certificate agree up to rounding."""
    own = found.coefficients
    u = np.array([one.u for one in own.values])
    theirs = shown.says.coefficients.values()
    off = np.abs([one.value - other.value for one, other in zip(own.values, theirs, strict=True)])
    apart = np.abs(own.covariance - np.array(shown.covariance))
    same = bool(np.all(off <= _SAME * u) and np.all(apart <= _SAME * np.outer(u, u)))
    verdicts = [
        json.loads(text).get("verification") for text in (found.result_json, shown.files["result.json"])
    ]
    told = [
        {name: (one or {}).get(name) for name in ("passed", "statement", "limit_g", "rule")}
        for one in verdicts
    ]
    return same and told[0] == told[1]


def against_register(verdict: Verdict, number: str, file: Path, content: bytes, folder: Path | None) -> None:
    """Compare the content of a certificate file with the entry for its number in a register.

    `folder` is the register's folder; None means a register in the folder of `file`, if it has the number.
    Raises `Refused` for a register that is damaged or cannot be read.
    """
    place = file.absolute().parent if folder is None else folder
    if not (place / LINES).is_file():
        if folder is None:
            return
        raise Refused(f"{place}: no register there ({LINES}); check the laboratory file")
    register = Register(place)
    register.read_lines()
    known = register.standings.get(number)
    if known is None and folder is None:
        return
    state, by = ("unknown", "") if known is None else (known.state, known.by)
    verdict.standing = RegisterSays.model_validate(
        {"folder": str(place), "named": folder is not None, "state": state, "by": by}
    )
    if known is None:
        return
    name = f"{number}.{'xml' if content.lstrip()[:1] == b'<' else 'pdf'}"
    if known.entry.files.get(name) == hashlib.sha256(content).hexdigest():
        verdict.agreed.append(f"the register in {place} has the SHA-256 of this file for {name}")
    else:
        verdict.wrong.append(
            f"the register has another SHA-256 for {name}: this is not the issued file; ask for that file"
        )
