"""Run folders as analyses read them (inputs, history, readings), and cached summaries of many runs."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any, Final

from bench.base.computing import uncollected
from bench.base.files import cache_folder, read_json, read_regular, to_text, write_whole
from bench.base.languages import message
from bench.base.text import cause_of
from bench.config.procedure.plan import Plan, Read
from bench.readings.corrected import LevelReading, with_levels
from bench.readings.table import UNORIENTED, VERIFICATION, Reading, Readings, readings_of
from bench.run.events import ENDED, EVENTS, MANIFEST, Manifest, RecordError, RunState, read_manifest, sha256
from bench.run.record import History, cannot_write, locked, read_history, trusted
from drivers.clock import utc_now

PLAN = "plan.json"
BENCH = "bench.yaml"
PROCEDURE = "procedure.yaml"
MODEL = "model.yaml"
EFFECTS = "effects.yaml"
LEARNED = "learned.yaml"
IMPORTED = "readings.csv"
VERIFY = "verify"
CALIBRATE_FILE, VERIFY_FILE, DIAGNOSE_FILE = "calibrate.json", "verify.json", "diagnose.json"
"""Names of the files with the results of these commands in a run's folder."""
RESULTS = "results.json"
"""Name of the file that lists the results of a finished run; `made` is null until all results are written."""
REPORT = "report.html"


@dataclass(frozen=True)
class Run:
    """A run folder, read on demand. Raises `RecordError` for a file that cannot be read."""

    folder: Path

    @property
    def name(self) -> str:
        """Name of the run, which is the name of its folder."""
        return self.folder.name

    @cached_property
    def manifest(self) -> Manifest:
        """The manifest with which the run was begun."""
        return read_manifest(self.folder)

    @cached_property
    def history(self) -> History:
        """The events of the run, with their hashes checked."""
        return read_history(self.folder)

    @cached_property
    def plan(self) -> Plan:
        """The plan of the run. Raises `RecordError` if it cannot be read."""
        try:
            with uncollected():
                return Plan.from_json(read_json(read_regular(self.folder / PLAN)))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise RecordError(
                f"{self.folder / PLAN}: cannot be read ({cause_of(error)}); {self._remedy()}"
            ) from error

    def _remedy(self) -> str:
        """Return what to do about a plan that cannot be read.

        If the file is intact, another version of the program wrote it, and can read it; otherwise a copy is needed.
        """
        try:
            intact = sha256(read_regular(self.folder / PLAN)) == self.manifest["files"][PLAN]
            version = self.manifest["versions"]["triaxial-bench"]
        except (OSError, RecordError, KeyError, TypeError):
            intact = False
        return (
            f"the file is intact: use the program that wrote it, version {version}"
            if intact
            else "restore it from a copy"
        )

    @property
    def created(self) -> str:
        """Civil time at which the run was begun; empty if the manifest cannot be read."""
        try:
            return str(self.manifest.get("created", ""))
        except RecordError:
            return ""

    @property
    def imported(self) -> bool:
        """Whether the run was imported from a readings file."""
        return "imported" in self.manifest

    @property
    def simulated(self) -> bool:
        """Whether the run was made on simulated instruments."""
        return bool(self.manifest.get("dry_run"))

    @property
    def asks_somebody(self) -> bool:
        """Whether a real person, not a script, answers the prompts of the run."""
        return not self.simulated or bool(self.manifest.get("living"))

    @property
    def results_missing(self) -> bool:
        """Whether the finished run lacks a result, or its list of results is damaged."""
        try:
            made = read_json((self.folder / RESULTS).read_bytes())["made"]
            return made is None or not all((self.folder / Path(name).name).is_file() for name in made)
        except FileNotFoundError:  # an earlier version wrote the report without this list
            return not (self.folder / REPORT).is_file()
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return True

    def results_due(self, until: ExitStack | None = None) -> None:
        """Note that results are missing; a lock on this note, until `until` closes, shows that they are coming.

        Raises `RecordError` if the folder cannot be written.
        """
        try:
            write_whole(self.folder / RESULTS, to_text({"made": None}))
        except OSError as error:
            raise cannot_write(self.folder, error) from error
        if until is not None:
            until.enter_context(locked(self.folder / RESULTS))

    @property
    def record_head(self) -> dict[str, str | int]:
        """Identification of the record: the number of `events` and the `head` of their hash chain.

        The head is the SHA-256 of the last line; each line contains the hash of the previous one. A copy of the
        head kept elsewhere, as in a result, therefore reveals any line changed, removed or added since.
        """
        return {"events": len(self.history.events), "head": self.history.head}

    def trusted_history(self) -> History:
        """Return the history. Raises `RecordError` if a line of the record or an input was changed."""
        return trusted(self.history, self.folder)

    def readings(self) -> Readings:
        """Return the recorded readings in the order of measurement; a repeated step has only its last reading.

        Raises `RecordError` if the record was changed or holds no reading.
        """
        history = self.trusted_history()
        readings = history.readings
        if not readings:
            resume = "" if self.history.state in ENDED else message(", or resume this one")
            raise RecordError(f"{self.folder}: the run has no reading; name another run{resume}")
        planned = sum(isinstance(s, Read) and s.installation == VERIFICATION for s in self.plan.steps)
        taken, mountings = list(readings.values()), self.plan.mountings
        mounted = [
            None if one.installation in UNORIENTED else (mountings[step], history.remounts[step])
            for step, one in readings.items()
        ]
        taken = _of_one_mounting(taken, mounted)
        table = with_levels(
            readings_of(taken, str(self.folder), history.power, mounted), self._seen_by_level()
        )
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
        history = self.trusted_history()
        out = history.progress.left_out
        planned = [i for i, step in enumerate(self.plan.steps) if isinstance(step, Read)]
        needed = sum(i not in out for i in planned)
        notes = []
        if out:
            asked = ", ".join(self.manifest.get("until", ()))
            notes.append(
                message(
                    f"measured until {asked}: {len(planned) - needed} of {len(planned)} planned readings "
                    "were left out"
                )
            )
        if taken != needed:
            notes.append(
                message(f"the run is {history.state}: {taken} of {needed} planned readings were taken")
            )
        if withdrawn := len({one[0] for one in history.taken if one is not None} - history.progress.done):
            notes.append(
                f"readings that do not count, because their repetition was asked for and not taken: {withdrawn}"
            )
        return tuple(notes)


def _of_one_mounting(taken: Sequence[Reading], mounted: Sequence[tuple[int, int] | None]) -> list[Reading]:
    """Return readings whose series are of one mounting each: earlier versions could record two in one series."""
    found: dict[tuple[str, int], tuple[int, int]] = {}
    free = count(1 + max((one.series for one in taken), default=0))
    numbers: dict[tuple[str, int, tuple[int, int]], int] = {}
    apart = []
    for one, mounting in zip(taken, mounted, strict=True):
        place = (one.installation, one.series)
        if mounting is not None and found.setdefault(place, mounting) != mounting:
            key = (*place, mounting)
            number = numbers[key] = numbers.get(key) or next(free)
            apart.append(replace(one, series=number))
        else:
            apart.append(one)
    return apart


def statement_in(verdict: Mapping[str, Any]) -> str:
    """Return the statement of conformity in a result of `verify` or in one of its points.

    Results of earlier versions have no statement; for them, return "pass" or "fail". Raises `KeyError` if neither
    is stated.
    """
    return str(verdict.get("statement") or ("pass" if verdict["passed"] else "fail"))


def checked_name(name: str) -> str:
    """Return `name` if it is valid both as a folder name and as a command-line argument.

    Raises `RecordError` for a name that is hard to type or would lead to another folder.
    """
    if re.fullmatch(r"\w[\w.+-]{0,99}", name) is None:
        raise RecordError(
            f"{name!r}: a run's name begins with a letter or digit; at most 99 letters, digits, dots, "
            "dashes and pluses follow"
        )
    return name


def find_run(name: str, runs: Path) -> Run:
    """Return the run called `name` in the folder `runs`, or the run at the path `name`.

    Raises `RecordError`, listing the latest runs, if there is no such run.
    """
    for folder in (runs / name, Path(name)):
        if (folder / MANIFEST).is_file():
            return Run(folder)
    there = ", ".join(run.name for run in all_runs(runs)[-5:]) or message("none")
    path = message("that path is not the folder of a run") if Path(name).exists() else message("no such path")
    raise RecordError(f"{name}: no run of that name in {runs} and {path}; the latest runs are: {there}")


def all_runs(runs: Path) -> list[Run]:
    """Return the runs in a folder, oldest first."""
    if not runs.is_dir():
        return []
    found = [Run(folder) for folder in runs.iterdir() if (folder / MANIFEST).is_file()]
    return sorted(found, key=lambda run: (run.created, run.name))


FORMAT: Final = 2
"""Version of the cache; increase it when its content or the rules for damaged records change."""

SETTLED_S: Final = 2.0
"""Least age of a run's newest file for its digest to be cached, s.

A file changed more recently may change again without a new time stamp.
"""

Stamp = list[list[Any]]
"""The state of a run's files: one row per file.

A row holds the file's name, size, times of the last change of content and of status (ns), device and inode.
"""


@dataclass(frozen=True)
class Digest:
    """A summary of a run: its state, the number of recorded readings, and the problems as sentences."""

    state: RunState
    readings: int
    problems: tuple[str, ...]

    @classmethod
    def of(cls, run: Run) -> Digest:
        """Return the digest of a run, read from its folder. Raises `RecordError` if it cannot be read."""
        history = run.history
        return cls(history.state, len(history.readings), history.problems)


class Digests:
    """The digests of the runs in a folder, from a cache where possible; `save` adds the new ones to the cache."""

    def __init__(self, runs: Path, cache: Path | None = None, now: Callable[[], datetime] = utc_now) -> None:
        self._file = (cache or cache_folder("runs")) / f"{sha256(os.fsencode(runs.absolute()))[:32]}.json"
        self._now = now
        self._kept = _kept_in(self._file)
        self._changed = False

    def of(self, run: Run) -> Digest:
        """Return the digest of a run, cached or newly computed. Raises `RecordError` if it cannot be read."""
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
        """Write the new digests to the cache; do nothing if the cache folder is not writable."""
        if not self._changed:
            return
        text = json.dumps(self._kept)
        with suppress(OSError):
            self._file.parent.mkdir(parents=True, exist_ok=True)
            head = json.dumps({"format": FORMAT, "sha256": sha256(text.encode())})
            write_whole(self._file, f"{head}\n{text}")


def _kept_in(file: Path) -> dict[str, dict[str, Any]]:
    """Return the digests in a cache file by run; none if the file is damaged or has another format."""
    try:
        head, _, text = file.read_text(encoding="utf-8").partition("\n")
        if json.loads(head) == {"format": FORMAT, "sha256": sha256(text.encode())}:
            kept: dict[str, dict[str, Any]] = json.loads(text)
            return kept
    except (OSError, ValueError, RecursionError):
        pass
    return {}


def _stamp(folder: Path, names: list[str]) -> Stamp:
    """Return names, sizes, times and inodes of files, to notice changes later; a missing file has only a name."""
    rows: Stamp = []
    for name in names:
        try:
            found = (folder / name).stat()
        except FileNotFoundError:
            rows.append([name])
            continue
        rows.append([name, found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_dev, found.st_ino])
    return rows
