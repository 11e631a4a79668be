"""Mistakes that the early warning named while a run was measured, put right in a copy of its readings."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import Mask
from bench.diagnosis.mistakes.search import Mistake
from bench.readings.corrected import MistakeName
from bench.readings.table import Readings
from bench.run.causes import STOP_ALARM
from bench.run.early_warning import watcher_of
from bench.run.events import EventType
from bench.run.expectation import CABLINGS, EarlySign, Kind
from bench.run.folder import Run
from bench.services.source import Source

SAT_IN: Final = re.compile(r"the block sits in installation (\S+), not in (\S+)")
OF_ONE_READING: Final = frozenset({Kind.NOT_TURNED, Kind.NEXT_POINT, Kind.WRONG_WAY, Kind.SLIP})
NAMES: Final = {Kind.ROTATION: MistakeName.REVERSED_ROTATION, Kind.ORIENTATION: MistakeName.OTHER_MOUNTING}
LEAST_NAMED: Final = 2
"""So many readings of a mounting name the installation in which the block sat, before all are moved there."""


MOST_TOLD: Final = 3
"""Causes that are told at the end of a run."""


@dataclass(frozen=True)
class _Named:
    """A row of the table with the sign that it raised."""

    row: int
    sign: EarlySign


def put_right(source: Source) -> tuple[Readings, tuple[Mistake, ...]]:
    """Return the readings of a source with what the early warning named put right, and the mistakes.

    They come back as they are where nothing was told while they were taken.
    """
    run, readings = source.run, source.readings
    if run is None or run.imported or not run.history.progress.signs:
        return readings, ()
    named = _signs(source)
    if not named or len(readings) != len(run.history.readings):
        return readings, ()
    copy = _Copy(readings)
    by_mount: defaultdict[tuple[int, str], list[_Named]] = defaultdict(list)
    for one in named:
        by_mount[copy.mount(one.row)].append(one)
    mistakes = []
    for mount, told in by_mount.items():
        mistakes += copy.mend(mount, told)
    return copy.readings(), tuple(mistakes)


def told_in_words(run: Run) -> list[str]:
    """Return what the early warning told while a run was taken, and what a person went on with, in sentences."""
    if not run.history.progress.signs:
        return []
    named: Counter[str] = Counter()
    lines = []
    for event in run.history.events:
        if event.type == EventType.EARLY_SIGN:
            named.update(event.data["causes"][:1])
        elif event.type == EventType.WENT_ON:
            lines.append(f"gone on in spite of '{' or '.join(event.data['causes'])}': {event.data['reason']}")
    found = [
        f"the early warning named '{cause}' at {times} reading{'s' if times > 1 else ''}"
        for cause, times in named.most_common(MOST_TOLD)
    ]
    more = len(named) - len(found)
    found += [f"… and {more} other causes"] if more > 0 else []
    return [*found, *lines, f"'bench diagnose {run.name}' goes by what was named"] if found or lines else []


def _signs(source: Source) -> list[_Named]:
    """Go through the readings that stand again; return those that a mistake explains far beyond chance."""
    assert source.run is not None  # noqa: S101
    history = source.run.history
    watcher = watcher_of(source.run.plan, source.bench)
    bound = STOP_ALARM / max(len(history.readings), 1)
    rows = {reading.place: row for row, reading in enumerate(history.readings.values())}
    found: dict[int, EarlySign] = {}
    for row, reading in enumerate(history.readings.values()):
        for sign in watcher.take(reading):
            sure = sign.p < bound and sign.kinds and set(sign.kinds) <= {*Kind} - _MAY_BE_EFFECTS
            if sign.confident and sign.wrong is not None:
                found[rows.get(sign.wrong, row)] = sign
            elif sure and sign.at_fault is None:
                found[row] = sign
    return [_Named(row, sign) for row, sign in sorted(found.items())]


_MAY_BE_EFFECTS: Final = frozenset({Kind.MOVED, Kind.TILTED, Kind.CHANNEL, Kind.EARLIER})


class _Copy:
    """A table of readings in which mistakes are put right."""

    def __init__(self, readings: Readings) -> None:
        self._given = readings
        self._signal, self._sd = readings.signal.copy(), readings.signal_sd.copy()
        self._label = readings.installation.astype(object)
        self._series = readings.series.copy()
        self._kept = np.ones(len(readings), dtype=bool)
        self._skipped: list[str] = []

    def mount(self, row: int) -> tuple[int, str]:
        """Return the mounting of a row as it was recorded: series and installation."""
        return int(self._given.series[row]), str(self._given.installation[row])

    def readings(self) -> Readings:
        """Return the table put right."""
        changed = replace(
            self._given,
            signal=self._signal,
            signal_sd=self._sd,
            installation=self._label.astype(np.str_),
            series=self._series,
            skipped=(*self._given.skipped, *self._skipped),
        )
        return changed.select(self._kept)

    def mend(self, mount: tuple[int, str], told: Sequence[_Named]) -> list[Mistake]:
        """Put right what was told of the readings of a mounting; return the mistakes."""
        sat = Counter(match[1] for one in told if (match := _sat_in(one.sign)) is not None)
        if sat and sat.most_common(1)[0][1] >= LEAST_NAMED:
            return [self._move(mount, sat.most_common(1)[0][0], told)]
        cabled = Counter(one.sign.causes[0] for one in told if _cabling(one.sign) is not None)
        mistakes = []
        for cause in (cause for cause, times in cabled.items() if times >= LEAST_NAMED):
            mistakes.append(self._rewire(mount, cause, [one for one in told if one.sign.causes[0] == cause]))
        done = {cause for cause, times in cabled.items() if times >= LEAST_NAMED}
        left = [one for one in told if one.sign.causes[0] not in done]
        return [*mistakes, *(self._leave_out(mount, one) for one in left)]

    def _move(self, mount: tuple[int, str], actual: str, told: Sequence[_Named]) -> Mistake:
        """Move the rows of a mounting to where the block sat: into the mounting before, if it is the same."""
        rows = self._rows(mount)
        first = int(np.flatnonzero(rows)[0])
        before = self.mount(first - 1) if first else (0, "")
        highest = int(self._given.series.max())
        self._label[rows] = actual
        self._series[rows] = before[0] if before[1] == actual else highest + 1
        words = (
            f"the block sat in installation {actual}, not in {mount[1]}, in its {int(rows.sum())} readings from "
            f"pass {self._given.pass_number[first]}, point {self._given.point[first]} on; the copy says so"
        )
        p = min(one.sign.p for one in told)
        return _mistake(MistakeName.SWAPPED_INSTALLATIONS, (), mount[1], None, None, words, p)

    def _rewire(self, mount: tuple[int, str], cause: str, told: Sequence[_Named]) -> Mistake:
        """Put the signals back between the first and the last reading that shows the cables."""
        rows = self._rows(mount)
        rows[: told[0].row] = False
        rows[told[-1].row + 1 :] = False
        matrix = CABLINGS[cause]
        self._signal[rows] = self._signal[rows] @ matrix.T
        self._sd[rows] = self._sd[rows] @ np.abs(matrix).T
        channels = told[0].sign.channels
        name = MistakeName.REVERSED_POLARITY if "reversed" in cause else MistakeName.SWAPPED_CHANNELS
        words = (
            f"{cause} in installation {mount[1]} from pass {self._given.pass_number[told[0].row]}, point "
            f"{self._given.point[told[0].row]} on ({int(rows.sum())} readings); the copy has their signals put back"
        )
        return _mistake(name, channels, mount[1], None, None, words, min(one.sign.p for one in told))

    def _leave_out(self, mount: tuple[int, str], one: _Named) -> Mistake:
        self._kept[one.row] = False
        number, point = int(self._given.pass_number[one.row]), int(self._given.point[one.row])
        where = f"installation {mount[1]}, pass {number}, point {point}"
        self._skipped.append(f"{where}: {' or '.join(one.sign.causes[:1])}")
        words = f"{where}: {' or '.join(one.sign.causes)}; the copy leaves the reading out"
        kind = Kind(one.sign.kinds[0])
        name = NAMES.get(kind, MistakeName.WRONG_SETTING if kind in OF_ONE_READING else MistakeName.OUTLIER)
        return _mistake(name, one.sign.channels, mount[1], number, point, words, one.sign.p)

    def _rows(self, mount: tuple[int, str]) -> Mask:
        return np.asarray((self._given.series == mount[0]) & (self._given.installation == mount[1]))


def _sat_in(sign: EarlySign) -> re.Match[str] | None:
    return SAT_IN.fullmatch(sign.causes[0]) if sign.kinds[0] == Kind.INSTALLATION else None


def _cabling(sign: EarlySign) -> str | None:
    return sign.causes[0] if sign.causes[0] in CABLINGS else None


def _mistake(
    name: MistakeName,
    channels: tuple[str, ...],
    installation: str,
    pass_number: int | None,
    point: int | None,
    words: str,
    p: float,
) -> Mistake:
    told = f"{words} (as the early warning named it)"
    return Mistake(name, channels, (installation,), pass_number, point, told, p, ())
