"""Bodies of readings: one or several sources that are diagnosed as one."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Mask
from bench.base.languages import message
from bench.diagnosis.mistakes.search import Mistake
from bench.readings.corrected import MistakeName
from bench.readings.table import JoinedPart, Readings, all_free, together
from bench.run.causes import CABLINGS, Kind
from bench.run.confidence import STOP_ALARM
from bench.run.early_warning import watcher_of
from bench.run.expectation import EarlySign
from bench.run.folder import Run
from bench.services.errors import Refused
from bench.services.own_effects import knowing_effects_in
from bench.services.requests.evaluation import Diagnose
from bench.services.requests.shared import name_to_type
from bench.services.source import (
    Failed,
    Source,
    data_sha256,
    load_each,
    load_sources,
    on_temperature,
    reading,
    refuse_copies,
    time_of,
)

TOGETHER: Final = "diagnose-together"


@dataclass(frozen=True)
class Body:
    """Readings that are diagnosed together: the `sources`, and all of them joined as one `source`.

    `nominal` (blocks, 3) are the data-sheet scale factors of each block; None if the blocks were not told apart.
    Free positions alone are not joined: `source` is then the first source, and `one_block` says whether one
    sensor made all readings (None: unknown).
    """

    sources: tuple[Source, ...]
    source: Source
    nominal: Floats | None = None
    one_block: bool | None = None

    @property
    def sha256(self) -> tuple[str, ...]:
        """The SHA-256 of the readings of each source."""
        return tuple(data_sha256(source.as_read) for source in self.sources)

    def output(self, suffix: str, number: int | None = None) -> Path:
        """Return the path of an output file that ends with `suffix`, for the body or for its source `number`."""
        if len(self.sources) == 1:
            return self.source.output("diagnose", suffix)
        place = place_together(self.sources) if number is None else self.sources[number]
        return place.output(TOGETHER, suffix)


def whole_body(request: Diagnose) -> Body:
    """Read the sources of a request as one body. Raises `Refused` if they were measured on different benches."""
    with knowing_effects_in(request.effects):
        return body_of(load_sources(reading(request, *request.sources)), request.one_block)


def single_bodies(request: Diagnose) -> list[Body | Failed]:
    """Return each source as a body, or as a `Failed` if it cannot be read; a single source raises its error."""
    with knowing_effects_in(request.effects):
        loaded = load_each(reading(request, *request.sources))
        return [one if isinstance(one, Failed) else body_of([one], request.one_block) for one in loaded]


def body_of(sources: list[Source], one_block: bool | None = None) -> Body:
    """Return the sources as one body: of one block (`one_block` True), or each of a different block (False).

    If `one_block` is None, the recorded names and nominal scale factors tell blocks apart. If these do not
    differ, the diagnosis decides from the readings.
    Raises `Refused` if the sources were measured on different benches.
    """
    refuse_copies(sources)
    first = sources[0]
    if len(sources) == 1 or all_free([source.readings for source in sources]):
        return Body(tuple(sources), first, None, one_block)
    for source in sources[1:]:
        _require_same_bench(first, source)
    try:
        blocks = _blocks(sources, one_block)
        readings = together(
            [JoinedPart(s.readings, _began_s(s), block) for s, block in zip(sources, blocks, strict=True)]
        )
    except ValueError as problem:
        raise Refused(f"--together: {problem}") from problem
    # a model found in one of the sources has no u there, because its values come from part of this body
    model = next((s.model for s in sources if not any(a.u for a in s.model.effects)), first.model)
    readings = replace(readings, notes=(*readings.notes, *on_temperature(readings, model)))
    name = " + ".join(source.name for source in sources)
    entries = tuple(entry for source in sources for entry in source.traced.entries)
    own = tuple(dict.fromkeys(effect for source in sources for effect in source.effects))
    traced = replace(first.traced, entries=entries)
    whole = replace(first, readings=readings, model=model, name=name, traced=traced, effects=own)
    nominal = None
    if blocks[0] is not None:
        kinds = {n: s for n, s in zip(blocks, sources, strict=True) if n is not None}
        nominal = np.array([kinds[n].bench.unit_under_test.scale_factors.values for n in sorted(kinds)])
    return Body(tuple(sources), whole, nominal, one_block)


def place_together(sources: Sequence[Source]) -> Source:
    """Return the first source, renamed so that the names of output files stand for all `sources`."""
    first = sources[0]
    if len(sources) == 1:
        return first
    stem = Path(first.name).stem
    others = Path(sources[1].name).stem if len(sources) == 2 else f"{len(sources) - 1}-more"
    return replace(first, name=str(Path(first.name).parent / f"{stem}+{others}.csv"))


def _blocks(sources: list[Source], one_block: bool | None) -> list[int | None]:
    """Return a block number for each source, by `one_block` or, if that is None, by name and scale factors.

    All numbers are None if names and scale factors do not differ.
    """
    if one_block is not None:
        return [0 if one_block else number for number in range(len(sources))]
    sheets = [tuple(source.bench.unit_under_test.scale_factors.values) for source in sources]
    names = [source.block_name for source in sources]
    told = list(zip(names, sheets, strict=True)) if all(names) else [("", sheet) for sheet in sheets]
    kinds = list(dict.fromkeys(told))
    return [kinds.index(one) for one in told] if len(kinds) > 1 else [None] * len(sources)


def _of_the_stand(source: Source) -> dict[str, float]:
    """Return the standard uncertainties (rad) of the stand's errors by name, without "voltmeter_error"."""
    return {name: u for name, u in source.stand_u.items() if name != "voltmeter_error"}


def _require_same_bench(first: Source, other: Source) -> None:
    one, two = first.model.installations, other.model.installations
    same = {
        "local gravity": first.g_m_s2 == other.g_m_s2,
        "limits of the stand": _of_the_stand(first) == _of_the_stand(other),
        "installations": one.keys() == two.keys()
        and all(np.allclose(one[name].block_from_platform, two[name].block_from_platform) for name in one),
    }
    different = [what for what, agrees in same.items() if not agrees]
    if different:
        raise Refused(
            f"--together: {other.name} has another bench than {first.name} ({', '.join(different)}); name "
            "one for both with --bench FILE"
        )


def _began_s(source: Source) -> float | None:
    """Return the start of a run, s in Unix time; None for a readings file, which does not state it."""
    begun = None if source.run is None or source.run.imported else time_of(source.run.created)
    return None if begun is None else begun.timestamp()


SAT_IN: Final = re.compile(r"the block sits in installation (\S+), not in (\S+)")
OF_ONE_READING: Final = frozenset({Kind.NOT_TURNED, Kind.NEXT_POINT, Kind.WRONG_WAY, Kind.SLIP})
NAMES: Final = {Kind.ROTATION: MistakeName.REVERSED_ROTATION, Kind.ORIENTATION: MistakeName.OTHER_MOUNTING}
LEAST_NAMED: Final = 2
"""Least number of readings that show another installation before their whole mounting is assigned to it."""


MOST_TOLD: Final = 3
"""Largest number of causes that are listed at the end of a run."""


@dataclass(frozen=True)
class _Named:
    """A row of the table of readings, and the sign of a mistake that the early warning found in this row."""

    row: int
    sign: EarlySign


def put_right(source: Source) -> tuple[Readings, tuple[Mistake, ...]]:
    """Correct readings for mistakes that the run's early warning found; return readings and mistakes."""
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
    """Return sentences on the early warnings of a run: their causes, and the warnings that a person overruled.

    Warnings whose readings were repeated are only counted.
    """
    from bench.run.sentences import sentence

    signs, overruled = run.history.not_repaired()
    named = Counter(event.data["causes"][0] for event in signs if event.data["causes"])
    lines = [
        message(f"early warning at {times} reading{'' if times == 1 else 's'}: {cause}")
        for cause, times in named.most_common(MOST_TOLD)
    ]
    if (more := len(named) - len(lines)) > 0:
        lines.append(message(f"early warning: {more} more cause{'' if more == 1 else 's'}"))
    lines += [sentence(event) for event in overruled]
    if named:
        lines.append(message(f"'bench diagnose {name_to_type(run.folder)}' uses these causes"))
    repaired = run.history.progress.signs - len(signs)
    if repaired:
        lines.append(
            message(
                f"early warning at {repaired} reading{' that was' if repaired == 1 else 's that were'} repeated"
            )
        )
    return lines


def _signs(source: Source) -> list[_Named]:
    """Repeat the early warning on the recorded readings, and return the rows that a mistake certainly affected."""
    assert source.run is not None  # noqa: S101
    history = source.run.history
    watcher = watcher_of(source.run.plan, source.bench)
    bound = STOP_ALARM / max(len(history.readings), 1)
    rows = {one.place: row for row, one in enumerate(history.readings.values())}
    found: dict[int, EarlySign] = {}
    for row, one in enumerate(history.readings.values()):
        for sign in watcher.take(one):
            sure = sign.p < bound and sign.kinds and set(sign.kinds) <= {*Kind} - _MAY_BE_EFFECTS
            if sign.confident and sign.kinds and sign.wrong is not None:
                found[rows.get(sign.wrong, row)] = sign
            elif sure and sign.at_fault is None:
                found[row] = sign
    return [_Named(row, sign) for row, sign in sorted(found.items())]


_MAY_BE_EFFECTS: Final = frozenset({Kind.SLIP, Kind.MOVED, Kind.TILTED, Kind.CHANNEL, Kind.EARLIER})
"""Kinds that resemble a large effect of the block, so that all readings together have to show them."""


class _Copy:
    """A copy of a table of readings in which mistakes are corrected."""

    def __init__(self, readings: Readings) -> None:
        self._given = readings
        self._signal, self._sd = readings.signal.copy(), readings.signal_sd.copy()
        self._label = readings.installation.astype(object)
        self._series = readings.series.copy()
        self._kept = np.ones(len(readings), dtype=bool)
        self._skipped: list[str] = []

    def mount(self, row: int) -> tuple[int, str]:
        """Return the mounting that was recorded for a row: series and installation."""
        return int(self._given.series[row]), str(self._given.installation[row])

    def readings(self) -> Readings:
        """Return the corrected table of readings."""
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
        """Correct the mistakes that the early warning found in a mounting; return these mistakes."""
        sat = Counter(match[1] for one in told if (match := _sat_in(one.sign)) is not None)
        for actual, times in sat.most_common(1):
            if times >= LEAST_NAMED:
                return [self._move(mount, actual, told)]
        cabled = Counter(one.sign.causes[0] for one in told if one.sign.causes[0] in CABLINGS)
        certain = [cause for cause, times in cabled.items() if times >= LEAST_NAMED]
        return [
            *(self._rewire(mount, [one for one in told if one.sign.causes[0] == cause]) for cause in certain),
            *(self._leave_out(mount, one) for one in told if one.sign.causes[0] not in certain),
        ]

    def _move(self, mount: tuple[int, str], actual: str, told: Sequence[_Named]) -> Mistake:
        """Move a mounting's rows to installation `actual`; they join the previous mounting if it is there."""
        rows = self._rows(mount)
        first = int(np.flatnonzero(rows)[0])
        before = self.mount(first - 1) if first else (0, "")
        highest = int(self._given.series.max())
        self._label[rows] = actual
        self._series[rows] = before[0] if before[1] == actual else highest + 1
        words = (
            f"the block sat in installation {actual}, not in {mount[1]}, in its {int(rows.sum())} readings from "
            f"pass {self._given.pass_number[first]}, point {self._given.point[first]} on; the copy is corrected"
        )
        return _mistake(MistakeName.SWAPPED_INSTALLATIONS, mount, words, told)

    def _rewire(self, mount: tuple[int, str], told: Sequence[_Named]) -> Mistake:
        """Undo swapped or reversed channels from the first to the last reading affected; return the mistake."""
        sign, first = told[0].sign, told[0].row
        cause = sign.causes[0]
        rows = self._rows(mount)
        rows[:first] = False
        rows[told[-1].row + 1 :] = False
        matrix = CABLINGS[cause]
        self._signal[rows] = self._signal[rows] @ matrix.T
        self._sd[rows] = self._sd[rows] @ np.abs(matrix).T
        name = MistakeName.REVERSED_POLARITY if "reversed" in cause else MistakeName.SWAPPED_CHANNELS
        words = (
            f"{cause} in installation {mount[1]} from pass {self._given.pass_number[first]}, point "
            f"{self._given.point[first]} on ({int(rows.sum())} readings); the copy has their "
            "signals exchanged back"
        )
        return _mistake(name, mount, words, told, sign.channels)

    def _leave_out(self, mount: tuple[int, str], one: _Named) -> Mistake:
        self._kept[one.row] = False
        number, point = int(self._given.pass_number[one.row]), int(self._given.point[one.row])
        where = f"installation {mount[1]}, pass {number}, point {point}"
        self._skipped.append(f"{where}: {' or '.join(one.sign.causes[:1])}")
        words = f"{where}: {' or '.join(one.sign.causes)}; the copy leaves the reading out"
        kind = Kind(one.sign.kinds[0])
        name = NAMES.get(kind, MistakeName.WRONG_SETTING if kind in OF_ONE_READING else MistakeName.OUTLIER)
        return replace(
            _mistake(name, mount, words, [one], one.sign.channels), pass_number=number, point=point
        )

    def _rows(self, mount: tuple[int, str]) -> Mask:
        return np.asarray((self._given.series == mount[0]) & (self._given.installation == mount[1]))


def _sat_in(sign: EarlySign) -> re.Match[str] | None:
    return SAT_IN.fullmatch(sign.causes[0]) if sign.kinds[0] == Kind.INSTALLATION else None


def _mistake(
    name: MistakeName,
    mount: tuple[int, str],
    words: str,
    told: Sequence[_Named],
    channels: tuple[str, ...] = (),
) -> Mistake:
    words = f"{words} (as the early warning named it)"
    return Mistake(name, channels, (mount[1],), None, None, words, min(one.sign.p for one in told), ())
