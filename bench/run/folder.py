"""Run folders as analyses see them: inputs, history, readings; a digest of many."""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import platformdirs

from bench.base.computing import uncollected
from bench.base.files import read_json, read_regular
from bench.config.procedure.plan import Plan, Read
from bench.readings.corrected import LevelReading, with_levels
from bench.readings.reading import readings_of
from bench.readings.table import VERIFICATION, Readings
from bench.run.events import EVENTS, MANIFEST, Manifest, RecordError, RunState, read_manifest, sha256
from bench.run.record import History, read_history
from drivers.clock import utc_now

PLAN = "plan.json"
BENCH = "bench.yaml"
PROCEDURE = "procedure.yaml"
MODEL = "model.yaml"
EFFECTS = "effects.yaml"
LEARNED = "learned.yaml"
IMPORTED = "readings.csv"
VERIFY = "verify"
RESULTS = "results.json"
"""Names what was made of a finished run: `made`, null until all of it is there."""
REPORT = "report.html"


@dataclass(frozen=True)
class Run:
    """A run folder, read on demand. Raises `RecordError` where something in it cannot be read."""

    folder: Path

    @property
    def name(self) -> str:
        """Name of the run: its folder's."""
        return self.folder.name

    @cached_property
    def manifest(self) -> Manifest:
        """What the run was started with."""
        return read_manifest(self.folder)

    @cached_property
    def history(self) -> History:
        """The events, checked."""
        return read_history(self.folder)

    @cached_property
    def plan(self) -> Plan:
        """The plan that was, or is to be, carried out."""
        try:
            with uncollected():
                return Plan.from_json(read_json(read_regular(self.folder / PLAN)))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise RecordError(
                f"{self.folder / PLAN}: cannot be read ({error}); take it from a copy"
            ) from error

    @property
    def created(self) -> str:
        """Civil time at which the run was begun, empty where its manifest cannot be read."""
        try:
            return str(self.manifest.get("created", ""))
        except RecordError:
            return ""

    @property
    def imported(self) -> bool:
        """Whether the run was made of a readings file."""
        return "imported" in self.manifest

    @property
    def simulated(self) -> bool:
        """Whether the run was made on simulated instruments."""
        return bool(self.manifest.get("dry_run"))

    @property
    def asks_somebody(self) -> bool:
        """Whether a living person answers the questions of the run, and no scripted one."""
        return not self.simulated or bool(self.manifest.get("living"))

    @property
    def results_missing(self) -> bool:
        """Whether of what is made of the run when it has finished not all is there."""
        try:
            made = read_json((self.folder / RESULTS).read_bytes())["made"]
            return made is None or not all((self.folder / Path(name).name).is_file() for name in made)
        except FileNotFoundError:  # a version before wrote the page and no such list
            return not (self.folder / REPORT).is_file()
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return True

    def trusted_history(self) -> History:
        """Return the history. Raises `RecordError` when a line or an input was changed."""
        if self.history.problems:
            raise RecordError(
                f"{self.folder}: the record cannot be trusted: {'; '.join(self.history.problems)}"
            )
        return self.history

    def readings(self) -> Readings:
        """Return the readings on record, in the order of measurement; of a repeated step the last counts.

        Raises `RecordError` when the record was changed, or holds no reading.
        """
        taken = list(self.trusted_history().readings.values())
        if not taken:
            raise RecordError(f"{self.folder}: no reading is recorded in this run")
        planned = sum(isinstance(s, Read) and s.installation == VERIFICATION for s in self.plan.steps)
        table = with_levels(readings_of(taken, str(self.folder)), self._seen_by_level())
        return replace(
            table,
            verification_missing=planned - len(table.verification()),
            notes=self._unfinished_note(len(taken)),
        )

    def _seen_by_level(self) -> list[LevelReading]:
        return [
            LevelReading(
                bench_s,
                (one.level_series, one.level_of),
                one.adjusted,
                (one.alpha1_arcsec, one.alpha2_arcsec),
                (one.u_alpha1_arcsec, one.u_alpha2_arcsec),
            )
            for bench_s, one in self.trusted_history().levelled
        ]

    def _unfinished_note(self, taken: int) -> tuple[str, ...]:
        """Say how much of the plan was measured, where it is not all."""
        history = self.trusted_history()
        out = history.progress.left_out
        planned = [i for i, step in enumerate(self.plan.steps) if isinstance(step, Read)]
        needed = sum(i not in out for i in planned)
        notes = []
        if out:
            asked = ", ".join(self.manifest.get("until", ()))
            notes.append(
                f"measured until {asked}: {len(planned) - needed} of {len(planned)} planned readings were left out"
            )
        if taken != needed:
            notes.append(f"the run is {history.state}: {taken} of {needed} planned readings were taken")
        return tuple(notes)


def checked_name(name: str) -> str:
    """Return the name of a run, which is that of its folder and an argument of commands.

    Raises `RecordError` for one that could not be typed, or would lie elsewhere.
    """
    if re.fullmatch(r"\w[\w.+-]{0,99}", name) is None:
        raise RecordError(
            f"{name!r}: a run's name is a letter or digit, then up to 99 letters, digits, dots, dashes and plusses"
        )
    return name


def find_run(name: str, runs: Path) -> Run:
    """Find a run by its name in the folder of runs, or by its path.

    Raises `RecordError` that lists the runs there are.
    """
    for folder in (runs / name, Path(name)):
        if (folder / MANIFEST).is_file():
            return Run(folder)
    there = ", ".join(run.name for run in all_runs(runs)[-5:]) or "none"
    raise RecordError(f"{name}: no run of that name in {runs} and no such path; the latest runs are: {there}")


def all_runs(runs: Path) -> list[Run]:
    """Return the runs in a folder, oldest first."""
    if not runs.is_dir():
        return []
    found = [Run(folder) for folder in runs.iterdir() if (folder / MANIFEST).is_file()]
    return sorted(found, key=lambda run: (run.created, run.name))


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
