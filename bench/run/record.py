"""A run on disk: inputs first, then one append-only file of events, each on the disk before the next step.

Every line of `events.jsonl` is a JSON object that carries, in `prev`, the SHA-256 of the line before it (of
`run.json` for the first), so that a changed or missing line is found. Everything else in the folder is
derived from these and can be made again.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final, TypedDict, cast

from bench.readings.reading import Reading
from bench.run.events import Event
from bench.run.states import RunState, state_after

EVENTS: Final = "events.jsonl"
MANIFEST: Final = "run.json"
FORMAT: Final = 1

Shield = Callable[[], AbstractContextManager[None]]


class UnitUnderTest(TypedDict):
    """The block that a run measures."""

    type: str
    serial: str


class Manifest(TypedDict, total=False):
    """What a run was begun with (`run.json`), in this order; `files` are the SHA-256 of the inputs by name.

    `seed` is None for a run on real instruments. A run of a readings file (`imported`) says how many
    `readings` that has, and nothing of a procedure. `bench_why` says why that bench file was taken. `devices` says
    where those drivers came from that are none of the bench's own, and is left out where there are none.
    """

    format: int
    name: str
    created: str
    imported: str
    readings: int
    dry_run: bool
    seed: int | None
    operator: str
    procedure: str
    bench: str
    bench_why: str
    plan_hash: str
    unit_under_test: UnitUnderTest
    versions: dict[str, str]
    devices: dict[str, str]
    files: dict[str, str]


class RecordError(Exception):
    """A run folder that cannot be written or believed; the text says where, why and what to do."""


@dataclass(frozen=True)
class History:
    """The events of a run, what is wrong with the file (sentences), and a half-written last line (`torn`)."""

    events: tuple[Event, ...]
    problems: tuple[str, ...]
    torn: str = ""

    @property
    def readings(self) -> dict[int, Reading]:
        """The readings by step, in the order of measurement; of a step taken again the last."""
        by_step: dict[int, Reading] = {}
        for event in self.events:
            if (reading := event.reading) is not None:
                by_step.pop(event.step, None)
                by_step[event.step] = reading
        return by_step

    @property
    def state(self) -> RunState:
        """What became of the run; "running" and "paused" also stand for one whose program died."""
        return state_after([event.type for event in self.events])


def sha256(data: bytes) -> str:
    """Return the SHA-256 of bytes in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


class Record:
    """The writer of a run's events. One program writes a run at a time.

    `shield` makes a context within which no signal interrupts the program.
    """

    def __init__(
        self,
        folder: Path,
        last_hash: str,
        count: int,
        now: Callable[[], datetime],
        shield: Shield = nullcontext,
    ) -> None:
        self.folder = folder
        self._now = now
        self._shield = shield
        self._last_hash = last_hash
        self._count = count
        try:
            # unbuffered: what a full disk refused is not tried again when the file is closed
            self._file = (folder / EVENTS).open("ab", buffering=0)
        except OSError as error:
            raise _cannot_write(folder, error) from error
        try:
            _lock(self._file.fileno())
        except OSError as error:
            self._file.close()
            raise RecordError(
                f"{folder}: another program is writing this run; wait for it or end it"
            ) from error

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
            **manifest,
            "files": {name: sha256(content) for name, content in inputs.items()},
        }
        text = json.dumps(manifest, indent=1, ensure_ascii=False).encode()
        try:
            _make_folder(folder, {**inputs, MANIFEST: text})
        except OSError as error:
            raise _cannot_write(folder, error) from error
        return cls(folder, sha256(text), 0, now, shield)

    @classmethod
    def reopen(
        cls, folder: Path, now: Callable[[], datetime], shield: Shield = nullcontext
    ) -> tuple[Record, History]:
        """Open a run to go on with it; a torn last line is cut off (and stands in the history's `torn`).

        Raises `RecordError` when the record was changed.
        """
        history = read_history(folder)
        if history.problems:
            raise RecordError(f"{folder}: the record cannot be trusted: {'; '.join(history.problems)}")
        path = folder / EVENTS
        content = path.read_bytes() if path.exists() else b""
        whole = content[: content.rfind(b"\n") + 1]
        try:
            if len(whole) < len(content):
                os.truncate(path, len(whole))
        except OSError as error:
            raise _cannot_write(folder, error) from error
        lines = whole.split(b"\n")[:-1]
        last = sha256(lines[-1] if lines else (folder / MANIFEST).read_bytes())
        return cls(folder, last, len(lines), now, shield), history

    def append(self, kind: str, bench_s: float, **data: Any) -> Event:
        """Write one event; it is on the disk when this returns. Raises `RecordError` (disk full, …)."""
        with self._shield():
            return self._append(kind, bench_s, data)

    def _append(self, kind: str, bench_s: float, data: dict[str, Any]) -> Event:
        event = Event(self._count + 1, self._now().isoformat(), bench_s, kind, data)
        whole_event = {**event.to_json(), "prev": self._last_hash}
        line = json.dumps(whole_event, ensure_ascii=False, allow_nan=False).encode()
        whole = self._file.tell()
        try:
            self._write(line + b"\n")
            os.fsync(self._file.fileno())
        except OSError as error:
            self._cut_back(whole)
            raise _cannot_write(self.folder, error) from error
        self._last_hash = sha256(line)
        self._count = event.number
        return event

    def close(self) -> None:
        """Let the file go."""
        self._file.close()

    def _write(self, data: bytes) -> None:
        """Write all of it: an unbuffered file may take a part only."""
        while data:
            data = data[self._file.write(data) :]

    def _cut_back(self, length: int) -> None:
        """Remove a half-written line, so that the record stays whole."""
        try:
            os.ftruncate(self._file.fileno(), length)
        except OSError:
            return  # the line stays torn; it is found and cut off at the next opening


def _lock(descriptor: int) -> None:
    """Hold the file against a second writer, where the system has such locks (not on Windows)."""
    try:
        import fcntl
    except ImportError:
        return
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_being_written(folder: Path) -> bool:
    """Whether a program is carrying out this run now (always false where the system has no file locks)."""
    try:
        with (folder / EVENTS).open("ab") as file:
            _lock(file.fileno())
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


def _make_folder(folder: Path, files: dict[str, bytes]) -> None:
    """Make a folder with its files, there whole or not at all. Raises `OSError`, `RecordError`."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    if folder.exists():
        raise RecordError(f"{folder}: there is a run of that name; choose another with --name")
    part = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        for name, content in files.items():
            _write_durably(part / name, content)
        part.chmod(0o755)
        part.rename(folder)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def _write_durably(path: Path, content: bytes) -> None:
    with path.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _cannot_write(folder: Path, error: OSError) -> RecordError:
    return RecordError(
        f"{folder}: cannot be written ({error.strerror or error}); what was recorded before is kept; "
        "free the disk, or choose another folder with --runs"
    )


def read_manifest(folder: Path) -> Manifest:
    """Return the inputs' manifest of a run. Raises `RecordError` when there is none."""
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except OSError:
        raise RecordError(f"{folder}: not a run (no {MANIFEST} in it)") from None
    except ValueError:
        raise RecordError(f"{folder / MANIFEST}: damaged, not JSON; take it from a copy of the run") from None
    if not isinstance(manifest, dict) or not isinstance(manifest.get("files", {}), dict):
        raise RecordError(f"{folder / MANIFEST}: damaged, not a manifest; take it from a copy of the run")
    return cast(Manifest, manifest)


def read_history(folder: Path) -> History:
    """Read the events of a run and check the chain of hashes and the inputs' hashes."""
    problems = [
        f"{name} was changed since the run began"
        for name, digest in read_manifest(folder).get("files", {}).items()
        if not (folder / name).is_file() or sha256((folder / name).read_bytes()) != digest
    ]
    path = folder / EVENTS
    try:
        content = path.read_bytes() if path.exists() else b""
    except OSError as error:
        raise RecordError(
            f"{path}: cannot be read ({error.strerror}); take it from a copy of the run"
        ) from error
    end = content.rfind(b"\n") + 1
    torn = content[end:].decode(errors="replace")
    events = []
    previous = sha256((folder / MANIFEST).read_bytes())
    for number, line, event, prev in _parse(content[:end]):
        if event is None:
            problems.append(f"{EVENTS}, line {number}: not an event")
            break
        if prev != previous or event.number != number:
            problems.append(
                f"{EVENTS}, line {number}: the chain is broken here (a line was changed or removed)"
            )
            break
        events.append(event)
        previous = sha256(line)
    return History(tuple(events), tuple(problems), torn)


def _parse(content: bytes) -> Iterator[tuple[int, bytes, Event | None, str]]:
    for number, line in enumerate(content.split(b"\n")[:-1], start=1):
        try:
            data = json.loads(line)
            previous = str(data.pop("prev"))
            yield number, line, Event.from_json(data), previous
        except (ValueError, KeyError, TypeError, AttributeError):
            yield number, line, None, ""
