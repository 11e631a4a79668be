"""XAdES (baseline B-B) in a certificate's XML: one signature, enveloped, over the whole document."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from bench.api.errors import Refused
from bench.certificate.signature.signatory import Signatory

if TYPE_CHECKING:
    from cryptography.x509 import Certificate

NAMESPACE: Final = "http://www.w3.org/2000/09/xmldsig#"
_XADES: Final = "http://uri.etsi.org/01903/v1.3.2#"
_SIGNED_PROPERTIES: Final = "http://uri.etsi.org/01903#SignedProperties"
_ENVELOPED: Final = "http://www.w3.org/2000/09/xmldsig#enveloped-signature"
_CANONICAL: Final = "http://www.w3.org/2006/12/xml-c14n11"
_MOST_BYTES: Final = 64_000_000


class NotIntact(Exception):
    """A signature is not what it should be, or what was signed has been changed; the text says what."""


class NoCertificate(NotIntact):
    """It is nothing that was ever issued."""


class Unsigned(NotIntact):
    """Nobody signed it."""


@dataclass(frozen=True)
class SignedXml:
    """What a signature stands for: `content`, in canonical form (no comments, no signature), and who signed.

    `signed_at` is what the signer's clock said; `comments` is how many the document has, which nobody signed.
    """

    content: bytes
    chain: tuple[Certificate, ...]
    signed_at: datetime
    comments: int


def sign_xml(document: bytes, signatory: Signatory, now: datetime) -> bytes:
    """Return a document with a signature as the last element of its root. Raises `Refused` for one that has one."""
    etree, xades, methods = _packages()
    root = _read(document)
    if next(root.iter(f"{{{NAMESPACE}}}Signature"), None) is not None:
        raise Refused("the document is signed already; sign the one without a signature")

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
    """A signatory's key as the library uses one."""

    def __init__(self, signatory: Signatory) -> None:
        self._signatory = signatory
        self.key_size: int = signatory.chain[0].public_key().key_size  # type: ignore[union-attr]

    def sign(self, message: bytes, **_: object) -> bytes:
        return self._signatory.sign(message)


def check_xml(document: bytes) -> SignedXml:
    """Return what the one signature of a document stands for, whoever made it.

    Raises `Unsigned` where there is none, `NotIntact` where there is more than one, where it does not stand for the
    whole document, where it is wrapped or has parts that nobody signed, and where anything signed was changed.
    """
    etree, xades, methods = _packages()
    root = _read(document)
    signature = _the_signature(root)
    certificates = _certificates(signature)
    when = _moment(signature)
    allowed = methods.SignatureMethod
    config = xades.XAdESSignatureConfiguration(
        expect_references=3,
        verification_time=when,
        signature_methods=frozenset(
            one
            for one in allowed
            if one.name.startswith(("ECDSA_SHA", "RSA_SHA")) and not one.name.endswith("SHA1")
        ),
    )
    try:
        whole, *_ = xades.XAdESVerifier().verify(root, x509_cert=certificates[0], expect_config=config)
    except (
        Exception
    ) as error:  # whatever the library, the parser and the cryptography below it make of bad input
        raise NotIntact(f"the signature does not hold ({_told(error)})") from error
    _check_references(whole.signature_xml)
    comments = sum(1 for _ in root.iter(etree.Comment))
    return SignedXml(bytes(whole.signed_data), certificates, when, comments)


def unsigned_content(document: bytes) -> bytes:
    """Return what a document without a signature says, in canonical form, without comments. Raises `NotIntact`."""
    etree, _, _ = _packages()
    return bytes(etree.tostring(_read(document), method="c14n", with_comments=False))


def _read(document: bytes) -> Any:
    """Return the root of a document without entities, document type, network. Raises `NotIntact`."""
    etree, _, _ = _packages()
    if len(document) > _MOST_BYTES:
        raise NotIntact(f"it has more than {_MOST_BYTES // 1_000_000} MB")
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)
    try:
        root = etree.fromstring(document, parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        raise NoCertificate(f"not XML ({_told(error)})") from error
    if root.getroottree().docinfo.doctype:
        raise NotIntact("it has a document type (DOCTYPE), which no certificate has")
    if next(root.iter(etree.Entity), None) is not None:
        raise NotIntact("it has entities, which no certificate has")
    outside = [*root.itersiblings(preceding=True), *root.itersiblings()]
    if any(one.tag is etree.ProcessingInstruction for one in (*root.iter(), *outside)):
        raise NotIntact("it has processing instructions, which no certificate has")
    return root


def _the_signature(root: Any) -> Any:
    """Return the one signature there is: the last element of the root, with the four parts it should have."""
    found = list(root.iter(f"{{{NAMESPACE}}}Signature"))
    if not found:
        raise Unsigned("nobody signed it (no XML signature)")
    if len(found) > 1:
        raise NotIntact(f"it has {len(found)} signatures, and a certificate has one")
    (signature,) = found
    elements = [one for one in root if isinstance(one.tag, str)]
    if signature.getparent() is not root or elements[-1] is not signature:
        raise NotIntact(
            "its signature does not stand where a certificate has it: the last element of the document"
        )
    ds = [f"{{{NAMESPACE}}}{name}" for name in ("SignedInfo", "SignatureValue", "KeyInfo", "Object")]
    parts = {
        tuple(ds): signature,
        (f"{{{_XADES}}}QualifyingProperties",): signature[-1] if len(signature) else signature,
        (f"{{{_XADES}}}SignedProperties",): signature.find(f"./{ds[3]}/{{{_XADES}}}QualifyingProperties"),
    }
    for tags, element in parts.items():
        if element is None or tuple(one.tag for one in element if isinstance(one.tag, str)) != tags:
            raise NotIntact("its signature has parts that nobody signed, or lacks some (XAdES, baseline B-B)")
    return signature


def _check_references(signature: Any) -> None:
    """Raise `NotIntact` unless what is signed is the whole document, the properties and the certificates."""
    info = signature.find(f"{{{NAMESPACE}}}SignedInfo")
    key_info = signature.find(f"{{{NAMESPACE}}}KeyInfo")
    properties = signature.find(f".//{{{_XADES}}}SignedProperties")
    references = info.findall(f"{{{NAMESPACE}}}Reference")
    transforms = [one.get("Algorithm") for one in references[0].iter(f"{{{NAMESPACE}}}Transform")]
    uris = [one.get("URI") for one in references]
    if (
        uris != ["", f"#{properties.get('Id')}", f"#{key_info.get('Id')}"]
        or references[1].get("Type") != _SIGNED_PROPERTIES
        or transforms != [_ENVELOPED, _CANONICAL]
    ):
        raise NotIntact(
            "its signature does not stand for the whole document, its properties and its certificates"
        )


def _certificates(signature: Any) -> tuple[Certificate, ...]:
    import base64

    from cryptography import x509

    texts = signature.findall(
        f"./{{{NAMESPACE}}}KeyInfo/{{{NAMESPACE}}}X509Data/{{{NAMESPACE}}}X509Certificate"
    )
    try:
        found = tuple(x509.load_der_x509_certificate(base64.b64decode(one.text or "")) for one in texts)
    except ValueError as error:
        raise NotIntact(f"a certificate in its signature cannot be read ({_told(error)})") from error
    if not found:
        raise NotIntact("its signature names no certificate of a signer")
    return found


def _moment(signature: Any) -> datetime:
    times = [one.text or "" for one in signature.iter(f"{{{_XADES}}}SigningTime")]
    try:
        (text,) = times
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise NotIntact("its signature does not say when it was made") from error
    if moment.tzinfo is None:
        raise NotIntact("its signature says when it was made without a time zone")
    return moment


def _told(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _packages() -> tuple[Any, Any, Any]:
    from lxml import etree
    from signxml import algorithms, xades

    return etree, xades, algorithms
