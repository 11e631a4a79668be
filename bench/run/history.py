"""The events of a run read back, one after the other: the chain of hashes is checked, and what they say is kept.

A record may hold many thousands of readings with all their samples. It is gone through once, and of a line no more
is kept than what going on with the run and evaluating it need.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256 as digest_of
from itertools import islice
from pathlib import Path
from typing import BinaryIO, Final, overload

from bench.base.computing import uncollected
from bench.base.files import open_regular, read_json, read_regular
from bench.readings.reading import Reading
from bench.run.events import Event, EventType, Levelled
from bench.run.manifest import EVENTS, MANIFEST, RecordError, changed_inputs, sha256
from bench.run.resume import Progress
from bench.run.states import RunState, state_after_one


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
    progress: Progress
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
        self._progress = Progress()
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
