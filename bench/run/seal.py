"""Seals of runs: the laboratory's key, the signature, and the RFC 3161 time stamp."""

from __future__ import annotations

import base64
import binascii
import hashlib
import http.client
import json
import os
import stat
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast
from urllib.parse import urlsplit

from bench.base.computing import missing
from bench.base.files import read_given, read_regular, remedy_for, to_text, write_whole
from bench.base.languages import message
from bench.base.text import as_typed
from bench.run.events import ENDED, EVENTS, MANIFEST, RecordError, sha256
from bench.run.folder import Run

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey


SEAL: Final = "seal.json"
FORMAT: Final = 1
_PREFIX: Final = b"triaxial-bench seal 1\n"
"""Prefix of the signed bytes, so that the signature of a seal is not valid for any other document."""
_STATED: Final = ("run", "events", "head", "manifest_sha256", "files", "sealed")


@dataclass(frozen=True)
class Seal:
    """The fingerprint of a record at the time of sealing.

    `events` is the number of events, `head` the SHA-256 of the last line; `files` maps inputs to their hashes.
    `sealed` is the time by the computer's clock. `signature` is the Ed25519 signature of `signed_bytes`, made
    with the private half of `public_key` (PEM). `time_stamp` is an RFC 3161 response (DER) for `stamped_bytes`.
    """

    run: str
    events: int
    head: str
    manifest_sha256: str
    files: dict[str, str]
    sealed: str
    public_key: str = ""
    signature: bytes = b""
    time_stamp: bytes = b""

    @property
    def _stated(self) -> dict[str, Any]:
        """What the seal states about the record, as JSON values."""
        return {name: getattr(self, name) for name in _STATED}

    @property
    def signed_bytes(self) -> bytes:
        """The bytes to sign: a fixed prefix, then all that the seal states about the record, as JSON."""
        text = json.dumps(self._stated, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
        return _PREFIX + text.encode()

    @property
    def stamped_bytes(self) -> bytes:
        """The bytes to be time-stamped: the signed bytes and the signature."""
        return self.signed_bytes + b"\n" + self.signature

    def to_json(self) -> dict[str, Any]:
        """Return the seal as stored in its file."""
        return {
            "format": FORMAT,
            **self._stated,
            "public_key": self.public_key,
            "signature": base64.b64encode(self.signature).decode(),
            "time_stamp": base64.b64encode(self.time_stamp).decode(),
        }

    @classmethod
    def from_json(cls, data: Any) -> Seal:
        """Return the seal stored in a file. Raises `KeyError`, `TypeError` or `ValueError` for invalid data."""
        texts = [data[name] for name in ("run", "head", "manifest_sha256", "sealed", "public_key")]
        files, events = data["files"], data["events"]
        if data["format"] != FORMAT or type(events) is not int or not isinstance(files, dict):
            raise ValueError("not a seal of a known version")
        if not all(isinstance(text, str) for text in (*texts, *files, *files.values())):
            raise ValueError("a text is missing")
        run, head, manifest, sealed, key = texts
        signature, stamp = (
            base64.b64decode(data[name], validate=True) for name in ("signature", "time_stamp")
        )
        return cls(run, events, head, manifest, files, sealed, key, signature, stamp)

    def differences(self, run: Run) -> tuple[str, ...]:
        """Return a sentence for each difference between a run and this seal; empty if the run is unchanged."""
        now = seal_of(run, self.sealed)
        wrong = []
        if now.events != self.events:
            wrong.append(
                f"the seal covers {self.events} events, but the record has {now.events}; restore the record from "
                "a copy"
            )
        elif now.head != self.head:
            wrong.append(
                "the last hash of the record differs from the sealed one; restore the record from a copy"
            )
        if (now.run, now.manifest_sha256, now.files) != (self.run, self.manifest_sha256, self.files):
            wrong.append(
                f"the inputs of the run ({MANIFEST}) differ from the sealed ones; restore them from a copy"
            )
        return tuple(f"the record changed after it was sealed: {text}" for text in wrong)


def seal_of(run: Run, sealed: str) -> Seal:
    """Return an unsigned seal of the present state of a run; `sealed` is the time of sealing."""
    manifest = run.manifest
    return Seal(
        run=str(manifest.get("name", "")),
        events=len(run.history.events),
        head=run.history.head,
        manifest_sha256=sha256(read_regular(run.folder / MANIFEST)),
        files={name: str(digest) for name, digest in manifest.get("files", {}).items()},
        sealed=sealed,
    )


def new_seal(run: Run, now: datetime) -> Seal:
    """Return an unsigned seal of a run that has ended or was imported.

    Raises `RecordError` for an unfinished or changed run, and for an incomplete last line.
    """
    state = run.trusted_history().state
    if (before := read_seal(run.folder)) is not None and (wrong := before.differences(run)):
        raise RecordError(f"{run.folder}: not sealed again: {'; '.join(wrong)}")
    if state not in ENDED and not run.imported:
        raise RecordError(
            f"{run.name}: the run is {state}, and only an ended run can be sealed; finish or abort it first"
        )
    if run.history.torn:
        raise RecordError(
            f"{run.folder / EVENTS}: an incomplete line follows the end of the run; delete this line, or restore "
            "the file from a copy, then seal the run"
        )
    return seal_of(run, now.isoformat())


def read_seal(folder: Path) -> Seal | None:
    """Return the seal of a run, or None. Raises `RecordError` for a damaged seal."""
    path = folder / SEAL
    try:
        return Seal.from_json(json.loads(read_regular(path).decode()))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RecordError(f"{path}: cannot be read ({error.strerror}); check name and permissions") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, binascii.Error):
        raise RecordError(f"{path}: damaged (not a seal); restore it from a copy of the run") from None


def write_seal(folder: Path, seal: Seal) -> Path:
    """Write the seal into the run's folder; return its path. Raises `OSError`."""
    write_whole(folder / SEAL, to_text(seal.to_json()))
    return folder / SEAL


def signed(seal: Seal, public_key: str, signature: bytes) -> Seal:
    """Return the seal with this signature, but without its time stamp, which was made for other bytes."""
    return replace(seal, public_key=public_key, signature=signature, time_stamp=b"")


def new_key(file: Path, passphrase: bytes | None) -> tuple[Path, str]:
    """Create an Ed25519 key pair; return the file of the public key and the key's fingerprint.

    The private key's file is readable by its owner only (0600), in a folder only the owner can enter (0700); a
    missing folder is created. Raises `RecordError` if the file exists, or if others may enter the folder.
    """
    _, ed25519 = _cryptography()
    public = file.with_name(file.name + ".pub")
    key = ed25519.Ed25519PrivateKey.generate()
    write_private(file, key, passphrase, {public: _public_pem(key.public_key())})
    return public, fingerprint(key.public_key())


def write_private(file: Path, key: Any, passphrase: bytes | None, beside: dict[Path, str]) -> None:
    """Write a private key (PKCS#8, PEM), readable by its owner only, and the public files that belong to it.

    `beside` maps the paths of the public files to their texts. Raises `RecordError` if a file exists, or if
    others may enter the folder.
    """
    serialization, _ = _cryptography()
    for one in (file, *beside):
        if one.exists():
            raise RecordError(f"{one}: a file of that name exists; choose another name for the key")
    try:
        if not file.absolute().parent.is_dir():
            file.absolute().parent.mkdir(parents=True, mode=0o700)
        _check_folder(file)
        cover = (
            serialization.BestAvailableEncryption(passphrase) if passphrase else serialization.NoEncryption()
        )
        pem = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, cover)
        with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as private:
            private.write(pem)
        for path, text in beside.items():
            path.write_text(text, encoding="ascii")
    except OSError as error:
        raise RecordError(
            f"{error.filename}: cannot be written ({error.strerror}); free disk space or check permissions"
        ) from error


def private_key(file: Path, passphrase: Callable[[], bytes]) -> Ed25519PrivateKey:
    """Return the private key that signs seals; `passphrase` is called if the key is encrypted.

    Raises `RecordError` for a file that others may read, and for a file without an Ed25519 key.
    """
    _, ed25519 = _cryptography()
    key = read_private(file, passphrase, "Ed25519, PEM; 'bench key FILE' makes one")
    if not isinstance(key, ed25519.Ed25519PrivateKey):
        raise RecordError(f"{file}: not an Ed25519 key; 'bench key FILE' makes one")
    return cast("Ed25519PrivateKey", key)


def read_private(file: Path, passphrase: Callable[[], bytes], wanted: str) -> Any:
    """Return a private key of any kind; `wanted` describes the expected kind in the error message.

    Raises `RecordError` for a file that others may read, and for a file without a key.
    """
    serialization, _ = _cryptography()
    try:
        pem = read_given(file)
        mode = file.stat().st_mode
    except OSError as error:
        remedy = remedy_for(error, "check name and permissions")
        raise RecordError(f"{file}: cannot be read ({error.strerror}); {remedy}") from error
    if os.name == "posix" and stat.S_IMODE(mode) & 0o077:
        raise RecordError(
            f"{file}: others may use this private key (mode {stat.S_IMODE(mode):o}); restrict it with "
            f"chmod 600 {as_typed(file)}, and make a new key if it may have been copied"
        )
    _check_folder(file)
    try:
        return serialization.load_pem_private_key(pem, passphrase() if b"ENCRYPTED" in pem else None)
    except (ValueError, TypeError) as error:
        raise RecordError(
            f"{file}: not a private key ({wanted}), or a wrong passphrase; try again, or name another file"
        ) from error


def sign(key: Ed25519PrivateKey, message: bytes) -> tuple[str, bytes]:
    """Return the public key (PEM) and the Ed25519 signature of a message."""
    return _public_pem(key.public_key()), key.sign(message)


def public_key(pem: str, where: str, remedy: str = "restore the seal from a copy") -> Ed25519PublicKey:
    """Return the Ed25519 key in the text `pem`; if it has none, raise `RecordError` with `where` and `remedy`."""
    serialization, ed25519 = _cryptography()
    try:
        key = serialization.load_pem_public_key(pem.encode())
    except ValueError as error:
        raise RecordError(f"{where}: not a public key (PEM); {remedy}") from error
    if not isinstance(key, ed25519.Ed25519PublicKey):
        raise RecordError(f"{where}: not an Ed25519 key; {remedy}")
    return cast("Ed25519PublicKey", key)


def read_public_key(file: Path) -> Ed25519PublicKey:
    """Return the Ed25519 public key in a file. Raises `RecordError` if there is none."""
    remedy = message("give the .pub file of 'bench key'")
    try:
        return public_key(read_regular(file).decode("ascii"), str(file), remedy)
    except OSError as error:
        raise RecordError(f"{file}: cannot be read ({error.strerror}); check name and permissions") from error
    except UnicodeDecodeError:
        raise RecordError(f"{file}: not a public key (PEM); {remedy}") from None


def is_signed(key: Ed25519PublicKey, signature: bytes, message: bytes) -> bool:
    """Return whether `signature` is a valid signature of `message` under the public key `key`."""
    from cryptography.exceptions import InvalidSignature

    try:
        key.verify(signature, message)
    except InvalidSignature:
        return False
    return True


def fingerprint(key: Ed25519PublicKey) -> str:
    """Return the SHA-256 of a public key (32 bytes) in hexadecimal, for comparison by people."""
    return hashlib.sha256(key.public_bytes_raw()).hexdigest()


def _public_pem(key: Ed25519PublicKey) -> str:
    serialization, _ = _cryptography()
    return key.public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    ).decode()


def _check_folder(file: Path) -> None:
    """Raise `RecordError` if others may enter the folder of a private key."""
    folder = file.absolute().parent
    mode = stat.S_IMODE(folder.stat().st_mode)
    if os.name == "posix" and mode & 0o077:
        raise RecordError(
            f"{folder}: a private key needs a folder that only its owner can enter; others may enter this one "
            f"(mode {mode:o}); chmod 700 {as_typed(folder)}, or choose another"
        )


def _cryptography() -> tuple[Any, Any]:
    try:
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError as error:
        raise RecordError(missing(error) or str(error)) from error
    return serialization, ed25519


WAIT_S: Final = 20.0
MOST_BYTES: Final = 1_000_000


class NoTimeStamp(RecordError):
    """A server returned no time stamp, or one for another message."""


@dataclass(frozen=True)
class TimeStamp:
    """The time in a time stamp; `trusted` says whether a trusted authority issued it."""

    time: datetime
    trusted: bool


def check_server(url: str) -> None:
    """Raise `NoTimeStamp` for a text that is not an http or https address."""
    parts = urlsplit(url)
    if parts.scheme not in {"http", "https"} or not parts.hostname:
        raise NoTimeStamp(
            message(f"--timestamp {url}: give the address of a server, beginning with http or https")
        )


def ask_time_stamp(url: str, message: bytes) -> bytes:
    """Request a time stamp for the SHA-256 of `message`; return the response (DER). Raises `NoTimeStamp`."""
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
        info = response.tst_info if granted else None
    except ValueError as error:
        raise NoTimeStamp(
            f"{url}: no time stamp (unexpected answer); check the address of the server"
        ) from error
    if info is None:
        raise NoTimeStamp(
            f"{url}: no time stamp: the server refused it ({', '.join(response.status_string)}); try again, or "
            "use another server"
        )
    if info.nonce != asked.nonce or info.message_imprint.message != hashlib.sha256(message).digest():
        raise NoTimeStamp(
            f"{url}: no time stamp: the server stamped other data; ask again, or use another server"
        )
    return answer


def _post(url: str, body: bytes) -> bytes:
    """Post a time-stamp query; return at most `MOST_BYTES` of the response. Raises `NoTimeStamp`."""
    headers = {"Content-Type": "application/timestamp-query"}
    request = urllib.request.Request(url, body, headers)  # noqa: S310 - the scheme was looked at
    try:
        with urllib.request.urlopen(request, timeout=WAIT_S) as answer:  # noqa: S310
            got: bytes = answer.read(MOST_BYTES)
    except (OSError, http.client.HTTPException, ValueError) as error:
        reason = error.reason if isinstance(error, urllib.error.URLError) else error
        raise NoTimeStamp(
            f"{url}: no time stamp ({reason}); try again when the server is reachable"
        ) from error
    return got


def read_time_stamp(response: bytes, message: bytes, authority: Path | None) -> TimeStamp:
    """Return the time in a time stamp of `message`; `authority` is a file of trusted certificates (PEM).

    Without `authority`, the time is not verified, and `trusted` is False. Raises `NoTimeStamp` if the stamp is
    damaged, belongs to another message, or was not issued by this authority.
    """
    try:
        import rfc3161_client as rfc3161
        from cryptography import x509
    except ImportError as error:
        raise NoTimeStamp(missing(error) or str(error)) from error
    try:
        decoded = rfc3161.decode_timestamp_response(response)
        info = decoded.tst_info
    except ValueError as error:
        raise NoTimeStamp("the seal's time stamp is damaged; restore the seal from a copy") from error
    if info.message_imprint.message != hashlib.sha256(message).digest():
        raise NoTimeStamp("the time stamp belongs to another seal; restore the seal from a copy")
    if authority is None:
        return TimeStamp(info.gen_time, trusted=False)
    try:
        roots = x509.load_pem_x509_certificates(read_given(authority))
    except OSError as error:
        remedy = remedy_for(error, "check name and permissions")
        raise NoTimeStamp(f"{authority}: cannot be read ({error.strerror}); {remedy}") from error
    except ValueError as error:
        raise NoTimeStamp(f"{authority}: not a certificate (PEM); give the authority's") from error
    builder = rfc3161.VerifierBuilder()
    for root in roots:
        builder = builder.add_root_certificate(root)
    try:
        builder.build().verify_message(decoded, message)
    except (rfc3161.VerificationError, ValueError) as error:
        raise NoTimeStamp(
            f"the time stamp was not signed by the authority in {authority} ({error}); give that authority's "
            "certificate"
        ) from error
    return TimeStamp(info.gen_time, trusted=True)
