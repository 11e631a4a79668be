"""The folder of runs as visitors may name things in it, and the certificates of its runs."""

from __future__ import annotations

import os
import stat
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bench.base.files import read_json
from bench.certificate.laboratory import load_laboratory
from bench.certificate.register import Register
from bench.panel.access import Refusal
from bench.run.events import MANIFEST
from bench.run.folder import Run
from bench.services.errors import Refused

LARGEST_PAGE: Final = 64 * 2**20


class RunsFolder:
    """The runs in a folder. What is a link, or lies elsewhere, is none of them."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def runs(self) -> list[Run]:
        """Return the runs, in no order."""
        try:
            with os.scandir(self.path) as found:
                names = [one.name for one in found if one.is_dir(follow_symlinks=False)]
        except OSError:
            return []
        return [Run(self.path / name) for name in names if self._holds(name)]

    def run(self, name: str) -> Run:
        """Return the run of a name. Raises `Refusal` (404) where there is none."""
        if not self._holds(name):
            raise Refusal(404, "there is no run of that name")
        return Run(self.path / name)

    def _holds(self, name: str) -> bool:
        if not name or name.startswith(".") or "/" in name or "\\" in name:
            return False
        try:
            folder = os.lstat(f"{self.path}/{name}")
            manifest = os.lstat(f"{self.path}/{name}/{MANIFEST}")
        except (OSError, ValueError):
            return False
        return stat.S_ISDIR(folder.st_mode) and stat.S_ISREG(manifest.st_mode)


def read_page(run: Run, name: str) -> bytes:
    """Return a file of a run. Raises `Refusal` (404) where it is none, or a link."""
    try:
        descriptor = os.open(run.folder / name, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | os.O_NONBLOCK)
        with os.fdopen(descriptor, "rb") as file:
            if stat.S_ISREG(os.fstat(descriptor).st_mode):
                return file.read(LARGEST_PAGE)
    except (OSError, ValueError):
        pass
    raise Refusal(404, f"{run.name} has no {name}")


@dataclass(frozen=True)
class Issued:
    """A certificate of a run: its number, what is true of it now and by what, whether it is signed, its files."""

    number: str
    state: str
    by: str
    signed: bool
    files: tuple[str, ...]


class Certificates:
    """The certificates that a laboratory's register holds; it is only read. None where no laboratory file is named.

    Raises `FileMistakes` for a laboratory file with mistakes.
    """

    def __init__(self, laboratory: Path | None) -> None:
        self._folder = None if laboratory is None else load_laboratory(laboratory).register_folder
        self._lock = threading.Lock()
        self._register: Register | None = None

    def of(self, run: Run) -> tuple[Issued, ...]:
        """Return the certificates of a run as its record is now. Raises `Refused` for a changed register."""
        head = _head_of(run) if self._folder is not None else ""
        register = self._read()
        if not head or register is None:
            return ()
        return tuple(
            Issued(
                number,
                one.state,
                one.by,
                bool(one.entry.data.get("signed_by")),
                tuple(sorted(one.entry.files)),
            )
            for number, one in register.standings.items()
            if one.entry.data.get("run") == run.name and one.entry.data.get("record", {}).get("head") == head
        )

    def file(self, run: Run, name: str) -> bytes:
        """Return a file of one of a run's certificates. Raises `Refusal` (404), `Refused` where it was changed."""
        register = self._read()
        if register is None or not any(name in one.files for one in self.of(run)):
            raise Refusal(404, f"{run.name} has no such certificate")
        return register.file(name)

    def _read(self) -> Register | None:
        if self._folder is None:
            return None
        with self._lock:
            register = self._register or Register(self._folder)
            try:
                register.read_lines()
            except OSError as error:
                raise Refused(f"{self._folder}: cannot be read ({error.strerror})") from error
            self._register = register
            return register


def _head_of(run: Run) -> str:
    """Return the hash that stands for a run's record, as its own result names it; empty where there is none."""
    try:
        return str(read_json(read_page(run, "calibrate.json"))["record"]["head"])
    except (Refusal, ValueError, KeyError, TypeError):
        return ""
