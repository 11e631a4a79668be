"""Synchronisation of the catalogue with run folders: reads new or changed folders, marks vanished ones.

The folders are authoritative: a deleted catalogue is rebuilt from them. Many folders are read by worker
processes. Rows are written in atomic batches, so that the next sync continues an interrupted one, and
simultaneous syncs lose nothing. A folder that was moved or renamed gives the same run. A copy of a folder is
reported, and its run is counted once, from a folder that is not damaged if there is one.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from sqlalchemy import delete, select, update

from bench.base.computing import tracked
from bench.base.text import visible
from bench.catalogue.folder import FolderEntry, Row, issued_in, read_folder
from bench.catalogue.store import (
    CERTIFICATES,
    FOLDERS,
    INSTRUMENTS,
    ISSUED,
    OF_A_RUN,
    REGISTER,
    RUNS,
    Catalogue,
    forget_dues,
)  # fmt: skip
from bench.results.catalogue import FolderProblem, SyncResult
from bench.run.events import EVENTS, MANIFEST
from bench.run.folder import PLAN
from bench.services.errors import Refused, refusing

if TYPE_CHECKING:
    from sqlalchemy import Connection, Table

_T = TypeVar("_T")

BATCH: Final = 1000
"""Number of folders written in one transaction."""
CHUNK: Final = 50
"""Number of folders handed to a process at once for reading."""
FEW: Final = 300
"""Up to this many folders are read in this process, because starting worker processes would take longer."""
MANY: Final = 20_000
"""Above this number of folders to scan, separate processes scan them."""
LOOKED: Final = 5000
"""Number of folders handed to a scanning process at once."""
ENDED: Final = "a process reading run folders ended; repeat 'bench catalogue sync', which continues there"
_COPY, _COUNTED = "a copy of ", ": counted once"
MOST_IN: Final = 5000
"""Largest number of keys in one condition; SQLite allows 32,766 parameters, PostgreSQL 65,535."""


@dataclass
class Synced:
    """Folder counts of a sync; `problems` maps unusable, damaged and duplicate folders to the reason."""

    added: int = 0
    changed: int = 0
    unchanged: int = 0
    moved: int = 0
    vanished: int = 0
    problems: dict[str, str] = field(default_factory=dict)

    def result(self, catalogue: str) -> SyncResult:
        """Return the result object of a sync of `catalogue`."""
        told = [FolderProblem(path=path, reason=why) for path, why in sorted(self.problems.items())]
        return SyncResult(**{**vars(self), "catalogue": catalogue, "problems": told})


def sync(
    catalogue: Catalogue, folders: Sequence[str | Path], *, whole: bool = False, processes: int | None = None
) -> Synced:
    """Synchronise a catalogue with the run folders up to 12 levels below `folders`; return the counts.

    With `whole`, each record that was never read fully is read event by event. `processes` is the number of worker
    processes, by default the number of cores. Raises `Refused` if a folder cannot be read or the database fails.
    """
    roots = _roots(folders)
    count = os.cpu_count() or 1 if processes is None else processes
    with catalogue.reading() as connection:
        unread = _unread(connection)
    seen = _seen([*roots, *unread], count)
    done = Synced()
    with catalogue.reading() as connection:
        known = _known(connection, roots, unread)
        read = select(RUNS.c.id).where(RUNS.c.record == "read") if whole else None
        proved = None if read is None else set(connection.execute(read).scalars())
    waiting, back = [], []
    for path, mark in sorted(seen.runs.items()):
        row = known.get(path)
        if row is None or not mark or row["fingerprint"] != mark or _orphaned(row) or _unproved(row, proved):
            waiting.append((path, mark))
            continue
        done.unchanged += 1
        if row["reason"]:
            done.problems[path] = row["reason"]
        if row["vanished"]:
            back.append(path)
    for batch in _batches(_read(waiting, whole, count), BATCH):
        with catalogue.writing() as connection:
            _write(connection, batch, known, done)
    gone = [
        row
        for path, row in known.items()
        if path not in seen.runs
        and not (path in seen.odd and row["run"] is None)
        and not Path(path, MANIFEST).exists()
    ]
    done.problems |= seen.odd
    odd = {path: why for path, why in seen.odd.items() if path not in known or known[path]["reason"] != why}
    if not (back or odd or seen.registers or gone):
        return done
    with catalogue.writing() as connection:
        for path in back:
            _mark(connection, path, vanished=False)
        nothing = {"fingerprint": "", "run": None, "vanished": False}
        _upsert(connection, FOLDERS, [{"path": path, "reason": why, **nothing} for path, why in odd.items()])
        _write_registers(connection, seen.registers, done)
        done.vanished = _mark_vanished(connection, gone)
    return done


def _orphaned(row: Row) -> bool:
    """Return whether the folder of a row is a copy, and the original run folder no longer exists."""
    reason = row["reason"] or ""
    original = reason.removeprefix(_COPY).removesuffix(_COUNTED)
    return reason.startswith(_COPY) and not Path(original, MANIFEST).exists()


def _unproved(row: Row, proved: set[int] | None) -> bool:
    return proved is not None and row["run"] is not None and row["run"] not in proved


def _roots(folders: Sequence[str | Path]) -> list[str]:
    roots = [os.path.abspath(folder) for folder in folders]  # noqa: PTH100 - links stay as they are named
    missing = [root for root in roots if not Path(root).is_dir()]
    if missing:
        raise Refused(
            "\n".join(
                f"{root}: no such folder; none of its runs was marked as gone; check the name"
                for root in missing
            )
        )
    return roots


def _seen(roots: Sequence[str], processes: int) -> WalkResult:
    seen = WalkResult()
    now_ns = time.time_ns()
    for root in tracked(roots, "looking for runs"):
        with refusing("check name and permissions", Path(root), reading=True), os.scandir(root):
            found, waiting = walk([(root, 0)], now_ns, MANY if processes > 1 else None)
        seen.take(found)
        if waiting:
            _look_apart(seen, waiting, now_ns, processes)
    odd = {visible(path): why for path, why in seen.odd.items()}
    for path in [path for path in seen.runs if not _is_text(path)]:
        odd[visible(path)] = "its name is not UTF-8: rename it"
        del seen.runs[path]
    return WalkResult(seen.runs, odd, seen.registers)


def _look_apart(seen: WalkResult, waiting: list[Place], now_ns: int, processes: int) -> None:
    """Scan many folders, in worker processes and in this process; add the results to `seen`."""
    parts = list(_batches(waiting, LOOKED))
    with pool_of(processes - 1, ENDED) as pool:
        asked = [pool.submit(walk, part, now_ns) for part in parts]
        for part, one in zip(reversed(parts), reversed(asked), strict=True):
            if not one.cancel():
                break
            seen.take(walk(part, now_ns)[0])
        for one in asked:
            if not one.cancelled():
                seen.take(one.result()[0])


def _is_text(path: str) -> bool:
    try:
        path.encode()
    except UnicodeEncodeError:
        return False
    return True


def _unread(connection: Connection) -> set[str]:
    """Return the folders that must be read again because an older schema's rows on them were dropped."""
    missing = FOLDERS.c.run.is_not(None) & FOLDERS.c.run.not_in(select(RUNS.c.id))
    paths = connection.execute(select(FOLDERS.c.path).where(missing)).scalars()
    return {path for path in paths if Path(path, MANIFEST).exists()}


def _known(connection: Connection, roots: Sequence[str], unread: set[str]) -> dict[str, Row]:
    """Return the catalogue's rows on the folders below `roots` and those in `unread`, by path."""
    heads = tuple(root.rstrip(os.sep) + os.sep for root in roots)
    names = FOLDERS.columns.keys()
    rows = (dict(zip(names, row, strict=True)) for row in connection.execute(select(FOLDERS)))
    wanted = {*roots, *unread}
    found = {r["path"]: r for r in rows if r["path"].startswith(heads) or r["path"] in wanted}
    for path in unread & found.keys():
        found[path]["fingerprint"] = ""
    return found


def _read(waiting: list[tuple[str, str]], whole: bool, processes: int) -> Iterator[FolderEntry]:
    """Yield the contents of folders in their order; many folders are read by worker processes."""
    if len(waiting) <= FEW or processes < 2:
        for path, mark in tracked(waiting, "reading runs"):
            yield read_folder(path, mark, whole=whole)
        return
    chunks = _batches(waiting, CHUNK)
    with pool_of(processes, ENDED) as pool:
        running: deque[Future[list[FolderEntry]]] = deque(
            pool.submit(_read_chunk, chunk, whole) for chunk in islice(chunks, 4 * processes)
        )
        for _ in tracked(range(-(-len(waiting) // CHUNK)), "reading runs"):
            found = running.popleft().result()
            running.extend(pool.submit(_read_chunk, chunk, whole) for chunk in islice(chunks, 1))
            yield from found


def _read_chunk(chunk: list[tuple[str, str]], whole: bool) -> list[FolderEntry]:
    return [read_folder(path, mark, whole=whole) for path, mark in chunk]


def _batches(parts: Iterable[_T], size: int) -> Iterator[list[_T]]:
    rest = iter(parts)
    while batch := list(islice(rest, size)):
        yield batch


def _write(connection: Connection, batch: list[FolderEntry], known: dict[str, Row], done: Synced) -> None:
    """Write a batch of folders, and count them in `done`; `known` are earlier rows on folders by path."""
    places = _places(connection, [found.run for found in batch if found.run is not None])
    rows: dict[str, list[Row]] = {table.name: [] for table in (INSTRUMENTS, CERTIFICATES, RUNS, *OF_A_RUN)}
    folders, left, runs = [], [], []
    for found in batch:
        before = known.get(found.path)
        reason = found.reason
        if found.run is not None:
            reason = found.rows["runs"][0]["problem"] or ""
            elsewhere, damaged = places.get(found.run, (found.path, False))
            gone = elsewhere != found.path and not Path(elsewhere, MANIFEST).exists()
            if elsewhere == found.path or gone or (damaged and not reason):
                if gone:
                    left.append(elsewhere)
                    done.moved += 1
                elif found.run not in places and (before is None or before["run"] is not None):
                    done.added += 1
                else:
                    done.changed += 1
                places[found.run] = found.path, bool(reason)
                runs.append(found.run)
                for name, own in found.rows.items():
                    rows[name] += own
            else:
                reason = f"{_COPY}{elsewhere}{_COUNTED}"
        if reason:
            done.problems[found.path] = reason
        folders.append(
            {
                "path": found.path,
                "fingerprint": found.fingerprint,
                "run": found.run,
                "reason": reason or None,
                "vanished": False,
            }
        )
    _forget(connection, runs)
    for table in OF_A_RUN:
        _delete(connection, table, table.c.run, runs)
    _delete(connection, FOLDERS, FOLDERS.c.path, left)
    for path in left:
        known.pop(path, None)
    for table in (INSTRUMENTS, CERTIFICATES, RUNS, *OF_A_RUN):
        _upsert(connection, table, rows[table.name])
    _forget(connection, runs)
    _upsert(connection, FOLDERS, folders)


def _places(connection: Connection, runs: list[int]) -> dict[int, tuple[str, bool]]:
    """Return the path of each of the `runs` that the catalogue has, and whether the run there has a problem."""
    found: dict[int, tuple[str, bool]] = {}
    for some in _batches(runs, MOST_IN):
        asked = select(RUNS.c.id, RUNS.c.path, RUNS.c.problem).where(RUNS.c.id.in_(some))
        found |= {run: (path, bool(problem)) for run, path, problem in connection.execute(asked)}
    return found


def _delete(connection: Connection, table: Table, column: Any, keys: list[Any]) -> None:
    for some in _batches(keys, MOST_IN):
        connection.execute(delete(table).where(column.in_(some)))


def _forget(connection: Connection, runs: list[int]) -> None:
    """Delete the cached due dates of the units of runs."""
    for some in _batches(runs, MOST_IN):
        forget_dues(connection, RUNS.c.id.in_(some))


def _upsert(connection: Connection, table: Table, rows: list[Row]) -> None:
    """Insert rows in place of rows with the same keys. Of several rows with one key the last is kept."""
    if not rows:
        return
    if connection.dialect.name == "sqlite":
        from sqlalchemy.dialects.sqlite import insert
    else:
        from sqlalchemy.dialects.postgresql import insert  # type: ignore[assignment]
    keys = [column.name for column in table.primary_key]
    by_key = {tuple(row[key] for key in keys): row for row in rows}
    statement = insert(table)
    others = {c.name: statement.excluded[c.name] for c in table.columns if c.name not in keys}
    written = statement.on_conflict_do_update(index_elements=keys, set_=others)
    connection.execute(written, [by_key[key] for key in sorted(by_key)])


def _mark(connection: Connection, path: str, *, vanished: bool) -> None:
    """Mark a folder and its run as vanished, or as present again."""
    forget_dues(connection, RUNS.c.path == path)
    for table in (FOLDERS, RUNS):
        connection.execute(update(table).where(table.c.path == path).values(vanished=vanished))


def _write_registers(connection: Connection, registers: Sequence[str], done: Synced) -> None:
    """Replace the rows of registers; a damaged register is reported and keeps its earlier rows."""
    for folder in registers:
        try:
            rows = issued_in(folder)
        except Refused as error:
            done.problems[folder] = str(error).removeprefix(f"{folder}: ")
            continue
        of_it = ISSUED.c.register == folder
        known = {row["id"]: dict(row) for row in connection.execute(select(ISSUED).where(of_it)).mappings()}
        if known != {row["id"]: row for row in rows}:
            connection.execute(delete(ISSUED).where(of_it))
            _upsert(connection, ISSUED, rows)


def _mark_vanished(connection: Connection, rows: list[Row]) -> int:
    """Mark runs whose folder is gone, delete rows of copies and of folders without a run; return the count."""
    count = 0
    for row in rows:
        if row["run"] is None or (row["reason"] or "").startswith(_COPY):
            connection.execute(delete(FOLDERS).where(FOLDERS.c.path == row["path"]))
        elif not row["vanished"]:
            _mark(connection, row["path"], vanished=True)
            count += 1
    return count


# --- folders that are runs ------------------------------------------------------------------------------

MOST_DEEP: Final = 12
SETTLED_NS: Final = 2_000_000_000
"""Files changed less than this ago are read again: a second change could leave their times the same."""
_READ: Final = (".json", ".jsonl", ".yaml", ".csv")
"""Suffixes of the files that the catalogue reads in a run folder."""
_NAME: Final = attrgetter("name")
Place = tuple[str, int]
"""A folder still to be scanned, and its depth."""


@dataclass(frozen=True)
class WalkResult:
    """The folders that a walk found.

    `runs` maps run folders to fingerprints of their files. `odd` maps incomplete run folders, and folders that
    cannot be entered, to the reason. `registers` are the folders with a register of certificates.
    """

    runs: dict[str, str] = field(default_factory=dict)
    odd: dict[str, str] = field(default_factory=dict)
    registers: list[str] = field(default_factory=list)

    def take(self, other: WalkResult) -> None:
        """Add the results of another walk."""
        self.runs.update(other.runs)
        self.odd.update(other.odd)
        self.registers.extend(other.registers)


def walk(places: Iterable[Place], now_ns: int, most: int | None = None) -> tuple[WalkResult, list[Place]]:
    """Find the run folders at and below `places`; return them, and the folders that were not yet entered.

    The walk does not enter run folders' own folders, hidden folders, or symbolic links below `places`. It ends
    early when more than `most` folders wait; another walk, in any process, can then continue with them.
    """
    seen, waiting = WalkResult(), deque(places)
    while waiting and (most is None or len(waiting) <= most):
        path, depth = waiting.popleft()
        try:
            with os.scandir(path) as entries:
                found = list(entries)
        except OSError as error:
            seen.odd[path] = f"cannot be read ({error.strerror})"
            continue
        names = {entry.name for entry in found}
        if MANIFEST in names:
            seen.runs[path] = fingerprint(found, now_ns)
            continue
        if EVENTS in names or PLAN in names:
            seen.odd[path] = f"a run without {MANIFEST}: copied or removed in part; copy it again"
            continue
        if REGISTER in names:
            seen.registers.append(path)
        if depth < MOST_DEEP:
            waiting += [
                (entry.path, depth + 1)
                for entry in found
                if not entry.name.startswith(".") and entry.is_dir(follow_symlinks=False)
            ]
    return seen, list(waiting)


def fingerprint(entries: list[os.DirEntry[str]], now_ns: int) -> str:
    """Return a hash of the names, sizes and times of the files that the catalogue reads in a run folder.

    If a file changed so shortly before `now_ns` that a later change could go unnoticed, the hash is empty.
    """
    parts, newest = [], 0
    for entry in sorted(entries, key=_NAME):
        name = entry.name
        if not name.endswith(_READ):
            continue
        try:
            stat = entry.stat()
        except OSError:
            parts.append(name)
            continue
        changed, made = stat.st_mtime_ns, stat.st_ctime_ns
        parts.append(f"{name}/{stat.st_size}/{changed}/{made}")
        newest = max(newest, changed, made)
    if now_ns - newest < SETTLED_NS:
        return ""
    told = "//".join(parts).encode("utf-8", "surrogateescape")
    return hashlib.blake2b(told, digest_size=16).hexdigest()


@contextmanager
def pool_of(processes: int, when_ended: str) -> Iterator[ProcessPoolExecutor]:
    """Yield a process pool. Raises `Refused` with the text `when_ended` if a worker process was killed."""
    pool = ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn"))
    try:
        yield pool
    except BrokenProcessPool as error:
        raise Refused(when_ended) from error
    finally:
        pool.shutdown(cancel_futures=True)
