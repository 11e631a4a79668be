"""The laboratory's key: an Ed25519 pair in PEM files (PKCS#8, and the public key beside it as `.pub`), and its use.

`cryptography` comes with the extra `signing`, and is imported only where a key is used.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from bench.base.extras import missing
from bench.base.regular import read_given, read_regular
from bench.run.manifest import RecordError

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey


def new_key(file: Path, passphrase: bytes | None) -> tuple[Path, str]:
    """Make a key pair; return the file of the public key and its fingerprint.

    The private key's file is for its owner alone (0600), in a folder that is (0700): one that is missing is made.
    Raises `RecordError` where there is a file already, and for a folder that others may enter.
    """
    _, ed25519 = _cryptography()
    public = file.with_name(file.name + ".pub")
    key = ed25519.Ed25519PrivateKey.generate()
    write_private(file, key, passphrase, {public: _public_pem(key.public_key())})
    return public, fingerprint(key.public_key())


def write_private(file: Path, key: Any, passphrase: bytes | None, beside: dict[Path, str]) -> None:
    """Write a private key (PKCS#8, PEM) for its owner alone, and beside it the texts that everybody may read.

    Raises `RecordError` where there is a file already, and for a folder that others may enter.
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
    """Read the private key that signs seals; `passphrase` is asked for where it has one.

    Raises `RecordError` for a file that others may read, and for one that is no such key.
    """
    _, ed25519 = _cryptography()
    key = read_private(file, passphrase, f"Ed25519, PEM; 'bench key {file}' makes one")
    if not isinstance(key, ed25519.Ed25519PrivateKey):
        raise RecordError(f"{file}: a key of another kind; 'bench key FILE' makes one of Ed25519")
    return cast("Ed25519PrivateKey", key)


def read_private(file: Path, passphrase: Callable[[], bytes], wanted: str) -> Any:
    """Read a private key of any kind from a file that is its owner's alone; `wanted` says what it should be.

    Raises `RecordError` for a file that others may read, and for one that is no key.
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
        return _loaded(serialization, pem, passphrase)
    except (ValueError, TypeError) as error:
        raise RecordError(f"{file}: not a private key ({wanted}), or another passphrase") from error


def _loaded(serialization: Any, pem: bytes, passphrase: Callable[[], bytes]) -> Any:
    if b"ENCRYPTED" in pem:
        return serialization.load_pem_private_key(pem, passphrase())
    return serialization.load_pem_private_key(pem, None)


def sign(key: Ed25519PrivateKey, message: bytes) -> tuple[str, bytes]:
    """Return the public key (PEM) and the signature of a message."""
    return _public_pem(key.public_key()), key.sign(message)


def public_key(pem: str, where: str) -> Ed25519PublicKey:
    """Return the public key of a text. Raises `RecordError` for what is none."""
    serialization, ed25519 = _cryptography()
    try:
        key = serialization.load_pem_public_key(pem.encode())
    except ValueError as error:
        raise RecordError(f"{where}: not a public key (PEM)") from error
    if not isinstance(key, ed25519.Ed25519PublicKey):
        raise RecordError(f"{where}: a key of another kind than Ed25519")
    return cast("Ed25519PublicKey", key)


def read_public_key(file: Path) -> Ed25519PublicKey:
    """Return the public key in a file. Raises `RecordError`."""
    try:
        return public_key(read_regular(file).decode("ascii"), str(file))
    except OSError as error:
        raise RecordError(f"{file}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError:
        raise RecordError(f"{file}: not a public key (PEM)") from None


def is_signed(key: Ed25519PublicKey, signature: bytes, message: bytes) -> bool:
    """Whether a signature of a message was made with the private half of this key."""
    from cryptography.exceptions import InvalidSignature

    try:
        key.verify(signature, message)
    except InvalidSignature:
        return False
    return True


def fingerprint(key: Ed25519PublicKey) -> str:
    """Return the SHA-256 of a public key (its 32 bytes), by which people compare keys."""
    return sha256(key.public_bytes_raw()).hexdigest()


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
