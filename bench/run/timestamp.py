"""Time stamps of RFC 3161: asked of a server that the user names, and held against the authority that he trusts."""

from __future__ import annotations

import http.client
import urllib.error
import urllib.request
from dataclasses import dataclass
from datetime import datetime
from hashlib import sha256
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from bench.base.extras import missing
from bench.base.regular import read_given
from bench.run.manifest import RecordError

WAIT_S: Final = 20.0
MOST_BYTES: Final = 1_000_000


class NoTimeStamp(RecordError):
    """A server gave no time stamp, or none for what was asked."""


@dataclass(frozen=True)
class TimeStamp:
    """The time in a time stamp, and whether a trusted authority stands behind it."""

    time: datetime
    trusted: bool


def check_server(url: str) -> None:
    """Refuse what is no address of a server. Raises `NoTimeStamp`."""
    parts = urlsplit(url)
    if parts.scheme not in {"http", "https"} or not parts.hostname:
        raise NoTimeStamp(f"--timestamp {url}: not the address of a server (http://… or https://…)")


def ask_time_stamp(url: str, message: bytes) -> bytes:
    """Have a server stamp the SHA-256 of a message; return its response (DER). Raises `NoTimeStamp`."""
    try:
        import rfc3161_client as rfc3161
    except ImportError as error:
        raise NoTimeStamp(missing(error) or str(error)) from error
    check_server(url)
    builder = rfc3161.TimestampRequestBuilder().data(message).hash_algorithm(rfc3161.HashAlgorithm.SHA256)
    asked = builder.build()
    answer = _post(url, asked.as_bytes())
    try:
        response = rfc3161.decode_timestamp_response(answer)
        granted = response.status in {0, 1}
        told = response.tst_info if granted else None
    except ValueError as error:
        raise NoTimeStamp(f"{url}: no time stamp (it answered with something else)") from error
    if told is None:
        raise NoTimeStamp(f"{url}: no time stamp, the server refused ({', '.join(response.status_string)})")
    if told.nonce != asked.nonce or told.message_imprint.message != sha256(message).digest():
        raise NoTimeStamp(f"{url}: no time stamp (it answered for something else)")
    return answer


def _post(url: str, body: bytes) -> bytes:
    """Send a request, answered with no more than a time stamp has. Raises `NoTimeStamp`."""
    headers = {"Content-Type": "application/timestamp-query"}
    request = urllib.request.Request(url, body, headers)  # noqa: S310 - the scheme was looked at
    try:
        with urllib.request.urlopen(request, timeout=WAIT_S) as answer:  # noqa: S310
            got: bytes = answer.read(MOST_BYTES)
    except (OSError, http.client.HTTPException, ValueError) as error:
        reason = error.reason if isinstance(error, urllib.error.URLError) else error
        raise NoTimeStamp(f"{url}: no time stamp ({reason}); ask again when the server is there") from error
    return got


def read_time_stamp(response: bytes, message: bytes, authority: Path | None) -> TimeStamp:
    """Return what a time stamp says of a message; `authority` holds the certificates that are trusted (PEM).

    Without one the time is what the stamp says, and nobody stands for it. Raises `NoTimeStamp` where the stamp is
    not one of this message, or not by this authority.
    """
    try:
        import rfc3161_client as rfc3161
        from cryptography import x509
    except ImportError as error:
        raise NoTimeStamp(missing(error) or str(error)) from error
    try:
        decoded = rfc3161.decode_timestamp_response(response)
        told = decoded.tst_info
    except ValueError as error:
        raise NoTimeStamp("its time stamp is damaged") from error
    if told.message_imprint.message != sha256(message).digest():
        raise NoTimeStamp("its time stamp is not one of this seal")
    if authority is None:
        return TimeStamp(told.gen_time, trusted=False)
    try:
        roots = x509.load_pem_x509_certificates(read_given(authority))
    except OSError as error:
        raise NoTimeStamp(f"{authority}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise NoTimeStamp(f"{authority}: not a certificate (PEM)") from error
    builder = rfc3161.VerifierBuilder()
    for root in roots:
        builder = builder.add_root_certificate(root)
    try:
        builder.build().verify_message(decoded, message)
    except (rfc3161.VerificationError, ValueError) as error:
        raise NoTimeStamp(f"its time stamp is not by the authority in {authority} ({error})") from error
    return TimeStamp(told.gen_time, trusted=True)
