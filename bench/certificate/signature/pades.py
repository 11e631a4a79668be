"""PAdES (baseline B-B) in a certificate's PDF: one signature that certifies the file and allows no change to it.

It is appended (an incremental update): what stands before it is the unsigned body, byte for byte.
"""

from __future__ import annotations

import io
from binascii import unhexlify
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any, Final

from bench.api.errors import Refused
from bench.certificate.signature.signatory import Signatory
from bench.certificate.signature.xades import NoCertificate, NotIntact, Unsigned

if TYPE_CHECKING:
    from cryptography.x509 import Certificate

FIELD: Final = "Certificate"
_MOST_BYTES: Final = 256_000_000
_REVISIONS: Final = 2
"""The body, and the signature."""


@dataclass(frozen=True)
class SignedPdf:
    """What a signature stands for, the whole file, and who signed; `signed_at` is what the signer's clock said."""

    chain: tuple[Certificate, ...]
    signed_at: datetime


def sign_pdf(body: bytes, signatory: Signatory, now: datetime, reason: str, place: str) -> bytes:
    """Return a PDF with a signature of all of it appended. Raises `Refused` for one that has one."""
    from asn1crypto.x509 import Certificate as Asn1
    from cryptography.hazmat.primitives.serialization import Encoding
    from pyhanko.pdf_utils.incremental_writer import IncrementalPdfFileWriter
    from pyhanko.sign import fields, signers
    from pyhanko_certvalidator.registry import SimpleCertificateStore

    own, *above = (Asn1.load(one.public_bytes(Encoding.DER)) for one in signatory.chain)
    store = SimpleCertificateStore()  # type: ignore[no-untyped-call]
    store.register_multiple(above)
    longest = signatory.chain[0].public_key().key_size  # type: ignore[union-attr]

    class ByKey(signers.Signer):
        async def async_sign_raw(self, data: bytes, digest_algorithm: str, dry_run: bool = False) -> bytes:
            return bytes(longest) if dry_run else signatory.sign(data)

    class AtTime(signers.PdfSigner):
        def init_signing_session(self, *given: Any, **named: Any) -> Any:
            session = super().init_signing_session(*given, **named)
            session.system_time = now
            return session

    class Writer(IncrementalPdfFileWriter):
        def ensure_output_version(self, version: Any) -> None:
            """Leave it at 1.7, on which PDF/A-3 stands; PAdES asks for no more than its extension (ESIC)."""

    told = signers.PdfSignatureMetadata(
        field_name=FIELD,
        md_algorithm="sha256",
        name=signatory.name,
        reason=reason,
        location=place,
        certify=True,
        docmdp_permissions=fields.MDPPerm.NO_CHANGES,
        subfilter=fields.SigSeedSubFilter.PADES,
    )
    writer = Writer(io.BytesIO(body))
    if next(iter(writer.prev.embedded_signatures), None) is not None:
        raise Refused("the PDF is signed already; sign the body without a signature")
    signed = AtTime(told, ByKey(signing_cert=own, cert_registry=store)).sign_pdf(writer)
    return bytes(signed.getvalue())


def check_pdf(file: bytes) -> SignedPdf:
    """Return who signed a PDF, whoever it is.

    Raises `Unsigned` where there is no signature, `NotIntact` where there is more than one, where it does not cover
    every byte but itself, where anything was appended after it, and where what it covers was changed.
    """
    if len(file) > _MOST_BYTES:
        raise NotIntact(f"it has more than {_MOST_BYTES // 1_000_000} MB")
    if not file.startswith(b"%PDF-"):
        raise NoCertificate("not a PDF from its first byte")
    from pyhanko.pdf_utils.reader import PdfFileReader

    try:
        reader = PdfFileReader(io.BytesIO(file), strict=True)
        if reader.encrypted:
            raise NotIntact("it is encrypted, and no certificate is")
        signatures = list(reader.embedded_signatures)
        if not signatures:
            raise Unsigned("nobody signed it (no PDF signature)")
        if len(signatures) > 1:
            raise NotIntact(f"it has {len(signatures)} signatures, and a certificate has one")
        (signature,) = signatures
        _check_cover(file, signature)
        if reader.xrefs.total_revisions != _REVISIONS or reader.xrefs.hybrid_xrefs_present:
            raise NotIntact("it has parts that were appended; a certificate is its body and one signature")
        return _who(signature)
    except (NotIntact, Refused):
        raise
    except Exception as error:  # whatever the libraries below make of bad input
        told = " ".join(str(error).split())[:200] or type(error).__name__
        raise NotIntact(f"its signature cannot be read ({told})") from error


def _check_cover(file: bytes, signature: Any) -> None:
    """Raise `NotIntact` unless a signature covers all of the file but the hexadecimal digits of itself."""
    ranges = [int(one) for one in signature.byte_range]
    if len(ranges) != 4 or ranges[0] != 0:
        raise NotIntact("its signature does not cover it from the first byte")
    _, before, after, rest = ranges
    if not 0 < before < after or after + rest != len(file):
        raise NotIntact("something was appended after its signature, which covers it no more to the end")
    gap = file[before:after]
    content = signature.pkcs7_content
    digits = gap[1:-1]
    if gap[:1] + gap[-1:] != b"<>" or len(digits) != 2 * len(content) or unhexlify(digits) != content:
        raise NotIntact("its signature leaves out more than itself")
    value = _written_anew(content)
    if content[: len(value)] != value or content[len(value) :].strip(b"\0"):
        raise NotIntact("something stands in the place of its signature beside it")


def _written_anew(content: bytes) -> bytes:
    """Return the one DER value at the start of padded bytes as it is written by the rules, lengths and all."""
    from asn1crypto.cms import ContentInfo

    return bytes(ContentInfo.load(content, strict=False).dump(force=True))


def _check_wrapping(data: Any, signer: Any) -> None:
    """Raise `NotIntact` where what the signature does not cover of its own wrapping is not as it was made.

    That are versions and a list of algorithms (RFC 5652, 5.1, 5.3), which readers look at or not.
    """
    from asn1crypto.algos import DigestAlgorithm
    from asn1crypto.core import Null

    sha256 = DigestAlgorithm({"algorithm": "sha256", "parameters": Null()}).dump()
    algorithms = [one.dump() for one in (*data["digest_algorithms"], signer["digest_algorithm"])]
    versions = [data["version"].native, signer["version"].native]
    if algorithms != [sha256, sha256] or versions != ["v1", "v1"] or signer["unsigned_attrs"].native:
        raise NotIntact("its signature is not wrapped as one of PAdES, baseline B-B, with SHA-256 is")


def _who(signature: Any) -> SignedPdf:
    from cryptography import x509
    from pyhanko.sign.fields import MDPPerm, SigSeedSubFilter
    from pyhanko.sign.validation import validate_pdf_signature
    from pyhanko_certvalidator import ValidationContext

    _check_wrapping(signature.signed_data, signature.signer_info)
    if signature.sig_object.get("/SubFilter") != SigSeedSubFilter.PADES.value:
        raise NotIntact("its signature is of another kind than PAdES")
    when = signature.self_reported_timestamp
    if when is None or when.tzinfo is None:
        raise NotIntact("its signature does not say when it was made")
    # for this question alone the signer is believed; whether it is the laboratory is asked apart
    context = ValidationContext(trust_roots=[signature.signer_cert], moment=when, allow_fetching=False)
    status = validate_pdf_signature(signature, context, key_usage_settings=_any_usage())
    if not status.intact:
        raise NotIntact("what was signed has been changed")
    if not status.valid:
        raise NotIntact("its signature was not made with the key of the certificate in it")
    if signature.docmdp_level != MDPPerm.NO_CHANGES:
        raise NotIntact("its signature allows changes, and that of a certificate allows none")
    chain = (signature.signer_cert, *signature.other_embedded_certs)
    return SignedPdf(tuple(x509.load_der_x509_certificate(one.dump()) for one in chain), when)


def _any_usage() -> Any:
    from pyhanko.sign.validation.settings import KeyUsageConstraints

    return KeyUsageConstraints(key_usage=set())
