"""Who signs: a private key, in a file or in a token, with the X.509 certificate that says whose it is.

The key of a seal (Ed25519, no certificate) is not one of these: readers of XAdES and PAdES take elliptic curves of
NIST or RSA, and ask for a certificate. So a certificate has a key of its own, by the same rules for its file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bench.api.errors import Refused
from bench.base.regular import read_given
from bench.run.signing import read_private, write_private

if TYPE_CHECKING:
    from cryptography.x509 import Certificate

SUFFIX: Final = ".crt"
"""The chain of a key stands beside it, in a file of its name with this added."""
_DAYS_IN_FORCE: Final = 3652
_LEAST_RSA_BITS: Final = 2048


@dataclass(frozen=True)
class Signatory:
    """A chain of certificates, that of the key first, and what signs with the key.

    `sign` returns a signature over the SHA-256 of a message: ECDSA as DER, RSA by PKCS #1 v1.5.
    """

    chain: tuple[Certificate, ...]
    sign: Callable[[bytes], bytes]

    @property
    def name(self) -> str:
        """Whose key it is, as its certificate says."""
        return name_of(self.chain[0])

    @property
    def by_curve(self) -> bool:
        """Whether its signatures are by ECDSA, not by RSA."""
        from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePublicKey

        return isinstance(self.chain[0].public_key(), EllipticCurvePublicKey)


def name_of(certificate: Certificate) -> str:
    """Return the common name of a certificate's subject, or all of it where it has none."""
    from cryptography.x509.oid import NameOID

    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else certificate.subject.rfc4514_string()


def fingerprint_of(certificate: Certificate) -> str:
    """Return the SHA-256 of a certificate (DER), by which people compare certificates."""
    from cryptography.hazmat.primitives.hashes import SHA256

    return certificate.fingerprint(SHA256()).hex()


def new_certificate_key(file: Path, name: str, passphrase: bytes | None, now: datetime) -> tuple[Path, str]:
    """Make a P-256 key and a certificate of a laboratory that it signs itself, in force for ten years.

    Return the file of the certificate and its fingerprint. Raises `RecordError` where there is a file already, and
    for a folder that others may enter; `Refused` for a name that no certificate can have.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    try:
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    except ValueError as error:
        raise Refused(f"{name!r}: not a name for a certificate (1 to 64 characters)") from error
    identifier = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    # for signatures of documents alone; a certificate of its own stands for nobody else's
    usage = x509.KeyUsage(True, True, False, False, False, False, False, False, False)
    certificate = (
        x509.CertificateBuilder(subject, subject, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(minutes=1))
        .not_valid_after(now + timedelta(days=_DAYS_IN_FORCE))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(identifier, critical=False)
        .sign(key, hashes.SHA256())
    )
    public = file.with_name(file.name + SUFFIX)
    pem = certificate.public_bytes(serialization.Encoding.PEM).decode()
    write_private(file, key, passphrase, {public: pem})
    return public, fingerprint_of(certificate)


def signatory_of(key: str, chain: Path | None, passphrase: Callable[[], bytes], now: datetime) -> Signatory:
    """Return who signs: `key` is a file (PEM) or an address in a token (`pkcs11:…`, RFC 7512).

    `chain` has the certificates (PEM), that of the key first; without it the file beside the key, or the token has
    it. Raises `RecordError` for a file that others may read or that is no key, `Refused` for what cannot sign now.
    """
    if key.startswith("pkcs11:"):
        from bench.certificate.signature.token import signatory_in_token

        signatory = signatory_in_token(key, None if chain is None else certificates_in(chain), passphrase)
    else:
        signatory = _in_file(Path(key), chain, passphrase)
    _check(signatory, now)
    return signatory


def certificates_in(file: Path) -> tuple[Certificate, ...]:
    """Return the certificates of a file (PEM). Raises `Refused` where it has none."""
    from cryptography import x509

    try:
        return tuple(x509.load_pem_x509_certificates(read_given(file)))
    except OSError as error:
        raise Refused(f"{file}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise Refused(f"{file}: no X.509 certificate in it (PEM)") from error


def _in_file(file: Path, chain: Path | None, passphrase: Callable[[], bytes]) -> Signatory:
    wanted = f"P-256 or RSA, PEM; 'bench key {file} --certificate NAME' makes one"
    key = read_private(file, passphrase, wanted)
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec, padding, rsa

    def sign(message: bytes) -> bytes:
        if isinstance(key, ec.EllipticCurvePrivateKey):
            return key.sign(message, ec.ECDSA(hashes.SHA256()))
        return key.sign(message, padding.PKCS1v15(), hashes.SHA256())  # type: ignore[no-any-return]

    if not isinstance(key, ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey):
        raise Refused(f"{file}: a key of another kind than certificates are signed with ({wanted})")
    beside = chain if chain is not None else file.with_name(file.name + SUFFIX)
    if chain is None and not beside.is_file():
        raise Refused(
            f"{file}: no certificate says whose key it is; name its chain with --chain FILE, or put it in {beside}"
        )
    return Signatory(certificates_in(beside), sign)


def _check(signatory: Signatory, now: datetime) -> None:
    """Raise `Refused` for a certificate that is not the key's, not in force, or not for signing."""
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric import rsa

    mine = signatory.chain[0]
    wrong = []
    public = mine.public_key()
    if isinstance(public, rsa.RSAPublicKey) and public.key_size < _LEAST_RSA_BITS:
        wrong.append(f"its key has {public.key_size} bits, and {_LEAST_RSA_BITS} are the least")
    try:
        _proves(public, signatory.sign(b"triaxial-bench"), b"triaxial-bench")
    except (InvalidSignature, ValueError, TypeError):
        wrong.append("it is of another key; the certificate of the key stands first in its chain")
    if not mine.not_valid_before_utc <= now <= mine.not_valid_after_utc:
        since, until = mine.not_valid_before_utc.date(), mine.not_valid_after_utc.date()
        wrong.append(f"it is in force from {since} to {until}, and not now")
    try:
        usage = mine.extensions.get_extension_for_class(x509.KeyUsage).value
    except (x509.ExtensionNotFound, ValueError):
        usage = None
    if usage is not None and not (usage.digital_signature or usage.content_commitment):
        wrong.append("it is not meant for signatures (its key usage)")
    for below, above in zip(signatory.chain, signatory.chain[1:], strict=False):
        try:
            below.verify_directly_issued_by(above)
        except (InvalidSignature, ValueError, TypeError):
            wrong.append(f"'{name_of(below)}' was not issued by '{name_of(above)}', next in it")
    if wrong:
        raise Refused(f"the certificate of '{signatory.name}' cannot be signed with: {'; '.join(wrong)}")


def _proves(public: object, signature: bytes, message: bytes) -> None:
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec, padding, rsa

    if isinstance(public, ec.EllipticCurvePublicKey):
        public.verify(signature, message, ec.ECDSA(hashes.SHA256()))
    elif isinstance(public, rsa.RSAPublicKey):
        public.verify(signature, message, padding.PKCS1v15(), hashes.SHA256())
    else:
        raise TypeError("neither an elliptic curve nor RSA")
