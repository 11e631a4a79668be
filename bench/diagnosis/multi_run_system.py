"""Several runs as one linear system with its candidates, and the mistakes in each run."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy.linalg import block_diag

from bench.base.arrays import Floats, Ints, Mask
from bench.base.languages import message
from bench.calibration.calibrate import first_guess
from bench.calibration.design import make_problem
from bench.calibration.result import CalibrationError
from bench.diagnosis.candidates import (
    SCALE_BY_RUN,
    SLOW_IN_TIME,
    SUBSETS,
    ZERO_BY_RUN,
    Candidates,
    Collector,
    Column,
    Variant,
    add_free_patterns,
    make_candidates,
)
from bench.diagnosis.levels import HARDLY_EVER
from bench.diagnosis.linear import LinearSystem, Rows, make_linear
from bench.diagnosis.mistakes.search import Mistake, MistakeSearch, find_mistakes
from bench.diagnosis.residual_dictionary import FASTEST
from bench.model.conditions import Conditions, Mounting
from bench.model.effects import AppliedEffect, Effect, Stage
from bench.model.effects.base import Subsystem
from bench.model.forward import ForwardModel
from bench.model.geometry import Block
from bench.readings.table import VERIFICATION, Readings, stacked

OTHER_BLOCK: Final = (1e-3, 3e-3, 10e-3)
"""Largest changes of one block between runs: of a scale factor, g/g; of a cross-axis term, g/g; of a bias, g."""


@dataclass(frozen=True)
class JointSystem(LinearSystem):
    """The linear system of several accelerometer blocks on one bench.

    `parts` has the linear system of each block, and the rows are those of the parts, in this order. Each block has
    its own coefficients; the unknowns of the bench are common to all. `block` is the first block, with the
    coefficients at which its system is linearised.
    """

    parts: tuple[LinearSystem, ...]

    def by_block(self) -> Iterator[tuple[Block, Mask]]:
        """Yield the coefficients at which each block is linearised, and the mask (N,) of the block's rows."""
        assert self.readings.block is not None  # noqa: S101 - it is a system of several
        of_row = self.readings.block[self.rows.reading]
        for number, part in zip(np.unique(self.readings.block), self.parts, strict=True):
            yield part.block, of_row == number

    @cached_property
    def conditions(self) -> Conditions:
        """The conditions of all readings, in the order of measurement."""
        return self.readings.conditions()

    def effect_columns(self, applied: AppliedEffect) -> Floats:
        """Return what `LinearSystem.effect_columns` returns, for an effect that acts on all blocks."""
        return np.concatenate([part.effect_columns(applied) for part in self.parts])

    def stage_columns(
        self, course: Floats, stage: Stage, adds_to: str = "", *, in_proportion: bool = False
    ) -> Floats:
        """Return what `LinearSystem.stage_columns` returns, for courses that act on all blocks."""
        assert self.readings.block is not None  # noqa: S101 - it is a system of several
        own = (course[self.readings.block == number] for number in np.unique(self.readings.block))
        return np.concatenate(
            [
                part.stage_columns(mine, stage, adds_to, in_proportion=in_proportion)
                for mine, part in zip(own, self.parts, strict=True)
            ]
        )


def make_system(readings: Readings, model: ForwardModel, stand_u: Mapping[str, float]) -> LinearSystem:
    """Return the linear system of readings of one or several blocks.

    The arguments and errors are those of `make_linear`.
    """
    if readings.block is None:
        return make_linear(readings, model, stand_u)
    masks = [readings.block == number for number in np.unique(readings.block)]
    tables = [np.flatnonzero(mask) for mask in masks]
    parts = [make_linear(replace(readings.select(mask), block=None), model, stand_u) for mask in masks]
    starts = np.cumsum([0, *(part.settings for part in parts)])
    own = [_random_of(part, stand_u) for part in parts]
    shared = np.concatenate([shared for shared, _ in own])
    first = parts[0]
    return JointSystem(
        readings=readings,
        model=model,
        block=first.block,
        rows=Rows(
            np.concatenate([rows[part.rows.reading] for rows, part in zip(tables, parts, strict=True)]),
            np.concatenate([part.rows.channel for part in parts]),
        ),
        response=np.concatenate([part.response for part in parts]),
        fixed=np.asarray(block_diag(*(part.fixed for part in parts)), dtype=np.float64),
        random=np.column_stack([block_diag(*(alone for _, alone in own)), shared]),
        slope=np.concatenate([part.slope for part in parts]),
        setting=np.concatenate(
            [np.where(p.setting >= 0, p.setting + s, -1) for p, s in zip(parts, starts[:-1], strict=True)]
        ),
        moved=readings.select(readings.is_oriented).conditions(),
        view=first.view,
        problem=first.problem,
        orientation=next(
            (p.orientation for p in parts if p.orientation is not None and p.orientation.contradicts),
            first.orientation,
        ),
        parts=tuple(parts),
    )


def _random_of(part: LinearSystem, stand_u: Mapping[str, float]) -> tuple[Floats, Floats]:
    """Return the columns of `random` that all blocks share (effects of the bench), and those of this block."""
    problem = make_problem(part.model, part.moved, stand_u)
    of_bench = np.zeros(part.random.shape[1], dtype=bool)
    for place, unknown in enumerate(problem.effects):
        subsystem = part.model.effects[unknown.effect].effect.subsystem
        of_bench[len(problem.stand) + place] = subsystem is not Subsystem.BLOCK
    return part.random[:, of_bench], part.random[:, ~of_bench]


# --- which runs are of one block ----------------------------------------------------------------------


def with_blocks(readings: Readings, model: ForwardModel) -> Readings:
    """Return the readings with `block`, the number of each row's accelerometer block; None for a single block.

    Stated numbers are kept. Without them, runs with compatible coefficients are of one block. A run that does not
    determine its coefficients is assigned to the first block.
    """
    if readings.block is not None:
        return readings if len(np.unique(readings.block)) > 1 else replace(readings, block=None)
    runs = readings.run
    if not runs.any():
        return readings
    known: list[Block] = []
    block = np.zeros(len(readings), dtype=np.int64)
    for number in range(int(runs.max()) + 1):
        own = _guess(readings.select(runs == number), model)
        if own is None:
            continue
        same = [i for i, other in enumerate(known) if not _differs(own, other)]
        if not same:
            known.append(own)
        block[runs == number] = same[0] if same else len(known) - 1
    if len(known) < 2:
        return readings
    return replace(readings, block=block, notes=(*readings.notes, *_told(readings, block)))


def _guess(run: Readings, model: ForwardModel) -> Block | None:
    rows = run.oriented()
    try:
        return first_guess(make_problem(model, rows.conditions(), {}), rows.signal)
    except (CalibrationError, KeyError):
        return None


def _differs(one: Block, other: Block) -> bool:
    (own, cross, zero), scale = OTHER_BLOCK, np.abs(np.diag(other.K))
    change = np.abs(one.K - other.K) / scale[:, None]
    most = np.where(np.eye(3, dtype=bool), own, cross)
    return bool(np.any(change > most) or np.any(np.abs(one.U0 - other.U0) > zero * scale))


def _told(readings: Readings, block: Ints) -> Iterator[str]:
    series = [
        message(
            f"block {number + 1}: series "
            f"{', '.join(str(s) for s in np.unique(readings.series[block == number]))}"
        )
        for number in np.unique(block)
    ]
    yield message(
        f"the coefficients say that these are {len(series)} blocks ({'; '.join(series)}): each has "
        "coefficients of its own, the stand and the meters are the same for all; "
        "--one-block says that they are one"
    )


def find_mistakes_in_each(
    readings: Readings, model: ForwardModel, stand_u: Mapping[str, float], nominal: Floats | None
) -> MistakeSearch:
    """Return the mistakes in several runs, each searched by itself, and a copy of the readings without them.

    The arguments and errors are those of `find_mistakes`, but `nominal` is (3,) or (blocks, 3). The probability of
    a false alarm is divided among the runs, and p-values are multiplied by the number of runs.
    """
    sheets = None if nominal is None else np.atleast_2d(nominal)
    if not readings.run.any():
        return find_mistakes(readings, model, stand_u, None if sheets is None else sheets[0])
    parts = sorted(_searched_together(readings, model), key=lambda part: int(np.argmax(part[0])))
    found = []
    for rows, block in parts:
        sheet = None if sheets is None else sheets[min(block, len(sheets) - 1)]
        found.append(find_mistakes(readings.select(rows), model, stand_u, sheet, HARDLY_EVER / len(parts)))
    if not any(one.mistakes for one in found):
        return MistakeSearch((), readings)
    corrected = stacked([one.corrected for one in found])
    skipped = dict.fromkeys([*readings.skipped, *(row for one in found for row in one.corrected.skipped)])
    return MistakeSearch(
        tuple(_of_run(mistake, readings.select(rows), len(parts))
              for one, (rows, _) in zip(found, parts, strict=True) for mistake in one.mistakes),
        replace(corrected, source=readings.source, notes=readings.notes, skipped=tuple(skipped)),
    )  # fmt: skip


def _searched_together(readings: Readings, model: ForwardModel) -> Iterator[tuple[Mask, int]]:
    """Yield the mask (n,) of rows that are searched together, and the index of their block.

    Each run that determines the coefficients is searched alone; other runs of the block join the first of these, or
    each other if there is none.
    """
    run = readings.run
    block = np.zeros(len(readings), dtype=np.int64) if readings.block is None else readings.block
    for place, number in enumerate(np.unique(block)):
        runs = np.unique(run[block == number]).tolist()
        able = [one for one in runs if _guess(readings.select(run == one), model) is not None]
        unable = [one for one in runs if one not in able]
        for first in able or unable[:1]:
            together = [first, *(unable if first in {*able[:1], *unable[:1]} else [])]
            yield (block == number) & np.isin(run, together), place


def _of_run(mistake: Mistake, run: Readings, runs: int) -> Mistake:
    """Return a mistake found in one of several runs, with the mountings of that run and a p-value for all runs."""
    p = min(runs * mistake.p, 1.0)
    if mistake.installations:
        return replace(mistake, p=p)
    labels = tuple(str(mount) for mount in run.oriented().conditions().mounts)
    series = ", ".join(str(number) for number in np.unique(run.series))
    return replace(mistake, p=p, installations=labels, words=f"series {series}: {mistake.words}")


OWN_IN_EACH_RUN: Final = ("warm_up", "bias_drift", "scale_drift", "voltmeter_drift")
"""Effects that start again with every run and may have a different size in each."""


def candidates_of(linear: LinearSystem, unit_noise: float, absent: Collection[str] = ()) -> Candidates:
    """Return the candidates for readings of one or several runs; the arguments are those of `make_candidates`."""
    if not linear.readings.run.any():
        return make_candidates(linear, unit_noise, absent=absent)
    return make_candidates(linear, unit_noise, _mount_sets, _add_unnamed, absent=absent)


# --- effects of the catalogue -------------------------------------------------------------------------


def _mount_sets(linear: LinearSystem, effect: Effect) -> Iterator[tuple[tuple[str, ...], ...]]:
    """Yield the sets of mountings in which an effect of several runs may act.

    An effect is common to all mountings or to one installation, or differs by block (without shape
    parameters), run or mounting. Effects of single passes are searched in each run instead.
    """
    readings = linear.readings
    if effect.per_pass:
        return
    if not effect.per_mount:
        yield ((),)
        if readings.block is not None and effect.subsystem is Subsystem.BLOCK:
            if not any(parameter.is_shape for parameter in effect.parameters):
                yield tuple(_labels(readings, readings.block))
        elif readings.block is None and effect.name in OWN_IN_EACH_RUN:
            yield tuple(_labels(readings, readings.run))
        return
    mounts = [m for m in linear.moved.mounts if m.installation != VERIFICATION]
    if effect.lasts:
        first = {labels[0] for labels in _labels(readings, readings.run)}
        mounts = [mount for mount in mounts if str(mount) not in first]
    groups = [tuple(str(m) for m in mounts)]
    names = dict.fromkeys(m.installation for m in mounts)
    if len(names) > 1:
        groups += [tuple(str(m) for m in mounts if m.installation == name) for name in names]
    yield from ((group,) for group in groups if group)
    if len(mounts) > 1:
        yield tuple((str(mount),) for mount in mounts)


def _labels(readings: Readings, number: Ints) -> Iterator[tuple[str, ...]]:
    for one in np.unique(number):
        mine = number == one
        pairs = zip(readings.series[mine].tolist(), readings.installation[mine].tolist(), strict=True)
        yield tuple(dict.fromkeys(str(Mounting(series, name)) for series, name in pairs))


# --- families without a name --------------------------------------------------------------------------


def _add_unnamed(collector: Collector, unit: float) -> None:
    rows, readings = collector.linear.rows, collector.linear.readings
    series, run = readings.series, readings.run
    # visits are counted from 1 in each run
    add_free_patterns(collector, unit, series + 1 - [series[run == number].min() for number in run])
    phase = elapsed_part(readings.conditions().elapsed_s, readings.run)[rows.reading]
    for channel in range(3):
        mine = (collector.linear.setting >= 0) & (rows.channel == channel)
        waves = [unit * mine * np.cos(np.pi * k * phase) for k in range(1, FASTEST + 1)]
        collector.add_free(SLOW_IN_TIME, (channel,), waves)
    _add_by_run(collector, readings.run[rows.reading], unit)


def _add_by_run(collector: Collector, run: Ints, unit: float) -> None:
    """Add separate zeros and scale factors for every run, where a block has more than one run."""
    linear = collector.linear
    readings = linear.readings
    block = np.zeros(len(readings), dtype=np.int64) if readings.block is None else readings.block
    if len(set(zip(block.tolist(), readings.run.tolist(), strict=True))) == len(set(block.tolist())):
        return
    for family, first in ((ZERO_BY_RUN, 9), (SCALE_BY_RUN, 0)):
        places: dict[int, tuple[int, ...]] = {}
        for channel in range(3):
            coefficient = first + channel if family == ZERO_BY_RUN else 4 * channel
            # the derivative by the coefficient, scaled so that its largest element equals the noise
            whole = linear.fixed[:, coefficient::12].sum(axis=1)
            scale = unit / max(float(np.max(np.abs(whole))), 1e-300)
            columns = [whole * scale * (run == number) for number in np.unique(run)]
            kind = Column(family, channel)
            places[channel] = tuple(collector.add(column, kind, 1.0) for column in columns)
        for channels in SUBSETS:
            columns_of = tuple(i for channel in channels for i in places[channel])
            collector.variants.append(Variant(family, columns_of, channels))


def elapsed_part(time_s: Floats, run: Ints) -> Floats:
    """Return the fraction of a run, 0 to 1, elapsed at each time (n,), s; `run` (n,) numbers the runs."""
    part = np.zeros(len(run))
    for mine in (run == number for number in np.unique(run)):
        part[mine] = (time_s[mine] - time_s[mine].min()) / max(float(np.ptp(time_s[mine])), 1e-300)
    return part
