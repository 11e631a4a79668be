"""A batch on disk: what was asked, and parts of its table, each there whole or not at all.

A part is a Parquet file that is never written again. Rows that are in one are not computed again; a row counts
as long as the run is as it was when it was computed.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from filelock import FileLock, Timeout

from bench.api.errors import Refused
from bench.base.regular import read_regular
from bench.base.whole import from_text, to_text
from bench.batch.columns import COLUMNS, Row, arrow_schema
from bench.batch.job import Job, program
from bench.batch.listing import fingerprint
from drivers.clock import utc_now

FORMAT: Final = 1
BATCH: Final = "batch.json"
PARTS: Final = "parts"
RUNS: Final = "runs.parquet"
PAGES: Final = "pages"
_LOCK: Final = ".lock"
_HALF: Final = ".writing"
_BEFORE: Final = {_LOCK, PARTS, BATCH + _HALF}
"""What a program that is killed as it begins leaves."""
_OPTIONS: Final = {"g_m_s2": "g", "limit_g": "limit"}


@dataclass(frozen=True)
class Progress:
    """How far a batch is: `pending` runs with their fingerprints, how many are `done`; `notes` for a person."""

    pending: Mapping[str, str]
    done: int
    notes: tuple[str, ...] = ()


class Store:
    """The folder of a batch, held by one program at a time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock = FileLock(folder / _LOCK, timeout=0)

    def __enter__(self) -> Store:
        """Take the folder. Raises `Refused` where another program has it, or where it is no folder of a batch."""
        if self.folder.exists() and not self.folder.is_dir():
            raise Refused(f"--out {self.folder}: a file of that name is there; give a folder")
        there = self.folder.is_dir() and any(one.name not in _BEFORE for one in self.folder.iterdir())
        if there and not (self.folder / BATCH).is_file():
            raise Refused(f"--out {self.folder}: the folder holds other files and no batch; give another")
        (self.folder / PARTS).mkdir(parents=True, exist_ok=True)
        try:
            self._lock.acquire()
        except Timeout:
            raise Refused(
                f"{self.folder}: another program carries this batch out; wait until it ends"
            ) from None
        for half in self.folder.rglob(f"*{_HALF}"):
            half.unlink()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Let the folder go."""
        self._lock.release()

    # --- what was asked -----------------------------------------------------------------------------

    def begin(self, job: Job, over: Sequence[str], runs: Sequence[str]) -> Progress:
        """Note what is asked and of which runs; return what is left to do.

        Raises `Refused` with all that differs, where the folder is of another command or program.
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
            noted = {
                "format": FORMAT,
                **asked,
                "differing": job.differing(),
                "begun": utc_now().isoformat(),
            }
            _write_synced(self.folder / BATCH, to_text(noted).encode())
        return self._left(job.command, runs)

    def _require_same(self, asked: Mapping[str, Any]) -> None:
        before = self.noted()
        told = [f"the command was {before['command']}"] if before["command"] != asked["command"] else []
        if not told:
            told += _differences(before["asked"], asked["asked"], "--")
        if before["over"] != asked["over"]:
            told.append(f"--over was {' '.join(before['over'])}")
        told += _differences(before["program"], asked["program"], "the program's ")
        if told:
            raise Refused(
                f"{self.folder}: its batch was begun otherwise: {'; '.join(told)}; go on as it was begun, or give "
                "another folder with --out"
            )

    def noted(self) -> dict[str, Any]:
        """Return what the batch was asked. Raises `Refused` where that cannot be read."""
        file = self.folder / BATCH
        try:
            noted: dict[str, Any] = from_text(read_regular(file))
            if noted["format"] != FORMAT or noted["command"] not in COLUMNS:
                raise ValueError(f"format {noted['format']}")
        except FileNotFoundError:
            raise Refused(f"{self.folder}: no batch is there (no {BATCH} in it)") from None
        except (OSError, ValueError, KeyError, TypeError) as problem:
            raise Refused(f"{file}: cannot be read ({problem}); give another folder with --out") from None
        return noted

    # --- what is done -------------------------------------------------------------------------------

    def _left(self, command: str, runs: Sequence[str]) -> Progress:
        import pyarrow

        now = {run: fingerprint(run) for run in runs}
        done = self._done()
        listed = pyarrow.table({"run": list(now), "fingerprint": list(now.values())})
        self._write_table(self.folder / RUNS, listed)
        pending = {run: mark for run, mark in now.items() if mark not in done.get(run, ())}
        notes = []
        if changed := sum(run in done for run in pending):
            notes.append(f"{changed} runs have changed since they were computed: they are computed again")
        if gone := len(done.keys() - now.keys()):
            notes.append(f"{gone} runs that were computed are no longer there: the result is without them")
        if done and (new := sum(run not in done for run in pending)):
            notes.append(f"{len(now) - len(pending)} runs are done, {new} are left")
        return Progress(pending, len(now) - len(pending), tuple(notes))

    def _done(self) -> dict[str, tuple[str, ...]]:
        from pyarrow import parquet

        done: dict[str, tuple[str, ...]] = {}
        for part in self.parts():
            try:
                table = parquet.read_table(part, columns=["run", "fingerprint"])
            except (OSError, ValueError, KeyError) as problem:
                first = str(problem).splitlines()[0]
                raise Refused(f"{part}: damaged ({first}); delete it: its runs are computed again") from None
            for run, mark in zip(table["run"].to_pylist(), table["fingerprint"].to_pylist(), strict=True):
                if mark in done.get(run, ()):
                    raise Refused(f"{part}: {run} stands in another part, too; delete {part}, and go on")
                done[run] = (*done.get(run, ()), mark)
        return done

    def parts(self) -> list[Path]:
        """Return the parts there are, in the order in which they were written."""
        return sorted((self.folder / PARTS).glob("part-*.parquet"))

    def write_part(self, command: str, rows: Iterable[Row]) -> None:
        """Write rows as a part that is there whole or not at all."""
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
        _write_synced(file, sink.getvalue())


def _differences(before: Mapping[str, Any], now: Mapping[str, Any], prefix: str) -> list[str]:
    names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    return [f"{prefix}{_OPTIONS.get(n, n).replace('_', '-')} was {_said(before.get(n))}" for n in names]


def _said(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{value['file']} (SHA-256 {value['sha256'][:12]}…)"
    return (
        {None: "not given", True: "on", False: "off"}.get(value, str(value)) if _plain(value) else str(value)
    )


def _plain(value: Any) -> bool:
    return value is None or isinstance(value, bool)


def _write_synced(file: Path, content: Any) -> None:
    """Write a file and sync it and its folder to the disk, before it has its name."""
    half = file.with_name(file.name + _HALF)
    with half.open("wb") as written:
        written.write(content)
        written.flush()
        os.fsync(written.fileno())
    half.replace(file)
    with suppress(OSError):  # not every system opens folders
        folder = os.open(file.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
