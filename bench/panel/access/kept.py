"""What the panel keeps in files of its own, for the owner's eyes alone: read anew when another program wrote it."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock

from bench.base.regular import read_regular
from bench.base.whole import from_text, to_text, write_whole
from bench.run.manifest import RecordError


def private_folder(folder: Path) -> Path:
    """Return a folder that is its owner's alone (0700), made where there is none. Raises `RecordError`."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        found = folder.lstat()
        if not stat.S_ISDIR(found.st_mode):
            raise RecordError(f"{folder}: is a link, and the panel keeps its secrets in a folder; remove it")
        if os.name == "posix" and stat.S_IMODE(found.st_mode) & 0o077:
            folder.chmod(0o700)
    except OSError as error:
        raise RecordError(
            f"{folder}: cannot be used ({error.strerror}); choose another folder of runs"
        ) from error
    return folder


class KeptList:
    """A list of JSON objects in a file; several programs may change it, one after the other."""

    def __init__(self, folder: Path, name: str) -> None:
        self._path = folder / name
        self._lock = FileLock(folder / f"{name}.lock", mode=0o600)
        self._stamp: tuple[int, int, int] | None = None
        self._rows: list[dict[str, Any]] = []

    def rows(self) -> list[dict[str, Any]]:
        """Return the rows, read anew where the file was written since. Raises `RecordError` for a damaged file."""
        try:
            found = self._path.stat()
            stamp = (found.st_mtime_ns, found.st_size, found.st_ino)
            if stamp != self._stamp:
                rows = from_text(read_regular(self._path))
                if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
                    raise ValueError
                self._rows, self._stamp = rows, stamp
        except FileNotFoundError:
            self._rows, self._stamp = [], None
        except (OSError, ValueError) as error:
            raise RecordError(
                f"{self._path}: cannot be read; put a copy in its place, or remove it and make new tokens"
            ) from error
        return list(self._rows)

    @contextmanager
    def changed(self) -> Iterator[list[dict[str, Any]]]:
        """Give the rows to be changed in place; they are written when the block ends. Raises `RecordError`."""
        try:
            with self._lock:
                rows = self.rows()
                before = json.dumps(rows)
                yield rows
                if json.dumps(rows) != before:
                    write_whole(self._path, to_text(rows))
                    self._path.chmod(0o600)
        except OSError as error:
            raise RecordError(f"{self._path}: cannot be written ({error.strerror}); free the disk") from error
