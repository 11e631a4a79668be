"""What is not known of an effect's shape: it may in part have others, and the u of all else holds that.

A warm-up that was found with a time constant of 20 min may have 25, or two of them; the play of a hysteresis
another width. Beside the shape found stand the others of the catalogue, and those a step beyond either end, each
with a size that is nothing but a prior: so much of what was found may be of it. The readings then say how much.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from bench.analysis.diagnosis.candidates import Candidates, Variant, plausible_columns
from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.naming import Naming
from bench.analysis.diagnosis.posterior import Posterior
from bench.base.arrays import CHANNELS, Floats
from bench.model import CATALOGUE, AppliedEffect, Effect

PART: Final = 0.5
"""Prior 1 sigma of what another shape may have, in sizes of what was found: half of it, as of two alike."""
BEYOND: Final = 2.0
"""A step beyond the ends of a grid of time constants, lags or widths."""

Shape = tuple[tuple[str, float], ...]


def other_shapes(effect: Effect, found: Shape) -> Iterator[Shape]:
    """Yield the shapes that an effect may have in part, beside the one that was found."""
    for place, (name, value) in enumerate(found):
        parameter = next(p for p in effect.parameters if p.name == name)
        if parameter.unit == "1":
            continue  # an order is one or the other: there is nothing between
        grid = [one for one in parameter.grid if one > 0.0]
        zero = [0.0] if 0.0 in parameter.grid else []
        for one in (*zero, grid[0] / BEYOND, *grid, grid[-1] * BEYOND):
            if one != value:
                yield (*found[:place], (name, one), *found[place + 1 :])


def beside(candidates: Candidates, naming: Naming, sized: Posterior) -> tuple[AppliedEffect, ...]:
    """Return what the things found may have of other shapes: values of zero with their prior u, SI.

    `sized` are the sizes with the shapes that were found.
    """
    return tuple(
        applied
        for found, mine in naming.parts()
        for applied in _of(candidates, found.variant, sized.amplitudes[mine])
    )


def _of(candidates: Candidates, variant: Variant, amplitudes: Floats) -> Iterator[AppliedEffect]:
    if not variant.named or not variant.shape:
        return
    effect = CATALOGUE[variant.family]
    kinds = [candidates.kinds[column] for column in variant.columns]
    for shape in other_shapes(effect, variant.shape):
        for mounts in dict.fromkeys(kind.mounts for kind in kinds):
            values: dict[str, Floats] = {name: np.asarray(size) for name, size in shape}
            u: dict[str, Floats] = {}
            for kind, column, amplitude in zip(kinds, variant.columns, amplitudes, strict=True):
                if kind.mounts == mounts:
                    size = PART * abs(float(amplitude)) * candidates.scale[column]
                    empty = np.zeros(() if kind.channel is None else 3)
                    values.setdefault(kind.parameter, empty)
                    u.setdefault(kind.parameter, empty.copy())[
                        () if kind.channel is None else kind.channel
                    ] = size
            channels = tuple(CHANNELS[c] for c in variant.channels)
            yield AppliedEffect(effect, values, channels, u, mounts)


def with_other_shapes(linear: LinearSystem, others: tuple[AppliedEffect, ...]) -> LinearSystem:
    """Return the system with what the effects may have of other shapes among what is unknown by a prior."""
    columns = [column for applied in others for column in _columns(linear, applied)]
    if not columns:
        return linear
    return replace(linear, random=np.column_stack([linear.random, *columns]))


def _columns(linear: LinearSystem, applied: AppliedEffect) -> Iterator[Floats]:
    """Yield the rows (N,) of one prior standard deviation of each parameter."""
    shape = tuple((p.name, float(applied.values[p.name])) for p in applied.effect.parameters if p.is_shape)
    for name, u in applied.u.items():
        parameter = next(p for p in applied.effect.parameters if p.name == name)
        of = plausible_columns(linear, applied.effect, parameter, shape, applied.installations)
        for channel, column in of.items():
            size = float(u[() if channel is None else channel]) / parameter.plausible
            if size > 0.0 and np.any(column):
                yield column * size
