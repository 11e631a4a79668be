"""Signatures of certificates: XAdES in the XML, PAdES in the PDF."""

from __future__ import annotations

import io
import logging
from binascii import unhexlify
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from lxml import etree

from bench.base.languages import message
from bench.certificate.signatory import Signatory
from bench.services.errors import Refused

if TYPE_CHECKING:
    from cryptography.x509 import Certificate


SIGNATURE: Final = "http://www.w3.org/2000/09/xmldsig#"
_XADES: Final = "http://uri.etsi.org/01903/v1.3.2#"
_SIGNED_PROPERTIES: Final = "http://uri.etsi.org/01903#SignedProperties"
_ENVELOPED: Final = f"{SIGNATURE}enveloped-signature"
_CANONICAL: Final = "http://www.w3.org/2006/12/xml-c14n11"
_MOST_BYTES: Final = 64_000_000

logging.getLogger("pyhanko").setLevel(
    logging.CRITICAL
)  # the sentences of a verification replace its tracebacks


ORIGINAL: Final = message("ask the laboratory for the original")
"""The remedy for a document that is not intact."""


def parser() -> etree.XMLParser:
    """Return an XML parser for documents from elsewhere, without entities, DTD or network access."""
    return etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)


class NotIntact(Exception):
    """Raised for a malformed signature or changed content; the message says which."""


class NoCertificate(NotIntact):
    """Raised for a file that cannot be an issued certificate, such as a draft."""


class Unsigned(NotIntact):
    """Raised for a document without a signature."""


@dataclass(frozen=True)
class SignedXml:
    """A signed XML and its signer.

    `content` is the canonical form without comments and signature. `chain` starts with the signer's certificate.
    `signed_at` is the time by the signer's clock. `comments` counts the comments in the file, which are not signed.
    """

    content: bytes
    chain: tuple[Certificate, ...]
    signed_at: datetime
    comments: int


def sign_xml(document: bytes, signatory: Signatory, now: datetime) -> bytes:
    """Return a document with a XAdES signature as the last element. Raises `Refused` if it is already signed."""
    xades, methods = _packages()
    root = _read(document)
    if next(root.iter(f"{{{SIGNATURE}}}Signature"), None) is not None:
        raise Refused("the document is already signed; sign the unsigned one")

    class Signer(xades.XAdESSigner):  # type: ignore[misc, name-defined]
        def add_signing_time(self, properties: Any, sig_root: Any, signing_settings: Any) -> None:
            told = etree.SubElement(properties, f"{{{_XADES}}}SigningTime")
            told.text = now.astimezone(UTC).isoformat(timespec="seconds")

    method = (
        methods.SignatureMethod.ECDSA_SHA256 if signatory.by_curve else methods.SignatureMethod.RSA_SHA256
    )
    signer = Signer(
        signature_algorithm=method,
        data_object_format=xades.XAdESDataObjectFormat("Digital calibration certificate", "text/xml"),
    )
    signed = signer.sign(root, key=_Key(signatory), cert=list(signatory.chain), always_add_key_value=False)
    return bytes(etree.tostring(signed, xml_declaration=True, encoding="UTF-8"))


class _Key:
    """An adapter: a signatory's key with the interface that signxml expects of a key."""

    def __init__(self, signatory: Signatory) -> None:
        self._signatory = signatory
        self.key_size: int = signatory.chain[0].public_key().key_size  # type: ignore[union-attr]

    def sign(self, message: bytes, **_: object) -> bytes:
        return self._signatory.sign(message)


def check_xml(document: bytes) -> SignedXml:
    """Verify the signature of a document; return its signed content and signer; trust is not checked.

    Raises `Unsigned` if there is no signature. Raises `NotIntact` if there are several, if the signature does not
    cover the whole document or has unsigned parts, or if anything signed was changed.
    """
    xades, methods = _packages()
    root = _read(document)
    signature = _the_signature(root)
    certificates = _certificates(signature)
    when = _moment(signature)
    allowed = methods.SignatureMethod
    config = xades.XAdESSignatureConfiguration(
        expect_references=3,
        # the signature alone is checked here; `why_not_trusted` compares its time with the certificate
        verification_time=certificates[0].not_valid_before_utc,
        signature_methods=frozenset(
            one
            for one in allowed
            if one.name.startswith(("ECDSA_SHA", "RSA_SHA")) and not one.name.endswith("SHA1")
        ),
    )
    try:
        whole, *_ = xades.XAdESVerifier().verify(root, x509_cert=certificates[0], expect_config=config)
    except Exception as error:  # bad input raises many kinds of exception in the libraries below
        raise NotIntact(f"the signature is invalid ({_reason(error)})") from error
    _check_references(whole.signature_xml)
    comments = sum(1 for _ in root.iter(etree.Comment))
    return SignedXml(bytes(whole.signed_data), certificates, when, comments)


def unsigned_content(document: bytes) -> bytes:
    """Return an unsigned XML in canonical form, without comments. Raises `NotIntact` for unsafe or no XML."""
    return bytes(etree.tostring(_read(document), method="c14n", with_comments=False))


def _read(document: bytes) -> Any:
    """Parse a document offline; return its root. Raises `NotIntact` for anything that certificates never have."""
    if len(document) > _MOST_BYTES:
        raise NotIntact(f"it has more than {_MOST_BYTES // 1_000_000} MB")
    try:
        root: Any = etree.fromstring(document, parser())
    except (etree.XMLSyntaxError, ValueError) as error:
        raise NoCertificate(f"not XML ({_reason(error)})") from error
    if root.getroottree().docinfo.doctype:
        raise NotIntact("it has a document type (DOCTYPE), which certificates never have")
    if next(root.iter(etree.Entity), None) is not None:
        raise NotIntact("it has entities, which certificates never have")
    outside = [*root.itersiblings(preceding=True), *root.itersiblings()]
    if any(one.tag is etree.ProcessingInstruction for one in (*root.iter(), *outside)):
        raise NotIntact("it has processing instructions, which certificates never have")
    return root


def _the_signature(root: Any) -> Any:
    """Return the only signature, the last element. Raises `Unsigned` without one, `NotIntact` if malformed."""
    found = list(root.iter(f"{{{SIGNATURE}}}Signature"))
    if not found:
        raise Unsigned("it has no XML signature")
    if len(found) > 1:
        raise NotIntact(f"it has {len(found)} signatures, instead of one")
    (signature,) = found
    elements = [one for one in root if isinstance(one.tag, str)]
    if signature.getparent() is not root or elements[-1] is not signature:
        raise NotIntact("its signature is not the last element of the document")
    ds = [f"{{{SIGNATURE}}}{name}" for name in ("SignedInfo", "SignatureValue", "KeyInfo", "Object")]
    parts = {
        tuple(ds): signature,
        (f"{{{_XADES}}}QualifyingProperties",): signature[-1] if len(signature) else signature,
        (f"{{{_XADES}}}SignedProperties",): signature.find(f"./{ds[3]}/{{{_XADES}}}QualifyingProperties"),
    }
    for tags, element in parts.items():
        if element is None or tuple(one.tag for one in element if isinstance(one.tag, str)) != tags:
            raise NotIntact("its signature has unsigned parts, or lacks some (XAdES, baseline B-B)")
    return signature


def _check_references(signature: Any) -> None:
    """Raise `NotIntact` unless the signature covers the whole document, its properties and the certificates."""
    info = signature.find(f"{{{SIGNATURE}}}SignedInfo")
    key_info = signature.find(f"{{{SIGNATURE}}}KeyInfo")
    properties = signature.find(f".//{{{_XADES}}}SignedProperties")
    references = info.findall(f"{{{SIGNATURE}}}Reference")
    transforms = [one.get("Algorithm") for one in references[0].iter(f"{{{SIGNATURE}}}Transform")]
    uris = [one.get("URI") for one in references]
    if (
        uris != ["", f"#{properties.get('Id')}", f"#{key_info.get('Id')}"]
        or references[1].get("Type") != _SIGNED_PROPERTIES
        or transforms != [_ENVELOPED, _CANONICAL]
    ):
        raise NotIntact(
            "its signature does not cover the whole document, its properties and its certificates"
        )


def _certificates(signature: Any) -> tuple[Certificate, ...]:
    import base64

    from cryptography import x509

    texts = signature.findall(
        f"./{{{SIGNATURE}}}KeyInfo/{{{SIGNATURE}}}X509Data/{{{SIGNATURE}}}X509Certificate"
    )
    try:
        found = tuple(x509.load_der_x509_certificate(base64.b64decode(one.text or "")) for one in texts)
    except ValueError as error:
        raise NotIntact(f"a certificate in its signature cannot be read ({_reason(error)})") from error
    if not found:
        raise NotIntact("its signature names no signer's certificate")
    return found


def _moment(signature: Any) -> datetime:
    times = [one.text or "" for one in signature.iter(f"{{{_XADES}}}SigningTime")]
    try:
        (text,) = times
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise NotIntact("its signature has no time") from error
    if moment.tzinfo is None:
        raise NotIntact("the time of its signature has no time zone")
    return moment


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _packages() -> tuple[Any, Any]:
    from signxml import algorithms, xades

    return xades, algorithms


FIELD: Final = "Certificate"
_MOST_PDF_BYTES: Final = 256_000_000
_REVISIONS: Final = 2
"""Number of revisions in a signed PDF: the body, and the signature."""


@dataclass(frozen=True)
class SignedPdf:
    """The signer of a PDF: the certificate chain, and the time of signing by the signer's clock."""

    chain: tuple[Certificate, ...]
    signed_at: datetime


def sign_pdf(body: bytes, signatory: Signatory, now: datetime, reason: str, place: str) -> bytes:
    """Return a PDF with a PAdES signature over the whole file. Raises `Refused` if it is already signed."""
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
            """Keep PDF version 1.7, which PDF/A-3 requires; its extension ESIC suffices for PAdES."""

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
        raise Refused("the PDF is already signed; sign the unsigned body")
    signed = AtTime(told, ByKey(signing_cert=own, cert_registry=store)).sign_pdf(writer)
    return bytes(signed.getvalue())


def check_pdf(file: bytes) -> SignedPdf:
    """Verify the signature of a PDF; return the signer; trust is not checked.

    Raises `Unsigned` if there is no signature. Raises `NotIntact` if there are several, if the signature does not
    cover every byte except itself, if anything was appended after it, or if anything signed was changed.
    """
    if len(file) > _MOST_PDF_BYTES:
        raise NotIntact(f"it has more than {_MOST_PDF_BYTES // 1_000_000} MB")
    if not file.startswith(b"%PDF-"):
        raise NoCertificate("not a PDF from its first byte")
    from pyhanko.pdf_utils.reader import PdfFileReader

    try:
        reader = PdfFileReader(io.BytesIO(file), strict=True)
        if reader.encrypted:
            raise NotIntact("it is encrypted, which certificates never are")
        signatures = list(reader.embedded_signatures)
        if not signatures:
            raise Unsigned("it has no PDF signature")
        if len(signatures) > 1:
            raise NotIntact(f"it has {len(signatures)} signatures, instead of one")
        (signature,) = signatures
        _check_cover(file, signature)
        if reader.xrefs.total_revisions != _REVISIONS or reader.xrefs.hybrid_xrefs_present:
            raise NotIntact("parts were appended to it after the signature")
        return _who(signature)
    except (NotIntact, Refused):
        raise
    except Exception as error:  # bad input raises many kinds of exception in the libraries below
        raise NotIntact(f"its signature cannot be read ({_reason(error)})") from error


def _check_cover(file: bytes, signature: Any) -> None:
    """Raise `NotIntact` unless the signature covers every byte of the file except its own hexadecimal digits."""
    ranges = [int(one) for one in signature.byte_range]
    if len(ranges) != 4 or ranges[0] != 0:
        raise NotIntact("its signature does not cover the beginning of the file")
    _, before, after, rest = ranges
    if not 0 < before < after or after + rest != len(file):
        raise NotIntact("its signature does not cover the end of the file: something was appended")
    gap = file[before:after]
    content = signature.pkcs7_content
    digits = gap[1:-1]
    if gap[:1] + gap[-1:] != b"<>" or len(digits) != 2 * len(content) or unhexlify(digits) != content:
        raise NotIntact("its signature does not cover the whole file")
    value = _written_anew(content)
    if content[: len(value)] != value or content[len(value) :].strip(b"\0"):
        raise NotIntact("other data replaced its signature")


def _written_anew(content: bytes) -> bytes:
    """Return the DER value at the start of padded bytes, encoded again by the rules of DER."""
    from asn1crypto.algos import DigestAlgorithm
    from asn1crypto.cms import ContentInfo

    value = ContentInfo.load(content, strict=False)
    for signer in value["content"]["signer_infos"]:
        for attribute in signer["signed_attrs"]:
            if attribute["type"].native == "signing_certificate_v2":
                for one in attribute["values"][0]["certs"]:
                    # asn1crypto would encode its own default value thousands of times, but not one that was read
                    one.children[0] = DigestAlgorithm.load(one["hash_algorithm"].dump())
    return bytes(value.dump(force=True))


def _check_wrapping(data: Any, signer: Any) -> None:
    """Raise `NotIntact` if unsigned parts of the CMS structure differ from those that this program writes."""
    from asn1crypto.algos import DigestAlgorithm
    from asn1crypto.core import Null

    sha256 = DigestAlgorithm({"algorithm": "sha256", "parameters": Null()}).dump()
    algorithms = [one.dump() for one in (*data["digest_algorithms"], signer["digest_algorithm"])]
    versions = [data["version"].native, signer["version"].native]
    if algorithms != [sha256, sha256] or versions != ["v1", "v1"] or signer["unsigned_attrs"].native:
        raise NotIntact("its signature is not PAdES, baseline B-B, with SHA-256")


def _who(signature: Any) -> SignedPdf:
    from cryptography import x509
    from pyhanko.sign.fields import MDPPerm, SigSeedSubFilter
    from pyhanko.sign.validation import validate_pdf_signature
    from pyhanko.sign.validation.settings import KeyUsageConstraints
    from pyhanko_certvalidator import ValidationContext

    _check_wrapping(signature.signed_data, signature.signer_info)
    if signature.sig_object.get("/SubFilter") != SigSeedSubFilter.PADES.value:
        raise NotIntact("its signature is not PAdES")
    when = signature.self_reported_timestamp
    if when is None or when.tzinfo is None:
        raise NotIntact("its signature has no time")
    # trust the signer here, to check the signature alone; `why_not_trusted` checks who signed
    context = ValidationContext(trust_roots=[signature.signer_cert], moment=when, allow_fetching=False)
    any_usage = KeyUsageConstraints(key_usage=set())
    status = validate_pdf_signature(signature, context, key_usage_settings=any_usage)
    if not status.intact:
        raise NotIntact("it was changed after it was signed")
    if not status.valid:
        raise NotIntact("its signature was not made with the key of the certificate in it")
    if signature.docmdp_level != MDPPerm.NO_CHANGES:
        raise NotIntact("its signature allows changes, which certificates never do")
    chain = (signature.signer_cert, *signature.other_embedded_certs)
    return SignedPdf(tuple(x509.load_der_x509_certificate(one.dump()) for one in chain), when)
