"""The register of issued certificates: an append-only file whose lines contain the previous line's hash.

Writing the line issues the certificate. Until then, its files have temporary names; they are renamed
afterwards, or when the register is next opened. After any interruption, a number therefore exists with its
files or not at all. Only one program at a time has the register open.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from filelock import FileLock, Timeout

from bench.base.files import open_regular, read_json, read_regular, write_whole
from bench.services.errors import Refused

LINES: Final = "register.jsonl"
MADE_FROM: Final = "made-from"
WAIT_S: Final = 120.0
"""Longest time (s) to wait for another program to close the register."""

_LOCK: Final = ".register.lock"
_PART: Final = ".part"
_FIRST: Final = hashlib.sha256(b"triaxial-bench register 1\n").hexdigest()

ISSUED, REVOKED = "issued", "revoked"


@dataclass(frozen=True)
class Entry:
    """A line of the register: event, certificate number, time (ISO 8601), authorising person, other details."""

    kind: str
    number: str
    time: str
    by: str
    data: Mapping[str, Any]

    @property
    def files(self) -> dict[str, str]:
        """The SHA-256 of each issued file, by name."""
        return dict(self.data.get("files", {}))


@dataclass(frozen=True)
class NumberStatus:
    """The status of a certificate number: `state` is "issued", "amended", "replaced" or "revoked".

    `by` is the number of the successor, or the reason for the revocation.
    """

    entry: Entry
    state: str = ISSUED
    by: str = ""


@dataclass
class Register:
    """A register, open and locked against other writers; `folder` contains it and the issued files.

    `standings` maps each number to its status. `head`, `length` and `count` are the hash of the last line,
    the bytes and the lines read so far.
    """

    folder: Path
    standings: dict[str, NumberStatus] = field(default_factory=dict)
    head: str = _FIRST
    length: int = 0
    count: int = 0

    def number_after(self, numbers: Iterator[str]) -> str:
        """Return the first of `numbers` that was never issued."""
        return next(number for number in numbers if number not in self.standings)

    def issue(self, entry: Entry, contents: Mapping[str, bytes]) -> None:
        """Issue a certificate; `contents` are its files by name.

        Raises `Refused` if the number is already issued, and `OSError` if the certificate could not be
        issued.
        """
        if entry.number in self.standings:
            raise Refused(f"{entry.number}: this number was issued before; choose another")
        for name, content in contents.items():
            _write_through(self.folder / (name + _PART), content)
        _sync_folder(self.folder)
        sha = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
        self._append(Entry(entry.kind, entry.number, entry.time, entry.by, {**entry.data, "files": sha}))
        self._put_in_place(self.standings[entry.number].entry)

    def revoke(self, entry: Entry) -> None:
        """Append the revocation of a certificate. Raises `OSError`."""
        self._append(entry)

    def file(self, name: str) -> bytes:
        """Return the content of an issued file. Raises `Refused` if the file is unknown, missing or changed."""
        number = name.rsplit(".", 1)[0]
        stated = self.standings[number].entry.files.get(name) if number in self.standings else None
        if stated is None:
            raise Refused(f"{self.folder}: no file {name} was issued")
        try:
            content = read_regular(self.folder / name)
        except OSError as error:
            raise Refused(
                f"{self.folder / name}: cannot be read ({error.strerror}); check name and permissions"
            ) from error
        if hashlib.sha256(content).hexdigest() != stated:
            raise Refused(f"{self.folder / name}: not the issued file; restore it from a copy")
        return content

    def keep(self, content: bytes) -> str:
        """Store an input of a certificate under its SHA-256, and return the SHA-256."""
        digest = hashlib.sha256(content).hexdigest()
        place = self.folder / MADE_FROM / digest
        if not place.is_file():
            place.parent.mkdir(exist_ok=True)
            write_whole(place, content)
        return digest

    def kept(self, digest: str) -> bytes:
        """Return a stored input of a certificate. Raises `Refused` if it is missing or changed."""
        try:
            content = read_regular(self.folder / MADE_FROM / digest)
        except OSError as error:
            raise Refused(
                f"{self.folder / MADE_FROM / digest}: cannot be read ({error.strerror}); check "
                "name and permissions"
            ) from error
        if hashlib.sha256(content).hexdigest() != digest:
            raise Refused(f"{self.folder / MADE_FROM / digest}: was changed; restore it from a copy")
        return content

    def damaged_files(self) -> list[str]:
        """Return a sentence for each issued file that is missing or changed."""
        wrong = []
        for standing in self.standings.values():
            for name in standing.entry.files:
                try:
                    self.file(name)
                except Refused as error:
                    wrong.append(str(error))
        return wrong

    def _append(self, entry: Entry) -> None:
        told = {
            "n": self.count + 1,
            "time": entry.time,
            "type": entry.kind,
            "number": entry.number,
            "by": entry.by,
            **entry.data,
            "prev": self.head,
        }
        line = json.dumps(told, ensure_ascii=False).encode()
        with (self.folder / LINES).open("r+b" if self.length else "w+b") as file:
            file.seek(self.length)
            file.truncate()  # a line that was half written when a program was killed
            file.write(line + b"\n")
            file.flush()
            os.fsync(file.fileno())
        _sync_folder(self.folder)
        self._take(line)

    def catch_up(self) -> None:
        """Read the lines added since, and finish interrupted issues. Raises `Refused` for a changed line."""
        self.read_lines()
        for part in self.folder.glob(f"*{_PART}"):
            self._finish(part)

    def read_lines(self) -> None:
        """Read the lines added since, without changing any file. Raises `Refused` for a changed line."""
        path = self.folder / LINES
        if (path.stat().st_size if path.exists() else 0) < self.length:
            raise Refused(f"{path}: its last lines are missing; restore it from a copy")
        if path.exists():
            with open_regular(path) as file:
                file.seek(self.length)
                for line in file:
                    if line.endswith(b"\n"):
                        self._take(line[:-1])

    def _take(self, line: bytes) -> None:
        where = f"{self.folder / LINES}, line {self.count + 1}"
        try:
            told = read_json(line)
            n, previous = told.pop("n"), told.pop("prev")
            kind, number = told.pop("type"), told.pop("number")
            entry = Entry(kind, number, told.pop("time"), told.pop("by"), told)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise Refused(f"{where}: not a line of a register ({error}); restore it from a copy") from None
        if previous != self.head or n != self.count + 1:
            raise Refused(
                f"{where}: the chain is broken here (a line was changed or removed); restore it from a copy"
            )
        self._note(entry, where)
        self.head = hashlib.sha256(line).hexdigest()
        self.length += len(line) + 1
        self.count = n

    def _note(self, entry: Entry, where: str) -> None:
        standing = self.standings.get(entry.number)
        if entry.kind == ISSUED:
            if standing is not None:
                raise Refused(f"{where}: number {entry.number} was issued twice; restore it from a copy")
            self.standings[entry.number] = NumberStatus(entry)
            before = entry.data.get("before") or {}
            old = self.standings.get(str(before.get("number")))
            if old is not None:
                self.standings[old.entry.number] = NumberStatus(old.entry, str(before["kind"]), entry.number)
        elif entry.kind == REVOKED and standing is not None:
            self.standings[entry.number] = NumberStatus(
                standing.entry, REVOKED, str(entry.data.get("reason", ""))
            )
        else:
            raise Refused(
                f"{where}: {entry.kind} of {entry.number} cannot follow here; restore it from a copy"
            )

    def _put_in_place(self, entry: Entry) -> None:
        """Rename the temporary files of a certificate to their final names."""
        for name in entry.files:
            (self.folder / (name + _PART)).replace(self.folder / name)
        _sync_folder(self.folder)

    def _finish(self, part: Path) -> None:
        """Rename a temporary file to its final name if its certificate was issued; delete it if not."""
        name = part.name.removesuffix(_PART)
        standing = self.standings.get(name.rsplit(".", 1)[0])
        stated = None if standing is None else standing.entry.files.get(name)
        if stated is None:
            part.unlink()
        elif not (self.folder / name).exists() and hashlib.sha256(read_regular(part)).hexdigest() == stated:
            part.replace(self.folder / name)
            _sync_folder(self.folder)


@contextlib.contextmanager
def opened(folder: Path, known: Register | None = None) -> Iterator[Register]:
    """Yield the open register of a folder, created if missing; `known` is a `Register` of that folder to reuse.

    Raises `Refused` if the register is damaged or not writable, or if another program keeps it open.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / _LOCK, timeout=WAIT_S)
        with lock:
            register = known or Register(folder)
            register.catch_up()
            yield register
    except Timeout:
        raise Refused(
            f"{folder}: another program has the register open; try again when it has ended"
        ) from None
    except OSError as error:
        raise Refused(
            f"{error.filename or folder}: cannot be written ({error.strerror}); free disk space "
            "or check permissions"
        ) from error


def _write_through(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    """Flush the file names in a folder to the disk on POSIX systems, so that they survive a power failure."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
