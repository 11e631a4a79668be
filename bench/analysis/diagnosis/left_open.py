"""What readings left open of the shapes of what was found, for a model file: independent sizes with their u.

The sizes of all parts of an effect are known together, with a covariance. Its square root, ordered by what it
changes in these readings, gives sizes that are independent of each other; the amplitude of the shape that was found
follows each of them, and is itself as it is known with the shape held.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from bench.analysis.diagnosis.applied import applied_of
from bench.analysis.diagnosis.candidates import Candidates
from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.naming import Naming
from bench.analysis.diagnosis.posterior import NoiseSize, Posterior
from bench.analysis.diagnosis.shapes import Piece, pieces
from bench.base.arrays import Floats
from bench.model import AppliedEffect
from bench.model.effects.in_part import InPart, in_part

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
