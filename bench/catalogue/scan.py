"""The run folders below a folder, each with a fingerprint of its files: read from the directory alone."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from operator import attrgetter
from struct import Struct
from typing import Final

from bench.run.folder import PLAN
from bench.run.manifest import EVENTS, MANIFEST

MOST_DEEP: Final = 12
SETTLED_NS: Final = 2_000_000_000
"""Files changed less than this ago may change once more without their times showing it: they are read again."""
LINES: Final = "register.jsonl"
"""The register of a folder of issued certificates."""

_READ: Final = (".json", ".jsonl", ".yaml", ".csv")
"""Endings of what a catalogue reads in a run folder."""
_NAME: Final = attrgetter("name")
_SIZES: Final = Struct("<qqq")


@dataclass(frozen=True)
class Seen:
    """What a walk found: run folders with the fingerprints of their files, folders that should be runs with why
    they are none, registers, and folders that cannot be entered, with why."""

    runs: dict[str, str]
    odd: dict[str, str]
    registers: tuple[str, ...]


def scan(root: str, now_ns: int) -> Seen:
    """Walk a folder, which is a run folder itself or holds them at any depth; links below it are not followed.

    A run folder is not entered further, nor is a hidden one. Raises `OSError` where `root` cannot be read.
    """
    runs: dict[str, str] = {}
    odd: dict[str, str] = {}
    registers: list[str] = []
    waiting = [(root, 0)]
    while waiting:
        path, depth = waiting.pop()
        try:
            with os.scandir(path) as entries:
                found = list(entries)
        except OSError as error:
            if depth == 0:
                raise
            odd[path] = f"cannot be read ({error.strerror})"
            continue
        names = {entry.name for entry in found}
        if MANIFEST in names:
            runs[path] = fingerprint(found, now_ns)
            continue
        if EVENTS in names or PLAN in names:
            odd[path] = f"a run without {MANIFEST}: half copied, or half removed"
            continue
        if LINES in names:
            registers.append(path)
        if depth < MOST_DEEP:
            waiting += [(entry.path, depth + 1) for entry in _folders(found)]
    return Seen(runs, odd, tuple(registers))


def _folders(entries: list[os.DirEntry[str]]) -> Iterator[os.DirEntry[str]]:
    for entry in entries:
        if not entry.name.startswith(".") and entry.is_dir(follow_symlinks=False):
            yield entry


def fingerprint(entries: list[os.DirEntry[str]], now_ns: int) -> str:
    """Return a hash of names, sizes and times of the files of a run; empty where they may yet change unseen."""
    parts, newest = [], 0
    for entry in sorted(entries, key=_NAME):
        if not entry.name.endswith(_READ):
            continue
        try:
            stat = entry.stat()
        except OSError:
            parts.append(os.fsencode(entry.name))
            continue
        changed, made = stat.st_mtime_ns, stat.st_ctime_ns
        parts += (os.fsencode(entry.name), _SIZES.pack(stat.st_size, changed, made))
        newest = max(newest, changed, made)
    if now_ns - newest < SETTLED_NS:
        return ""
    return hashlib.blake2b(b"/".join(parts), digest_size=16).hexdigest()
