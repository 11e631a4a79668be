"""Candidates: every effect of the catalogue in each form that these readings allow."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Final, NamedTuple

import numpy as np

from bench.base.arrays import CHANNELS, Floats, Ints, Mask
from bench.diagnosis.levels import ALIKE, MARK_DEG
from bench.diagnosis.linear import MODULUS, LinearSystem
from bench.diagnosis.noise_grid import Whitener
from bench.diagnosis.residual_dictionary import SIZE_NAMES, DictionaryTerm, dictionary
from bench.model.effects import CATALOGUE, AppliedEffect, Effect, Parameter, Stage
from bench.model.effects.base import pass_label
from bench.readings.table import UNORIENTED, VERIFICATION, Readings

Cell = tuple[str, int]
"""A mounting and one of its passes."""


def spells(readings: Readings, *, lasting: bool) -> Iterator[tuple[str, ...]]:
    """Yield each set of passes or mountings in which an effect may act, as a tuple of their labels.

    A set is a single pass, a mounting from a later pass on, or a whole mounting. The label of a mounting
    stands for all its passes. A whole mounting is a set only if its installation has several mountings;
    otherwise the mounting angles describe the same change. An effect that outlasts a remount (`lasting`) may
    also act in any whole mounting, and in all readings from a later pass on.
    """
    conditions = readings.conditions()
    mounts = [str(conditions.mounts[number]) for number in conditions.mount]
    kinds = dict(zip(mounts, readings.installation.tolist(), strict=True))
    of_all = zip(mounts, readings.pass_number.tolist(), strict=True)
    cells = [cell for cell in dict.fromkeys(of_all) if kinds[cell[0]] not in UNORIENTED]
    fitted = [cell for cell in cells if kinds[cell[0]] != VERIFICATION]
    labels = list(dict.fromkeys(mount for mount, _ in fitted))
    chosen: list[Sequence[Cell]] = []
    for mount in labels:
        own = [cell for cell in fitted if cell[0] == mount]
        chosen += [own[first:] for first in range(1, len(own))]
        if len(own) > 2:  # of two passes, one is as different from the other as the other from it
            chosen += [[cell] for cell in own[:-1]]
        again = sum(kinds[other] == kinds[mount] for other in labels) > 1
        if (lasting or again) and len(own) < len(fitted):
            chosen.append(own)
    if lasting:
        chosen += [cells[first:] for first in range(1, len(cells))]
    yield from dict.fromkeys(_labels(one, cells) for one in chosen)


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
"""All sets of one, two or three channels."""

ROUND: Final = ("cosine", "sine")
LEADS: Final = (ROUND, "across_")
"""Prefixes of parameter names. Cosine and sine with the same prefix describe one wave and belong together."""

ZERO_BY_RUN: Final = "zeros_by_run"
SCALE_BY_RUN: Final = "scale_by_run"
SINGLE_READING: Final = "single_reading"
SINGLE_SETTING: Final = "single_setting"
FREE_BY_ANGLE: Final = "free_by_angle"
FREE_BY_PASS: Final = "free_by_pass"
SLOW_IN_TIME: Final = "slow_in_time"
UNNAMED: Final = (
    FREE_BY_ANGLE, FREE_BY_PASS, SLOW_IN_TIME, SINGLE_READING, SINGLE_SETTING,
    ZERO_BY_RUN, SCALE_BY_RUN,
)  # fmt: skip
"""Families of empirical signatures without a physical cause in the catalogue."""


SINGLE: Final = (SINGLE_READING, SINGLE_SETTING)
RARE: Final = 1e-3
"""Prior odds of a single deviating reading against another unnamed pattern: tails of the noise look alike."""
KIND_PRIOR: Final = (0.03, 0.01, 0.96)
"""Prior probabilities that an unnamed form with a formula, one without, or a catalogue effect is missing."""
EQUAL: Final = 0.1
"""Prior odds that an effect has the same size in all channels, against any other form of it."""


class Column(NamedTuple):
    """The parameter that a column estimates, in a channel and in some mountings or passes.

    `channel` is None if the parameter is common to all channels; `mounts` is empty for all mountings.
    """

    parameter: str
    channel: int | None
    mounts: tuple[str, ...] = ()


class Variant(NamedTuple):
    """One form that a family may take: its channels, its mountings, and its shape (names and SI values).

    `columns` are indices in `Candidates.columns`: first of amplitudes (`sizes`), then of `starts` unknown
    states in which the effect begins (`Parameter.start_of`). If the amplitudes are the same in all channels,
    `own` are the columns of this form with a value for each channel. For an unnamed family, `where` says where
    it acts, and `term` is its formula, if any.
    """

    family: str
    columns: tuple[int, ...]
    channels: tuple[int, ...]
    mounts: tuple[str, ...] = ()
    shape: tuple[tuple[str, float], ...] = ()
    where: str = ""
    term: DictionaryTerm | None = None
    starts: int = 0
    own: tuple[int, ...] = ()

    @property
    def sizes(self) -> tuple[int, ...]:
        """The columns of the amplitudes, without the columns of starting states, which come last."""
        return self.columns[: len(self.columns) - self.starts]

    @property
    def plain(self) -> Variant:
        """The variant with a value for each channel, without starting states: each mounting is in equilibrium."""
        return self._replace(columns=self.own or self.sizes, starts=0, own=())

    @property
    def stage(self) -> Stage | None:
        """The stage of the model at which the variant acts; None for an unnamed pattern without a formula."""
        if self.term is not None:
            return self.term.stage
        return CATALOGUE[self.family].stage if self.named else None

    @property
    def is_plain(self) -> bool:
        """Whether the variant has no starting states, and a value for each channel."""
        return not self.starts and not self.own

    @property
    def named(self) -> bool:
        """Whether the family is an effect of the catalogue."""
        return self.term is None and self.family not in UNNAMED


@dataclass
class Candidates:
    """All variants that the search compares, with the columns that they need.

    `columns` (N, P) are the changes of the rows by one plausible size of each parameter, which `kinds`
    describes; `scale` (P,) are these sizes in SI, 1 for unnamed families.
    """

    columns: Floats
    kinds: tuple[Column, ...]
    scale: Floats
    variants: tuple[Variant, ...]

    def with_columns(self, columns: Floats, scale: Floats | None = None) -> Candidates:
        """Return the same variants with other `columns` (N, P), such as those of fewer rows, and other `scale`."""
        other = copy(self)  # with all that follows from the variants
        other.columns, other.scale = columns, self.scale if scale is None else scale
        return other

    @cached_property
    def families(self) -> tuple[str, ...]:
        """The names of the families in order."""
        return tuple(dict.fromkeys(v.family for v in self.variants))

    @cached_property
    def _member(self) -> Ints:
        place = {name: i for i, name in enumerate(self.families)}
        return np.array([place[v.family] for v in self.variants], dtype=np.intp)  # also of no variants

    @cached_property
    def by_family(self) -> Ints:
        """The indices of the variants, sorted by family."""
        return np.argsort(self._member, kind="stable")

    @cached_property
    def family_starts(self) -> Ints:
        """The places in `by_family` where the variants of each family begin."""
        return np.searchsorted(self._member[self.by_family], np.arange(len(self.families)))

    @cached_property
    def share(self) -> Floats:
        """The prior probabilities (variants,) of the variants, given their family."""
        odds = np.array([EQUAL if v.own else 1.0 for v in self.variants])
        return np.asarray(odds / np.bincount(self._member, odds)[self._member])

    @cached_property
    def log_prior(self) -> Floats:
        """ln of the probability that a family is the one that is missing, shape (families,)."""
        kinds = [2 if name in CATALOGUE else 1 if name in UNNAMED else 0 for name in self.families]
        share = np.array([KIND_PRIOR[kind] / kinds.count(kind) for kind in kinds])
        share[[name in SINGLE for name in self.families]] *= RARE
        return np.asarray(np.log(share / share.sum()))

    @cached_property
    def of_meter(self) -> Mask:
        """The mask (variants,) of the effects of the voltmeters."""
        return np.array([v.stage is Stage.VOLTMETER_READING for v in self.variants], dtype=np.bool_)

    @cached_property
    def by_size(self) -> tuple[tuple[Ints, Ints], ...]:
        """Indices (v,) and columns (v, p) of all variants with p columns, for each p."""
        groups: dict[int, list[int]] = {}
        for number, variant in enumerate(self.variants):
            groups.setdefault(len(variant.columns), []).append(number)
        return tuple(
            (np.array(members), np.array([self.variants[m].columns for m in members]))
            for members in groups.values()
        )

    @cached_property
    def equal(self) -> tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]:
        """The columns of each variant with equal amplitudes in all channels, and those with a value for each."""
        return tuple((v.columns, v.own) for v in self.variants if v.own)

    def of_family(self, family: str) -> list[int]:
        """Return the indices in `variants` of all variants of a family."""
        place = self.families.index(family)
        stop = self.family_starts[place + 1] if place + 1 < len(self.families) else len(self.by_family)
        members: list[int] = self.by_family[self.family_starts[place] : stop].tolist()
        return members


class Collector:
    """A builder of `Candidates`: it accumulates columns, and the variants that consist of them."""

    def __init__(self, linear: LinearSystem) -> None:
        self.linear = linear
        self.columns: list[Floats] = []
        self.kinds: list[Column] = []
        self.scale: list[float] = []
        self.variants: list[Variant] = []
        self._everywhere: dict[tuple[object, ...], dict[int | None, Floats]] = {}
        self.rows_in = cache(linear.rows_in)

    def columns_of(
        self,
        effect: Effect,
        parameter: Parameter,
        shape: tuple[tuple[str, float], ...],
        mounts: tuple[str, ...],
    ) -> dict[int | None, Floats]:
        """Return the columns of one parameter of an effect, as `plausible_columns` does, but faster.

        The columns are computed once for all rows, and set to 0 outside `mounts`, unless the effect lasts beyond
        them.
        """
        if not mounts or effect.lasts:
            return plausible_columns(self.linear, effect, parameter, shape, mounts)
        key = (effect.name, parameter.name, shape)
        if key not in self._everywhere:
            self._everywhere[key] = plausible_columns(self.linear, effect, parameter, shape, ())
        rows = self.rows_in(mounts)
        return {channel: np.where(rows, column, 0.0) for channel, column in self._everywhere[key].items()}

    def add(self, column: Floats, kind: Column, scale: float) -> int:
        """Add a column (N,), the change of the rows by the plausible size `scale` (SI); return its index."""
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
        """Add a variant of an unnamed family with all `columns`; with `several`, only if there are at least two."""
        kind = Column(family, channels[0] if len(channels) == 1 else None)
        places = tuple(self.add(column, kind, 1.0) for column in columns)
        if len(places) > several:
            self.variants.append(Variant(family, places, channels, where=where))


def with_terms(candidates: Candidates, linear: LinearSystem) -> Candidates:
    """Return the candidates, with the terms of the residual dictionary added as unnamed families.

    Terms that follow the same course and act on the same quantity are one family, in whatever channels they act.
    """
    columns = [candidates.columns.T]
    kinds_of = {c: [Column(size, c) for size in SIZE_NAMES] for c in (None, 0, 1, 2)}
    kinds, scale, variants = list(candidates.kinds), candidates.scale.tolist(), list(candidates.variants)
    for term, channel, changes in dictionary(linear):
        places = tuple(range(len(kinds), len(kinds) + len(changes)))
        kinds += kinds_of[channel][: len(changes)]
        scale += [term.unit.plausible] * len(changes)
        columns.append(changes)
        variants.append(Variant(term.family, places, (0, 1, 2) if channel is None else (channel,), term=term))
    return Candidates(np.concatenate(columns).T.copy(), tuple(kinds), np.array(scale), tuple(variants))


def is_form(candidates: Candidates, family: str) -> bool:
    """Return whether a family is a term of the residual dictionary: an unnamed family with a formula."""
    return candidates.variants[candidates.of_family(family)[0]].term is not None


def without_copies(candidates: Candidates, white: Whitener) -> Candidates:
    """Return the candidates without the unnamed patterns that effects of the catalogue reproduce.

    Each whitened column of such a pattern lies, up to `ALIKE`, in the span of one shape of an effect.
    """
    own: dict[tuple[object, ...], set[int]] = {}
    named = [variant.named for variant in candidates.variants]
    for variant in itertools.compress(candidates.variants, named):
        own.setdefault((variant.family, variant.shape), set()).update(variant.sizes)
    every = set(range(len(candidates.kinds)))
    unnamed = sorted(every.difference(*(v.columns for v in itertools.compress(candidates.variants, named))))
    columns = (white @ candidates.columns).T
    left, bases = columns[unnamed], []
    for of_effect in own.values():
        size, basis = np.linalg.svd(columns[sorted(of_effect)], full_matrices=False)[1:]
        bases.append(basis[size > 1e-9 * size[0]])
    starts = np.cumsum([0, *map(len, bases[:-1])])
    along = left @ np.concatenate(bases).T
    explained = np.add.reduceat(np.square(along, out=along), starts, axis=1)
    same = np.any(explained >= (1.0 - ALIKE) * np.sum(left**2, axis=1, keepdims=True), axis=1)
    copies = set(itertools.compress(unnamed, same.tolist()))
    kept = tuple(v for v in candidates.variants if not copies.issuperset(v.columns))
    return replace(candidates, variants=kept)


MountSets = Callable[[LinearSystem, Effect], Iterator[tuple[tuple[str, ...], ...]]]
"""Yields sets of groups of mountings for an effect; each group has its own parameters, () is all."""


def make_candidates(
    linear: LinearSystem,
    unit_noise: float,
    mount_sets: MountSets | None = None,
    unnamed: Callable[[Collector, float], None] | None = None,
    *,
    absent: Collection[str] = (),
) -> Candidates:
    """Return every effect that the model may lack for these readings, and the unnamed patterns.

    Left out are effects in `absent`, effects of the model and, unless the signals are in volts, effects in volts.
    `unit_noise` is the prior u of unnamed patterns, unit of the signal. `mount_sets` and `unnamed` choose mountings
    and patterns; by default they are those of one run.
    """
    collector = Collector(linear)
    for effect in CATALOGUE.values():
        if effect.name not in absent and (linear.readings.unit == "V" or not in_volts(effect)):
            _add_effect(collector, effect, mount_sets or _mount_sets, with_starts=mount_sets is None)
    collector.variants = [v for v in collector.variants if not _in_model(v, linear.model.effects)]
    (unnamed or _add_unnamed)(collector, unit_noise)
    return Candidates(
        np.stack(collector.columns, axis=1),
        tuple(collector.kinds),
        np.array(collector.scale),
        tuple(collector.variants),
    )


def in_volts(effect: Effect) -> bool:
    """Return whether an effect has a parameter in volts, which has no plausible size for other signals."""
    return any(parameter.unit.partition("/")[0].endswith("V") for parameter in effect.parameters)


def _in_model(variant: Variant, effects: Sequence[AppliedEffect]) -> bool:
    channels = {CHANNELS[c] for c in variant.channels}
    return any(
        applied.effect.name == variant.family
        and (channels & set(applied.channels) or not any(p.per_channel for p in applied.effect.parameters))
        and (
            not variant.mounts
            or not applied.installations
            or bool(set(variant.mounts) & set(applied.installations))
        )
        for applied in effects
    )


# --- effects of the catalogue -----------------------------------------------------------------------


def _add_effect(collector: Collector, effect: Effect, mount_sets: MountSets, *, with_starts: bool) -> None:
    linear_ones = [p for p in effect.parameters if p.is_size]
    shapes = [p for p in effect.parameters if p.grid]
    grids = [[(p.name, value) for value in p.grid] for p in shapes]
    for shape in itertools.product(*grids):
        for mounts in mount_sets(collector.linear, effect):
            starts = _starts(collector, effect, shape) if with_starts and mounts == ((),) else {}
            _add_form(collector, effect, linear_ones, shape, mounts, starts)


def _mount_sets(linear: LinearSystem, effect: Effect) -> Iterator[tuple[tuple[str, ...], ...]]:
    if effect.per_pass:
        of_signals = effect.stage in (Stage.BLOCK_OUTPUT, Stage.VOLTMETER_READING)
        twice = _twins(linear) if effect.outlasts_mount and of_signals else ()
        in_spells = spells(linear.readings, lasting=effect.outlasts_mount)
        yield from ((spell,) for spell in in_spells if spell not in twice)
        return
    if not effect.per_mount:
        yield ((),)
        return
    if effect.lasts:
        later = linear.conditions.mounts[1:]
        yield from (((str(mount),),) for mount in later if mount.installation not in UNORIENTED)
        return
    labels = [str(m) for m in linear.moved.mounts if m.installation != VERIFICATION]
    yield from (((label,),) for label in labels)
    if len(labels) > 1:
        yield (tuple(labels),)
        yield tuple((label,) for label in labels)


def _twins(linear: LinearSystem) -> tuple[tuple[str, ...], ...]:
    """Return the first mounting and its first pass: a change there is equivalent to one in all later readings.

    The coefficients absorb the difference: if the change is assigned to the later readings, they apply before it.
    The result is empty in two cases, in which `spells` has no set of all later readings: verification points come
    first, or readings of the inputs or in free positions come later.
    """
    readings, conditions = linear.readings, linear.conditions
    known = ~np.isin(readings.installation, list(UNORIENTED))
    start = int(np.argmax(known))
    if not known[start:].all() or readings.installation[start] == VERIFICATION:
        return ()
    first = str(conditions.mounts[conditions.mount[start]])
    return (first,), (pass_label(first, int(readings.pass_number[start])),)


def _add_form(
    collector: Collector,
    effect: Effect,
    parameters: list[Parameter],
    shape: tuple[tuple[str, float], ...],
    mount_groups: tuple[tuple[str, ...], ...],
    starts: dict[int | None, list[int]],
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
                variant = Variant(effect.name, columns, channels, mounts, shape)
                collector.variants.append(variant)
                if per_channel and len(channels) == 3:
                    _add_equal(collector, variant)
                started = tuple(i for c in channels for i in starts.get(c, ()))
                if started:
                    collector.variants.append(
                        variant._replace(columns=columns + started, starts=len(started))
                    )


def _add_equal(collector: Collector, variant: Variant) -> None:
    """Add the variant with the same amplitudes in all channels, as accelerometers of one type are alike.

    Without it, an effect with one parameter common to all channels would win against three equal parameters.
    """
    each: dict[tuple[str, tuple[str, ...]], list[int]] = {}
    for i in variant.columns:
        each.setdefault((collector.kinds[i].parameter, collector.kinds[i].mounts), []).append(i)
    equal = tuple(
        collector.add(
            np.sum([collector.columns[i] for i in own], axis=0),
            Column(parameter, None, mounts),
            collector.scale[own[0]],
        )
        for (parameter, mounts), own in each.items()
    )
    collector.variants.append(variant._replace(columns=equal, own=variant.columns))


def _starts(
    collector: Collector, effect: Effect, shape: tuple[tuple[str, float], ...]
) -> dict[int | None, list[int]]:
    """Add a column for the starting state of each mounting; return the indices of the columns by channel.

    An amplitude of 1 is the standard deviation of the state if the effect has its plausible size.
    """
    linear = collector.linear
    index: dict[int | None, list[int]] = {}
    for start in (p for p in effect.parameters if p.start_of):
        size = next(p for p in effect.parameters if p.name == start.start_of)
        spread = effect.start_spread(linear.conditions) * size.plausible
        everywhere = plausible_columns(linear, effect, start, shape, ())
        mounts = [str(m) for m in linear.conditions.mounts if m.installation not in UNORIENTED]
        for mount, (channel, column) in itertools.product(mounts, everywhere.items()):
            own = np.where(collector.rows_in((mount,)), column, 0.0) * (spread / start.plausible)
            if np.any(own):
                kind = Column(start.name, channel, (mount,))
                index.setdefault(channel, []).append(collector.add(own, kind, spread))
    return index


def _parameter_sets(effect: Effect, parameters: list[Parameter]) -> Iterator[tuple[str, ...]]:
    """Yield the sets of parameters that may be present without the other parameters of the effect."""
    if effect.apart:
        yield from effect.apart
        return
    names = tuple(p.name for p in parameters)
    waves = [tuple(n for n in names if n.endswith(ROUND) and n.startswith(lead)) for lead in LEADS]
    if set(names) == {n for wave in waves for n in wave}:
        yield from (wave for wave in waves if wave and wave != names)
    elif len(names) > 1:
        yield from ((name,) for name in names)
    yield names


def plausible_columns(
    linear: LinearSystem,
    effect: Effect,
    parameter: Parameter,
    shape: tuple[tuple[str, float], ...],
    mounts: tuple[str, ...],
) -> dict[int | None, Floats]:
    """Return the changes (N,) of the rows by one plausible size of a parameter, by channel number.

    The key is None if the parameter is common to all channels. The effect acts in `mounts` (empty: everywhere),
    with the shape parameters `shape` in SI.
    """
    values: dict[str, Floats] = {name: np.asarray(value) for name, value in shape}
    size = parameter.plausible
    values[parameter.name] = np.full(3, size) if parameter.per_channel else np.asarray(size)
    applied = AppliedEffect(effect, values, installations=mounts)
    if not parameter.per_channel:
        return {None: linear.effect_column(applied)}
    return dict(enumerate(linear.effect_columns(applied).T))


# --- families without a name ------------------------------------------------------------------------


def add_free_patterns(collector: Collector, unit: float, visit: Ints) -> None:
    """Add two patterns for each channel: a free value for each angle, and a free value for each pass.

    The values have the prior u `unit`, unit of the signal. Installations have separate values, and so have
    mountings with different numbers; `visit` (n,) is the number of the mounting of each reading.
    """
    linear, free = collector.linear, collector.add_free
    rows, readings = linear.rows, linear.readings
    # not modulo a turn: a scale may come back to another angle than the head
    angle = np.round(np.degrees(np.nan_to_num(readings.angle_rad[rows.reading])) / MARK_DEG).astype(np.int64)
    mount = list(zip(visit[rows.reading], readings.installation[rows.reading], strict=True))
    pass_number = readings.pass_number[rows.reading]
    for channel in range(3):
        mine = (linear.setting >= 0) & (rows.channel == channel)
        free(FREE_BY_ANGLE, (channel,), [unit * one for one in each(mine, mount, angle)], several=True)
        free(FREE_BY_PASS, (channel,), [unit * one for one in each(mine, mount, pass_number)], several=True)


def _add_unnamed(collector: Collector, unit: float) -> None:
    linear, free = collector.linear, collector.add_free
    rows = linear.rows
    add_free_patterns(collector, unit, linear.readings.series)
    for row, single in enumerate(unit * np.eye(len(linear))):
        channels = (0, 1, 2) if rows.channel[row] == MODULUS else (int(rows.channel[row]),)
        free(SINGLE_READING, channels, [single], f"reading {rows.reading[row] + 1}")
    for number in range(linear.settings):
        column = np.where(linear.setting == number, linear.slope, 0.0)
        length = float(np.linalg.norm(column))
        if length > 0.0:
            reading = int(rows.reading[linear.setting == number][0])
            free(SINGLE_SETTING, (0, 1, 2), [unit * column / length], f"reading {reading + 1}")


def each(mine: Mask, *labels: Iterable[object]) -> Iterator[Floats]:
    """Yield an indicator column (N,) for each combination of `labels` that occurs in the mask `mine`."""
    numbers: dict[object, int] = {}
    number = np.array([numbers.setdefault(key, len(numbers)) for key in zip(*labels, strict=True)])
    for one in dict.fromkeys(number[mine].tolist()):
        yield (mine & (number == one)).astype(np.float64)
