"""What calibrations have in common: the covariance between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Final

import numpy as np

from bench.analysis.calibration.same_meters import METERS_DRIFT
from bench.analysis.history.comparison import Snapshot
from bench.base.arrays import Floats, Ints
from bench.model.block import COEFFICIENTS

SECONDS_PER_DAY: Final = 86400.0


def joint_covariances(snapshots: Sequence[Snapshot]) -> Floats:
    """Return for each coefficient the covariance of n calibrations with one another, (12, n, n).

    In common are the gains and offsets of the same meters, less the longer they may have drifted (all, from
    `METERS_DRIFT` on), and K2 and K3 of the same block. Scale factors have to be per one g.
    """
    n = len(snapshots)
    found = np.zeros((len(COEFFICIENTS), n, n))
    meters = np.sqrt(
        np.maximum([np.diag(s.covariance - s.without_meters) for s in snapshots], 0.0)
    )  # (n, 12)
    for i, first in enumerate(snapshots):
        found[:, i, i] = np.diag(first.covariance)
        for j in range(i):
            other = snapshots[j]
            alike = _still_alike(first, other) * meters[i] * meters[j] + _of_block(first, other)
            found[:, i, j] = found[:, j, i] = alike
    return found


@dataclass(frozen=True)
class Joint:
    """The covariance of all twelve coefficients of n calibrations, in its parts.

    `own` (n, 12, 12) belongs to each alone; `meters` (n, 12, 12) are roots of what meters bring, correlated by
    `alike` (n, n); `terms` (n, 12, q) are what K2 and K3 of a block bring to all its calibrations; `block` (n,)
    tells which.
    """

    own: Floats
    meters: Floats
    alike: Floats
    terms: Floats
    block: Ints

    def of_sums(self, weights: Floats) -> Floats:
        """Return the covariance (12, 12) of sums over calibrations, each coefficient with its weights (12, n)."""
        found = np.einsum("kn,ln,nkl->kl", weights, weights, self.own, optimize=True)
        meters = weights.T[:, :, None] * self.meters
        n, size, _ = meters.shape
        mixed = (self.alike @ meters.reshape(n, -1)).reshape(n, size, -1)
        found += np.einsum("nka,nla->kl", meters, mixed, optimize=True)
        for one in np.unique(self.block):
            here = self.block == one
            summed = np.einsum("kn,nkq->kq", weights[:, here], self.terms[here], optimize=True)
            found += summed @ summed.T
        return np.asarray(0.5 * (found + found.T))


def joint_of(snapshots: Sequence[Snapshot]) -> Joint:
    """Return what n calibrations have in common over all twelve coefficients; as `joint_covariances`."""
    size = len(COEFFICIENTS)
    meters = np.array([s.covariance - s.without_meters for s in snapshots])
    level, along = np.linalg.eigh(meters)
    roots = (along * np.sqrt(np.maximum(level, 0.0))[:, None, :]) @ along.swapaxes(1, 2)
    none = np.zeros((size, 0))
    listed = [none if s.block_terms is None else s.block_terms for s in snapshots]
    most = max(one.shape[1] for one in listed)
    terms = np.array([np.pad(one, ((0, 0), (0, most - one.shape[1]))) for one in listed])
    names: dict[tuple[str, int], int] = {}
    block = [
        names.setdefault((s.block, one.shape[1]), len(names))
        for s, one in zip(snapshots, listed, strict=True)
    ]
    alike = np.array([[1.0 if a is b else _still_alike(a, b) for b in snapshots] for a in snapshots])
    own = np.array([s.without_meters for s in snapshots]) - terms @ terms.swapaxes(1, 2)
    return Joint(own, roots, alike, terms, np.array(block, dtype=np.int64))


def _still_alike(first: Snapshot, other: Snapshot) -> float:
    """Return the correlation of errors of the meters, by whole days: 1 on one day, 0 for other meters."""
    if not first.meters or first.meters != other.meters or first.when is None or other.when is None:
        return 0.0
    apart = abs(_day(first.when) - _day(other.when))
    return max(0.0, 1.0 - apart / METERS_DRIFT.days)


def _day(when: datetime) -> float:
    return float(np.floor(when.timestamp() / SECONDS_PER_DAY))


def _of_block(first: Snapshot, other: Snapshot) -> Floats:
    mine, theirs = first.block_terms, other.block_terms
    if mine is None or theirs is None or (first.block, mine.shape) != (other.block, theirs.shape):
        return np.zeros(len(COEFFICIENTS))
    return np.asarray(np.sum(mine * theirs, axis=1))
