"""How large the noise of each channel is beside the others', from what a description of the readings leaves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.analysis.calibration.repeats_likelihood import believed_sizes
from bench.analysis.diagnosis.candidates import Candidates
from bench.analysis.diagnosis.evidence import Data, Whitened
from bench.analysis.diagnosis.linear import LinearSystem
from bench.analysis.diagnosis.posterior import noise_size, posterior, whiten_rows
from bench.analysis.diagnosis.repeats import cells_of
from bench.base.arrays import Floats, Ints, rms

UNEQUAL_P: Final = 0.01
"""Channels have sizes of their own where chance alone makes them so different less often than this."""


@dataclass(frozen=True)
class ChannelSizes:
    """Sizes (3,) of the channels' noise, 1 on the average of squares, and all 1 where they are alike.

    `evidence` is ln odds that they have sizes of their own against one of all, no size of it more likely before.
    """

    sizes: Floats
    evidence: float


def by_channel(left: Floats, freedom: Floats, slope: Floats, cells: Ints, floor: float) -> ChannelSizes:
    """Return the sizes of the channels' noise.

    `left` (n, 3) is what a description leaves of each setting, `freedom` (n,) how much of it the description does
    not take up, `slope` (n, 3) du/dphi: what goes along it is the setting's. `cells` (n,) number settings with
    the same slope, `floor` is the least noise that is believed, unit of the signal.
    """
    count = int(cells.max()) + 1
    free = np.bincount(cells, freedom, count)
    products = (left[:, :, None] * left[:, None, :]).reshape(-1, 9)
    scatter = _by_cell(products, cells, count)
    mean = _by_cell(slope, cells, count) / np.bincount(cells, minlength=count)[:, None]
    used = free > 1e-6
    scatter, free = scatter[used].reshape(1, -1, 3, 3), free[used]
    found = believed_sizes(scatter, free, mean[used][None], floor)
    p_equal = float(found.p_equal[0])
    # of a chi-square with two degrees of freedom half is -ln p; two sizes more cost ln n (Schwarz's criterion)
    evidence = -math.log(max(p_equal, 1e-300)) - math.log(max(float(free.sum()), 1.0))
    if p_equal > UNEQUAL_P:
        return ChannelSizes(np.ones(3), evidence)
    sizes = np.sqrt(found.variances[0, :3])
    return ChannelSizes(np.asarray(sizes / rms(sizes)), evidence)


def _by_cell(columns: Floats, cells: Ints, count: int) -> Floats:
    sums = [np.bincount(cells, column, count) for column in columns.T]
    return np.asarray(np.stack(sums, axis=1), dtype=np.float64)


def sizes_left(
    linear: LinearSystem, candidates: Candidates, whitened: Whitened, data: Data, columns: Sequence[int]
) -> ChannelSizes:
    """Return the sizes of the channels' noise from what the model leaves with these columns of what was found."""
    noise = noise_size(whitened, data, tuple(columns))
    effects = candidates.columns[:, list(columns)]
    fitted = posterior(linear, effects, noise)
    design = np.concatenate([linear.fixed, linear.random, effects], axis=1)
    rows = np.ones(len(linear), dtype=bool)
    white = whiten_rows(linear, noise, design, rows)
    free = 1.0 - np.einsum("np,pq,nq->n", white, fitted.covariance, white, optimize=True)
    oriented = linear.setting >= 0
    of_run = linear.relative_of_run
    left = ((linear.response - design @ fitted.mean) / of_run)[oriented].reshape(-1, 3)
    slope = (linear.slope / of_run)[oriented].reshape(-1, 3)
    floor = 1e-11 * float(np.max(np.abs(linear.readings.signal)))
    return by_channel(left, free[oriented].reshape(-1, 3).mean(axis=1), slope, cells_of(linear), floor)
