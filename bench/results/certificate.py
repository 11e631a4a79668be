"""The results of `bench certificate`: issued certificates, the content of a register, a verification."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final, Literal

from pydantic import Field
from rich.console import Console
from rich.text import Text

from bench.base.languages import HEADING, message, translated
from bench.base.numbers import rounded, uncertainty
from bench.base.result_model import ResultModel
from bench.base.tables import table
from bench.base.text import visible
from bench.results.parts import coefficient_unit


class IssuedRun(ResultModel):
    """The certificate or draft issued for a run, or the reason why there is none."""

    run: str
    number: str | None = Field(description="number of the certificate; null if none was issued")
    files: list[str] = Field(description="files of the certificate, written now or before")
    why: str | None = Field(description="why no certificate was issued; empty if one was")
    issued_before: bool = Field(description="true if this certificate was issued for the record before")
    lacks: list[str] = Field(description="what is missing from a draft before it can be issued")

    def print_on(self, out: Console) -> None:
        """Print the certificate's number and its files."""
        if not self.number:
            said = message("a draft")
        elif self.issued_before:
            said = message(f"issued before as {self.number}")
        else:
            said = message(f"issued as {self.number}")
        out.print(Text(f"{self.run}: {translated(said)}"))  # the name of a run stays
        for file in self.files:
            out.print(f"  {file}")


class CertificateResult(ResultModel):
    """The result of `bench certificate issue`: the outcome for each run."""

    certificates: list[IssuedRun] = Field(description="one entry for each run, in the given order")


State = Literal["issued", "amended", "replaced", "revoked"]


class RegisteredCertificate(ResultModel):
    """A certificate in the register."""

    number: str
    issued: str = Field(description="civil time at which the certificate was issued")
    authorised_by: str
    unit: str = Field(description="type and serial number of the block")
    customer: str
    run: str
    simulated: bool
    signed_by: str | None = Field(description="owner of the signing key, according to the key's certificate")
    state: State
    by: str = Field(description="number of the replacement, or the reason for revocation")
    files: dict[str, str] = Field(description="SHA-256 of each file, by name")
    made_again: bool = False
    """whether unsigned files, generated again, are identical; with --again"""


class RegisterResult(ResultModel):
    """The certificates in a register, and the problems with the files of certificates."""

    register_: str = Field(alias="register", description="folder of the register")
    head: str = Field(description="SHA-256 of the last line, which depends on all lines before it")
    certificates: list[RegisteredCertificate]
    problems: list[str] = Field(description="files and certificates that differ from those issued")

    def print_on(self, out: Console) -> None:
        """Print a line for each certificate."""
        for one in self.certificates:
            state = translated(one.state) + (f" ({one.by})" if one.by else "")
            state += "" if one.signed_by else ", " + translated(message("not signed"))
            out.print(Text(f"{one.number}  {one.issued[:10]}  {one.unit}  {one.run}  {state}"))

    def print_head(self, out: Console) -> None:
        """Print the number of certificates, and the hash of the last line, which covers all lines."""
        out.print(f"{len(self.certificates)} certificates, chain of hashes complete, head {self.head}")


class SignerPart(ResultModel):
    """The signer of a certificate."""

    name: str = Field(description="name in the signer's certificate")
    certificate_sha256: str
    signed_at: str = Field(description="time of signing by the signer's clock (ISO 8601)")


_PLAIN: Final = {r"\volt": "V", r"\metre\second\tothe{-2}": "m/s²", r"\one": "1"}
"""Plain units of signals by their D-SI notation, which states K per local g as a quantity per one."""


class CertifiedCoefficient(ResultModel):
    """A coefficient on a certificate."""

    value: float
    U: float
    k: float
    unit: str = Field(description="unit in the notation of D-SI")

    def plain_unit(self, name: str) -> str:
        """Return the unit of the coefficient `name` as people write it, "V/g" for `\\volt` of Kxx."""
        plain = _PLAIN.get(self.unit)
        return self.unit if plain is None else coefficient_unit(name, plain)


class CertificateSays(ResultModel):
    """The contents of a certificate."""

    number: str
    laboratory: str
    customer: str
    items: list[str]
    calibrated: list[str] = Field(description="first and last day of the calibration")
    issued: str
    authorised_by: str
    conformity: str = Field(description="statement of conformity in the words of DCC; empty if there is none")
    simulated: bool
    coefficients: dict[str, CertifiedCoefficient]
    files: list[str] = Field(description="names of the files embedded in the XML")

    def print_on(self, out: Console) -> None:
        """Print the certificate's data and coefficients."""
        if self.simulated:
            out.print("SIMULATED: it certifies nothing of any real unit")
        for name, text in {
            message("certificate", "heading"): self.number,
            message("laboratory", "heading"): self.laboratory,
            message("customer", "heading"): self.customer,
            message("unit", "heading"): "; ".join(self.items),
            message("calibrated", "heading"): " to ".join(dict.fromkeys(self.calibrated)),
            message("issued", "heading"): self.issued,
            message("authorised by", "heading"): self.authorised_by,
            message("conformity", "heading"): translated(self.conformity, "statement")
            or translated(message("no statement")),
        }.items():
            out.print(Text(f"{translated(name, HEADING)}: {visible(text)}"))  # names stay
        shown = table("coefficient", ">value", ">U", ">k", "")
        for name, one in self.coefficients.items():
            value, U = rounded(one.value, one.U), uncertainty(one.U)
            shown.add_row(visible(name), value, U, f"{one.k:.3g}", visible(one.plain_unit(name)))
        out.print(shown)


class RegisterSays(ResultModel):
    """What the laboratory's register states about a certificate."""

    folder: str
    named: bool = Field(description="whether --laboratory named it; if not, it was beside the file")
    state: Literal["issued", "amended", "replaced", "revoked", "unknown"]
    by: str = Field(description="number of the replacement, or the reason for revocation")

    @property
    def known(self) -> bool:
        """Whether the register contains the certificate's number."""
        return self.state != "unknown"

    @property
    def holds(self) -> bool:
        """Whether the certificate was issued, and was not amended, replaced or revoked since."""
        return self.state == "issued"

    @property
    def vouches(self) -> bool:
        """Whether the register contains the certificate, and the user named the register."""
        return self.named and self.known

    @property
    def words(self) -> str:
        """The certificate's state in the register, as the end of the verdict; "" for a valid certificate."""
        if self.holds:
            return ""
        return f", {self.state.upper()} ({self.by})" if self.known else ", UNKNOWN TO THE REGISTER"


class VerifyResult(ResultModel):
    """The result of verifying a certificate."""

    file: str
    verdict: str
    """verdict in one line, such as `intact, signer unknown` (without a trust file), `not signed`, `CHANGED`
    or `NO CERTIFICATE`, and then what the register states
    """
    intact: bool
    trusted: bool | None
    """whether the trust file confirms the signer; null without a trust file, unless nobody may trust the signer"""
    why_not_trusted: str | None = Field(description="why the signer is not trusted; empty if trusted")
    wrong: list[str] = Field(description="why the certificate is not intact; empty if it is")
    agreed: list[str] = Field(description="values that were compared and agree")
    signer: SignerPart
    signed: CertificateSays | None
    """signed content; null if the certificate is not intact or not signed"""
    unsigned: CertificateSays | None
    """content of an unsigned certificate; null if it is not intact or is signed"""
    register_: RegisterSays | None = Field(alias="register")
    """what the register states about the certificate; null without a register"""
    not_signed: list[str]
    not_proved: list[str]

    @property
    def accepted(self) -> bool:
        """Whether the certificate is intact, its signer trusted, and its number valid in the register.

        Without a trust file, the signer is not checked; without a register, the number is not. An unsigned
        certificate is accepted only if a register that the user named contains it.
        """
        standing = self.register_
        holds = standing is None or standing.holds
        vouched = self.unsigned is None or (standing is not None and standing.vouches)
        return self.intact and holds and vouched and not self.why_not_trusted

    def print_on(self, out: Console) -> None:
        """Print the verdict; for a certificate that is not intact, only the reasons."""
        out.print(f"{self.file}: {self.verdict}")
        for why in self.wrong:
            out.print(f"  {visible(why)}")
        if not self.intact:
            out.print("do not rely on it; ask the laboratory that issued it for an intact file")
            return
        if self.unsigned is None:
            signer = self.signer
            out.print(f"signer: {visible(signer.name)}, certificate SHA-256 {signer.certificate_sha256}")
            out.print(f"signed at: {signer.signed_at}")
        if self.why_not_trusted:
            out.print(f"not trusted: {visible(self.why_not_trusted)}")
        for said in filter(None, (self.signed, self.unsigned)):
            said.print_on(out)
        for heading, lines in (
            (message("agrees", "heading"), self.agreed), (message("not signed"), self.not_signed),
            (message("not proved"), self.not_proved),
        ):  # fmt: skip
            for line in lines:
                out.print(Text(f"{translated(heading, HEADING)}: {translated(visible(line))}"))


def print_coefficients(result: Mapping[str, Any], at_c: float, out: Console) -> None:
    """Print the coefficients in `result`, the parsed JSON of `bench calibrate --json`, and what they mean.

    `at_c` is the temperature at which they hold, °C; NaN if it is unknown.
    """
    mark = f"{translated('SIMULATED')}: " if result.get("simulated") else ""
    where = message("at an unknown temperature") if math.isnan(at_c) else message(f"at {at_c:.1f} °C")
    told = message(
        f"{result['source']}: U = K a + U0, a the specific force in local g ({result['g_m_s2']:.6g} m/s², "
        f"+1 g on an upward axis), U in {result['unit']}, block {where}"
    )
    out.print(Text(mark + translated(told)))
    shown = table("coefficient", ">value", ">u", "")
    for name, one in result["coefficients"].items():
        unit = coefficient_unit(name, result["unit"])
        shown.add_row(name, rounded(one["value"], one["u"]), uncertainty(one["u"]), unit)
    out.print(shown)
