"""A run on disk: an append-only chain of events, all on the disk before the next step; and read back.

A record may hold many thousands of readings with all their samples. It is read once, and of a line no more is kept
than resuming the run and evaluating it need.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from datetime import datetime
from hashlib import sha256 as digest_of
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, Final, overload

from bench.base.computing import uncollected
from bench.base.files import open_regular, read_json, read_regular
from bench.base.text import in_json
from bench.config.procedure.plan import Plan, Read, Turn
from bench.readings.reading import Reading
from bench.run.events import (
    DEFAULT_RULE,
    EVENTS,
    FORMAT,
    MANIFEST,
    Event,
    EventType,
    Levelled,
    Manifest,
    RecordError,
    RunState,
    changed_inputs,
    sha256,
    state_after_one,
)
from bench.run.resume import ENDS_A_POINT, PlanProgress, end_of_point, turn_before


class Events(Sequence[Event]):
    """The events that were found good, read from the file each time that they are gone through."""

    def __init__(self, path: Path, count: int, last: Event | None) -> None:
        self._path, self._count, self._last = path, count, last

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Event]:
        if not self._count:
            return
        with open_regular(self._path) as file:
            for line in islice(file, self._count):
                yield parse_line(line)[0]

    @overload
    def __getitem__(self, index: int) -> Event: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[Event]: ...

    def __getitem__(self, index: int | slice) -> Event | Sequence[Event]:
        if index == -1 and self._last is not None:
            return self._last
        return tuple(self)[index]


@dataclass(frozen=True)
class History:
    """What the events of a run say, what is wrong with the file in sentences, and `torn`, a half-written last line.

    `head` is the SHA-256 of the last whole line, which stands for all before it, `length` the bytes up to there.
    `taken` are readings and the marks of a mounting in the middle of a run, in the order of measurement, without
    their samples; `identities` those of the instruments when the run was begun, `serials` their serial numbers
    where the bench has certificates; `levelled` what the level showed, with the bench time. What follows on a line
    that cannot be believed is left out of everything.
    """

    events: Events
    head: str
    length: int
    problems: tuple[str, ...]
    torn: str
    state: RunState
    progress: PlanProgress
    taken: tuple[tuple[int, Reading] | None, ...]
    identities: dict[str, str]
    serials: dict[str, str]
    levelled: tuple[tuple[float, Levelled], ...] = ()

    @property
    def readings(self) -> dict[int, Reading]:
        """The readings by step, in the order of measurement; of a step taken again the last. Without samples."""
        by_step: dict[int, Reading] = {}
        for one in self.taken:
            if one is not None:
                step, reading = one
                by_step.pop(step, None)
                by_step[step] = reading
        return by_step


@uncollected()
def read_history(folder: Path) -> History:
    """Read the events of a run and check the chain of hashes and the inputs' hashes. Raises `RecordError`."""
    problems = changed_inputs(folder)
    path = folder / EVENTS
    reader = _Reader(sha256(read_regular(folder / MANIFEST)))
    try:
        if path.exists():
            with open_regular(path) as file:
                problems += reader.read(file)
    except OSError as error:
        raise RecordError(
            f"{path}: cannot be read ({error.strerror}); take it from a copy of the run"
        ) from error
    return reader.history(path, problems)


class _Reader:
    """Goes through the lines of a record, as long as they can be believed."""

    def __init__(self, manifest_sha256: str) -> None:
        self._head, self._length, self._torn = manifest_sha256, 0, ""
        self._count = 0
        self._last: Event | None = None
        self._state = RunState.READY
        self._progress = PlanProgress()
        self._taken: list[tuple[int, Reading] | None] = []
        self._identities: dict[str, str] | None = None
        self._serials: dict[str, str] = {}
        self._levelled: list[tuple[float, Levelled]] = []

    def read(self, file: BinaryIO) -> list[str]:
        """Take the lines; return what is wrong with the first that cannot be believed."""
        for line in file:
            if not line.endswith(b"\n"):
                self._torn = line.decode(errors="replace")
                break
            if why := self._take(line):
                return [f"{EVENTS}, line {self._count + 1}: {why}"]
        return []

    def _take(self, line: bytes) -> str:
        """Take a line, or return what is wrong with it."""
        try:
            event, previous = parse_line(line)
        except ValueError:
            return "not an event"
        if previous != self._head or event.number != self._count + 1:
            return "the chain is broken here (a line was changed or removed)"
        try:
            self._note(event)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            return f"not an event that can follow here ({error})"
        self._head = digest_of(line[:-1]).hexdigest()
        self._length += len(line)
        self._count, self._last = event.number, event
        return ""

    def _note(self, event: Event) -> None:
        """Keep what an event says."""
        self._state = state_after_one(self._state, event.type)
        self._progress.take(event)
        if event.type == EventType.STEP_DONE:
            if "reading" in event.data and (reading := event.reading) is not None:
                self._taken.append((event.step, reading))
            elif isinstance(event.result, Levelled):
                self._levelled.append((event.bench_s, event.result))
        elif event.type == EventType.REMOUNTED:
            self._taken.append(None)
        elif event.type in _OPENED and self._identities is None:
            self._identities = dict(self._progress.identities)
            self._serials = {str(name): str(serial) for name, serial in event.data.get("serials", {}).items()}

    def history(self, path: Path, problems: list[str]) -> History:
        """Return what was taken."""
        return History(
            events=Events(path, self._count, self._last),
            head=self._head,
            length=self._length,
            problems=tuple(problems),
            torn=self._torn,
            state=self._state,
            progress=self._progress,
            taken=tuple(self._taken),
            identities=self._identities or {},
            serials=self._serials,
            levelled=tuple(self._levelled),
        )


_OPENED: Final = frozenset({EventType.RUN_STARTED, EventType.RUN_RESUMED})


def parse_line(line: bytes) -> tuple[Event, str]:
    """Return the event of a line and the hash that it gives for the line before.

    Raises `ValueError` for what is no event, and for one that no bench writes.
    """
    try:
        data = read_json(line)
        previous = data.pop("prev")
        return Event.from_json(data), str(previous)
    except (KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise ValueError(str(error)) from error


# --- where to go on ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class ResumePoint:
    """Where to go on: `step` is the next one to do, `turn` the turn to make again before it, if any.

    `bench_s` is the bench time (s since the run began) at which `step` was last begun.
    """

    step: int
    bench_s: float
    turn: int | None = None


def resume_point(plan: Plan, history: History) -> ResumePoint:
    """Find where to go on.

    Between a turn and the readings of its point the head may have been moved: the turn is made again, and
    with it what stands between the last reading taken and the next. Readings taken are never repeated.
    `step` is `len(plan.steps)` when nothing is left to do. Raises `RecordError` for steps that the plan lacks.
    """
    progress = history.progress
    known = progress.done | progress.skipped | progress.left_out
    if beyond := [step for step in known if step >= len(plan.steps)]:
        raise RecordError(
            f"the record tells of step {max(beyond) + 1}, and the plan has {len(plan.steps)}: "
            "they are not of one run; take both from a copy of it"
        )
    last_s = history.events[-1].bench_s if history.events else 0.0
    step = next((i for i in range(len(plan.steps)) if not progress.settled(i)), len(plan.steps))
    turn = turn_before(plan, step, progress.left_out)
    if turn == step or not _reading_is_open(plan, step):
        return ResumePoint(step, progress.begun_s.get(step, last_s))
    taken = [i for i in range(turn, step) if isinstance(plan.steps[i], Read)]
    step = max(taken, default=turn) + 1
    return ResumePoint(step, progress.begun_s.get(step, last_s), turn)


def _reading_is_open(plan: Plan, step: int) -> bool:
    """Whether `step` lies within a point of which a reading is still to come."""
    if step == len(plan.steps) or isinstance(plan.steps[step], Turn | ENDS_A_POINT):
        return False
    return any(isinstance(later, Read) for later in plan.steps[step : end_of_point(plan, step)])


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
