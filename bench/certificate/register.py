"""The register of issued certificates: an append-only file; each line contains the hash of the line before.

Writing the line issues the certificate. Before that, the certificate's files have temporary names; they are
renamed afterwards, or when the register is next opened. After an interruption, a number therefore exists with
all its files or not at all. Only one program at a time has the register open for writing.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Final

from bench.base.files import read_regular, sync_folder, write_synced
from bench.services.chain import Chain, Entry
from bench.services.errors import Refused, refusing

_PART: Final = ".part"

ISSUED, REVOKED = "issued", "revoked"


@dataclass(frozen=True)
class NumberStatus:
    """The status of a certificate number: `state` is "issued", "amended", "replaced" or "revoked".

    `by` is the number of the certificate that supersedes it, or the reason for the revocation.
    """

    entry: Entry
    state: str = ISSUED
    by: str = ""


@dataclass
class Register(Chain):
    """A register, open and locked against other writers; `standings` maps each number to its status."""

    KIND: ClassVar[str] = "register"

    standings: dict[str, NumberStatus] = field(default_factory=dict)

    def number_after(self, numbers: Iterator[str]) -> str:
        """Return the first of `numbers` that was never issued."""
        return next(number for number in numbers if number not in self.standings)

    def issue(self, entry: Entry, contents: Mapping[str, bytes]) -> None:
        """Issue a certificate with its files. Raises `Refused` for a number issued before, `OSError` on failure."""
        if entry.number in self.standings:
            raise Refused(f"{entry.number}: this number was issued before; choose another")
        for name, content in contents.items():
            write_synced(self.folder / (name + _PART), content)
        sync_folder(self.folder)
        sha = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
        self.append(Entry(entry.kind, entry.number, entry.time, entry.by, {**entry.data, "files": sha}))
        self._put_in_place(self.standings[entry.number].entry)

    def file(self, name: str) -> bytes:
        """Return the content of an issued file. Raises `Refused` if the file is unknown, missing or changed."""
        number = name.rsplit(".", 1)[0]
        stated = self.standings[number].entry.files.get(name) if number in self.standings else None
        if stated is None:
            raise Refused(
                f"{self.folder}: no file {name} was issued; 'bench certificate register' lists the numbers"
            )
        with refusing("check name and permissions", self.folder / name, reading=True):
            content = read_regular(self.folder / name)
        if hashlib.sha256(content).hexdigest() != stated:
            raise Refused(
                f"{self.folder / name}: the file differs from the issued one; restore it from a copy"
            )
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

    def catch_up(self) -> None:
        """Read the lines that others added; finish interrupted issues. Raises `Refused` for a damaged register."""
        self.read_lines()
        for part in self.folder.glob(f"*{_PART}"):
            self._finish(part)

    def _note(self, entry: Entry, where: str) -> bool:
        standing = self.standings.get(entry.number)
        if entry.kind == ISSUED:
            if standing is not None:
                raise Refused(
                    f"{where}: number {entry.number} was issued twice; restore the register from a copy"
                )
            self.standings[entry.number] = NumberStatus(entry)
            before = entry.data.get("before") or {}
            old = self.standings.get(str(before.get("number")))
            if old is not None and old.state == ISSUED:  # a revoked one stays revoked
                self.standings[old.entry.number] = NumberStatus(old.entry, str(before["kind"]), entry.number)
        elif entry.kind == REVOKED and standing is not None:
            self.standings[entry.number] = NumberStatus(
                standing.entry, REVOKED, str(entry.data.get("reason", ""))
            )
        else:
            return False
        return True

    def _put_in_place(self, entry: Entry) -> None:
        for name in entry.files:
            (self.folder / (name + _PART)).replace(self.folder / name)
        sync_folder(self.folder)

    def _finish(self, part: Path) -> None:
        """Rename a temporary file to its final name if its certificate was issued; else delete it."""
        name = part.name.removesuffix(_PART)
        standing = self.standings.get(name.rsplit(".", 1)[0])
        stated = None if standing is None else standing.entry.files.get(name)
        if stated is None:
            part.unlink()
        elif not (self.folder / name).exists() and hashlib.sha256(read_regular(part)).hexdigest() == stated:
            part.replace(self.folder / name)
            sync_folder(self.folder)
