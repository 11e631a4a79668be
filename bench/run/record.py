"""A run on disk: an append-only hash chain of events. Each event is on disk before the next step begins.

A record may hold many thousands of readings with all their samples. The file is read once, and only the parts of
each line that resuming and evaluation need are kept in memory.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from datetime import datetime
from hashlib import sha256 as digest_of
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, Final

from bench.base.computing import uncollected
from bench.base.files import DISK_FULL, open_regular, read_json, read_regular, sync_folder, write_synced
from bench.base.languages import message
from bench.base.text import as_typed, cause_of, in_json
from bench.config.procedure.plan import Plan, Read, Turn
from bench.readings.table import Reading
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


class Events:
    """The valid events of a record, parsed from the file at each iteration; `last` is the last one, or None."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.last: Event | None = None

    def __len__(self) -> int:
        return 0 if self.last is None else self.last.number

    def __iter__(self) -> Iterator[Event]:
        if self.last is None:
            return
        with open_regular(self._path) as file:
            for line in islice(file, self.last.number):
                yield parse_line(line)[0]

    @property
    def last_s(self) -> float:
        """The bench time of the last event, s; 0 without events."""
        return 0.0 if self.last is None else self.last.bench_s


@dataclass
class History:
    """The content of a run's record, and the problems found in it.

    `problems` are sentences about the file; `torn` is an incomplete last line. `head` is the SHA-256 of the last
    complete line, which identifies all lines so far; `length` is their size in bytes. `taken` holds (step, reading
    without samples) in the order of measurement, and None for each `remounted` event. `identities` and `serials`
    are the instruments' identities and serial numbers at the start of the run; `serials` is empty if certificates
    are not checked. `levelled` holds (bench time, levelling result), and `power` holds (bench time, state of the
    block's supply: "on", "found on", "off" or "fault"). `remounts` counts the unplanned mountings before the last
    reading of each step. Events after an invalid line are left out of all fields.
    """

    events: Events
    head: str
    length: int = 0
    problems: tuple[str, ...] = ()
    torn: str = ""
    state: RunState = RunState.READY
    progress: PlanProgress = field(default_factory=PlanProgress)
    taken: list[tuple[int, Reading] | None] = field(default_factory=list)
    identities: dict[str, str] = field(default_factory=dict)
    serials: dict[str, str] = field(default_factory=dict)
    levelled: list[tuple[float, Levelled]] = field(default_factory=list)
    power: list[tuple[float, str]] = field(default_factory=list)
    remounts: dict[int, int] = field(default_factory=dict)

    def not_repaired(self) -> tuple[list[Event], list[Event]]:
        """Return the early signs whose reading at fault was not repeated, and the decisions to continue there."""
        steps: dict[tuple[int, str, int, int], int] = {}
        found: list[tuple[int, Event]] = []  # each with the step of the reading at fault
        for event in self.events if self.progress.signs else ():
            if event.type == EventType.STEP_DONE and event.data.get("reading") and (one := event.reading):
                steps[one.place] = event.step
                found = [kept for kept in found if kept[0] != event.step]
            elif event.type == EventType.EARLY_SIGN:
                wrong = event.data.get("wrong")
                found.append((steps.get(tuple(wrong), event.step) if wrong else event.step, event))
            elif event.type == EventType.WENT_ON:
                doubt = next((at for at, sign in reversed(found) if sign.data.get("confident")), event.step)
                found.append((doubt, event))
        signs, overruled = (
            [event for _, event in found if event.type == kind]
            for kind in (EventType.EARLY_SIGN, EventType.WENT_ON)
        )
        return signs, overruled

    @property
    def readings(self) -> dict[int, Reading]:
        """The readings by step in the order of measurement, without samples; of a repeated step, only the last.

        A reading that a person asked to repeat no longer counts, even if the repetition has not been taken.
        """
        by_step: dict[int, Reading] = {}
        for one in self.taken:
            if one is not None and one[0] in self.progress.done:
                step, reading = one
                by_step.pop(step, None)
                by_step[step] = reading
        return by_step


@uncollected()
def read_history(folder: Path) -> History:
    """Read the record of a run, and check its hash chain and the inputs' hashes. Raises `RecordError`."""
    problems = changed_inputs(folder)
    path = folder / EVENTS
    history = History(Events(path), sha256(read_regular(folder / MANIFEST)))
    try:
        if path.exists():
            with open_regular(path) as file:
                problems += _Reader(history).read(file)
    except OSError as error:
        raise RecordError(
            f"{path}: cannot be read ({error.strerror}); check its permissions, or restore it from a copy of the "
            "run"
        ) from error
    history.problems = tuple(problems)
    return history


def trusted(history: History, folder: Path) -> History:
    """Return the history of a run. Raises `RecordError` if a line of the record or an input was changed."""
    if history.problems:
        problems = "; ".join(history.problems)
        raise RecordError(f"{folder}: the record cannot be trusted; restore it from a copy: {problems}")
    return history


class _Reader:
    """Reader of a record's lines into a history, up to the first invalid line."""

    def __init__(self, history: History) -> None:
        self._history = history
        self._opened = False
        self._remounts = 0

    def read(self, file: BinaryIO) -> list[str]:
        """Read the lines; return a list with one sentence on the first invalid line, or an empty list."""
        for line in file:
            if not line.endswith(b"\n"):
                self._history.torn = line.decode(errors="replace")
                break
            if why := self._take(line):
                return [f"{EVENTS}, line {len(self._history.events) + 1}: {why}"]
        return []

    def _take(self, line: bytes) -> str:
        """Read one line; return a description of its fault, or an empty string."""
        try:
            event, previous = parse_line(line)
        except ValueError:
            return "not an event"
        history = self._history
        if previous != history.head or event.number != len(history.events) + 1:
            return "the chain is broken here (a line was changed or removed)"
        try:
            self._note(event)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            return f"not an event that can follow here ({cause_of(error)})"
        history.head = digest_of(line[:-1]).hexdigest()
        history.length += len(line)
        history.events.last = event
        return ""

    def _note(self, event: Event) -> None:
        history = self._history
        history.state = state_after_one(history.state, event.type)
        history.progress.take(event)
        if event.type == EventType.STEP_DONE:
            if "reading" in event.data and (reading := event.reading) is not None:
                history.taken.append((event.step, reading))
                history.remounts[event.step] = self._remounts
            elif isinstance(event.result, Levelled):
                history.levelled.append((event.bench_s, event.result))
        elif event.type == EventType.POWER:
            history.power.append((event.bench_s, str(event.data["power"])))
        elif event.type == EventType.REMOUNTED:
            history.taken.append(None)
            self._remounts += "why" not in event.data  # after a loss of power the block is still mounted
        elif event.type in _OPENED and not self._opened:
            self._opened = True
            history.identities = dict(history.progress.identities)
            history.serials = {
                str(name): str(serial) for name, serial in event.data.get("serials", {}).items()
            }


_OPENED: Final = frozenset({EventType.RUN_STARTED, EventType.RUN_RESUMED})


def parse_line(line: bytes) -> tuple[Event, str]:
    """Return the event in a line, and the hash that it states for the previous line.

    Raises `ValueError` for a line that is not a valid event.
    """
    try:
        data = read_json(line)
        previous = data.pop("prev")
        return Event.from_json(data), str(previous)
    except (KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise ValueError(str(error)) from error


# --- where to resume --------------------------------------------------------------------------------


@dataclass(frozen=True)
class ResumePoint:
    """Where a run is resumed: at step `step`, after a repetition of the turn at step `turn`, if any.

    `bench_s` is the bench time, s, at which `step` was last begun, or the bench time of the last event if the
    step was never begun.
    """

    step: int
    bench_s: float
    turn: int | None = None


def resume_point(plan: Plan, history: History) -> ResumePoint:
    """Return the point at which a run is resumed; `step` is `len(plan.steps)` when nothing is left to do.

    If the run stopped within a point that lacks a reading, the head may have been moved since. Therefore the turn
    to this point is repeated, then the steps after the last finished reading of the point. Finished readings are
    never repeated. Raises `RecordError` if the record mentions steps that the plan lacks.
    """
    progress = history.progress
    known = progress.done | progress.skipped | progress.left_out
    if beyond := [step for step in known if step >= len(plan.steps)]:
        raise RecordError(
            f"the record has step {max(beyond) + 1}, and the plan has {len(plan.steps)}: "
            "they belong to different runs; restore both from a copy of the run"
        )
    last_s = history.events.last_s
    step = next((i for i in range(len(plan.steps)) if not progress.settled(i)), len(plan.steps))
    turn = turn_before(plan, step, progress.left_out)
    if turn == step or not _reading_is_open(plan, step):
        return ResumePoint(step, progress.begun_s.get(step, last_s))
    taken = [i for i in range(turn, step) if isinstance(plan.steps[i], Read)]
    step = max(taken, default=turn) + 1
    return ResumePoint(step, progress.begun_s.get(step, last_s), turn)


def _reading_is_open(plan: Plan, step: int) -> bool:
    """Return whether `step` lies within a point that still lacks a reading."""
    if step == len(plan.steps) or isinstance(plan.steps[step], Turn | ENDS_A_POINT):
        return False
    return any(isinstance(later, Read) for later in plan.steps[step : end_of_point(plan, step)])


WITH_THE_NEXT: Final = frozenset(
    {EventType.STEP_STARTED, EventType.ASKED, EventType.ANSWERED, EventType.ANSWER_REFUSED}
)
"""Events that are not forced to disk at once; they are flushed together with the next event."""

Shield = Callable[[], AbstractContextManager[None]]


class Record:
    """The writer of a run's events; a lock admits only one writing program at a time.

    `state` is the state of the run; events that are invalid in this state are rejected. `count` is the number of
    events in the record, including events of earlier programs. `shield` returns a context in which no signal
    interrupts the program.
    """

    def __init__(self, folder: Path, now: Callable[[], datetime], shield: Shield = nullcontext) -> None:
        self.folder = folder
        self.state = RunState.READY
        self._now = now
        self._shield = shield
        self._last_hash, self.count, self._length = "", 0, 0
        self._half_written = False
        try:
            # unbuffered, so that closing the file does not retry a write that a full disk refused
            self._file = open_regular(folder / EVENTS, "ab")
        except OSError as error:
            raise cannot_write(folder, error) from error
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
        """Create the run's folder with its inputs, force all to disk, and return the run's record.

        `inputs` holds the files' contents by name. Raises `RecordError` if the folder exists or cannot be written.
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
        for named in (folder, folder.parent):
            with suppress(OSError):  # some network drives cannot
                sync_folder(named)
        record._last_hash = sha256(text)
        return record

    @classmethod
    def reopen(
        cls, folder: Path, now: Callable[[], datetime], shield: Shield = nullcontext
    ) -> tuple[Record, History]:
        """Open a run to continue it; return its record and history. An incomplete last line is removed.

        The history is read under the lock and keeps the removed line in `torn`. Raises `RecordError` if another
        program is writing the run, or if the record was changed.
        """
        if not (folder / MANIFEST).is_file():
            raise RecordError(f"{folder}: not a run (no {MANIFEST} in it); 'bench runs' lists the runs")
        record = cls(folder, now, shield)
        try:
            history = trusted(read_history(folder), folder)
            record._go_on_after(history)
        except BaseException:
            record.close()
            raise
        return record, history

    def _go_on_after(self, history: History) -> None:
        """Continue after the last event of `history`, which was read while this record held the file's lock."""
        self.state = history.state
        self._last_hash, self.count, self._length = history.head, len(history.events), history.length
        if history.torn:
            self._cut_back()
            self._check_place()

    def append(self, kind: str, bench_s: float, /, **data: Any) -> Event:
        """Write one event and return it.

        On return the event is on disk, except for types in `WITH_THE_NEXT`: the next event forces them to disk.
        Raises `RecordError` (disk full, …), or `ValueError` for an event that is invalid in the present state.
        """
        with self._shield():
            state = state_after_one(self.state, kind)
            if self._half_written:
                self._cut_back()
            self._check_place()
            event = Event(self.count + 1, self._now().isoformat(), bench_s, kind, data)
            whole_event = {**event.to_json(), "prev": self._last_hash}
            line = in_json(json.dumps(whole_event, ensure_ascii=False, allow_nan=False)).encode()
            try:
                self._write(line + b"\n")
                if kind not in WITH_THE_NEXT:
                    os.fsync(self._file.fileno())
            except OSError as error:
                self._cut_back()
                raise cannot_write(self.folder, error) from error
            self._last_hash = sha256(line)
            self._length += len(line) + 1
            self.count, self.state = event.number, state
            return event

    def _check_place(self) -> None:
        """Raise `RecordError` if the next line would be lost, or would break the hash chain of another program."""
        found = os.fstat(self._file.fileno())
        if self._half_written:
            raise RecordError(f"{self.folder}: a half-written line cannot be cut off; free disk space")
        if not found.st_nlink:
            raise RecordError(
                f"{self.folder}: was deleted during the run, and its readings are lost; run it again"
            )
        if found.st_size != self._length:
            raise RecordError(
                f"{self.folder}: another program wrote into {EVENTS}; recording ended; check it with "
                f"'bench show {as_typed(self.folder)} --verify'"
            )

    def whereabouts(self) -> Path | None:
        """Return the present folder of the record, which may have been renamed; None if it is not found.

        The record's open file is compared with the files at the old path and in the neighbouring folders.
        """
        own = os.fstat(self._file.fileno())
        with suppress(OSError):
            for folder in (self.folder, *sorted(self.folder.parent.iterdir())):
                with suppress(OSError):
                    if os.path.samestat(own, (folder / EVENTS).stat()):
                        return folder
        return None

    def close(self) -> None:
        """Close the file and release its lock."""
        self._file.close()

    def _write(self, data: bytes) -> None:
        """Write all bytes; an unbuffered file may accept only a part at once."""
        while data:
            data = data[self._file.write(data) :]

    def _cut_back(self) -> None:
        """Remove an incomplete last line, so that the record stays valid."""
        try:
            os.ftruncate(self._file.fileno(), self._length)
        except OSError:
            self._half_written = True  # retried before the next line and at the next opening
        else:
            self._half_written = False


HAS_LOCKS: Final = find_spec("fcntl") is not None
"""Whether the system has file locks; Windows has none."""
LOOKS: Final = 10_000
"""Number of attempts at the exclusive lock while other programs hold the shared lock."""


def _lock(descriptor: int) -> bool:
    """Lock the file against a second writer; return False if another writer holds the lock.

    Always return True on systems without file locks. A shared lock does not indicate a writer: programs
    hold it briefly to check whether the run is being written.
    """
    if not HAS_LOCKS:
        return True
    import fcntl

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
    """Acquire a shared lock on the file; return False if a writer holds the exclusive lock."""
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def is_being_written(folder: Path) -> bool:
    """Return whether a program is carrying out this run now; a lock on the record's file shows it.

    Always False on systems without file locks.
    """
    return is_locked(folder / EVENTS)


def is_locked(path: Path) -> bool:
    """Return whether a program holds the lock of a file; always False on systems without file locks."""
    with suppress(OSError):
        if HAS_LOCKS:
            with open_regular(path) as file:
                return not _shared(file.fileno())
    return False


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of a file that exists, which may be replaced; a killed program's lock is released."""
    if not HAS_LOCKS:  # there, an open file cannot be replaced
        yield
        return
    with open_regular(path) as file:
        _lock(file.fileno())
        yield


def _make_folder(folder: Path, files: dict[str, bytes]) -> None:
    """Create a folder with its files, either completely or not at all. Raises `RecordError`."""
    part: Path | None = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        _refuse_taken(folder)
        part = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        for name, content in files.items():
            write_synced(part / name, content)
        part.chmod(0o755)
        part.rename(folder)
    except OSError as error:
        _refuse_taken(folder)  # another program may have created it meanwhile
        place = "free disk space, or " if error.errno in DISK_FULL else ""
        raise RecordError(
            f"{folder}: cannot be written ({error.strerror or error}); {place}choose another folder with --runs"
        ) from error
    finally:
        if part is not None:
            shutil.rmtree(part, ignore_errors=True)


def _refuse_taken(folder: Path) -> None:
    if os.path.lexists(folder):
        if (folder / MANIFEST).is_file():
            raise RecordError(f"{folder}: a run of that name exists; choose another with --name")
        raise RecordError(f"{folder}: a file or folder of that name exists; choose another with --name")


def cannot_write(folder: Path, error: OSError) -> RecordError:
    """Return the error of a run's folder that cannot be written, with its remedy."""
    remedy = message("free disk space") if error.errno in DISK_FULL else message("make the folder writable")
    if error.errno == errno.EFBIG:
        remedy = message("raise the limit of a file's size")
    return RecordError(
        f"{folder}: cannot be written ({error.strerror or error}); what was recorded is kept; {remedy}, then "
        "continue"
    )
