"""A time-stamping authority of RFC 3161 on the loopback interface, with its own DER encoding and key.

Sources: RFC 3161, 2.4 (request, response, TSTInfo); RFC 5652, 5 (SignedData); RFC 5035, 5.4 (signing
certificate).
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, HTTPServer

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from rfc3161_client import _rust

Key = ec.EllipticCurvePrivateKey
STAMPED = datetime(2026, 3, 1, 12, tzinfo=UTC)
SHA256 = "2.16.840.1.101.3.4.2.1"
ECDSA_SHA256 = "1.2.840.10045.4.3.2"
SIGNED_DATA = "1.2.840.113549.1.7.2"
TST_INFO = "1.2.840.113549.1.9.16.1.4"
CONTENT_TYPE, MESSAGE_DIGEST = "1.2.840.113549.1.9.3", "1.2.840.113549.1.9.4"
SIGNING_CERTIFICATE_V2 = "1.2.840.113549.1.9.16.2.47"


# --- DER --------------------------------------------------------------------------------------------


def der(tag: int, *parts: bytes) -> bytes:
    body = b"".join(parts)
    length = len(body)
    if length < 0x80:
        return bytes([tag, length]) + body
    size = length.to_bytes((length.bit_length() + 7) // 8, "big")
    return bytes([tag, 0x80 | len(size)]) + size + body


def sequence(*parts: bytes) -> bytes:
    return der(0x30, *parts)


def set_of(*parts: bytes) -> bytes:
    return der(0x31, *sorted(parts))


def octets(data: bytes) -> bytes:
    return der(0x04, data)


def integer(value: int) -> bytes:
    return der(0x02, value.to_bytes(value.bit_length() // 8 + 1, "big"))


def oid(dotted: str) -> bytes:
    first, second, *rest = map(int, dotted.split("."))
    body = [bytes([40 * first + second])]
    for number in rest:
        digits = [number & 0x7F]
        while number := number >> 7:
            digits.append(0x80 | number & 0x7F)
        body.append(bytes(reversed(digits)))
    return der(0x06, *body)


def attribute(name: str, value: bytes) -> bytes:
    return sequence(oid(name), set_of(value))


# --- the authority ----------------------------------------------------------------------------------


def certificate(name: str, key: Key, issuer: tuple[x509.Certificate, Key] | None = None) -> x509.Certificate:
    """Return a self-signed certificate or, from an issuer (certificate, key), one for time stamps."""
    called = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    built = (
        x509.CertificateBuilder()
        .subject_name(called)
        .issuer_name(issuer[0].subject if issuer else called)
        .public_key(key.public_key())
        .serial_number(7 if issuer else 1)
        .not_valid_before(STAMPED - timedelta(days=3650))
        .not_valid_after(STAMPED + timedelta(days=36500))
        .add_extension(x509.BasicConstraints(ca=issuer is None, path_length=None), critical=True)
    )
    if issuer:
        usage = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.TIME_STAMPING])
        built = built.add_extension(usage, critical=True)
    return built.sign(issuer[1] if issuer else key, hashes.SHA256())


class Authority:
    """An authority that answers requests by `answer`, which a test may replace; by default it is `stamp`."""

    def __init__(self) -> None:
        root_key, self._key = ec.generate_private_key(ec.SECP256R1()), ec.generate_private_key(ec.SECP256R1())
        self.root = certificate("a test authority", root_key)
        self._certificate = certificate("stamps for tests", self._key, (self.root, root_key))
        self.requests: list[tuple[str | None, bytes]] = []
        self.answer: Callable[[bytes], bytes] = self.stamp

    def pem(self) -> bytes:
        return self.root.public_bytes(Encoding.PEM)

    def stamp(self, request: bytes) -> bytes:
        """Return the response (DER) to a request (DER)."""
        asked = _rust.parse_timestamp_request(request)
        imprint = sequence(sequence(oid(SHA256), b"\x05\x00"), octets(asked.message_imprint.message))
        time = der(0x18, STAMPED.strftime("%Y%m%d%H%M%SZ").encode())
        info = sequence(integer(1), oid("1.2.3.4.1"), imprint, integer(42), time, integer(asked.nonce or 0))
        token = sequence(oid(SIGNED_DATA), der(0xA0, self._signed_data(info)))
        return sequence(sequence(integer(0)), token)

    def _signed_data(self, info: bytes) -> bytes:
        own = self._certificate.public_bytes(Encoding.DER)
        hashed = sequence(sequence(sequence(octets(hashlib.sha256(own).digest()))))
        attributes = sorted(
            [
                attribute(CONTENT_TYPE, oid(TST_INFO)),
                attribute(MESSAGE_DIGEST, octets(hashlib.sha256(info).digest())),
                attribute(SIGNING_CERTIFICATE_V2, hashed),
            ]
        )
        signature = self._key.sign(der(0x31, *attributes), ec.ECDSA(hashes.SHA256()))
        signer = sequence(
            integer(1),
            sequence(self._certificate.issuer.public_bytes(), integer(self._certificate.serial_number)),
            sequence(oid(SHA256)),
            der(0xA0, *attributes),
            sequence(oid(ECDSA_SHA256)),
            octets(signature),
        )
        return sequence(
            integer(3),
            set_of(sequence(oid(SHA256))),
            sequence(oid(TST_INFO), der(0xA0, octets(info))),
            der(0xA0, own),
            set_of(signer),
        )


class Served:
    """An authority served over HTTP on loopback; `url` is its address within the context."""

    def __init__(self, authority: Authority) -> None:
        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                authority.requests.append((self.headers["Content-Type"], body))
                answer = authority.answer(body)
                self.send_response(200)
                self.send_header("Content-Length", str(len(answer)))
                self.end_headers()
                self.wfile.write(answer)

            def log_message(self, *_: object) -> None:
                pass

        self._server = HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}/tsr"
        self._thread = threading.Thread(target=lambda: self._server.serve_forever(0.01))

    def __enter__(self) -> Served:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()
