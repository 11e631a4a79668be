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
from bench.base.languages import message
from bench.calibration import CalibrationError
from bench.calibration.conformity import SIMPLE, DecisionRule
from bench.certificate.content import RunFindings
from bench.certificate.dcc.reading import ShownValues, shown_of
from bench.certificate.gather import found_by
from bench.certificate.page import DCC, RELATIONS, faults_of
from bench.certificate.register import Register
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
from bench.services.chain import LINES
from bench.services.errors import Refused, refusing, sentence
from bench.services.verification import NOTHING_ASKED, VerdictOptions

if TYPE_CHECKING:
    from cryptography.x509 import Certificate

NOT_PROVED: Final = (
    message("when it was signed: only the signer states the time; no authority stamped it"),
    message("that the signer's certificate had not been withdrawn: no list of withdrawn ones was checked"),
)
NOT_MEASURED: Final = message("that what was measured is true")
PAGES_NOT_READ: Final = message("that the pages print what the data say: only the data were compared")
RECORD_NOT_HERE: Final = message("that the record gives these results: the record is missing here")
REGISTER_NOT_HERE: Final = message(
    "that it still holds: the register of amended and revoked ones is missing here"
)
UNSIGNED: Final = message(
    "who made it and that it is unchanged: it is unsigned; --laboratory FILE checks the register"
)
UNKNOWN: Final = message(
    "who signed: anybody can write the name in its certificate; --trust FILE checks the laboratory's own, "
    "obtained from the laboratory"
)


@dataclass
class Findings:
    """What the steps of a verification found, in their order.

    `signatures` begins with the signature of the verified file; `unsigned` says that the certificate has none.
    The lists of sentences become the members of `VerifyResult` with the same names.
    """

    signatures: list[SignedPdf | SignedXml] = field(default_factory=list)
    unsigned: bool = False
    wrong: list[str] = field(default_factory=list)
    agreed: list[str] = field(default_factory=list)
    not_signed: list[str] = field(default_factory=list)
    not_proved: list[str] = field(default_factory=list)

    def why_not_trusted(self, trusted: Sequence[Certificate] | None) -> str | None:
        """Return why a signer is not trusted; "" if all signers are trusted.

        `trusted` are certificates of signers or authorities. The result is None without `trusted`, unless nobody
        may trust a signer, or if a signed certificate's signatures could not be read.
        """
        if trusted is not None and self.unsigned:
            return message("nobody signed it")
        reasons = [why_not_trusted(one.chain, one.signed_at, trusted) for one in self.signatures]
        return next(filter(None, reasons), "" if reasons and trusted is not None else None)

    def signer(self) -> SignerPart:
        """Return the signer of the verified file; all members are empty if nobody signed it."""
        if not self.signatures:
            return SignerPart(name="", certificate_sha256="", signed_at="")
        first = self.signatures[0]
        own = first.chain[0]
        return SignerPart(
            name=name_of(own), certificate_sha256=fingerprint_of(own), signed_at=first.signed_at.isoformat()
        )


def verify_certificate(
    file: Path, trust: Path | None, runs: Path, register: Path | None = None
) -> VerifyResult:
    """Verify a certificate (PDF or XML) and, if it is in the same folder, its other form (XML or PDF).

    `trust` contains the certificates (PEM) of trusted signers or authorities. `register` is the folder of the
    laboratory's register; if it is None, a register in the folder of `file` is used. Raises `Refused` for a file
    that cannot be read, or for a damaged register.
    """
    trusted = None if trust is None else certificates_in(trust)
    content = _content(file)
    found = Findings()
    shown = standing = None
    failure = message("CHANGED")
    try:
        shown = _verify_forms(found, file, content)
    except NotIntact as error:
        found.wrong.append(f"{error}; {ORIGINAL}")
        failure = message("NO CERTIFICATE") if isinstance(error, NoCertificate) else failure
    if shown is not None:
        standing = against_register(found, shown.says.number, file, content, register)
        if not found.wrong:
            against_record(found, shown, runs)
    intact, named = not found.wrong, standing is not None and standing.named
    distrust, signer = found.why_not_trusted(trusted), found.signer()
    if not found.unsigned:
        found.not_proved[:0] = [UNKNOWN] if distrust is None else []
        found.not_proved += NOT_PROVED
    found.not_proved.append(NOT_MEASURED)
    if intact and found.unsigned and not named:
        found.not_proved.append(UNSIGNED)
    elif intact and standing is None:
        found.not_proved.append(REGISTER_NOT_HERE)
    says = shown.says if shown is not None and intact else None
    return VerifyResult.from_object(
        found,
        file=str(file),
        verdict=_headline(found.unsigned, distrust, signer.name, standing) if intact else failure,
        intact=intact,
        trusted=None if distrust is None else not distrust,
        why_not_trusted=distrust,
        signer=signer,
        signed=None if found.unsigned else says,
        unsigned=says if found.unsigned else None,
        register_=standing,
    )


def _headline(unsigned: bool, distrust: str | None, signer: str, standing: RegisterSays | None) -> str:
    if unsigned:
        issued = standing is not None and standing.vouches
        words = message("not signed, unchanged since it was issued") if issued else message("not signed")
    elif distrust is None:
        words = message("intact, signer unknown")
    else:
        words = message("intact, signer not trusted" if distrust else f"intact, signed by {signer}")
    return words if standing is None else words + standing.words


def _verify_forms(found: Findings, file: Path, content: bytes) -> ShownValues:
    """Verify the form in `file` and, if it is in the same folder, the other form; return the values."""
    if content.lstrip()[:1] == b"<":
        shown, _ = _verify_xml(found, content)
        beside = file.with_suffix(".pdf")
        if beside.is_file():
            try:
                _, attached = _verify_pdf(Findings(), _content(beside))
            except NotIntact as error:
                raise NotIntact(f"{beside.name} beside it: {error}") from error
            _same_xml(found, attached[DCC], content, beside.name)
        else:
            found.not_proved.append(
                f"that there is a PDF with the same content: {beside.name} is not beside it"
            )
        return shown
    shown, attached = _verify_pdf(found, content)
    beside = file.with_suffix(".xml")
    if beside.is_file():
        _same_xml(found, attached[DCC], _content(beside), beside.name)
    return shown


def _content(file: Path) -> bytes:
    with refusing("check name and permissions", file, reading=True):
        return read_given(file)


# --- the two forms ------------------------------------------------------------------------------------


def _verify_xml(found: Findings, document: bytes) -> tuple[ShownValues, SignedXml | None]:
    """Verify an XML; return its values and its signature, None if it is unsigned. Raises `NotIntact`."""
    signed, content = _signed_or_not(document)
    found.signatures += [] if signed is None else [signed]
    found.unsigned = signed is None
    shown = shown_of(content)
    if found.unsigned is shown.says_signed:
        raise NotIntact(
            "it claims a signature but has none"
            if found.unsigned
            else "it claims to be unsigned but has a signature"
        )
    _agree_on_numbers(shown)
    found.agreed.append(message("the coefficients of the digital certificate are those of its result"))
    if signed is not None and signed.comments:
        found.not_signed.append(
            message(f"{signed.comments} comments in the XML, which are unsigned and not shown")
        )
    return shown, signed


def _signed_or_not(document: bytes) -> tuple[SignedXml | None, bytes]:
    """Return an XML's signature (None if it is unsigned) and its content."""
    try:
        signed = check_xml(document)
    except Unsigned:
        return None, unsigned_content(document)
    return signed, signed.content


def _verify_pdf(found: Findings, file: bytes) -> tuple[ShownValues, dict[str, bytes]]:
    """Verify a PDF; return its values and its attached files by name. Raises `NotIntact`."""
    signed: SignedPdf | None = None
    with contextlib.suppress(Unsigned):
        signed = check_pdf(file)
        found.signatures.append(signed)
    if faults := faults_of(file):
        raise NotIntact(f"it is not PDF/A-3b, as certificates are: {'; '.join(faults)}")
    attached, title = _attached(file)
    if signed is None and set(attached) == set(RELATIONS) - {DCC}:
        raise NoCertificate("it is a draft and was never issued")
    if set(attached) != set(RELATIONS):
        raise NotIntact(
            f"the PDF has the attachments {', '.join(sorted(attached))}, but a certificate has "
            f"{', '.join(sorted(RELATIONS))}"
        )
    try:
        shown, digital = _verify_xml(found, attached[DCC])
    except NotIntact as error:
        raise NotIntact(f"the attached {DCC}: {error}") from error
    if signed is not None and digital is not None:
        _agree_on_signer(signed, digital)
    elif signed is not None or digital is not None:
        signer, other = ("the PDF", "the XML in it") if signed is not None else ("the XML in it", "the PDF")
        raise NotIntact(f"{signer} is signed, but not {other}")
    number = shown.says.number
    if not number or not title.endswith(f" {number}"):
        raise NotIntact(f"the PDF is of '{title}', its XML of certificate {number}")
    for name, content in shown.files.items():
        if attached.get(name) != content:
            raise NotIntact(f"the {name} in the XML differs from the one in the PDF")
    common = "number, result and seal" if found.unsigned else "signer, number, result and seal"
    found.agreed.append(message(f"PDF and XML have {common} in common"))
    found.not_proved.append(PAGES_NOT_READ)
    return shown, attached


def _agree_on_signer(paper: SignedPdf, digital: SignedXml) -> None:
    """Raise `NotIntact` unless the same signer signed the XML first and then the PDF."""
    if fingerprint_of(paper.chain[0]) != fingerprint_of(digital.chain[0]):
        raise NotIntact(
            f"the PDF was signed by {name_of(paper.chain[0])}, its XML by {name_of(digital.chain[0])}"
        )
    if digital.signed_at > paper.signed_at:
        raise NotIntact("its XML states a later signature than the PDF")


def _same_xml(found: Findings, attached: bytes, document: bytes, name: str) -> None:
    """Raise `NotIntact` unless the XML inside the PDF and the separate XML have the same content and signer."""
    try:
        forms = [_signed_or_not(one) for one in (attached, document)]
    except NotIntact as error:
        raise NotIntact(f"{name} beside it: {error}") from error
    signers = {None if signed is None else fingerprint_of(signed.chain[0]) for signed, _ in forms}
    if len({content for _, content in forms}) > 1 or len(signers) > 1:
        raise NotIntact(f"{name} beside it differs from the one in it")
    found.agreed.append(message(f"{name} beside it has the same content"))


def _attached(file: bytes) -> tuple[dict[str, bytes], str]:
    import pikepdf

    try:
        with pikepdf.open(io.BytesIO(file)) as pdf:
            found = {name: one.get_file().read_bytes() for name, one in pdf.attachments.items()}
            return found, str(pdf.open_metadata().get("dc:title", ""))
    except (pikepdf.PdfError, ValueError, KeyError, AttributeError) as error:
        raise NotIntact("its attached files cannot be read") from error


# --- numbers ------------------------------------------------------------------------------------------


def _agree_on_numbers(shown: ShownValues) -> None:
    """Raise `NotIntact` unless the listed coefficients equal those of the attached `result.json`."""
    coefficients = shown.says.coefficients
    if not coefficients or "result.json" not in shown.files:
        raise NotIntact("the digital certificate lacks its coefficients or the result that states them")
    try:
        result = json.loads(shown.files["result.json"])
        covariance = np.array(result["covariance"], dtype=np.float64)
        stated = {name: result["coefficients"][name] for name in result["order"]}
        values = {name: float(one["value"]) for name, one in stated.items()}
        u = {name: float(one["u"]) for name, one in stated.items()}
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise NotIntact("the result in the digital certificate cannot be read") from error
    listed = {name: one.value for name, one in coefficients.items()}
    if values != listed or not np.array_equal(covariance, shown.covariance):
        raise NotIntact("the coefficients of the digital certificate differ from its result")
    if not all(math.isclose(one.U, one.k * u[name], rel_tol=1e-12) for name, one in coefficients.items()):
        raise NotIntact("U of a coefficient differs from k times its u")


# --- the record of its run, and the register ------------------------------------------------------------


def against_record(found: Findings, shown: ShownValues, runs: Path) -> None:
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
        found.wrong.append(
            "the seal in the digital certificate cannot be read; ask the laboratory for the original"
        )
        return
    except (RecordError, OSError):
        differences = None
    if differences is None:
        found.not_proved.append(RECORD_NOT_HERE)
        return
    if differences:
        found.wrong.append(f"{folder}: {'; '.join(differences)}")
        return
    try:
        k = next(iter(shown.says.coefficients.values())).k
        again = found_by(seal.run, runs, k, _asked(shown))
    except (Refused, RecordError, CalibrationError) as error:
        found.wrong.append(
            f"{folder}: the record gives no result ({sentence(error)}); remove the cause, then verify again"
        )
        return
    told = message(f"the record in {folder} is unchanged")
    if again.result_json.encode() == shown.files["result.json"]:
        found.agreed.append(message(f"{told} and gives the same result to the last digit"))
    elif _as_good_as(again, shown):
        found.agreed.append(
            message(
                f"{told} and gives the same result within {_SAME:g} u, within rounding of another computer"
            )
        )
    elif shown.release != metadata.version("triaxial-bench"):
        found.agreed.append(told)
        found.not_proved.append(
            f"that the record gives these results: release {shown.release} evaluated it, not this one"
        )
    else:
        found.wrong.append(
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
    apart = np.abs(own.covariance - shown.covariance)
    same = bool(np.all(off <= _SAME * u) and np.all(apart <= _SAME * np.outer(u, u)))
    verdicts = [
        json.loads(text).get("verification") for text in (found.result_json, shown.files["result.json"])
    ]
    told = [
        {name: (one or {}).get(name) for name in ("passed", "statement", "limit_g", "rule")}
        for one in verdicts
    ]
    return same and told[0] == told[1]


def against_register(
    found: Findings, number: str, file: Path, content: bytes, folder: Path | None
) -> RegisterSays | None:
    """Compare a certificate file's `content` with the register's entry for `number`; return the entry's state.

    `folder` is the register's folder. If it is None, a register in the folder of `file` is used; the result
    is None if that register is missing or lacks the number. If a register in `folder` lacks it, the state is
    "unknown". Raises `Refused` if `folder` has no register, or if the register is damaged or unreadable.
    """
    place = file.absolute().parent if folder is None else folder
    if not (place / LINES).is_file():
        if folder is None:
            return None
        raise Refused(f"{place}: no register there ({LINES}); check the laboratory file")
    register = Register(place).read_lines()
    known = register.standings.get(number)
    if known is None and folder is None:
        return None
    state, by = ("unknown", "") if known is None else (known.state, known.by)
    standing = RegisterSays.model_validate(
        {"folder": str(place), "named": folder is not None, "state": state, "by": by}
    )
    if known is None:
        return standing
    name = f"{number}.{'xml' if content.lstrip()[:1] == b'<' else 'pdf'}"
    if known.entry.files.get(name) == hashlib.sha256(content).hexdigest():
        found.agreed.append(message(f"the register in {place} has the SHA-256 of this file for {name}"))
    else:
        found.wrong.append(
            f"the register has another SHA-256 for {name}: this is not the issued file; ask for that file"
        )
    return standing
