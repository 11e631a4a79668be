"""The seal of a run: what its record was when it had ended, to be signed and time-stamped.

The last hash of the chain stands for every line before it, but only where it is known from elsewhere: who can write
the folder can take lines off the end, or make a whole new chain. A seal names that hash and the number of events;
what it proves is what its signature, its time stamp or a copy of it in other hands proves.
"""

from __future__ import annotations

import base64
import binascii
import json
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from bench.base.regular import read_regular
from bench.base.whole import to_text, write_whole
from bench.run.folder import Run
from bench.run.manifest import MANIFEST, RecordError, sha256
from bench.run.states import ENDED

SEAL: Final = "seal.json"
FORMAT: Final = 1
_PREFIX: Final = b"triaxial-bench seal 1\n"
"""What is signed begins with it, so that a signature of a seal is one of nothing else."""


@dataclass(frozen=True)
class Seal:
    """What a record was: `events` of them, `head` the SHA-256 of the last line, and the inputs by their hashes.

    `sealed` is what the computer's clock said. `signature` is one of `signed_bytes` by Ed25519 with `public_key`
    (PEM); `time_stamp` a response (RFC 3161, DER) for `stamped_bytes`.
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
    def signed_bytes(self) -> bytes:
        """What a signature is of: all that the seal says of the record."""
        told = {
            "run": self.run,
            "events": self.events,
            "head": self.head,
            "manifest_sha256": self.manifest_sha256,
            "files": self.files,
            "sealed": self.sealed,
        }
        text = json.dumps(told, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
        return _PREFIX + text.encode()

    @property
    def stamped_bytes(self) -> bytes:
        """What a time stamp is of: what is signed, and the signature."""
        return self.signed_bytes + b"\n" + self.signature

    def to_json(self) -> dict[str, Any]:
        """Return it as it stands in its file."""
        return {
            "format": FORMAT,
            "run": self.run,
            "events": self.events,
            "head": self.head,
            "manifest_sha256": self.manifest_sha256,
            "files": self.files,
            "sealed": self.sealed,
            "public_key": self.public_key,
            "signature": base64.b64encode(self.signature).decode(),
            "time_stamp": base64.b64encode(self.time_stamp).decode(),
        }

    @classmethod
    def from_json(cls, data: Any) -> Seal:
        """Return the seal of a file. Raises `KeyError`, `TypeError`, `ValueError` for what is none."""
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
        """Say in what a run is not what was sealed."""
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
    """Return an unsigned seal of a run as it is now."""
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
    """Return the seal of a run that has ended. Raises `RecordError` for another, and for one that was changed."""
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
    """Return a seal with its signature; a time stamp of before would not be of it."""
    return replace(seal, public_key=public_key, signature=signature, time_stamp=b"")
