"""Seals of runs: the laboratory's key, the signature, the RFC 3161 time stamp."""

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
from bench.base.files import read_given, read_regular, to_text, write_whole
from bench.run.events import ENDED, MANIFEST, RecordError, sha256
from bench.run.folder import Run

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey


SEAL: Final = "seal.json"
FORMAT: Final = 1
_PREFIX: Final = b"triaxial-bench seal 1\n"
"""Prefix of the signed bytes: a signature of a seal cannot serve for any other document."""
_STATED: Final = ("run", "events", "head", "manifest_sha256", "files", "sealed")


@dataclass(frozen=True)
class Seal:
    """The fingerprint of a record at the time of sealing.

    `events` is the number of events, `head` the SHA-256 of the last line, `files` are the hashes of the
    inputs. `sealed` is the time by the computer's clock. `signature` is the Ed25519 signature of
    `signed_bytes` with `public_key` (PEM). `time_stamp` is a response (RFC 3161, DER) for `stamped_bytes`.
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
        """The statements of the seal about the record."""
        return {name: getattr(self, name) for name in _STATED}

    @property
    def signed_bytes(self) -> bytes:
        """The bytes that are signed: all statements of the seal about the record."""
        text = json.dumps(self._stated, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
        return _PREFIX + text.encode()

    @property
    def stamped_bytes(self) -> bytes:
        """The bytes that are time-stamped: the signed bytes and the signature."""
        return self.signed_bytes + b"\n" + self.signature

    def to_json(self) -> dict[str, Any]:
        """Return the seal as its file holds it."""
        return {
            "format": FORMAT,
            **self._stated,
            "public_key": self.public_key,
            "signature": base64.b64encode(self.signature).decode(),
            "time_stamp": base64.b64encode(self.time_stamp).decode(),
        }

    @classmethod
    def from_json(cls, data: Any) -> Seal:
        """Return the seal in a file. Raises `KeyError`, `TypeError`, `ValueError` where there is none."""
        texts = [data[name] for name in ("run", "head", "manifest_sha256", "sealed", "public_key")]
        files, events = data["files"], data["events"]
        if data["format"] != FORMAT or type(events) is not int or not isinstance(files, dict):
            raise ValueError("not a seal that this version knows")
        if not all(isinstance(text, str) for text in (*texts, *files, *files.values())):
            raise ValueError("a text is none")
        run, head, manifest, sealed, key = texts
        signature, stamp = (
            base64.b64decode(data[name], validate=True) for name in ("signature", "time_stamp")
        )
        return cls(run, events, head, manifest, files, sealed, key, signature, stamp)

    def differences(self, run: Run) -> tuple[str, ...]:
        """Return sentences on the differences between a run and its seal."""
        now = seal_of(run, self.sealed)
        wrong = []
        if now.events != self.events:
            wrong.append(f"sealed were {self.events} events, and there are {now.events}")
        elif now.head != self.head:
            wrong.append("the head of its chain is not the sealed one")
        if (now.run, now.manifest_sha256, now.files) != (self.run, self.manifest_sha256, self.files):
            wrong.append(f"its inputs ({MANIFEST}) are not the sealed ones")
        return tuple(f"the record is not what was sealed: {text}" for text in wrong)


def seal_of(run: Run, sealed: str) -> Seal:
    """Return an unsigned seal of the present state of a run; `sealed` is the time."""
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
    """Return the seal of a run that has ended or was imported.

    Raises `RecordError` for a run that goes on, for a changed one, and for a torn last line.
    """
    state = run.trusted_history().state
    if (before := read_seal(run.folder)) is not None and (wrong := before.differences(run)):
        raise RecordError(f"{run.folder}: {'; '.join(wrong)}; it is not sealed anew")
    if state not in ENDED and not run.imported:
        raise RecordError(f"{run.name}: only a run that has ended can be sealed, and this one is {state}")
    if run.history.torn:
        raise RecordError(f"{run.name}: the last line of its record is half written; seal a whole one")
    return seal_of(run, now.isoformat())


def read_seal(folder: Path) -> Seal | None:
    """Return the seal of a run, None where it has none. Raises `RecordError` for a damaged one."""
    path = folder / SEAL
    try:
        return Seal.from_json(json.loads(read_regular(path).decode()))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RecordError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, binascii.Error):
        raise RecordError(f"{path}: damaged, not a seal; take it from a copy of the run") from None


def write_seal(folder: Path, seal: Seal) -> Path:
    """Write the seal of a run; return its file. Raises `OSError`."""
    write_whole(folder / SEAL, to_text(seal.to_json()))
    return folder / SEAL


def signed(seal: Seal, public_key: str, signature: bytes) -> Seal:
    """Return a seal with its signature, without its time stamp, which was made for the earlier bytes."""
    return replace(seal, public_key=public_key, signature=signature, time_stamp=b"")


def new_key(file: Path, passphrase: bytes | None) -> tuple[Path, str]:
    """Make a key pair; return the file of the public key and its fingerprint.

    Only the owner can read the private key's file (0600) and enter its folder (0700); a missing folder is
    made. Raises `RecordError` where the file exists already, and for a folder that others may enter.
    """
    _, ed25519 = _cryptography()
    public = file.with_name(file.name + ".pub")
    key = ed25519.Ed25519PrivateKey.generate()
    write_private(file, key, passphrase, {public: _public_pem(key.public_key())})
    return public, fingerprint(key.public_key())


def write_private(file: Path, key: Any, passphrase: bytes | None, beside: dict[Path, str]) -> None:
    """Write a private key (PKCS#8, PEM) that only its owner can read, and beside it the public texts.

    Raises `RecordError` where a file exists already, and for a folder that others may enter.
    """
    serialization, _ = _cryptography()
    for one in (file, *beside):
        if one.exists():
            raise RecordError(f"{one}: there is a file of that name; a key is never written over")
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
        raise RecordError(f"{error.filename}: cannot be written ({error.strerror})") from error


def private_key(file: Path, passphrase: Callable[[], bytes]) -> Ed25519PrivateKey:
    """Return the private key that signs seals; `passphrase` is called where the key needs one.

    Raises `RecordError` for a file that others may read, and for a file without such a key.
    """
    _, ed25519 = _cryptography()
    key = read_private(file, passphrase, f"Ed25519, PEM; 'bench key {file}' makes one")
    if not isinstance(key, ed25519.Ed25519PrivateKey):
        raise RecordError(f"{file}: a key of another kind; 'bench key FILE' makes one of Ed25519")
    return cast("Ed25519PrivateKey", key)


def read_private(file: Path, passphrase: Callable[[], bytes], wanted: str) -> Any:
    """Return a private key of any kind from a file that only its owner may read; `wanted` names the kind.

    Raises `RecordError` for a file that others may read, and for a file without a key.
    """
    serialization, _ = _cryptography()
    try:
        pem = read_given(file)
        mode = file.stat().st_mode
    except OSError as error:
        raise RecordError(f"{file}: cannot be read ({error.strerror})") from error
    if os.name == "posix" and stat.S_IMODE(mode) & 0o077:
        raise RecordError(
            f"{file}: others may use this private key (mode {stat.S_IMODE(mode):o}); chmod 600 {file}, and if "
            "it may have been copied make another"
        )
    _check_folder(file)
    try:
        return serialization.load_pem_private_key(pem, passphrase() if b"ENCRYPTED" in pem else None)
    except (ValueError, TypeError) as error:
        raise RecordError(f"{file}: not a private key ({wanted}), or another passphrase") from error


def sign(key: Ed25519PrivateKey, message: bytes) -> tuple[str, bytes]:
    """Return the public key (PEM) and the signature of a message."""
    return _public_pem(key.public_key()), key.sign(message)


def public_key(pem: str, where: str) -> Ed25519PublicKey:
    """Return the public key in a text. Raises `RecordError` where there is none."""
    serialization, ed25519 = _cryptography()
    try:
        key = serialization.load_pem_public_key(pem.encode())
    except ValueError as error:
        raise RecordError(f"{where}: not a public key (PEM)") from error
    if not isinstance(key, ed25519.Ed25519PublicKey):
        raise RecordError(f"{where}: a key of another kind than Ed25519")
    return cast("Ed25519PublicKey", key)


def read_public_key(file: Path) -> Ed25519PublicKey:
    """Return the public key in a file. Raises `RecordError` where there is none."""
    try:
        return public_key(read_regular(file).decode("ascii"), str(file))
    except OSError as error:
        raise RecordError(f"{file}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError:
        raise RecordError(f"{file}: not a public key (PEM)") from None


def is_signed(key: Ed25519PublicKey, signature: bytes, message: bytes) -> bool:
    """Return whether a signature of a message was made with the private half of this key."""
    from cryptography.exceptions import InvalidSignature

    try:
        key.verify(signature, message)
    except InvalidSignature:
        return False
    return True


def fingerprint(key: Ed25519PublicKey) -> str:
    """Return the SHA-256 of a public key (its 32 bytes); people compare keys by it."""
    return hashlib.sha256(key.public_bytes_raw()).hexdigest()


def _public_pem(key: Ed25519PublicKey) -> str:
    serialization, _ = _cryptography()
    return key.public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    ).decode()


def _check_folder(file: Path) -> None:
    """Raise `RecordError` where others may enter the folder of a private key."""
    folder = file.absolute().parent
    mode = stat.S_IMODE(folder.stat().st_mode)
    if os.name == "posix" and mode & 0o077:
        raise RecordError(
            f"{folder}: a private key stands in a folder of its owner's alone, and others may enter this one "
            f"(mode {mode:o}); chmod 700 {folder}, or choose another"
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
    """A server gave no time stamp, or one for another message."""


@dataclass(frozen=True)
class TimeStamp:
    """The time in a time stamp; `trusted` says whether a trusted authority issued it."""

    time: datetime
    trusted: bool


def check_server(url: str) -> None:
    """Raise `NoTimeStamp` for a text that is no address of a server."""
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
    if told.nonce != asked.nonce or told.message_imprint.message != hashlib.sha256(message).digest():
        raise NoTimeStamp(f"{url}: no time stamp (it answered for something else)")
    return answer


def _post(url: str, body: bytes) -> bytes:
    """Send a request; return at most `MOST_BYTES` of the answer. Raises `NoTimeStamp`."""
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
    """Return the time stamp of a message; `authority` is the file of the trusted certificates (PEM).

    Without certificates the time is only stated, and not trusted. Raises `NoTimeStamp` where the stamp
    belongs to another message, or is not by this authority.
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
    if told.message_imprint.message != hashlib.sha256(message).digest():
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
