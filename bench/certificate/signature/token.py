"""A key that never leaves its token: a card, a stick, a module, by PKCS #11.

Its address is one of RFC 7512: `pkcs11:token=LABORATORY;object=certificates?module-path=/usr/lib/…/module.so`.
"""

from __future__ import annotations

from collections.abc import Callable
from hashlib import sha256
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import unquote, unquote_to_bytes

from bench.api.errors import Refused
from bench.certificate.signature.signatory import Signatory

if TYPE_CHECKING:
    from cryptography.x509 import Certificate

_PATH: Final = ("token", "object", "id", "serial")
_QUERY: Final = ("module-path",)
_SHOWN: Final = "pkcs11:token=NAME;object=NAME?module-path=/path/of/the/module.so"


def signatory_in_token(
    address: str, chain: tuple[Certificate, ...] | None, pin: Callable[[], bytes]
) -> Signatory:
    """Return who signs with a key in a token; `pin` is asked for.

    `chain` stands for the certificate in the token where it is given. Raises `Refused` for an address that names
    not one key, a module that is none, a PIN that the token does not take.
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
            key = _the_one(session, pkcs11.ObjectClass.PRIVATE_KEY, path, f"{told}: private keys")
            own = chain or (_certificate(session, path, told),)
        except Refused:
            session.close()  # or the token is still open to whoever asks next
            raise
    except UnicodeDecodeError as error:
        raise Refused(f"{told}: a PIN is UTF-8 text") from error
    except pkcs11.exceptions.PKCS11Error as error:
        reason = str(error) or type(error).__name__
        raise Refused(
            f"{told}: the token gives no key ({reason}); is it there, and is its PIN right?"
        ) from error
    except RuntimeError as error:  # a file that is no module
        raise Refused(f"{module}: not a module of PKCS #11 ({error})") from error
    return Signatory(own, _signing(key, told))


def _parts(address: str) -> tuple[dict[str, Any], str]:
    """Return what an address says of the key, and its module."""
    body, _, query = address.removeprefix("pkcs11:").partition("?")
    path: dict[str, Any] = {}
    for part in filter(None, body.split(";")):
        name, _, value = part.partition("=")
        if name not in _PATH or name in path:
            raise Refused(f"{address}: '{name}' is not expected here; an address is {_SHOWN}")
        path[name] = unquote_to_bytes(value) if name == "id" else unquote(value)
    asked = dict(part.partition("=")[::2] for part in filter(None, query.split("&")))
    if set(asked) != set(_QUERY) or not {"object", "id"} & set(path):
        raise Refused(
            f"{address}: names not one key of one module; an address is {_SHOWN}, the PIN is asked for"
        )
    return path, unquote(asked["module-path"])


def _the_one(session: Any, kind: Any, path: dict[str, Any], what: str) -> Any:
    from pkcs11 import Attribute

    wanted = {Attribute.CLASS: kind}
    if "object" in path:
        wanted[Attribute.LABEL] = path["object"]
    if "id" in path:
        wanted[Attribute.ID] = path["id"]
    found = list(session.get_objects(wanted))
    if len(found) != 1:
        raise Refused(f"{what} of that name in the token: {len(found)}, and one is wanted")
    return found[0]


def _certificate(session: Any, path: dict[str, Any], told: str) -> Certificate:
    from cryptography import x509
    from pkcs11 import Attribute, ObjectClass

    try:
        found = _the_one(session, ObjectClass.CERTIFICATE, path, f"{told}: certificates")
    except Refused as error:
        raise Refused(
            f"{error}; --chain FILE names the key's certificate where it is not in the token"
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
            # tokens that hash by themselves are fewer than those that sign a hash
            both = bytes(key.sign(sha256(message).digest(), mechanism=Mechanism.ECDSA))
        except PKCS11Error as error:
            reason = str(error) or type(error).__name__
            raise Refused(f"{told}: the token does not sign ({reason})") from error
        half = len(both) // 2
        return encode_dss_signature(int.from_bytes(both[:half]), int.from_bytes(both[half:]))

    return sign
