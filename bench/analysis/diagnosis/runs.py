"""What might be missing in many runs of one bench, of one block or of several.

All runs may have the same of an effect, or each its own. What one run alone has (a step, a slip, a reading that
stands apart) is looked for in that run, beside what all have.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Final

import numpy as np

from bench.analysis.diagnosis.candidates import (
    FREE_BY_ANGLE,
    FREE_BY_PASS,
    HEAD_ANGLE,
    SCALE_BY_RUN,
    SLOW_IN_TIME,
    SUBSETS,
    WAVES,
    ZERO_BY_RUN,
    Candidates,
    Collector,
    Column,
    Variant,
    each,
    make_candidates,
)
from bench.analysis.diagnosis.linear import LinearSystem
from bench.base.arrays import Floats, Ints
from bench.model import Effect
from bench.model.conditions import Mounting
from bench.model.effects import Subsystem
from bench.readings.table import VERIFICATION, Readings

OWN_IN_EACH_RUN: Final = ("warm_up", "bias_drift", "scale_drift", "voltmeter_drift")
"""What begins anew with every run need not be as large in each."""


def candidates_of(linear: LinearSystem, unit_noise: float, absent: Collection[str] = ()) -> Candidates:
    """Collect all that might be missing in these readings, of one run or of several; arguments as for one."""
    if not linear.readings.run.any():
        return make_candidates(linear, unit_noise, absent=absent)
    return make_candidates(linear, unit_noise, _mount_sets, _add_unnamed, absent=absent)


# --- effects of the catalogue -------------------------------------------------------------------------


def _mount_sets(linear: LinearSystem, effect: Effect) -> Iterator[tuple[tuple[str, ...], ...]]:
    """Yield the same everywhere, in one installation of every run, each block or run or mounting its own.

    What is of some passes is looked for in each run. An effect with a shape is the same in all blocks, or is found
    in one of them: no shape is looked for that fits blocks of different sizes.
    """
    readings = linear.readings
    if effect.per_pass:
        return
    if not effect.per_mount:
        yield ((),)
        if readings.block is not None and effect.subsystem is Subsystem.BLOCK:
            if not any(parameter.is_shape for parameter in effect.parameters):
                yield tuple(labels for labels in _labels(readings, readings.block))
        elif readings.block is None and effect.name in OWN_IN_EACH_RUN:
            yield tuple(labels for labels in _labels(readings, readings.run))
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
    """Yield for each number in turn the mountings of its rows, in order."""
    for one in np.unique(number):
        mine = number == one
        pairs = zip(readings.series[mine].tolist(), readings.installation[mine].tolist(), strict=True)
        yield tuple(dict.fromkeys(str(Mounting(series, name)) for series, name in pairs))


# --- families without a name --------------------------------------------------------------------------


def _add_unnamed(collector: Collector, unit: float) -> None:
    """Add what has no name: the same in every run, or another zero or scale factor in each."""
    linear, free = collector.linear, collector.add_free
    rows, readings = linear.rows, linear.readings
    run = readings.run[rows.reading]
    oriented = linear.setting >= 0
    angle = np.round(np.degrees(np.nan_to_num(readings.angle_rad[rows.reading])) / 5.0).astype(np.int64)
    mount = list(zip(_visit(readings)[rows.reading], readings.installation[rows.reading], strict=True))
    pass_number = readings.pass_number[rows.reading]
    phase = _phase(readings)[rows.reading]
    for channel in range(3):
        mine = oriented & (rows.channel == channel)
        free(FREE_BY_ANGLE, (channel,), [unit * one for one in each(mine, mount, angle)], several=True)
        free(FREE_BY_PASS, (channel,), [unit * one for one in each(mine, mount, pass_number)], several=True)
        waves = [unit * mine * np.cos(np.pi * k * phase) for k in range(1, WAVES + 1)]
        free(SLOW_IN_TIME, (channel,), waves)
    errors = [np.where(one > 0.0, linear.slope / linear.typical_slope, 0.0) for one in each(oriented, angle)]
    free(HEAD_ANGLE, (0, 1, 2), [unit * one for one in errors], several=True)
    _add_by_run(collector, run, unit)


def _add_by_run(collector: Collector, run: Ints, unit: float) -> None:
    """Add zeros and scale factors of their own in every run, where a block has more than one."""
    linear = collector.linear
    readings = linear.readings
    block = np.zeros(len(readings), dtype=np.int64) if readings.block is None else readings.block
    if len(set(zip(block.tolist(), readings.run.tolist(), strict=True))) == len(set(block.tolist())):
        return
    for family, first in ((ZERO_BY_RUN, 9), (SCALE_BY_RUN, 0)):
        places: dict[int, tuple[int, ...]] = {}
        for channel in range(3):
            coefficient = first + channel if family == ZERO_BY_RUN else 4 * channel
            # the column of the coefficient is the derivative by it: of a size that the noise has
            whole = linear.fixed[:, coefficient::12].sum(axis=1)
            scale = unit / max(float(np.max(np.abs(whole))), 1e-300)
            columns = [whole * scale * (run == number) for number in np.unique(run)]
            kind = Column(family, channel)
            places[channel] = tuple(collector.add(column, kind, 1.0) for column in columns)
        for channels in SUBSETS:
            columns_of = tuple(i for channel in channels for i in places[channel])
            collector.variants.append(Variant(family, columns_of, channels))


def _visit(readings: Readings) -> Ints:
    """Return which visit within its run a row is of, counted from 1."""
    run = readings.run
    visit = np.empty(len(readings), dtype=np.int64)
    for number in np.unique(run):
        mine = run == number
        visit[mine] = readings.series[mine] - readings.series[mine].min() + 1
    return visit


def _phase(readings: Readings) -> Floats:
    """Return how far in its run each reading is, 0 to 1."""
    elapsed = readings.conditions().elapsed_s
    run = readings.run
    phase = np.zeros(len(readings))
    for number in np.unique(run):
        mine = run == number
        phase[mine] = (elapsed[mine] - elapsed[mine].min()) / max(float(np.ptp(elapsed[mine])), 1e-300)
    return phase
