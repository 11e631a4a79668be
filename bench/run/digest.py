"""What became of many runs, told at once: read once and kept, as long as the files of a run are the ones read.

What is kept stands in the user's cache folder. It is taken for a run whose files have the same size, times and
place on the disk as when they were read; anything else in it, or no cache, costs only the time to read the run.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import platformdirs

from bench.run.folder import Run
from bench.run.manifest import EVENTS, MANIFEST, sha256
from bench.run.states import RunState
from drivers.clock import utc_now

FORMAT: Final = 2
"""One more with every change in what is kept, or in what makes a record a damaged one."""

SETTLED_S: Final = 2.0
"""Files changed less than this ago may change once more without their times showing it: they are read again."""

Stamp = list[list[Any]]
"""Of each file that a run is told by: name, size, times of its contents and of its entry (ns), device and place."""


@dataclass(frozen=True)
class Digest:
    """What became of a run, how many readings stand in its record, and what is wrong with it (sentences)."""

    state: RunState
    readings: int
    problems: tuple[str, ...]

    @classmethod
    def of(cls, run: Run) -> Digest:
        """Read a run. Raises `RecordError` where it cannot be."""
        history = run.history
        return cls(history.state, len(history.readings), history.problems)


def cache_folder() -> Path:
    """Return where digests are kept."""
    return Path(platformdirs.user_cache_dir("triaxial-bench")) / "runs"


class Digests:
    """The digests of the runs in a folder. `save` keeps those that were read since, where that can be done."""

    def __init__(self, runs: Path, cache: Path | None = None, now: Callable[[], datetime] = utc_now) -> None:
        self._file = (cache or cache_folder()) / f"{sha256(os.fsencode(runs.absolute()))[:32]}.json"
        self._now = now
        self._kept = _kept_in(self._file)
        self._changed = False

    def of(self, run: Run) -> Digest:
        """Return the digest of a run, read if need be. Raises `RecordError` where it cannot be."""
        try:
            kept = self._kept[run.name]
            names = [row[0] for row in kept["stamp"]]
            if names[:2] == [MANIFEST, EVENTS] and _stamp(run.folder, names) == kept["stamp"]:
                return Digest(RunState(kept["state"]), int(kept["readings"]), tuple(kept["problems"]))
        except (OSError, ValueError, KeyError, TypeError, IndexError):
            pass
        return self._read(run)

    def _read(self, run: Run) -> Digest:
        names = [MANIFEST, EVENTS, *(run.manifest.get("files", {}))]
        before = _stamp(run.folder, names)
        digest = Digest.of(run)
        newest_ns = max((time for row in before for time in row[2:4]), default=0)
        settled = self._now().timestamp() - newest_ns / 1e9 > SETTLED_S
        if settled and _stamp(run.folder, names) == before:
            self._kept[run.name] = {
                "stamp": before,
                "state": digest.state.value,
                "readings": digest.readings,
                "problems": list(digest.problems),
            }
            self._changed = True
        return digest

    def save(self) -> None:
        """Keep what was read, where there is a place for it."""
        if not self._changed:
            return
        text = json.dumps(self._kept)
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            descriptor, part = tempfile.mkstemp(dir=self._file.parent)
            try:
                with os.fdopen(descriptor, "w", encoding="utf-8") as file:
                    file.write(json.dumps({"format": FORMAT, "sha256": sha256(text.encode())}) + "\n" + text)
                Path(part).replace(self._file)
            except BaseException:
                Path(part).unlink(missing_ok=True)
                raise
        except OSError:
            return


def _kept_in(file: Path) -> dict[str, dict[str, Any]]:
    """Return what a file keeps, nothing where it is none of ours or not as it was written."""
    try:
        head, _, text = file.read_text(encoding="utf-8").partition("\n")
        if json.loads(head) == {"format": FORMAT, "sha256": sha256(text.encode())}:
            kept: dict[str, dict[str, Any]] = json.loads(text)
            return kept
    except (OSError, ValueError, RecursionError):
        pass
    return {}


def _stamp(folder: Path, names: list[str]) -> Stamp:
    """Return the stamp of files; of one that is not there the name alone."""
    rows: Stamp = []
    for name in names:
        try:
            found = (folder / name).stat()
        except FileNotFoundError:
            rows.append([name])
            continue
        rows.append([name, found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_dev, found.st_ino])
    return rows
