"""A run on disk: inputs first, then one append-only file of events, all on the disk before the next step.

What a step begins with, and what is asked and answered, is in the file at once, and on the disk with the event
after it: a power cut in between leaves the record at the step before, and the run goes on from there all the same.

Every line of `events.jsonl` is a JSON object that carries, in `prev`, the SHA-256 of the line before it (of
`run.json` for the first), so that a changed or missing line is found. Everything else in the folder is
derived from these and can be made again.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from bench.base.files import open_regular
from bench.base.visible import in_json
from bench.run.events import Event, EventType
from bench.run.history import History, read_history
from bench.run.manifest import DEFAULT_RULE, EVENTS, FORMAT, MANIFEST, Manifest, RecordError, sha256
from bench.run.states import RunState, state_after_one

WITH_THE_NEXT: Final = frozenset(
    {EventType.STEP_STARTED, EventType.ASKED, EventType.ANSWERED, EventType.ANSWER_REFUSED}
)
"""Events that are not waited for until they are on the disk."""

_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})

Shield = Callable[[], AbstractContextManager[None]]


class Record:
    """The writer of a run's events. One program writes a run at a time.

    `state` is what its events have led to; an event that cannot follow is not written.
    `shield` makes a context within which no signal interrupts the program.
    """

    def __init__(self, folder: Path, now: Callable[[], datetime], shield: Shield = nullcontext) -> None:
        self.folder = folder
        self.state = RunState.READY
        self._now = now
        self._shield = shield
        self._last_hash, self._count, self._length = "", 0, 0
        self._half_written = False
        try:
            # unbuffered: what a full disk refused is not tried again when the file is closed
            self._file = open_regular(folder / EVENTS, "ab")
        except OSError as error:
            raise _cannot_write(folder, error) from error
        if not _lock(self._file.fileno()):
            self._file.close()
            raise RecordError(f"{folder}: another program is writing this run; wait for it or end it")

    @classmethod
    def create(
        cls,
        folder: Path,
        manifest: Manifest,
        inputs: dict[str, bytes],
        now: Callable[[], datetime],
        shield: Shield = nullcontext,
    ) -> Record:
        """Make the folder with its inputs, all on the disk before this returns.

        `inputs` are files by name. Raises `RecordError` when the folder exists or cannot be written.
        """
        manifest = {
            "format": FORMAT,
            "default_rule": DEFAULT_RULE,
            **manifest,
            "files": {name: sha256(content) for name, content in inputs.items()},
        }
        text = in_json(json.dumps(manifest, indent=1, ensure_ascii=False)).encode()
        _make_folder(folder, {**inputs, MANIFEST: text})
        record = cls(folder, now, shield)
        record._last_hash = sha256(text)
        return record

    @classmethod
    def reopen(
        cls, folder: Path, now: Callable[[], datetime], shield: Shield = nullcontext
    ) -> tuple[Record, History]:
        """Open a run to go on with it; a torn last line is cut off (and stands in the history's `torn`).

        Everything is read while no other program can write. Raises `RecordError` when one does, or when the
        record was changed.
        """
        if not (folder / MANIFEST).is_file():
            raise RecordError(f"{folder}: not a run (no {MANIFEST} in it)")
        record = cls(folder, now, shield)
        try:
            history = read_history(folder)
            if history.problems:
                raise RecordError(f"{folder}: the record cannot be trusted: {'; '.join(history.problems)}")
            record._go_on_after(history)
        except BaseException:
            record.close()
            raise
        return record, history

    def _go_on_after(self, history: History) -> None:
        """Take up where a history ends, which was read while this record held the file."""
        self.state = history.state
        self._last_hash, self._count, self._length = history.head, len(history.events), history.length
        if history.torn:
            self._cut_back()
            self._check_place()

    @property
    def count(self) -> int:
        """How many events were written, those of earlier programs included."""
        return self._count

    def append(self, kind: str, bench_s: float, /, **data: Any) -> Event:
        """Write one event; in the file, and save for those of `WITH_THE_NEXT` on the disk, when this returns.

        Raises `RecordError` (disk full, …), and `ValueError` for an event that cannot follow on the state.
        """
        with self._shield():
            return self._append(kind, bench_s, data)

    def _append(self, kind: str, bench_s: float, data: dict[str, Any]) -> Event:
        state = state_after_one(self.state, kind)
        if self._half_written:
            self._cut_back()
        self._check_place()
        event = Event(self._count + 1, self._now().isoformat(), bench_s, kind, data)
        whole_event = {**event.to_json(), "prev": self._last_hash}
        line = in_json(json.dumps(whole_event, ensure_ascii=False, allow_nan=False)).encode()
        try:
            self._write(line + b"\n")
            if kind not in WITH_THE_NEXT:
                os.fsync(self._file.fileno())
        except OSError as error:
            self._cut_back()
            raise _cannot_write(self.folder, error) from error
        self._last_hash = sha256(line)
        self._length += len(line) + 1
        self._count, self.state = event.number, state
        return event

    def _check_place(self) -> None:
        """Raise `RecordError` where what is written would be lost, or would break another's chain."""
        found = os.fstat(self._file.fileno())
        if self._half_written:
            raise RecordError(f"{self.folder}: a half-written line cannot be cut off; free the disk")
        if not found.st_nlink:
            raise RecordError(f"{self.folder}: was deleted while the run went on; what it recorded is lost")
        if found.st_size != self._length:
            raise RecordError(
                f"{self.folder}: another program has written into {EVENTS}; nothing more is recorded, and "
                f"'bench show {self.folder.name} --verify' tells whether it is whole"
            )

    def whereabouts(self) -> Path | None:
        """Return the folder that the record stands in by now, as it may have been renamed; None if not found.

        It is looked for by its file, where it was and among the runs beside it.
        """
        own = os.fstat(self._file.fileno())
        with suppress(OSError):
            for folder in (self.folder, *sorted(self.folder.parent.iterdir())):
                with suppress(OSError):
                    if os.path.samestat(own, (folder / EVENTS).stat()):
                        return folder
        return None

    def close(self) -> None:
        """Let the file go."""
        self._file.close()

    def _write(self, data: bytes) -> None:
        """Write all of it: an unbuffered file may take a part only."""
        while data:
            data = data[self._file.write(data) :]

    def _cut_back(self) -> None:
        """Remove a half-written line, so that the record stays whole."""
        try:
            os.ftruncate(self._file.fileno(), self._length)
        except OSError:
            self._half_written = True  # it is tried again before the next line, and at the next opening
        else:
            self._half_written = False


LOOKS: Final = 10_000
"""How often a writer looks whether those who only look at the file have let it go."""


def _lock(descriptor: int) -> bool:
    """Hold the file against a second writer; say whether it is held, or no such locks are to be had (Windows).

    Whoever only looks whether the run is being written holds the file, shared, for a moment, and is no writer.
    """
    try:
        import fcntl
    except ImportError:
        return True
    for _ in range(LOOKS):
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            if not _shared(descriptor):
                return False
            fcntl.flock(descriptor, fcntl.LOCK_UN)
        else:
            return True
    return False


def _shared(descriptor: int) -> bool:
    """Hold the file together with others that look at it; false where a writer has it."""
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def is_being_written(folder: Path) -> bool:
    """Whether a program is carrying out this run now; the file is opened for reading only.

    Always false where the system has no file locks.
    """
    try:
        with open_regular(folder / EVENTS) as file:
            return not _shared(file.fileno())
    except (OSError, ImportError):
        return False


def _make_folder(folder: Path, files: dict[str, bytes]) -> None:
    """Make a folder with its files, there whole or not at all. Raises `RecordError`."""
    part: Path | None = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        _refuse_taken(folder)
        part = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        for name, content in files.items():
            _write_durably(part / name, content)
        part.chmod(0o755)
        part.rename(folder)
    except OSError as error:
        _refuse_taken(folder)  # another program has made it meanwhile
        raise _cannot_write(folder, error) from error
    finally:
        if part is not None:
            shutil.rmtree(part, ignore_errors=True)


def _refuse_taken(folder: Path) -> None:
    if os.path.lexists(folder):
        if (folder / MANIFEST).is_file():
            raise RecordError(f"{folder}: there is a run of that name; choose another with --name")
        raise RecordError(f"{folder}: there is a file or folder of that name; choose another with --name")


def _write_durably(path: Path, content: bytes) -> None:
    with path.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _cannot_write(folder: Path, error: OSError) -> RecordError:
    remedy = "free the disk, or " if error.errno in _FULL else ""
    return RecordError(
        f"{folder}: cannot be written ({error.strerror or error}); what was recorded before is kept; "
        f"{remedy}choose another folder with --runs"
    )
