"""Reads the events of a record as they are written: whole lines alone, each once."""

from __future__ import annotations

from collections.abc import Iterator
from io import SEEK_END
from pathlib import Path
from typing import Final

from bench.base.collecting import uncollected
from bench.base.regular import open_regular
from bench.run.events import Event, EventType
from bench.run.history import parse_line
from bench.run.manifest import EVENTS, RecordError

KEPT_LINES, KEPT_BYTES = 100, 1 << 20
"""Near its two ends all of a record is read; between them the beginnings of steps tell nothing any more."""

HEAD: Final = 160
_BEGUN: Final = f'"type": "{EventType.STEP_STARTED}"'.encode()
"""Stands before everything that a person or an instrument says."""


class Tail:
    """The events of a run from the first on. Half a line waits until it is whole, or cut off."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / EVENTS
        self._read = 0
        self._count = 0

    def grown(self) -> bool:
        """Say whether there is something that was not read yet; a record that was cut back counts as that,
        too."""
        try:
            return self._path.stat().st_size != self._read
        except OSError:
            return False

    def new(self) -> Iterator[Event]:
        """Return the events written since the last call, of a long record without the beginnings of old steps.

        Raises `RecordError` where the record is not one that has only grown.
        """
        try:
            with open_regular(self._path) as file, uncollected():
                size = file.seek(0, SEEK_END)
                if size < self._read:
                    raise RecordError(f"{self._path}: is shorter than it was; another program changed it")
                file.seek(self._read)
                for line in file:
                    if not line.endswith(b"\n"):
                        return
                    if self._count > KEPT_LINES and size - self._read > KEPT_BYTES and _BEGUN in line[:HEAD]:
                        self._count, self._read = self._count + 1, self._read + len(line)
                        continue
                    yield self._event(line)
        except FileNotFoundError:
            return
        except OSError as error:
            raise RecordError(
                f"{self._path}: cannot be read ({error.strerror}); see that it is there"
            ) from error

    def _event(self, line: bytes) -> Event:
        try:
            event, _ = parse_line(line)
        except ValueError as error:
            raise self._broken() from error
        if event.number != self._count + 1:
            raise self._broken()
        self._count, self._read = event.number, self._read + len(line)
        return event

    def _broken(self) -> RecordError:
        return RecordError(
            f"{self._path}, line {self._count + 1}: cannot be believed; 'bench show RUN --verify' says more"
        )
