"""The course of a batch: rows as they come, gathered into parts, until none is left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

from bench.base.progress import tracked
from bench.batch.columns import Row
from bench.batch.store import Progress, Store
from drivers.clock import Clock, SystemClock

PART_ROWS: Final = 256
"""A part has so many rows at most: what a program that is killed may lose, and memory holds."""
PART_S: Final = 10.0
"""A part is written at the first row that comes so long after the last part."""

Computed = Callable[[Iterator[str]], Iterator[Row]]
"""Gives the rows of runs in any order: by processes, or by a cluster."""


@dataclass
class Course:
    """Rows that belong to no part yet, and where parts are written."""

    store: Store
    command: str
    clock: Clock = field(default_factory=SystemClock)
    _rows: list[Row] = field(default_factory=list)
    _since_s: float = 0.0

    def carry_out(self, progress: Progress, computed: Computed) -> None:
        """Compute what is pending; unless the program is killed, each row that came is in a part at the end."""
        self._since_s = self.clock.now_s()
        rows = computed(iter(progress.pending))
        try:
            for row in tracked(rows, "runs", len(progress.pending)):
                self._take(row | {"fingerprint": progress.pending[row["run"]]})
        finally:
            self._write()
            if isinstance(rows, Iterator) and hasattr(rows, "close"):
                rows.close()

    def _take(self, row: Row) -> None:
        self._rows.append(row)
        if len(self._rows) >= PART_ROWS or self.clock.now_s() - self._since_s >= PART_S:
            self._write()

    def _write(self) -> None:
        if self._rows:
            self.store.write_part(self.command, self._rows)
        self._rows.clear()
        self._since_s = self.clock.now_s()
