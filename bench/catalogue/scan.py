"""Run folders below a folder with fingerprints; processes that read many."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Final

from bench.run.events import EVENTS, MANIFEST
from bench.run.folder import PLAN
from bench.services.errors import Refused

MOST_DEEP: Final = 12
SETTLED_NS: Final = 2_000_000_000
"""Files changed less than this ago may change once more without their times showing it: they are read again."""
LINES: Final = "register.jsonl"
"""The register of a folder of issued certificates."""

_READ: Final = (".json", ".jsonl", ".yaml", ".csv")
"""Endings of what a catalogue reads in a run folder."""
_NAME: Final = attrgetter("name")
Place = tuple[str, int]
"""A folder that waits to be looked into, and how deep it is."""


@dataclass(frozen=True)
class Seen:
    """What a walk found: run folders with the fingerprints of their files, folders that should be runs with why
    they are none, registers, and folders that cannot be entered, with why."""

    runs: dict[str, str] = field(default_factory=dict)
    odd: dict[str, str] = field(default_factory=dict)
    registers: list[str] = field(default_factory=list)

    def take(self, other: Seen) -> None:
        """Add what another walk found."""
        self.runs.update(other.runs)
        self.odd.update(other.odd)
        self.registers.extend(other.registers)


def scan(root: str, now_ns: int, most: int | None = None) -> tuple[Seen, list[Place]]:
    """Walk a folder, which is a run folder itself or holds them at any depth; links below it are not followed.

    A run folder is not entered further, nor is a hidden one. Where more than `most` folders wait the walk ends, and
    they are returned beside what was seen: `scan_all` goes on with them, in any process. Raises `OSError` where
    `root` cannot be read.
    """
    seen = Seen()
    with os.scandir(root):
        pass
    return seen, _walk(seen, [(root, 0)], now_ns, most)


def scan_all(places: Iterable[Place], now_ns: int) -> Seen:
    """Walk folders with all that is below them."""
    seen = Seen()
    _walk(seen, places, now_ns, None)
    return seen


def _walk(seen: Seen, places: Iterable[Place], now_ns: int, most: int | None) -> list[Place]:
    waiting = deque(places)
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
            seen.odd[path] = f"a run without {MANIFEST}: half copied, or half removed"
            continue
        if LINES in names:
            seen.registers.append(path)
        if depth < MOST_DEEP:
            waiting += [(entry.path, depth + 1) for entry in _folders(found)]
    return list(waiting)


def _folders(entries: list[os.DirEntry[str]]) -> Iterator[os.DirEntry[str]]:
    for entry in entries:
        if not entry.name.startswith(".") and entry.is_dir(follow_symlinks=False):
            yield entry


def fingerprint(entries: list[os.DirEntry[str]], now_ns: int) -> str:
    """Return a hash of names, sizes and times of the files of a run; empty where they may yet change unseen."""
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
    """Give processes. Raises `Refused` with the words `when_ended` where one of them was ended from outside."""
    pool = ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn"))
    try:
        yield pool
    except BrokenProcessPool as error:
        raise Refused(when_ended) from error
    finally:
        pool.shutdown(cancel_futures=True)
