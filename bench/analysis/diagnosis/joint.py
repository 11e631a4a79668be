"""Several runs as one linear system: shared is what the bench has, of its own what each block has.

Of one block all runs have the same coefficients. Of several blocks each has coefficients of its own, and what
is the stand's and the meters' is the same for all: what is too small for one run shows in many.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy.linalg import block_diag

from bench.analysis.calibration import CalibrationError
from bench.analysis.calibration.calibrate import first_guess
from bench.analysis.calibration.design import make_problem
from bench.analysis.diagnosis.linear import LinearSystem, Rows, make_linear
from bench.analysis.mistakes.search import MistakeSearch, find_mistakes
from bench.base.arrays import Floats, Ints
from bench.model import AppliedEffect, Block, Conditions, ForwardModel, Stage
from bench.model.effects import Subsystem
from bench.readings.joined import stacked
from bench.readings.table import Readings

OTHER_SCALE: Final = 1e-3
OTHER_CROSS: Final = 3e-3
OTHER_ZERO_G: Final = 10e-3
"""Further than this, of the scale factor, a block hardly changes between runs: it is taken for another one."""


@dataclass(frozen=True)
class JointSystem(LinearSystem):
    """The systems of several blocks as one; `block` is the first, `parts` are those of each."""

    parts: tuple[LinearSystem, ...]

    @property
    def g_per_signal(self) -> Floats:
        """What turns a row into g (N,), each by its own block."""
        return self._of_each_block(lambda part: part.g_per_signal)

    def _of_each_block(self, of: Callable[[LinearSystem], Floats]) -> Floats:
        """Return what is of a row by its own block, shape (N,)."""
        assert self.readings.block is not None  # noqa: S101 - it is a system of several
        block = self.readings.block[self.rows.reading]
        size = np.empty(len(self))
        for number, part in zip(np.unique(self.readings.block), self.parts, strict=True):
            mine = block == number
            rows = Rows(self.rows.reading[mine], self.rows.channel[mine])
            size[mine] = of(replace(part, readings=self.readings, rows=rows, response=self.response[mine]))
        return size

    @property
    def relative_of_channel(self) -> Floats:
        """How large the noise of a row is for its channel (N,), of a modulus as its own block shows it."""
        return self._of_each_block(lambda part: replace(part, by_channel=self.by_channel).relative_of_channel)

    @cached_property
    def conditions(self) -> Conditions:
        """The conditions of all readings, in the order of measurement."""
        return self.readings.conditions()

    def effect_column(self, applied: AppliedEffect) -> Floats:
        """Return what an effect with these values adds to the rows, shape (N,)."""
        return np.concatenate([part.effect_column(applied) for part in self.parts])

    def effect_columns(self, applied: AppliedEffect) -> Floats:
        """Return the same for each channel of an effect of the block apart, shape (N, 3)."""
        return np.concatenate([part.effect_columns(applied) for part in self.parts])

    def formula_columns(self, applied: AppliedEffect) -> Floats:
        """Return what an effect that needs no path adds to the rows, the same in all blocks, as of one."""
        return np.concatenate([part.formula_columns(applied) for part in self.parts])

    def course_columns(self, course: Floats, stage: Stage, adds_to: str = "", *, of_force: bool) -> Floats:
        """Return what a course over the readings (n,) adds at a stage, the same in all blocks, as of one."""
        assert self.readings.block is not None  # noqa: S101 - it is a system of several
        own = [course[self.readings.block == number] for number in np.unique(self.readings.block)]
        return np.concatenate(
            [
                part.course_columns(mine, stage, adds_to, of_force=of_force)
                for mine, part in zip(own, self.parts, strict=True)
            ]
        )


def make_system(readings: Readings, model: ForwardModel, stand_u: Mapping[str, float]) -> LinearSystem:
    """Make readings of one block or of several linear. Raises `CalibrationError` as `make_linear` does."""
    if readings.block is None:
        return make_linear(readings, model, stand_u)
    tables = [np.flatnonzero(readings.block == number) for number in np.unique(readings.block)]
    parts = [make_linear(_rows_of(readings, rows), model, stand_u) for rows in tables]
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


def _rows_of(readings: Readings, rows: Ints) -> Readings:
    chosen = np.zeros(len(readings), dtype=bool)
    chosen[rows] = True
    return replace(readings.select(chosen), block=None)


def _random_of(part: LinearSystem, stand_u: Mapping[str, float]) -> tuple[Floats, Floats]:
    """Return the columns that a block shares with others, of what the bench has, and those of its own."""
    problem = make_problem(part.model, part.moved, stand_u)
    of_bench = np.zeros(part.random.shape[1], dtype=bool)
    for place, unknown in enumerate(problem.effects):
        subsystem = part.model.effects[unknown.effect].effect.subsystem
        of_bench[len(problem.stand) + place] = subsystem is not Subsystem.BLOCK
    return part.random[:, of_bench], part.random[:, ~of_bench]


# --- which runs are of one block ----------------------------------------------------------------------


def with_blocks(readings: Readings, model: ForwardModel) -> Readings:
    """Return readings of several runs with the number of the block of each row; None where all are of one.

    Where nobody says it, the coefficients that each run gives tell. A run that does not determine them is
    taken for one of the first block.
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
    scale = np.abs(np.diag(other.K))
    change = np.abs(one.K - other.K) / scale[:, None]
    most = np.where(np.eye(3, dtype=bool), OTHER_SCALE, OTHER_CROSS)
    return bool(np.any(change > most) or np.any(np.abs(one.U0 - other.U0) > OTHER_ZERO_G * scale))


def _told(readings: Readings, block: Ints) -> Iterator[str]:
    series = [
        f"block {number + 1}: series {', '.join(str(s) for s in np.unique(readings.series[block == number]))}"
        for number in np.unique(block)
    ]
    yield (
        f"the coefficients say that these are {len(series)} blocks ({'; '.join(series)}): each has coefficients of "
        "its own, the stand and the meters are the same for all; --one-block says that they are one"
    )


def find_mistakes_in_each(
    readings: Readings, model: ForwardModel, stand_u: Mapping[str, float], nominal: Floats | None
) -> MistakeSearch:
    """Look for mistakes in the runs of each block. `nominal` (3,) or (blocks, 3), else as `find_mistakes`."""
    if readings.block is None:
        return find_mistakes(readings, model, stand_u, None if nominal is None else np.atleast_2d(nominal)[0])
    numbers = np.unique(readings.block)
    sheets = [None] * len(numbers) if nominal is None else np.broadcast_to(nominal, (len(numbers), 3))
    found = [
        find_mistakes(readings.select(readings.block == number), model, stand_u, sheet)
        for number, sheet in zip(numbers, sheets, strict=True)
    ]
    corrected = stacked([one.corrected for one in found])
    return MistakeSearch(
        tuple(mistake for one in found for mistake in one.mistakes),
        replace(corrected, source=readings.source, notes=readings.notes, skipped=_skipped(found, readings)),
        sum(one.looks for one in found),
    )


def _skipped(found: list[MistakeSearch], readings: Readings) -> tuple[str, ...]:
    return tuple(dict.fromkeys([*readings.skipped, *(row for one in found for row in one.corrected.skipped)]))
