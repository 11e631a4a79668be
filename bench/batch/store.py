"""A batch on disk: the job, its runs, and the parts of its table. Each part is complete or absent."""

from __future__ import annotations

import glob
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from filelock import FileLock, Timeout

from bench.base.computing import tracked
from bench.base.files import from_text, read_regular, sync_folder, to_text, write_synced
from bench.base.languages import message
from bench.base.text import cause_of
from bench.batch.job import COLUMNS, Job, Row, arrow_schema, program
from bench.run.events import EVENTS, MANIFEST, sha256
from bench.run.folder import BENCH, CALIBRATE_FILE, DIAGNOSE_FILE, EFFECTS, IMPORTED, PLAN, VERIFY_FILE
from bench.services.errors import Refused
from drivers.clock import Clock, SystemClock, utc_now

_QUESTION: Final = re.compile(r"[a-z][a-z_]*\s*(=|!=|>=|<=|>|<)")
_READ: Final = (
    MANIFEST, EVENTS, BENCH, PLAN, IMPORTED, EFFECTS, CALIBRATE_FILE, VERIFY_FILE, DIAGNOSE_FILE,
)  # fmt: skip
"""Files of a run on which its row depends."""


@dataclass(frozen=True)
class Listed:
    """The runs of a batch (absolute paths, sorted, unique), and the matching folders that hold no run."""

    runs: tuple[str, ...]
    no_runs: tuple[str, ...] = ()


def list_runs(
    over: Sequence[str], runs: Path, catalogue: str | None = None, option: str = "--over"
) -> Listed:
    """Return the runs that `over` selects, by a query of the `catalogue` or by patterns of paths.

    A query consists of words such as `unit=Q-17`; a run must satisfy all. Patterns are shell patterns (`*`,
    `?`, `[…]`, `**` for nested folders), matched in the working folder or else in the folder `runs`. A folder
    that is not a run stands for the runs in it. Raises `Refused` if no run is found; the message names the
    `option`.
    """
    words = [word for given in over for word in _words(given)]
    asked = [word for word in words if is_question(word)]
    if not any(words):
        raise Refused(f"{option} names no run; give runs, such as {option} 'runs/*' or {option} unit=Q-17")
    if asked and len(asked) < len(words):
        other = next(word for word in words if not is_question(word))
        raise Refused(
            f"{option} {other}: patterns of names and conditions ({asked[0]}) cannot be mixed; give one kind"
        )
    found = _asked(asked, catalogue) if asked else _there(words, runs)
    if not found.runs:
        kind = message("no run in the catalogue matches") if asked else message("no run is there")
        raise Refused(f"{option} {' '.join(words)}: {kind}")
    return found


def _words(given: str) -> list[str]:
    """Return the words of a text if all are query words; otherwise the whole text, as one pattern."""
    words = given.split()
    return words if len(words) > 1 and all(map(is_question, words)) else [given]


def is_question(word: str) -> bool:
    """Whether a word is a query (`unit=Q-17`) and not a pattern of paths."""
    return _QUESTION.match(word) is not None and not Path(word).exists()


def fingerprint(run: str) -> str:
    """Return a hash of the sizes and modification times of those files of a run that determine its row."""
    told = []
    for name in _READ:
        try:
            is_ = (Path(run) / name).stat()
        except OSError:
            continue
        told.append(f"{name} {is_.st_size} {is_.st_mtime_ns}")
    return sha256("\n".join(told).encode())[:32]


def _asked(words: Sequence[str], catalogue: str | None) -> Listed:
    from bench.catalogue.questions import run_folders
    from bench.catalogue.store import open_catalogue

    with open_catalogue(catalogue, existing=True) as opened:
        return _sorted(run_folders(opened, words), ())


def _there(patterns: Iterable[str], runs: Path) -> Listed:
    found: list[Path] = []
    others: list[Path] = []
    for pattern in patterns:
        for path in _matches(pattern, runs):
            if (path / MANIFEST).is_file():
                found.append(path)
                continue
            inside = [one for one in path.iterdir() if (one / MANIFEST).is_file()] if path.is_dir() else []
            found += inside
            if path.is_dir() and not inside:
                others.append(path)
    return _sorted(found, others)


def _matches(pattern: str, runs: Path) -> list[Path]:
    if not glob.has_magic(pattern):
        places = [Path(pattern), runs / pattern]
        return [place for place in places if place.exists()][:1]
    matching = partial(glob.glob, recursive=True)  # a pattern may be absolute, unlike for `Path.glob`
    return [Path(path) for path in matching(pattern) or matching(str(runs / pattern))]


def _sorted(found: Iterable[Path], others: Iterable[Path]) -> Listed:
    return Listed(
        tuple(sorted({str(path.resolve()) for path in found})), tuple(sorted({str(path) for path in others}))
    )


FORMAT: Final = 1
_OF_JOB: Final = ("format", "command", "asked", "over", "program", "differing", "begun")
"""The members of the file of a batch."""
BATCH: Final = "batch.json"
PARTS: Final = "parts"
RUNS: Final = "runs.parquet"
_LOCK: Final = ".lock"
_HALF: Final = ".writing"
_BEFORE: Final = {_LOCK, PARTS, BATCH + _HALF}
"""Files that remain when a program is killed while it creates a batch."""
_OPTIONS: Final = {"g_m_s2": "--g", "limit_g": "--limit", "pages": "the folder of pages"}


@dataclass(frozen=True)
class BatchProgress:
    """Progress of a batch: runs still `pending`, with their fingerprints, and `notes` for the user."""

    pending: Mapping[str, str]
    notes: tuple[str, ...] = ()


class Store:
    """The folder of a batch; as a context manager, it lets one program at a time compute the batch."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock = FileLock(folder / _LOCK, timeout=0)

    def __enter__(self) -> Store:
        """Lock the folder.

        Raises `Refused` if another program holds it, or if the folder is not that of a batch.
        """
        if self.folder.exists() and not self.folder.is_dir():
            raise Refused(f"--out {self.folder}: this is a file; name a folder")
        there = self.folder.is_dir() and any(one.name not in _BEFORE for one in self.folder.iterdir())
        if there and not (self.folder / BATCH).is_file():
            raise Refused(f"--out {self.folder}: the folder has other files but no batch; name another")
        (self.folder / PARTS).mkdir(parents=True, exist_ok=True)
        try:
            self._lock.acquire()
        except Timeout:
            raise Refused(
                f"{self.folder}: another program is computing this batch; wait until it ends"
            ) from None
        for half in self.folder.rglob(f"*{_HALF}"):
            half.unlink()
        return self

    def __exit__(self, *error: object) -> None:
        self._lock.release()

    # --- what was asked -----------------------------------------------------------------------------

    def begin(self, job: Job, over: Sequence[str], runs: Sequence[str]) -> BatchProgress:
        """Record the job and its runs; return the runs still to be computed.

        Raises `Refused` if the folder's batch has other options or another `over`, if it was begun with other
        versions or other code of the program, or if a part is damaged.
        """
        asked = {
            "command": job.command,
            "asked": job.to_json(),
            "over": list(over),
            "program": dict(program()),
        }
        if (self.folder / BATCH).is_file():
            self._require_same(asked)
        else:
            noted = {"format": FORMAT, **asked, "differing": job.differing(), "begun": utc_now().isoformat()}
            _put_in_place(self.folder / BATCH, to_text(noted).encode())
        return self._left(job.command, runs)

    def _require_same(self, asked: Mapping[str, Any]) -> None:
        before = self.noted()
        told = [f"the command was {before['command']}"] if before["command"] != asked["command"] else []
        if not told:
            told += _differences(before["asked"], asked["asked"], _option)
        if before["over"] != asked["over"]:
            told.append(f"--over was {' '.join(before['over'])}")
        told += _differences(before["program"], asked["program"], "the program's {}".format)
        if told:
            raise Refused(
                f"{self.folder}: its batch was started with other options: {'; '.join(told)}; use the same "
                "options, files and program, or name another folder with --out"
            )

    def noted(self) -> dict[str, Any]:
        """Return the stored job of the batch. Raises `Refused` if its file cannot be read."""
        file = self.folder / BATCH
        try:
            noted: dict[str, Any] = from_text(read_regular(file))
            if lacking := [name for name in _OF_JOB if not isinstance(noted, dict) or name not in noted]:
                raise ValueError(f"it lacks {', '.join(lacking)}")
            if noted["format"] != FORMAT or noted["command"] not in COLUMNS:
                raise ValueError(f"format {noted['format']}, command {noted['command']}")
        except (FileNotFoundError, NotADirectoryError):
            raise Refused(
                f"{self.folder}: the folder has no batch (no {BATCH} in it); name the folder of a batch"
            ) from None
        except (OSError, ValueError, TypeError) as problem:
            raise Refused(
                f"{file}: not a readable batch ({cause_of(problem)}); restore it from a copy, or start the batch "
                "again in another folder"
            ) from None
        return noted

    # --- what is done -------------------------------------------------------------------------------

    def _left(self, command: str, runs: Sequence[str]) -> BatchProgress:
        import pyarrow

        now = {run: fingerprint(run) for run in runs}
        done = self._done()
        listed = pyarrow.table({"run": list(now), "fingerprint": list(now.values())})
        self._write_table(self.folder / RUNS, listed)
        pending = {run: mark for run, mark in now.items() if mark not in done.get(run, ())}
        notes = []
        if changed := sum(run in done for run in pending):
            notes.append(f"{changed} runs changed since they were computed; they are computed again")
        if gone := len(done.keys() - now.keys()):
            notes.append(f"{gone} computed runs no longer exist; the result omits them")
        if done and (new := sum(run not in done for run in pending)):
            notes.append(f"{len(now) - len(pending)} runs are done, {new} are left")
        return BatchProgress(pending, tuple(notes))

    def _done(self) -> dict[str, tuple[str, ...]]:
        from pyarrow import parquet

        done: dict[str, tuple[str, ...]] = {}
        for part in self.parts():
            try:
                table = parquet.read_table(part, columns=["run", "fingerprint"])
            except (OSError, ValueError, KeyError) as problem:
                first = str(problem).splitlines()[0]
                raise Refused(
                    f"{part}: damaged ({first}); delete this file, and its runs are computed again"
                ) from None
            for run, mark in zip(table["run"].to_pylist(), table["fingerprint"].to_pylist(), strict=True):
                if mark in done.get(run, ()):
                    raise Refused(
                        f"{part}: {run} is in another part, too; delete {part}, and repeat the command"
                    )
                done[run] = (*done.get(run, ()), mark)
        return done

    def parts(self) -> list[Path]:
        """Return the files of the parts in the order in which they were written."""
        return sorted((self.folder / PARTS).glob("part-*.parquet"))

    def write_part(self, command: str, rows: Iterable[Row]) -> None:
        """Write rows as a new part, atomically."""
        import pyarrow

        parts = self.parts()
        number = int(parts[-1].stem.partition("-")[2]) + 1 if parts else 1
        schema = arrow_schema(command)
        table = pyarrow.Table.from_pylist(list(rows), schema=schema)
        self._write_table(self.folder / PARTS / f"part-{number:07}.parquet", table)

    @staticmethod
    def _write_table(file: Path, table: Any) -> None:
        import pyarrow
        from pyarrow import parquet

        sink = pyarrow.BufferOutputStream()
        parquet.write_table(table, sink, compression="zstd")
        _put_in_place(file, sink.getvalue())


def _differences(
    before: Mapping[str, Any], now: Mapping[str, Any], called: Callable[[str], str]
) -> list[str]:
    names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    return [f"{called(name)} was {_said(before.get(name))}" for name in names]


def _option(name: str) -> str:
    return _OPTIONS.get(name, f"--{name.replace('_', '-')}")


def _said(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{value['file']} (SHA-256 {value['sha256'][:12]}…)"
    if value is None or value == []:
        return "not given"
    if isinstance(value, list):
        return " ".join(map(_said, value))
    return ("on" if value else "off") if isinstance(value, bool) else str(value)


def _put_in_place(file: Path, content: Any) -> None:
    """Write a file under a temporary name, sync it and its folder to the disk, and then rename it."""
    half = file.with_name(file.name + _HALF)
    write_synced(half, content)
    half.replace(file)
    sync_folder(file.parent)


PART_ROWS: Final = 256
"""Largest number of rows in a part: it bounds the memory used, and the loss if the program is killed."""
PART_S: Final = 10.0
"""A part is written with the first row that arrives this long (s) after the previous part."""

Computed = Callable[[Iterator[str]], Iterator[Row]]
"""A function that yields the rows of runs in any order, computed by processes or by a cluster."""


@dataclass
class PartWriter:
    """A buffer of rows that are not yet in a part, and the store to which parts are written."""

    store: Store
    command: str
    clock: Clock = field(default_factory=SystemClock)
    _rows: list[Row] = field(default_factory=list)
    _since_s: float = 0.0

    def carry_out(self, progress: BatchProgress, computed: Computed) -> None:
        """Compute the pending runs with `computed`; write all rows to parts, even after an interruption."""
        self._since_s = self.clock.now_s()
        rows = computed(iter(progress.pending))
        try:
            for row in tracked(rows, "runs", len(progress.pending)):
                self._take(row | {"fingerprint": progress.pending[row["run"]]})
        finally:
            self._write()
            if isinstance(rows, Iterator) and hasattr(rows, "close"):
                rows.close()

    def _take(self, row: Row) -> None:
        self._rows.append(row)
        if len(self._rows) >= PART_ROWS or self.clock.now_s() - self._since_s >= PART_S:
            self._write()

    def _write(self) -> None:
        if self._rows:
            self.store.write_part(self.command, self._rows)
        self._rows.clear()
        self._since_s = self.clock.now_s()
