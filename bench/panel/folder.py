"""The folder of runs: safe access to runs and files, the table of runs, the certificates of a run."""

from __future__ import annotations

import json
import os
import stat
import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from bench.base.files import open_regular, read_json
from bench.base.languages import message
from bench.certificate.laboratory import load_laboratory
from bench.certificate.register import NumberStatus, Register
from bench.panel.access import Refusal
from bench.run.events import EVENTS, MANIFEST, RecordError
from bench.run.folder import BENCH, CALIBRATE_FILE, PLAN, PROCEDURE, RESULTS, VERIFY_FILE, Digests, Run
from bench.run.record import is_being_written
from bench.services.records import run_summary
from drivers.clock import Clock, SystemClock

LARGEST_PAGE: Final = 64 * 2**20


class RunsFolder:
    """The runs in a folder; symbolic links and paths out of the folder are excluded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def runs(self) -> list[Run]:
        """Return the runs, in arbitrary order."""
        try:
            with os.scandir(self.path) as found:
                names = [one.name for one in found if one.is_dir(follow_symlinks=False)]
        except OSError:
            return []
        return [Run(self.path / name) for name in names if self.holds(name)]

    def run(self, name: str) -> Run:
        """Return the run with this name. Raises `Refusal` (404) if there is none."""
        if not self.holds(name):
            raise Refusal(404, "no run has that name; see the list of runs")
        return Run(self.path / name)

    def holds(self, name: str) -> bool:
        """Whether there is a run with this name."""
        if not name or name.startswith(".") or "/" in name or "\\" in name:
            return False
        try:
            folder = os.lstat(f"{self.path}/{name}")
            manifest = os.lstat(f"{self.path}/{name}/{MANIFEST}")
        except (OSError, ValueError):
            return False
        return stat.S_ISDIR(folder.st_mode) and stat.S_ISREG(manifest.st_mode)


def read_page(run: Run, name: str) -> bytes:
    """Return the content of a run's file. Raises `Refusal` (404) if it is missing, a link or not a regular file."""
    try:
        flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
        descriptor = os.open(run.folder / name, flags)
        with os.fdopen(descriptor, "rb") as file:
            if stat.S_ISREG(os.fstat(descriptor).st_mode):
                return file.read(LARGEST_PAGE)
    except (OSError, ValueError):
        pass
    raise Refusal(404, f"{run.name} has no {name}; go back to the run and make it there")


class Certificates:
    """A laboratory's certificates; none without a laboratory file. Raises `FileMistakes` if it is invalid."""

    def __init__(self, laboratory: Path | None) -> None:
        self._folder = None if laboratory is None else load_laboratory(laboratory).register_folder
        self._lock = threading.Lock()
        self._register: Register | None = None

    def of(self, run: Run) -> dict[str, NumberStatus]:
        """Return, by number, the certificates issued for the record from which a run's result was calculated.

        Raises `Refused` for a damaged register.
        """
        head = head_of(run) if self._folder is not None else ""
        register = self._read()
        if not head or register is None:
            return {}
        return {
            number: one
            for number, one in register.standings.items()
            if one.entry.data.get("run") == run.name and one.entry.data.get("record", {}).get("head") == head
        }

    def file(self, run: Run, name: str) -> bytes:
        """Return a file of a run's certificate. Raises `Refusal` (404) if it is missing, `Refused` if altered."""
        register = self._read()
        if register is None or not any(name in one.entry.files for one in self.of(run).values()):
            raise Refusal(404, f"{run.name} has no such certificate; see its page")
        return register.file(name)

    def _read(self) -> Register | None:
        if self._folder is None:
            return None
        with self._lock:
            register = (self._register or Register(self._folder)).read_lines()
            self._register = register
            return register


def head_of(run: Run) -> str:
    """Return the head of a run's record that the result of the calibration states; "" without a result."""
    try:
        return str(read_json(read_page(run, CALIBRATE_FILE))["record"]["head"])
    except (Refusal, ValueError, KeyError, TypeError):
        return ""


UNREAD: Final = message("not read yet")
LONGEST_LOOK_S: Final = 0.1
"""Longest time (s) that a page spends on reading runs; rows of the others show only their manifests."""
TAIL: Final = 65_536
_ON: Final = {b'"run_paused"': "paused", b'"run_continued"': "running", b'"run_resumed"': "running"}
_GOES_ON: Final = frozenset({"running", "paused"})

Stamp = tuple[tuple[int, int, int] | None, ...]


@dataclass(frozen=True)
class RunRow:
    """A row of the table of runs; `state` is one or two words, `detail` describes damage to the record."""

    name: str
    created: str = ""
    instruments: str = ""
    state: str = UNREAD
    detail: str = ""
    verdict: str = ""
    unit: str = ""
    bench: str = ""
    operator: str = ""
    procedure: str = ""
    to_go_on: str = ""

    @property
    def alive(self) -> bool:
        """Whether a program is carrying out the run now."""
        return self.state in _GOES_ON

    def fits(self, words: tuple[str, ...], wanted: Mapping[str, str]) -> bool:
        """Return whether the row contains all `words` (casefolded) and the non-empty texts `wanted`, by column."""
        if any(text and getattr(self, column) != text for column, text in wanted.items()):
            return False
        told = " ".join((self.name, self.unit, self.bench, self.operator, self.procedure, self.created))
        return all(word in told.casefold() for word in words)


class RunsTable:
    """The runs of a folder as rows, newest first."""

    def __init__(self, folder: RunsFolder, clock: Clock | None = None) -> None:
        self._folder = folder
        self._clock = clock or SystemClock()
        self._digests = Digests(folder.path)
        self._reading = threading.Lock()
        self._kept: dict[str, tuple[Stamp, RunRow]] = {}
        self._rest = threading.Thread()

    def rows(self) -> list[RunRow]:
        """Return all rows; runs not read within 0.1 s (`LONGEST_LOOK_S`) have only the manifest's data."""
        until_s = self._clock.now_s() + LONGEST_LOOK_S
        found = []
        for run in self._folder.runs():
            stamp = _stamp(run.folder)
            kept = self._kept.get(run.name)
            if kept is not None and kept[0] == stamp:
                found.append(kept[1])
            elif self._clock.now_s() < until_s:
                found.append(self._read(run, stamp, wait=False))
            else:
                found.append(_of_manifest(run))
        there = {row.name for row in found}
        for name in list(self._kept):
            if name not in there:
                self._kept.pop(name, None)
        return sorted(
            (_now(self._folder, row) for row in found), key=lambda r: (r.created, r.name), reverse=True
        )

    def read_all(self) -> None:
        """Read every run that is not cached, and cache the rows."""
        for run in self._folder.runs():
            stamp = _stamp(run.folder)
            if self._kept.get(run.name, (None,))[0] != stamp:
                self._read(run, stamp, wait=True)
        with self._reading:
            self._digests.save()

    def read_the_rest(self) -> threading.Thread:
        """Return the thread that reads the runs for which `rows` had no time; start it if it does not run."""
        rest = self._rest
        if not rest.is_alive():
            self._rest = rest = threading.Thread(target=self.read_all, daemon=True)
            rest.start()  # not the thread of another page that is asked for at this moment
        return rest

    def _read(self, run: Run, stamp: Stamp, *, wait: bool) -> RunRow:
        """Return the row of a run, read from its record.

        Without `wait`, return a row with only data of the manifest while another thread is reading. Of a run
        in progress, only the end of the record is read, because records may be long.
        """
        if is_being_written(run.folder):
            return replace(_of_manifest(run), state=state_at_the_end(run.folder))
        if not self._reading.acquire(blocking=wait):
            return _of_manifest(run)
        try:
            summary = run_summary(run, self._digests.of)
        finally:
            self._reading.release()
        state, _, detail = summary.state.partition(": ")
        row = replace(
            _of_manifest(run),
            state=state,
            detail=detail,
            verdict=summary.verdict or "",
            to_go_on=summary.to_go_on,
        )
        self._kept[run.name] = (stamp, row)
        return row


def _now(folder: RunsFolder, row: RunRow) -> RunRow:
    """Return a cached row with the current state: a program may have resumed the run without a new event."""
    if row.to_go_on and is_being_written(folder.path / row.name):
        return replace(row, state=state_at_the_end(folder.path / row.name), to_go_on="")
    return row


def _of_manifest(run: Run) -> RunRow:
    try:
        manifest: Mapping[str, Any] = run.manifest
    except RecordError:
        return RunRow(run.name)
    unit = manifest.get("unit_under_test")
    told = unit if isinstance(unit, dict) else {}
    return RunRow(
        name=run.name,
        created=str(manifest.get("created", "")),
        instruments="simulated"
        if manifest.get("dry_run")
        else "imported"
        if "imported" in manifest
        else "real",
        unit=f"{told.get('type', '')} {told.get('serial', '')}".strip(),
        bench=Path(str(manifest.get("bench", ""))).stem,
        operator=str(manifest.get("operator", "")),
        procedure=Path(str(manifest.get("procedure", ""))).stem,
    )


def _stamp(folder: Path) -> Stamp:
    place = str(folder)
    stamps: list[tuple[int, int, int] | None] = []
    for name in (MANIFEST, EVENTS, RESULTS, VERIFY_FILE, PLAN, PROCEDURE, BENCH):
        try:
            found = os.stat(f"{place}/{name}")  # noqa: PTH116 - thousands at once, and Path is slower
            stamps.append((found.st_mtime_ns, found.st_size, found.st_ino))
        except OSError:
            stamps.append(None)
    return tuple(stamps)


def state_at_the_end(folder: Path) -> str:
    """Return the state of a run in progress, "running" or "paused", from the last lines of its record."""
    try:
        with open_regular(folder / EVENTS) as file:
            file.seek(max(file.seek(0, 2) - TAIL, 0))
            lines = file.read().splitlines()
    except OSError:
        return "running"
    for line in reversed(lines):
        if any(word in line for word in _ON):
            try:
                kind = f'"{json.loads(line)["type"]}"'.encode()
            except (ValueError, KeyError, TypeError):
                continue
            if kind in _ON:
                return _ON[kind]
    return "running"
