"""Parts of the effects found that the readings leave open: other shapes, other channels, starting states.

The u of the coefficients includes them, and a model file states them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats
from bench.diagnosis.candidates import Candidates, Variant, plausible_columns
from bench.diagnosis.evidence import Data, Whitened
from bench.diagnosis.levels import BY_CHANCE, NEGLIGIBLE, UNSEEN
from bench.diagnosis.linear import LinearSystem
from bench.diagnosis.naming import Naming, Scored
from bench.diagnosis.posterior import NoiseSize, Posterior, applied_of
from bench.model.effects import CATALOGUE, AppliedEffect, Effect
from bench.model.effects.base import InPart, in_part
from bench.model.effects.voltmeter import NORMAL_V

PART: Final = 0.5
"""Prior 1 sigma of the size of another shape, as a fraction of the size found."""
BEYOND: Final = 2.0
"""Factor by which other shapes extend beyond the ends of a grid of time constants, lags or widths."""
WIDE: Final = 1.5
"""If the ratio of two neighbours in a grid exceeds this, another shape is put between them."""

Shape = tuple[tuple[str, float], ...]


def other_shapes(effect: Effect, found: Shape) -> Iterator[Shape]:
    """Yield other shapes that the effect, or a part of it, may have in truth.

    One parameter with a unit at a time has values of its grid, between them and just beyond; the others stay.
    """
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
    """Return, for each effect found, parts of other shapes or in other channels that may act besides it.

    Their values are zero, with their prior u in SI. `sized` are the estimates with the shapes found.
    `channels` maps the index of an effect found to the probability (3,) that it acts in each channel
    (`channels_of`).
    """
    return tuple(
        tuple(_of(candidates, found.variant, sized.amplitudes[mine], (channels or {}).get(number)))
        for number, (found, mine) in enumerate(naming.sizes())
    )


def channels_of(whitened: Whitened, data: Data, naming: Naming) -> dict[int, Floats]:
    """Return the probabilities (3,) that the finds (keys: their indices) act in x, y and z, over all forms."""
    plausible = {}
    for number, one in enumerate(naming.found):
        if not one.variant.named:
            continue
        others = [c for i, f in enumerate(naming.found) if i != number for c in f.variant.columns]
        scored = Scored.beside(whitened, data, others)
        members = whitened.candidates.of_family(one.variant.family)
        evidence = scored.scores.variants[members, 0]
        has = np.array([[c in whitened.candidates.variants[m].channels for c in range(3)] for m in members])
        plausible[number] = np.asarray(special.softmax(evidence) @ has)
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
        of_shape = variant._replace(shape=shape)
        yield from applied_of(candidates, of_shape, 0.0 * amplitudes, part * np.abs(amplitudes))
    if plausible is not None and any(p.per_channel for p in effect.parameters):
        yield from _in_other_channels(candidates, variant, np.abs(amplitudes), plausible)
    if effect.name == "voltmeter_nonlinearity":
        # where its curve is zero is a convention: at no voltage with no slope, or at the ends of the range
        size = float(np.max(np.abs(amplitudes * candidates.scale[list(variant.sizes)])))
        yield AppliedEffect(
            CATALOGUE["voltmeter_gain"], {"gain": np.zeros(())}, u={"gain": np.asarray(size / NORMAL_V)}
        )


def _steps(effect: Effect, shape: Shape) -> int:
    """Return the number of shapes in the catalogue's grids and just beyond them, except the shape found."""
    grids = [p.grid for name, _ in shape for p in effect.parameters if p.name == name and p.unit != "1"]
    return sum(len(grid) + 1 for grid in grids)


def _in_other_channels(
    candidates: Candidates, variant: Variant, sizes: Floats, plausible: Floats
) -> Iterator[AppliedEffect]:
    """Yield the effect, in the shape found, for other channels; its u is weighted by their probability."""
    others = [c for c in range(3) if c not in variant.channels and plausible[c] > BY_CHANCE]
    share = np.array([np.sqrt(plausible[c]) if c in others else 0.0 for c in range(3)])
    for one in applied_of(candidates, variant, 0.0 * sizes, sizes):
        u = {name: np.max(of) * share for name, of in one.u.items() if np.ndim(of)}
        if others and u:
            values = {name: value for name, value in one.values.items() if name in u or name not in one.u}
            yield replace(one, values=values, channels=tuple(CHANNELS[c] for c in others), u=u)


def with_other_shapes(linear: LinearSystem, others: tuple[AppliedEffect, ...]) -> LinearSystem:
    """Return the system with the parts of other shapes, `others`, as further unknowns with their prior u."""
    columns = [piece.column for piece in pieces(linear, others)]
    return linear.with_random(*columns) if columns else linear


class OpenSize(NamedTuple):
    """A size limited only by its prior, in a channel (None: all); `column` (N,) is the change by its prior u."""

    applied: AppliedEffect
    parameter: str
    channel: int | None
    column: Floats


def pieces(linear: LinearSystem, others: tuple[AppliedEffect, ...]) -> Iterator[OpenSize]:
    """Yield every size of the effects `others` that has a prior u and changes any of these rows."""
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
                    yield OpenSize(applied, name, channel, column * size)


def left_open(
    linear: LinearSystem,
    candidates: Candidates,
    naming: Naming,
    others: Sequence[tuple[AppliedEffect, ...]],
    fitted: Posterior,
    noise: NoiseSize,
) -> tuple[AppliedEffect, ...]:
    """Return the parts (`InPart`) of the effects found that the readings leave uncertain, for a model file.

    `others` are, for each effect found, its possible parts with other shapes (`beside`). `linear` is the
    system without these parts; `fitted` are the estimates with all these parts, which follow the other random
    columns.
    """
    start = linear.fixed.shape[1] + linear.random.shape[1]
    first = len(fitted.mean) - fitted.effects
    found: list[AppliedEffect] = []
    for (one, mine), of_find in zip(naming.sizes(), others, strict=True):
        rest = list(pieces(linear, of_find))
        places = np.arange(start, start + len(rest))
        start += len(rest)
        if not rest:
            continue
        own = np.arange(first + mine.start, first + mine.stop)
        follows = _follows(fitted.covariance, own, places)
        shown = np.column_stack([piece.column for piece in rest])
        shown = shown + candidates.columns[:, list(one.variant.sizes)] @ follows
        directions = _directions(fitted.covariance[np.ix_(places, places)], shown / noise.reading)
        sizes, *_ = np.linalg.lstsq(directions, fitted.mean[places], rcond=None)
        for direction, size in zip(directions.T, sizes, strict=True):
            change = follows @ direction
            own_part = applied_of(candidates, one.variant, change, np.zeros_like(change))
            parts = (*(replace(a, u={}) for a in own_part), *_applied(rest, direction))
            found.append(in_part(one.variant.family, _next(found, one.variant), parts, float(size), 1.0))
    return tuple(found)


def _next(parts: Sequence[AppliedEffect], variant: Variant) -> int:
    """Return the number of the next of the `parts` that belongs to the family of `variant`."""
    own = (one.effect for one in parts if isinstance(one.effect, InPart))
    return 1 + sum(effect.of == variant.family for effect in own)


def starting_states(
    linear: LinearSystem,
    candidates: Candidates,
    naming: Naming,
    sized: Posterior,
    begun: Sequence[AppliedEffect] = (),
) -> tuple[AppliedEffect, ...]:
    """Return the starting state of each mounting and channel as a part (`InPart`) of the effect found.

    Prior u follows from the size in `sized`; the value is zero unless states repeat. Parts `begun` precede
    these.
    """
    states: list[AppliedEffect] = []
    for found, mine in naming.sizes():
        variant = found.variant
        if not variant.starts:
            continue
        size = sized.amplitudes[mine]
        effect = CATALOGUE[variant.family]
        start = next(p for p in effect.parameters if p.start_of)
        spread = effect.start_spread(linear.conditions)
        (whole,) = applied_of(candidates, variant, size, 0.0 * size)
        of_size = whole.values[start.start_of]
        values = {name: value for name, value in whole.values.items() if name != start.start_of}
        for place, column in enumerate(variant.columns[len(variant.sizes) :], mine.stop):
            kind = candidates.kinds[column]
            assert kind.channel is not None  # noqa: S101 - a state has a channel
            own = np.where(np.arange(3) == kind.channel, of_size * spread, 0.0)
            estimate = sized.amplitudes[place] * candidates.scale[column] / own[kind.channel]
            part = replace(
                whole,
                values=values | {start.name: own},
                channels=(CHANNELS[kind.channel],),
                u={},
                installations=kind.mounts,
            )
            number = _next([*begun, *states], variant)
            value = float(np.clip(estimate, -2.0, 2.0)) if effect.start_repeats else 0.0
            states.append(in_part(variant.family, number, (part,), value, 1.0))
    return tuple(states)


def _follows(covariance: Floats, own: Floats, places: Floats) -> Floats:
    """Return the coefficients (own, others) of a regression of the amplitudes found on the other sizes."""
    of_others = covariance[np.ix_(places, places)]
    return np.asarray(np.linalg.lstsq(of_others, covariance[np.ix_(places, own)], rcond=NEGLIGIBLE)[0].T)


def _directions(covariance: Floats, shown: Floats) -> Floats:
    """Return a square root (m, k) of a covariance, by decreasing change of the readings.

    `shown` (N, m) is the change by each size, in units of noise; negligible columns are left out.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    _, sizes, turned = np.linalg.svd(shown @ root, full_matrices=False)
    return np.asarray((root @ turned.T)[:, sizes > UNSEEN])


def _applied(rest: Sequence[OpenSize], sizes: Floats) -> Iterator[AppliedEffect]:
    """Yield the effects of other shapes with these sizes, each a multiple of its prior standard deviation."""
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
