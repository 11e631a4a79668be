"""Signatories: a key in a file or a token, its X.509 certificate chain, and the check of trust."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import unquote, unquote_to_bytes

from bench.base.files import read_given
from bench.run.seal import read_private, write_private
from bench.services.errors import Refused, refusing

if TYPE_CHECKING:
    from cryptography.x509 import Certificate


SUFFIX: Final = ".crt"
"""Suffix that turns the name of a key file into the name of its certificate chain file."""
_DAYS_IN_FORCE: Final = 3652
_LEAST_RSA_BITS: Final = 2048
_LEAST_CURVE_BITS: Final = 224
"""As strong as RSA with `_LEAST_RSA_BITS`: 112 bits (NIST SP 800-57, part 1)."""


@dataclass(frozen=True)
class Signatory:
    """A signatory: the function that signs and the certificate chain, which starts with the key's own certificate.

    `sign` returns a signature over the SHA-256 of a message: ECDSA as DER, RSA by PKCS #1 v1.5.
    """

    chain: tuple[Certificate, ...]
    sign: Callable[[bytes], bytes]

    @property
    def name(self) -> str:
        """The name of the key's owner, as the certificate of the key states it."""
        return name_of(self.chain[0])

    @property
    def by_curve(self) -> bool:
        """Whether the key signs with ECDSA; otherwise with RSA."""
        from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePublicKey

        return isinstance(self.chain[0].public_key(), EllipticCurvePublicKey)


def name_of(certificate: Certificate) -> str:
    """Return the common name of a certificate's subject, or the whole subject if it has no common name."""
    from cryptography.x509.oid import NameOID

    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else certificate.subject.rfc4514_string()


def fingerprint_of(certificate: Certificate) -> str:
    """Return the fingerprint by which people compare certificates: the SHA-256 of the DER form, in hexadecimal."""
    from cryptography.hazmat.primitives.hashes import SHA256

    return certificate.fingerprint(SHA256()).hex()


def new_certificate_key(file: Path, name: str, passphrase: bytes | None, now: datetime) -> tuple[Path, str]:
    """Make a P-256 key and a self-signed certificate that is valid for ten years; `name` is its subject.

    Return the path of the certificate and its fingerprint. Raises `RecordError` if a file exists already or if
    others may enter its folder, `Refused` for a name that a certificate cannot have.
    """
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    try:
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    except ValueError as error:
        raise Refused(
            f"{name!r}: not a name for a certificate; give 1 to 64 bytes (a Cyrillic letter takes 2), not "
            f"{len(name.encode())}"
        ) from error
    identifier = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    # only digital signature and content commitment: this key must not sign other certificates
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
    """Return the signatory for a `key`: a PEM file, or the address of a key in a token (`pkcs11:…`, RFC 7512).

    `chain` is a PEM file with certificates, that of the key first. Without it, the chain is read from the
    key's folder or from the token. Raises `RecordError` for a key file that others may read or that holds no
    key, `Refused` for a key or certificate that cannot be used for signing at `now`.
    """
    if key.startswith("pkcs11:"):
        signatory = signatory_in_token(key, None if chain is None else certificates_in(chain), passphrase)
    else:
        signatory = _in_file(Path(key), chain, passphrase)
    _check(signatory, now)
    return signatory


def certificates_in(file: Path) -> tuple[Certificate, ...]:
    """Return the certificates in a PEM file. Raises `Refused` if it has none or cannot be read."""
    from cryptography import x509

    try:
        with refusing("check name and permissions", file, reading=True):
            return tuple(x509.load_pem_x509_certificates(read_given(file)))
    except ValueError as error:
        raise Refused(f"{file}: the file has no X.509 certificate (PEM); give a file that has one") from error


def _in_file(file: Path, chain: Path | None, passphrase: Callable[[], bytes]) -> Signatory:
    wanted = "P-256 or RSA, PEM; 'bench key FILE --certificate NAME' makes one"
    key = read_private(file, passphrase, wanted)
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec, padding, rsa

    def sign(message: bytes) -> bytes:
        if isinstance(key, ec.EllipticCurvePrivateKey):
            return key.sign(message, ec.ECDSA(hashes.SHA256()))
        return key.sign(message, padding.PKCS1v15(), hashes.SHA256())  # type: ignore[no-any-return]

    if not isinstance(key, ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey):
        raise Refused(
            f"{file}: this kind of key cannot sign certificates; give one of another kind ({wanted})"
        )
    beside = chain if chain is not None else file.with_name(file.name + SUFFIX)
    if chain is None and not beside.is_file():
        raise Refused(
            f"{file}: the key has no certificate; name its chain with --chain FILE, or put it in {beside}"
        )
    return Signatory(certificates_in(beside), sign)


def _check(signatory: Signatory, now: datetime) -> None:
    """Raise `Refused` if the certificate does not match the key, is not valid now, or is not meant for signing."""
    from cryptography.exceptions import InvalidSignature

    mine = signatory.chain[0]
    wrong = ["; ".join(told) for told in _unfit(mine)]
    try:
        _proves(mine.public_key(), signatory.sign(b"triaxial-bench"), b"triaxial-bench")
    except (InvalidSignature, ValueError, TypeError):
        wrong.append("it belongs to another key; put the certificate of the key first in its chain")
    if not mine.not_valid_before_utc <= now <= mine.not_valid_after_utc:
        since, until = mine.not_valid_before_utc.date(), mine.not_valid_after_utc.date()
        wrong.append(f"it is valid from {since} to {until}, not now; use one that is valid now")
    for below, above in zip(signatory.chain, signatory.chain[1:], strict=False):
        try:
            below.verify_directly_issued_by(above)
        except (InvalidSignature, ValueError, TypeError):
            wrong.append(
                f"'{name_of(below)}' was not issued by '{name_of(above)}', the next in the chain; reorder it"
            )
    if wrong:
        raise Refused(f"the certificate of '{signatory.name}' cannot be used for signing: {'; '.join(wrong)}")


def _unfit(own: Certificate) -> Iterator[tuple[str, str]]:
    """Yield why a certificate must not sign at any time, each with the remedy: a weak key, or another purpose."""
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import rsa

    public = own.public_key()
    least = _LEAST_RSA_BITS if isinstance(public, rsa.RSAPublicKey) else _LEAST_CURVE_BITS
    if (bits := getattr(public, "key_size", least)) < least:
        yield f"its key has {bits} bits, fewer than {least}", "use a longer key"
    try:
        usage = own.extensions.get_extension_for_class(x509.KeyUsage).value
    except (x509.ExtensionNotFound, ValueError):
        return
    if not (usage.digital_signature or usage.content_commitment):
        yield "its key usage excludes signatures", "use a certificate for signing"


def _proves(public: object, signature: bytes, message: bytes) -> None:
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec, padding, rsa

    if isinstance(public, ec.EllipticCurvePublicKey):
        public.verify(signature, message, ec.ECDSA(hashes.SHA256()))
    elif isinstance(public, rsa.RSAPublicKey):
        public.verify(signature, message, padding.PKCS1v15(), hashes.SHA256())
    else:
        raise TypeError("neither an elliptic curve nor RSA")


_PATH: Final = ("token", "object", "id", "serial")
_QUERY: Final = ("module-path",)
_SHOWN: Final = "pkcs11:token=NAME;object=NAME?module-path=/path/of/the/module.so"


def signatory_in_token(
    address: str, chain: tuple[Certificate, ...] | None, pin: Callable[[], bytes]
) -> Signatory:
    """Return the signatory for a key in a token; `pin` is called for the PIN.

    `chain`, if given, replaces the certificate in the token. Raises `Refused` if the address names no key or
    several, if the module is not for PKCS #11, or if the token rejects the PIN.
    """
    import pkcs11

    path, module = _parts(address)
    told = address.partition("?")[0]
    try:
        names = {"token_label": path.get("token"), "token_serial": path.get("serial")}
        given = {
            name: value.encode() if name == "token_serial" else value
            for name, value in names.items()
            if value
        }
        token = pkcs11.lib(module).get_token(**given)
        session = token.open(user_pin=pin().decode())
        try:
            key = _the_one(session, pkcs11.ObjectClass.PRIVATE_KEY, path, told, "private keys")
            own = chain or (_certificate(session, path, told),)
        except Refused:
            session.close()  # otherwise the next caller finds the token still logged in
            raise
    except UnicodeDecodeError as error:
        raise Refused(
            f"{told}: the PIN is not UTF-8 text; set the terminal to UTF-8, and type it again"
        ) from error
    except pkcs11.exceptions.PKCS11Error as error:
        reason = str(error) or type(error).__name__
        raise Refused(
            f"{told}: the token gave no key ({reason}); check that the token is connected, and type the PIN again"
        ) from error
    except RuntimeError as error:  # a file that is no module
        raise Refused(f"{module}: not a module of PKCS #11; give the token's library ({error})") from error
    return Signatory(own, _signing(key, told))


def _parts(address: str) -> tuple[dict[str, Any], str]:
    """Return the key attributes in a PKCS #11 address, and the path of the module."""
    body, _, query = address.removeprefix("pkcs11:").partition("?")
    path: dict[str, Any] = {}
    for part in filter(None, body.split(";")):
        name, _, value = part.partition("=")
        if name not in _PATH or name in path:
            raise Refused(f"{address}: '{name}' is not allowed here; give an address such as {_SHOWN}")
        path[name] = unquote_to_bytes(value) if name == "id" else unquote(value)
    asked = dict(part.partition("=")[::2] for part in filter(None, query.split("&")))
    wrong = [] if {"object", "id"} & set(path) else ["'object' or 'id' is missing"]
    wrong += [f"'{name}' is missing after '?'" for name in _QUERY if name not in asked]
    wrong += [f"'{name}' is not allowed after '?'" for name in asked if name not in _QUERY]
    if wrong:
        raise Refused(
            f"pkcs11:{body}: {', '.join(wrong)}; give an address such as {_SHOWN} (the program asks for the PIN)"
        )
    return path, unquote(asked["module-path"])


def _the_one(session: Any, kind: Any, path: dict[str, Any], told: str, what: str) -> Any:
    from pkcs11 import Attribute

    wanted = {Attribute.CLASS: kind}
    if "object" in path:
        wanted[Attribute.LABEL] = path["object"]
    if "id" in path:
        wanted[Attribute.ID] = path["id"]
    found = list(session.get_objects(wanted))
    if len(found) != 1:
        remedy = "name one by its id" if found else "check the address"
        raise Refused(f"{told}: the token has {len(found) or 'no'} {what} of that name; {remedy}")
    return found[0]


def _certificate(session: Any, path: dict[str, Any], told: str) -> Certificate:
    from cryptography import x509
    from pkcs11 import Attribute, ObjectClass

    try:
        found = _the_one(session, ObjectClass.CERTIFICATE, path, told, "certificates")
    except Refused as error:
        raise Refused(
            f"{error}; --chain FILE names the key's certificate if it is not in the token"
        ) from error
    return x509.load_der_x509_certificate(found[Attribute.VALUE])


def _signing(key: Any, told: str) -> Callable[[bytes], bytes]:
    from cryptography.hazmat.primitives.asymmetric.utils import encode_dss_signature
    from pkcs11 import KeyType, Mechanism
    from pkcs11.exceptions import PKCS11Error

    def sign(message: bytes) -> bytes:
        try:
            if key.key_type == KeyType.RSA:
                return bytes(key.sign(message, mechanism=Mechanism.SHA256_RSA_PKCS))
            # hash here: more tokens can sign a given hash than can hash the message themselves
            both = bytes(key.sign(sha256(message).digest(), mechanism=Mechanism.ECDSA))
        except PKCS11Error as error:
            reason = str(error) or type(error).__name__
            raise Refused(
                f"{told}: the token refused to sign ({reason}); check its PIN and what its key may sign"
            ) from error
        half = len(both) // 2
        return encode_dss_signature(int.from_bytes(both[:half]), int.from_bytes(both[half:]))

    return sign


def why_not_trusted(
    chain: Sequence[Certificate], when: datetime, trusted: Sequence[Certificate] | None
) -> str | None:
    """Return why a signer's certificate is not trusted at time `when`; "" if it is.

    A certificate is trusted if `trusted` contains it or a certificate under which it was issued. `chain`
    starts with the signer's certificate; others may link it to `trusted`. Revocation is not checked. If
    `trusted` is None, the result is None, unless nobody may trust the certificate.
    """
    own = chain[0]
    since, until = own.not_valid_before_utc, own.not_valid_after_utc
    if not since <= when <= until:
        days = f"{since.date()} to {until.date()}"
        return f"its certificate (valid from {days}) was not valid at the time of the signature"
    if unfit := next(_unfit(own), None):
        return unfit[0]
    if trusted is None or fingerprint_of(own) in map(fingerprint_of, trusted):
        return None if trusted is None else ""
    from asn1crypto.x509 import Certificate as Asn1
    from cryptography.hazmat.primitives.serialization import Encoding
    from pyhanko_certvalidator import CertificateValidator, ValidationContext
    from pyhanko_certvalidator.errors import PathBuildingError, PathValidationError, ValidationError

    first, *others = (Asn1.load(one.public_bytes(Encoding.DER)) for one in chain)
    roots = [Asn1.load(one.public_bytes(Encoding.DER)) for one in trusted]
    context = ValidationContext(trust_roots=roots, moment=when, allow_fetching=False)
    validator = CertificateValidator(first, intermediate_certs=others, validation_context=context)
    try:
        asyncio.run(validator.async_validate_path())
    except PathBuildingError:
        return "the trust file has no certificate that confirms it"
    except (PathValidationError, ValidationError) as error:
        return " ".join(str(error).split())
    return ""
