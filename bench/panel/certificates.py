"""The certificates of runs: what the laboratory's register says of each, and the files as they were issued."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path

from bench.api.errors import Refused
from bench.base.json_text import read_json
from bench.certificate.laboratory import load_laboratory
from bench.certificate.register import Register
from bench.panel.access.people import Refusal
from bench.panel.folder import read_page
from bench.run.folder import Run


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
