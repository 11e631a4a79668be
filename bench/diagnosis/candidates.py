"""Candidates: every effect of the catalogue in each form that these readings allow."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Ints, Mask
from bench.config.bench_file.file import BenchFile
from bench.diagnosis.linear import MODULUS, LinearSystem
from bench.model.effects import CATALOGUE, AppliedEffect, Effect, Parameter
from bench.model.effects.base import pass_label, rows_of
from bench.readings.table import UNORIENTED, VERIFICATION, Readings

Cell = tuple[str, int]
"""A mounting and one of its passes."""


def spells(readings: Readings, *, lasting: bool) -> Iterator[tuple[str, ...]]:
    """Yield labels of what may belong together: the later passes of a mounting, one pass, a whole mounting.

    A whole mounting only where its installation was mounted more than once: of one that was not, nothing says
    that the block ever sat otherwise, and how it sat are the angles of its mounting. With `lasting` any mounting,
    and all that comes after a pass, verification points included: what stays through a remount.
    A mounting all passes of which belong to it is named by itself.
    """
    mounts = [
        label if series == 1 else f"{label}/{series}"
        for label, series in zip(readings.installation.tolist(), readings.series.tolist(), strict=True)
    ]
    kinds = readings.installation.tolist()
    rows = zip(mounts, readings.pass_number.tolist(), kinds, strict=True)
    cells = list(dict.fromkeys((mount, number) for mount, number, kind in rows if kind not in UNORIENTED))
    checked = {mount for mount, kind in zip(mounts, kinds, strict=True) if kind == VERIFICATION}
    seen: set[tuple[str, ...]] = set()
    fitted = [cell for cell in cells if cell[0] not in checked]
    of_visit = dict(zip(mounts, kinds, strict=True))
    visits = Counter(of_visit[mount] for mount in {mount for mount, _ in fitted})
    whole = {mount for mount, _ in fitted if lasting or visits[of_visit[mount]] > 1}
    for chosen in _chosen(fitted, whole, cells if lasting else []):
        labels = _labels(chosen, cells)
        if labels not in seen:
            seen.add(labels)
            yield labels


def _chosen(
    fitted: Sequence[Cell], whole: Collection[str], to_the_end: Sequence[Cell]
) -> Iterator[Sequence[Cell]]:
    for mount in dict.fromkeys(mount for mount, _ in fitted):
        own = [cell for cell in fitted if cell[0] == mount]
        yield from (own[first:] for first in range(1, len(own)))
        if len(own) > 2:  # of two passes, one is as different from the other as the other from it
            yield from ([cell] for cell in own[:-1])
        if mount in whole and len(own) < len(fitted):
            yield own
    yield from (to_the_end[first:] for first in range(1, len(to_the_end)))


def _labels(chosen: Sequence[Cell], cells: Sequence[Cell]) -> tuple[str, ...]:
    labels = []
    for mount in dict.fromkeys(mount for mount, _ in chosen):
        own = [cell for cell in chosen if cell[0] == mount]
        whole = len(own) == sum(cell[0] == mount for cell in cells)
        labels += [mount] if whole else [pass_label(*cell) for cell in own]
    return tuple(labels)


SUBSETS: Final = tuple(
    subset for size in (1, 2, 3) for subset in itertools.combinations(range(3), size)
)  # fmt: skip
"""All sets of channels, one, two and three."""

ROUND: Final = ("cosine", "sine")
LEADS: Final = (ROUND, "across_")
"""Parameters that belong together, amplitude and phase of one wave: with the same lead of their names."""

SLIP: Final = "block_slip"
"""What is looked for by a threshold of its own, too."""
ZERO_BY_RUN: Final = "zeros_by_run"
SCALE_BY_RUN: Final = "scale_by_run"
STEP_AFTER: Final = "step"
SINGLE_READING: Final = "single_reading"
SINGLE_SETTING: Final = "single_setting"
FREE_BY_ANGLE: Final = "free_by_angle"
FREE_BY_PASS: Final = "free_by_pass"
SLOW_IN_TIME: Final = "slow_in_time"
HEAD_ANGLE: Final = "free_head_angle"
UNNAMED: Final = (
    FREE_BY_ANGLE, FREE_BY_PASS, HEAD_ANGLE, SLOW_IN_TIME, STEP_AFTER, SINGLE_READING, SINGLE_SETTING,
    ZERO_BY_RUN, SCALE_BY_RUN,
)  # fmt: skip
"""Families that no physics stands behind."""


@dataclass(frozen=True)
class Column:
    """One number that is to be estimated: a parameter of an effect, of a channel, at mountings (all if none)."""

    parameter: str
    channel: int | None
    mounts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Variant:
    """One form of a family: which columns of `Candidates.columns` it has, and what they stand for.

    `shape` holds the values of shape parameters, SI.
    """

    family: str
    columns: tuple[int, ...]
    channels: tuple[int, ...]
    mounts: tuple[str, ...] = ()
    shape: tuple[tuple[str, float], ...] = ()
    where: str = ""

    @property
    def named(self) -> bool:
        """Whether it is an effect of the catalogue."""
        return self.family in CATALOGUE


@dataclass
class Candidates:
    """All variants, and their columns (N, P) for one prior standard deviation of each.

    `kinds` says of each column what it stands for, `scale` what its unit is worth in SI (1 where unnamed).
    `by_family` orders the variants by family, each of which begins at its `family_starts`.
    """

    columns: Floats
    kinds: tuple[Column, ...]
    scale: Floats
    variants: tuple[Variant, ...]
    families: tuple[str, ...] = field(init=False)
    by_family: Ints = field(init=False)
    family_starts: Ints = field(init=False)

    def __post_init__(self) -> None:
        """Collect the names of the families in order, and where their variants are."""
        self.families = tuple(dict.fromkeys(v.family for v in self.variants))
        place = {name: i for i, name in enumerate(self.families)}
        member = np.array([place[v.family] for v in self.variants])
        self.by_family = np.argsort(member, kind="stable")
        self.family_starts = np.searchsorted(member[self.by_family], np.arange(len(self.families)))

    @cached_property
    def slips(self) -> list[int]:
        """The numbers of the variants of a slip about any axis, one for each of the passes that it may be in."""
        if SLIP not in self.families:
            return []
        whole = len(CATALOGUE[SLIP].parameters)
        return [i for i in self.of_family(SLIP) if len(self.variants[i].columns) == whole]

    def of_family(self, family: str) -> list[int]:
        """Return the numbers of a family's variants."""
        place = self.families.index(family)
        stop = self.family_starts[place + 1] if place + 1 < len(self.families) else len(self.by_family)
        members: list[int] = self.by_family[self.family_starts[place] : stop].tolist()
        return members


class Collector:
    """What is gathered of columns and of the variants that they make up."""

    def __init__(self, linear: LinearSystem) -> None:
        self.linear = linear
        self.columns: list[Floats] = []
        self.kinds: list[Column] = []
        self.scale: list[float] = []
        self.variants: list[Variant] = []
        self._everywhere: dict[tuple[object, ...], dict[int | None, Floats]] = {}
        self._rows: dict[tuple[str, ...], Mask] = {}

    def columns_of(
        self,
        effect: Effect,
        parameter: Parameter,
        shape: tuple[tuple[str, float], ...],
        mounts: tuple[str, ...],
    ) -> dict[int | None, Floats]:
        """Return what `plausible_columns` does; where no row looks back, mountings have a part of the whole."""
        if not mounts or effect.needs_history or effect.needs_path or effect.lasts:
            return plausible_columns(self.linear, effect, parameter, shape, mounts)
        key = (effect.name, parameter.name, shape)
        if key not in self._everywhere:
            self._everywhere[key] = plausible_columns(self.linear, effect, parameter, shape, ())
        if mounts not in self._rows:
            self._rows[mounts] = rows_of(mounts, self.linear.conditions)[self.linear.rows.reading]
        rows = self._rows[mounts]
        return {channel: np.where(rows, column, 0.0) for channel, column in self._everywhere[key].items()}

    def add(self, column: Floats, kind: Column, scale: float) -> int:
        """Add a column (N,) for one plausible size, `scale` in SI; return its number."""
        self.columns.append(column)
        self.kinds.append(kind)
        self.scale.append(scale)
        return len(self.columns) - 1

    def add_free(
        self,
        family: str,
        channels: tuple[int, ...],
        columns: Iterable[Floats],
        where: str = "",
        *,
        several: bool = False,
    ) -> None:
        """Add a family without a name; of one that needs `several` columns there is no variant with one."""
        kind = Column(family, channels[0] if len(channels) == 1 else None)
        places = tuple(self.add(column, kind, 1.0) for column in columns)
        if len(places) > several:
            self.variants.append(Variant(family, places, channels, where=where))


MountSets = Callable[[LinearSystem, Effect], Iterator[tuple[tuple[str, ...], ...]]]
"""Sets of groups of mountings that an effect may have: each group has parameters of its own; () is everywhere."""


def make_candidates(
    linear: LinearSystem,
    unit_noise: float,
    mount_sets: MountSets | None = None,
    unnamed: Callable[[Collector, float], None] | None = None,
    *,
    absent: Collection[str] = (),
) -> Candidates:
    """Collect all that might be missing in these readings, but for effects that are `absent` from the bench.

    `unit_noise` is the size of the noise of a reading, unit of the signal: what is unnamed has no other scale.
    Several runs have other `mount_sets` and other families that are `unnamed` than one.
    """
    collector = Collector(linear)
    for effect in CATALOGUE.values():
        if effect.name not in absent and (linear.readings.unit == "V" or not in_volts(effect)):
            _add_effect(collector, effect, mount_sets or _mount_sets)
    collector.variants = [v for v in collector.variants if not _in_model(v, linear.model.effects)]
    (unnamed or _add_unnamed)(collector, unit_noise)
    return Candidates(
        np.stack(collector.columns, axis=1),
        tuple(collector.kinds),
        np.array(collector.scale),
        tuple(collector.variants),
    )


def in_volts(effect: Effect) -> bool:
    """Whether it is so many microvolts large: signals in counts or g are not voltages, and it has no size there."""
    return any(parameter.unit.partition("/")[0].endswith("V") for parameter in effect.parameters)


def _in_model(variant: Variant, effects: Sequence[AppliedEffect]) -> bool:
    """Return whether the model has this effect already, in one of these channels and mountings."""
    for applied in effects:
        if applied.effect.name == variant.family:
            per_channel = any(p.per_channel for p in applied.effect.parameters)
            channels = not per_channel or any(CHANNELS[c] in applied.channels for c in variant.channels)
            everywhere = not variant.mounts or not applied.installations
            if channels and (everywhere or set(variant.mounts) & set(applied.installations)):
                return True
    return False


# --- effects of the catalogue -----------------------------------------------------------------------


def _add_effect(collector: Collector, effect: Effect, mount_sets: MountSets) -> None:
    linear_ones = [p for p in effect.parameters if not p.grid]
    shapes = [p for p in effect.parameters if p.grid]
    grids = [[(p.name, value) for value in p.grid] for p in shapes]
    for shape in itertools.product(*grids):
        for mounts in mount_sets(collector.linear, effect):
            _add_form(collector, effect, linear_ones, shape, mounts)


def _mount_sets(linear: LinearSystem, effect: Effect) -> Iterator[tuple[tuple[str, ...], ...]]:
    if effect.per_pass:
        yield from ((spell,) for spell in spells(linear.readings, lasting=effect.outlasts_mount))
        return
    if not effect.per_mount:
        yield ((),)
        return
    labels = [str(m) for m in linear.moved.mounts if m.installation != VERIFICATION]
    if effect.lasts:
        yield from (((label,),) for label in labels[1:])
        return
    yield from (((label,),) for label in labels)
    if len(labels) > 1:
        yield (tuple(labels),)
        yield tuple((label,) for label in labels)


def _add_form(
    collector: Collector,
    effect: Effect,
    parameters: list[Parameter],
    shape: tuple[tuple[str, float], ...],
    mount_groups: tuple[tuple[str, ...], ...],
) -> None:
    index: dict[tuple[str, int | None], list[int]] = {}
    for mounts in mount_groups:
        for parameter in parameters:
            columns_of = collector.columns_of(effect, parameter, shape, mounts)
            for channel, column in columns_of.items():
                if np.any(column):
                    place = collector.add(
                        column, Column(parameter.name, channel, mounts), parameter.plausible
                    )
                    index.setdefault((parameter.name, channel), []).append(place)
    mounts = tuple(label for group in mount_groups for label in group)
    for names in _parameter_sets(effect, parameters):
        per_channel = any(p.per_channel for p in parameters if p.name in names)
        for channels in SUBSETS if per_channel else ((0, 1, 2),):
            keys = [(n, c) for n in names for c in (*channels, None)]
            columns = tuple(i for key in keys for i in index.get(key, []))
            if columns and (not per_channel or all(any((n, c) in index for n in names) for c in channels)):
                collector.variants.append(Variant(effect.name, columns, channels, mounts, shape))


def _parameter_sets(effect: Effect, parameters: list[Parameter]) -> Iterator[tuple[str, ...]]:
    """Yield sets of parameters that may be there without the others."""
    if effect.apart:
        yield from effect.apart
        return
    names = tuple(p.name for p in parameters)
    waves = [tuple(n for n in names if n.endswith(ROUND) and n.startswith(lead)) for lead in LEADS]
    if set(names) == {n for wave in waves for n in wave}:
        yield from (wave for wave in waves if wave and wave != names)
    elif 1 < len(names) <= MOST_APART:
        yield from ((name,) for name in names)
    yield names


MOST_APART: Final = 3
"""An effect with more parameters than this has them all or none."""


def plausible_columns(
    linear: LinearSystem,
    effect: Effect,
    parameter: Parameter,
    shape: tuple[tuple[str, float], ...],
    mounts: tuple[str, ...],
) -> dict[int | None, Floats]:
    """Return what a parameter of plausible size adds to the rows (N,), for each channel or, under None, for all."""
    values: dict[str, Floats] = {name: np.asarray(value) for name, value in shape}
    size = parameter.plausible
    values[parameter.name] = np.full(3, size) if parameter.per_channel else np.asarray(size)
    applied = AppliedEffect(effect, values, installations=mounts)
    if not parameter.per_channel:
        return {None: linear.effect_column(applied)}
    return dict(enumerate(linear.effect_columns(applied).T))


# --- families without a name ------------------------------------------------------------------------

WAVES: Final = 6
"""Half waves over a run by which something slow in time is described."""


def _add_unnamed(collector: Collector, unit: float) -> None:
    linear, free = collector.linear, collector.add_free
    rows, readings = linear.rows, linear.readings
    oriented = linear.setting >= 0
    # not modulo a turn: a scale may come back to another angle than the head
    angle = np.round(np.degrees(np.nan_to_num(readings.angle_rad[rows.reading])) / 5.0).astype(np.int64)
    mount = list(zip(readings.series[rows.reading], readings.installation[rows.reading], strict=True))
    pass_number = readings.pass_number[rows.reading]
    phase = _phase(linear)
    for channel in range(3):
        mine = oriented & (rows.channel == channel)
        free(FREE_BY_ANGLE, (channel,), [unit * one for one in each(mine, mount, angle)], several=True)
        free(FREE_BY_PASS, (channel,), [unit * one for one in each(mine, mount, pass_number)], several=True)
        waves = [unit * mine * np.cos(np.pi * k * phase) for k in range(1, WAVES + 1)]
        free(SLOW_IN_TIME, (channel,), waves)
    steepness = linear.typical_slope
    errors = [unit * np.where(one > 0.0, linear.slope / steepness, 0.0) for one in each(oriented, angle)]
    free(HEAD_ANGLE, (0, 1, 2), errors, several=True)
    last = int(rows.reading[oriented].max())
    for channel in range(3):
        for at in sorted(set(rows.reading[oriented].tolist())):
            if 0 < at < last:
                step = unit * ((rows.channel == channel) & (rows.reading >= at))
                free(STEP_AFTER, (channel,), [step], f"from reading {at + 1} on")
    for row in np.flatnonzero(rows.channel != MODULUS).tolist():
        single = np.where(np.arange(len(linear)) == row, unit, 0.0)
        free(SINGLE_READING, (int(rows.channel[row]),), [single], f"reading {rows.reading[row] + 1}")
    for number in range(linear.settings):
        column = np.where(linear.setting == number, linear.slope, 0.0)
        length = float(np.linalg.norm(column))
        if length > 0.0:
            reading = int(rows.reading[linear.setting == number][0])
            free(SINGLE_SETTING, (0, 1, 2), [unit * column / length], f"reading {reading + 1}")


def each(mine: Mask, *labels: Iterable[object]) -> Iterator[Floats]:
    """Yield for each combination of labels, in order, 1 in the rows of `mine` that have it and 0 in all others."""
    keys = list(zip(*labels, strict=True))
    for key in dict.fromkeys(itertools.compress(keys, mine)):
        yield np.array([own and k == key for k, own in zip(keys, mine, strict=True)], dtype=np.float64)


def _phase(linear: LinearSystem) -> Floats:
    """Return how far in the run the rows are, 0 to 1, by time or where there is none by their order."""
    time = linear.readings.time_s[linear.rows.reading]
    timed = np.all(np.isfinite(time)) and np.ptp(time) > 0
    t = time if timed else linear.rows.reading.astype(np.float64)
    return np.asarray((t - t.min()) / max(float(np.ptp(t)), 1e-300))


@dataclass(frozen=True)
class KnownBench:
    """What decides which effects can be there; None where nobody says it.

    `own_meters`: each channel has a meter of its own. `fixed_ranges`: no meter changes its range.
    `scale_on_axis`: the head's scale sits on the axis that turns the block, and no gear is between them.
    """

    own_meters: bool | None = None
    fixed_ranges: bool | None = None
    scale_on_axis: bool | None = None

    @classmethod
    def of(cls, bench: BenchFile) -> KnownBench:
        """Return what a bench file says: in it the ranges of voltmeters are fixed."""
        meters = bench.instruments.voltmeters
        return cls(
            own_meters=all(len(meter.channels) == 1 for meter in meters),
            fixed_ranges=True,
            scale_on_axis=bench.instruments.head.scale_on_axis,
        )

    def absent(self, readings: Readings) -> dict[str, str]:
        """Return the effects of the catalogue that cannot be there, each with the reason.

        What the record says of its ranges counts for more than what the bench file says.
        """
        fixed, said = self.fixed_ranges, "the bench file has fixed ranges"
        recorded = {str(text).strip() for text in readings.extra.get("range_v", ())} - {""}
        if recorded:
            fixed, said = len(recorded) == 1, "all readings were taken on one range"
        why = {
            "range_offset": said if fixed else "",
            "channel_crosstalk": "each channel has a voltmeter of its own" if self.own_meters else "",
            "meters_exchanged": "one voltmeter reads all channels" if self.own_meters is False else "",
            "backlash": "the head's scale sits on the axis itself" if self.scale_on_axis else "",
        }
        return {name: why[name] for name in CATALOGUE if why.get(name)}

    def not_judged(self, readings: Readings) -> str:
        """Return which effects are looked for as nobody says that the bench cannot have them; or nothing."""
        recorded = {str(text).strip() for text in readings.extra.get("range_v", ())} - {""}
        unknown = {
            "range_offset": self.fixed_ranges is None and not recorded,
            "channel_crosstalk": self.own_meters is None,
            "meters_exchanged": self.own_meters is None,
            "backlash": self.scale_on_axis is None,
        }
        names = [name for name in CATALOGUE if unknown.get(name)]
        if not names:
            return ""
        return (
            f"whether the bench can have {', '.join(names)} was not judged, as nobody named its bench file: "
            "they are looked for; --bench FILE says what meters and head it has"
        )


NOTHING_KNOWN = KnownBench()
"""Of a bench of which nobody says anything."""
