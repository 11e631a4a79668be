"""The table of runs: each run read once, and again when its files are others; quick with thousands of them."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from bench.base.files import open_regular
from bench.panel.folder import RunsFolder
from bench.run.events import EVENTS, MANIFEST, RecordError
from bench.run.folder import BENCH, PLAN, PROCEDURE, RESULTS, VERIFY, Digests, Run
from bench.run.record import is_being_written
from bench.services.records import run_summary
from drivers.clock import Clock, SystemClock

UNREAD: Final = "not read yet"
LONGEST_LOOK_S: Final = 0.1
"""So long a page waits for runs that nobody has read yet; the rest is read meanwhile."""
TAIL: Final = 65_536
_ON: Final = {b'"run_paused"': "paused", b'"run_continued"': "running", b'"run_resumed"': "running"}
_GOES_ON: Final = frozenset({"running", "paused"})

Stamp = tuple[tuple[int, int, int] | None, ...]


@dataclass(frozen=True)
class Row:
    """A run in the table; `state` is a word or two, `detail` what is wrong with a damaged record."""

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
        """Whether a program carries it out now."""
        return self.state in _GOES_ON

    def fits(self, words: tuple[str, ...], wanted: Mapping[str, str]) -> bool:
        """Whether all words stand somewhere in it, and each column that is `wanted` says that."""
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
        self._kept: dict[str, tuple[Stamp, Row]] = {}

    def rows(self) -> list[Row]:
        """Return all rows; of runs that take too long to read for now what stands in their manifest."""
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
        """Read every run once, and keep what was read for the next time."""
        for run in self._folder.runs():
            self._read(run, _stamp(run.folder), wait=True)
        with self._reading:
            self._digests.save()

    def _read(self, run: Run, stamp: Stamp, *, wait: bool) -> Row:
        """Read a run, unless others are being read and nobody waits for that.

        One that is being carried out is told by the end of its record, which may be a long one.
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


def _now(folder: RunsFolder, row: Row) -> Row:
    """Return a row that was kept as it is now: another program may have taken the run up without a line yet."""
    if row.to_go_on and is_being_written(folder.path / row.name):
        return replace(row, state=state_at_the_end(folder.path / row.name), to_go_on="")
    return row


def _of_manifest(run: Run) -> Row:
    try:
        manifest: Mapping[str, Any] = run.manifest
    except RecordError:
        return Row(run.name)
    unit = manifest.get("unit_under_test")
    told = unit if isinstance(unit, dict) else {}
    return Row(
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
    for name in (MANIFEST, EVENTS, RESULTS, f"{VERIFY}.json", PLAN, PROCEDURE, BENCH):
        try:
            found = os.stat(f"{place}/{name}")  # noqa: PTH116 - thousands at once: a path costs more than to look
            stamps.append((found.st_mtime_ns, found.st_size, found.st_ino))
        except OSError:
            stamps.append(None)
    return tuple(stamps)


def state_at_the_end(folder: Path) -> str:
    """Return the state of a run that is being carried out, by the last lines of its record."""
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
