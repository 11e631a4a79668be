"""Keys, certification authorities and a small PDF for tests of signing."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, padding
from cryptography.x509.oid import NameOID

from bench.certificate.signatory import Signatory, signatory_of

NOW = datetime(2026, 11, 22, 12, 0, 0, tzinfo=UTC)


def no_passphrase() -> bytes:
    """Fail, because no passphrase should be requested."""
    raise AssertionError("a passphrase was asked for")


@dataclass(frozen=True)
class Issuer:
    """A certification authority."""

    key: ec.EllipticCurvePrivateKey
    certificate: x509.Certificate


@cache
def authority(name: str, above: str = "") -> Issuer:
    """Return the authority `name`, made once and certified by the authority `above`, or ("") by itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    issuer = authority(above) if above else None
    return Issuer(key, certified(key.public_key(), name, issuer, ca=True, own=key))


def certified(
    public: Any,
    name: str,
    issuer: Issuer | None,
    until: datetime = NOW + timedelta(days=365),
    sign: bool = True,
    ca: bool = False,
    own: Any = None,
) -> x509.Certificate:
    """Return a certificate of a public key, signed by an issuer or, without one, by the key `own`."""
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    usage = x509.KeyUsage(sign and not ca, sign and not ca, not sign, False, False, ca, ca, False, False)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject if issuer is None else issuer.certificate.subject)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(NOW - timedelta(days=30))
        .not_valid_after(until)
        .add_extension(x509.BasicConstraints(ca=ca, path_length=None), critical=True)
        .add_extension(usage, critical=True)
        .sign(own if issuer is None else issuer.key, hashes.SHA256())
    )


def in_file(folder: Path, key: Any, chain: list[x509.Certificate]) -> Signatory:
    """Write a key and its certificate chain into a folder; return the signatory who uses them."""
    folder.chmod(0o700)
    file, beside = folder / "lab.pem", folder / "chain.pem"
    plain = (serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    file.write_bytes(key.private_bytes(*plain))
    file.chmod(0o600)
    beside.write_bytes(b"".join(one.public_bytes(serialization.Encoding.PEM) for one in chain))
    return signatory_of(str(file), beside, no_passphrase, NOW)


@cache
def blank_pdf() -> bytes:
    """Return a PDF/A-3b with a word and an attachment."""
    import typst

    source = (
        b'#pdf.attach("dcc.xml", bytes("<a/>"), relationship: "data", mime-type: "text/xml", description: "data")\n'
        b"#set document(title: [Certificate])\nA word."
    )
    return typst.compile(source, format="pdf", pdf_standards=["a-3b"], ignore_system_fonts=True, timestamp=0)


@cache
def a_signatory(name: str = "Laboratory of Tests") -> Signatory:
    """Return a signatory with a P-256 key and a self-signed certificate, made once for each name."""
    key = ec.generate_private_key(ec.SECP256R1())
    return signatory(key, certified(key.public_key(), name, None, own=key))


def signatory(key: Any, certificate: x509.Certificate) -> Signatory:
    """Return who signs with an elliptic-curve or RSA key, whether or not its certificate permits that."""
    how: list[Any] = [] if isinstance(key, ec.EllipticCurvePrivateKey) else [padding.PKCS1v15()]
    how += [hashes.SHA256() if how else ec.ECDSA(hashes.SHA256())]
    return Signatory((certificate,), lambda message: key.sign(message, *how))
