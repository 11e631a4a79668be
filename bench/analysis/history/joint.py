"""What calibrations have in common: the covariance between them."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import Final

import numpy as np

from bench.analysis.calibration.same_meters import METERS_DRIFT
from bench.analysis.history.comparison import Snapshot
from bench.base.arrays import Floats
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
