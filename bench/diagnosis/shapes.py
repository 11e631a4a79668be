"""Unknown shapes of effects: the uncertainty that they add, and what a model file keeps of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from bench.base.arrays import CHANNELS, Floats
from bench.diagnosis.candidates import Candidates, Variant, plausible_columns
from bench.diagnosis.evidence import Data, Whitened
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.naming import Naming, Scored
from bench.diagnosis.posterior import NoiseSize, Posterior, applied_of
from bench.model.effects import CATALOGUE, AppliedEffect, Effect
from bench.model.effects.base import InPart, in_part
from bench.model.effects.voltmeter import NORMAL_V

PART: Final = 0.5
"""Prior 1 sigma of what another shape may have, in sizes of what was found: half of it, as of two alike."""
BEYOND: Final = 2.0
"""A step beyond the ends of a grid of time constants, lags or widths."""
WIDE: Final = 1.5
"""Neighbours of a grid that are further apart than so many times have another shape between them."""
HARDLY: Final = 0.01
"""A channel that has the effect with no more probability is left out."""

Shape = tuple[tuple[str, float], ...]


def other_shapes(effect: Effect, found: Shape) -> Iterator[Shape]:
    """Yield the shapes that an effect may have in part, beside the one that was found."""
    for place, (name, value) in enumerate(found):
        parameter = next(p for p in effect.parameters if p.name == name)
        if parameter.unit == "1":
            continue  # an order is one or the other: there is nothing between
        grid = sorted(one for one in parameter.grid if one > 0.0)
        zero = [0.0] if 0.0 in parameter.grid else []
        whole = [grid[0] / BEYOND, *grid, grid[-1] * BEYOND]
        between = [np.sqrt(a * b) for a, b in pairwise(whole) if b > WIDE * a]
        for one in (*zero, *sorted([*whole, *map(float, between)])):
            if one != value:
                yield (*found[:place], (name, one), *found[place + 1 :])


def beside(
    candidates: Candidates, naming: Naming, sized: Posterior, channels: Mapping[int, Floats] | None = None
) -> tuple[tuple[AppliedEffect, ...], ...]:
    """Return what each of the things found may have of other shapes: values of zero with their prior u, SI.

    `sized` are the sizes with the shapes that were found, `channels` (3,) how plausible it is of each find, by
    its number, that a channel has it (`channels_of`).
    """
    return tuple(
        tuple(_of(candidates, found.variant, sized.amplitudes[mine], (channels or {}).get(number)))
        for number, (found, mine) in enumerate(naming.parts())
    )


def channels_of(whitened: Whitened, data: Data, naming: Naming) -> dict[int, Floats]:
    """Return for each find how plausible it is that a channel has it (3,), by the evidence of its forms."""
    plausible = {}
    for number, one in enumerate(naming.found):
        if not one.variant.named:
            continue
        others = [c for i, f in enumerate(naming.found) if i != number for c in f.variant.columns]
        scored = Scored.beside(whitened, data, others)
        members = whitened.candidates.of_family(one.variant.family)
        evidence = scored.scores.variants[members, 0]
        weight = np.exp(evidence - evidence.max())
        has = np.array([[c in whitened.candidates.variants[m].channels for c in range(3)] for m in members])
        plausible[number] = np.asarray(weight @ has / weight.sum())
    return plausible


def _of(
    candidates: Candidates, variant: Variant, amplitudes: Floats, plausible: Floats | None
) -> Iterator[AppliedEffect]:
    if not variant.named:
        return
    effect = CATALOGUE[variant.family]
    others = list(other_shapes(effect, variant.shape))
    # as much in all, however many there are
    part = PART * np.sqrt(_steps(effect, variant.shape) / len(others)) if others else 0.0
    for shape in others:
        yield from _with_shape(candidates, variant, shape, part * np.abs(amplitudes))
    if plausible is not None and any(p.per_channel for p in effect.parameters):
        yield from _in_other_channels(candidates, variant, np.abs(amplitudes), plausible)
    if effect.name == "voltmeter_nonlinearity":
        # where its curve is zero is a convention: at no voltage with no slope, or at the ends of the range
        size = float(np.max(np.abs(amplitudes * candidates.scale[list(variant.columns)])))
        yield AppliedEffect(
            CATALOGUE["voltmeter_gain"], {"gain": np.zeros(())}, u={"gain": np.asarray(size / NORMAL_V)}
        )


def _steps(effect: Effect, shape: Shape) -> int:
    """Return how many shapes the catalogue itself tries, and those beyond its ends, but for the one found."""
    grids = [p.grid for name, _ in shape for p in effect.parameters if p.name == name and p.unit != "1"]
    return sum(len(grid) + 1 for grid in grids)


def _with_shape(
    candidates: Candidates, variant: Variant, shape: Shape, sizes: Floats
) -> Iterator[AppliedEffect]:
    """Yield the effect with another shape in the channels found; `sizes` of the columns, plausible sizes."""
    kinds = [candidates.kinds[column] for column in variant.columns]
    for mounts in dict.fromkeys(kind.mounts for kind in kinds):
        values: dict[str, Floats] = {name: np.asarray(size) for name, size in shape}
        u: dict[str, Floats] = {}
        for kind, column, size in zip(kinds, variant.columns, sizes, strict=True):
            if kind.mounts == mounts:
                empty = np.zeros(() if kind.channel is None else 3)
                values.setdefault(kind.parameter, empty)
                of = u.setdefault(kind.parameter, empty.copy())
                of[() if kind.channel is None else kind.channel] = size * candidates.scale[column]
        channels = tuple(CHANNELS[c] for c in variant.channels)
        yield AppliedEffect(CATALOGUE[variant.family], values, channels, u, mounts)


def _in_other_channels(
    candidates: Candidates, variant: Variant, sizes: Floats, plausible: Floats
) -> Iterator[AppliedEffect]:
    """Yield the effect with the shape found in the channels that may have it, too, each as plausibly as said."""
    others = [c for c in range(3) if c not in variant.channels and plausible[c] > HARDLY]
    kinds = [candidates.kinds[column] for column in variant.columns]
    for mounts in dict.fromkeys(kind.mounts for kind in kinds):
        largest: dict[str, float] = {}
        for kind, column, size in zip(kinds, variant.columns, sizes, strict=True):
            if kind.mounts == mounts and kind.channel is not None:
                known = largest.get(kind.parameter, 0.0)
                largest[kind.parameter] = max(known, float(size * candidates.scale[column]))
        if not others or not largest:
            continue
        share = np.array([np.sqrt(plausible[c]) if c in others else 0.0 for c in range(3)])
        values: dict[str, Floats] = {name: np.asarray(size) for name, size in variant.shape}
        yield AppliedEffect(
            CATALOGUE[variant.family],
            values | {name: np.zeros(3) for name in largest},
            tuple(CHANNELS[c] for c in others),
            {name: size * share for name, size in largest.items()},
            mounts,
        )


def with_other_shapes(linear: LinearSystem, others: tuple[AppliedEffect, ...]) -> LinearSystem:
    """Return the system with what the effects may have of other shapes among what is unknown by a prior."""
    columns = [piece.column for piece in pieces(linear, others)]
    if not columns:
        return linear
    return replace(linear, random=np.column_stack([linear.random, *columns]))


class Piece(NamedTuple):
    """One size that is open: its effect, its parameter and channel (None: of all), the rows (N,) of one prior u."""

    applied: AppliedEffect
    parameter: str
    channel: int | None
    column: Floats


def pieces(linear: LinearSystem, others: tuple[AppliedEffect, ...]) -> Iterator[Piece]:
    """Yield the sizes that show in these readings."""
    for applied in others:
        shape = tuple(
            (p.name, float(applied.values[p.name])) for p in applied.effect.parameters if p.is_shape
        )
        for name, u in applied.u.items():
            parameter = next(p for p in applied.effect.parameters if p.name == name)
            of = plausible_columns(linear, applied.effect, parameter, shape, applied.installations)
            for channel, column in of.items():
                size = float(u[() if channel is None else channel]) / parameter.plausible
                if size > 0.0 and np.any(column):
                    yield Piece(applied, name, channel, column * size)


SHOWS: Final = 0.3
"""What changes these readings by less, in units of noise in all, is left out."""
ROUNDING: Final = 1e-12


def left_open(
    linear: LinearSystem,
    candidates: Candidates,
    naming: Naming,
    others: Sequence[tuple[AppliedEffect, ...]],
    fitted: Posterior,
    noise: NoiseSize,
) -> tuple[AppliedEffect, ...]:
    """Return what is open of each find; `others` are the parts that it may have, which `fitted` estimates, too.

    `linear` is the system without them, `fitted` the estimate with all of them behind its random columns.
    """
    start = linear.fixed.shape[1] + linear.random.shape[1]
    first = len(fitted.mean) - fitted.effects
    found: list[AppliedEffect] = []
    for (one, mine), of_find in zip(naming.parts(), others, strict=True):
        rest = list(pieces(linear, of_find))
        places = np.arange(start, start + len(rest))
        start += len(rest)
        if not rest:
            continue
        own = np.arange(first + mine.start, first + mine.stop)
        follows = _follows(fitted.covariance, own, places)
        shown = np.column_stack([piece.column for piece in rest])
        shown = shown + candidates.columns[:, list(one.variant.columns)] @ follows
        directions = _directions(fitted.covariance[np.ix_(places, places)], shown / noise.reading)
        sizes, *_ = np.linalg.lstsq(directions, fitted.mean[places], rcond=None)
        for direction, size in zip(directions.T, sizes, strict=True):
            change = follows @ direction
            own_part = applied_of(candidates, one.variant, change, np.zeros_like(change))
            parts = (*(_without_u(a) for a in own_part), *_applied(rest, direction))
            number = 1 + sum(
                isinstance(a.effect, InPart) and a.effect.of == one.variant.family for a in found
            )
            found.append(in_part(one.variant.family, number, parts, float(size), 1.0))
    return tuple(found)


def _follows(covariance: Floats, own: Floats, places: Floats) -> Floats:
    """Return by how much the amplitudes found change with the other sizes, shape (own, others)."""
    of_others = covariance[np.ix_(places, places)]
    return np.asarray(np.linalg.lstsq(of_others, covariance[np.ix_(places, own)], rcond=ROUNDING)[0].T)


def _directions(covariance: Floats, shown: Floats) -> Floats:
    """Return a square root of a covariance, column by column what changes the readings most, shape (m, k).

    `shown` (N, m) is what a unit of each size changes, in units of noise.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    _, sizes, turned = np.linalg.svd(shown @ root, full_matrices=False)
    return np.asarray((root @ turned.T)[:, sizes > SHOWS])


def _applied(rest: Sequence[Piece], sizes: Floats) -> Iterator[AppliedEffect]:
    """Yield the other shapes with these sizes, in prior standard deviations of each."""
    by_effect: dict[int, tuple[AppliedEffect, dict[str, Floats]]] = {}
    for piece, size in zip(rest, sizes, strict=True):
        _, values = by_effect.setdefault(id(piece.applied), (piece.applied, {}))
        u = np.asarray(piece.applied.u[piece.parameter], dtype=np.float64)
        at = () if piece.channel is None else piece.channel
        values.setdefault(piece.parameter, np.zeros_like(u))[at] = size * u[at]
    for applied, values in by_effect.values():
        shape = {p.name: applied.values[p.name] for p in applied.effect.parameters if p.is_shape}
        yield AppliedEffect(
            applied.effect, shape | values, applied.channels, installations=applied.installations
        )


def _without_u(applied: AppliedEffect) -> AppliedEffect:
    return AppliedEffect(
        applied.effect, applied.values, applied.channels, installations=applied.installations
    )
