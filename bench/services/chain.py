"""Append-only registers: files whose lines contain the previous line's hash, one writer at a time.

A register of certificates or of validations is a subclass of `Chain`, whose `_note` interprets each line.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, Self, TypeVar

from filelock import FileLock, Timeout

from bench.base.files import open_regular, read_json, read_regular, sync_folder, write_whole
from bench.base.text import cause_of
from bench.services.errors import Refused, refusing
from drivers.clock import utc_now

LINES: Final = "register.jsonl"
MADE_FROM: Final = "made-from"
WAIT_S: Final = 120.0
"""Longest time (s) to wait for another program to close the register."""

_LOCK: Final = ".register.lock"


@dataclass(frozen=True)
class Entry:
    """A line of a register: `kind` of event, number, time (ISO 8601), authorising person, and other `data`."""

    kind: str
    number: str
    time: str
    by: str
    data: Mapping[str, Any]

    @property
    def files(self) -> dict[str, str]:
        """The SHA-256 of each issued file, by name."""
        return dict(self.data.get("files", {}))


def civil_now() -> str:
    """Return the present civil time for an entry: ISO 8601 with offset, to the second."""
    return utc_now().astimezone().isoformat(timespec="seconds")


@dataclass
class Chain:
    """A register in `folder`, as far as it was read: `count` lines, `length` bytes; `head` hashes the last line.

    `KIND` is the kind of register, and the name of its folder beside a laboratory file. `opened` locks a register
    against other writers.
    """

    KIND: ClassVar[str]

    folder: Path
    head: str = ""
    length: int = 0
    count: int = 0

    def __post_init__(self) -> None:
        """Set a missing `head` to the hash that the first line of the register must contain as the previous one."""
        self.head = self.head or hashlib.sha256(f"triaxial-bench {self.KIND} 1\n".encode()).hexdigest()

    @classmethod
    def beside(cls, laboratory: Path) -> Self:
        """Return the register of a laboratory file, of which nothing is read yet."""
        return cls(laboratory.absolute().parent / cls.KIND)

    def _note(self, entry: Entry, where: str) -> bool:
        """Interpret the line at the place `where`; return whether it can follow the lines before it."""
        raise NotImplementedError

    def keep(self, content: bytes) -> str:
        """Store `content`, on which an entry is based, under its SHA-256; return the SHA-256."""
        digest = hashlib.sha256(content).hexdigest()
        place = self.folder / MADE_FROM / digest
        if not place.is_file():
            place.parent.mkdir(exist_ok=True)
            write_whole(place, content)
        return digest

    def kept(self, digest: str) -> bytes:
        """Return the stored content with SHA-256 `digest`. Raises `Refused` if it is missing or was changed."""
        file = self.folder / MADE_FROM / digest
        with refusing("restore it from a copy, or check its permissions", file, reading=True):
            content = read_regular(file)
        if hashlib.sha256(content).hexdigest() != digest:
            raise Refused(f"{file}: was changed; restore it from a copy")
        return content

    def append(self, entry: Entry) -> None:
        """Append `entry` as a line, and flush it to the disk. Raises `OSError`."""
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
        sync_folder(self.folder)
        self._take(line)

    def catch_up(self) -> None:
        """Read the lines that were added since the last reading. Raises `Refused` for a damaged register."""
        self.read_lines()

    def read_lines(self) -> Self:
        """Read the lines added since the last reading; change no file. Raises `Refused` for a damaged register."""
        path = self.folder / LINES
        with refusing("check name and permissions", self.folder, reading=True):
            if (path.stat().st_size if path.exists() else 0) < self.length:
                raise Refused(f"{path}: the last lines are missing; restore the file from a copy")
            if path.exists():
                with open_regular(path) as file:
                    file.seek(self.length)
                    for line in file:
                        if line.endswith(b"\n"):
                            self._take(line[:-1])
        return self

    def _take(self, line: bytes) -> None:
        where = f"{self.folder / LINES}, line {self.count + 1}"
        try:
            told = read_json(line)
            n, previous = told.pop("n"), told.pop("prev")
            kind, number = told.pop("type"), told.pop("number")
            entry = Entry(kind, number, told.pop("time"), told.pop("by"), told)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise Refused(
                f"{where}: not a line of a register ({cause_of(error)}); restore it from a copy"
            ) from None
        if previous != self.head or n != self.count + 1:
            raise Refused(
                f"{where}: the chain is broken here (a line was changed or removed); restore it from a copy"
            )
        if not self._note(entry, where):
            raise Refused(
                f"{where}: the entry '{kind}' of {number} contradicts the entries before it; restore the register "
                "from a copy"
            )
        self.head = hashlib.sha256(line).hexdigest()
        self.length += len(line) + 1
        self.count = n


Of = TypeVar("Of", bound=Chain)


@contextlib.contextmanager
def opened(register: Of) -> Iterator[Of]:
    """Yield a register, locked and read to its end; its folder is created if missing. Raises `Refused`."""
    folder = register.folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / _LOCK, timeout=WAIT_S)
        with lock:
            register.catch_up()
            yield register
    except Timeout:
        raise Refused(
            f"{folder}: another program has the register open; try again when it has ended"
        ) from None
    except OSError as error:
        raise Refused(
            f"{error.filename or folder}: cannot be written ({error.strerror}); free disk space or check "
            "permissions"
        ) from error
