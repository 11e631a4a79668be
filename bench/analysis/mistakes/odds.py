"""The odds of a gross mistake where nobody believes the bench's limits: its errors may be of any size above them.

Hand-set positions tilt by degrees, and a supposition that leaves readings out fits what is left the better for
it. So the sizes of two errors, one common to the repeats of a position and one of each reading, are integrated
over, and so are the coefficients; a reading that a supposition leaves out is predicted by nothing, and costs what
a signal costs that may be anything within its range.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.analysis.mistakes.reinterpretation import Oriented
from bench.base.arrays import Floats

SIZES: Final = 10
"""Sizes of each of the two errors that are tried, evenly in their logarithm,"""
LARGEST_G: Final = 0.1
"""up to this, six degrees: a larger one would take a block that contradicts its data sheet for a tilted one."""


@dataclass(frozen=True)
class Prior:
    """Means and standard deviations (4, 3) of (K_ix, K_iy, K_iz, U0_i), in g and g/g."""

    mean: Floats
    u: Floats


def log_evidence(
    table: Oriented, columns: Floats, unit: float, prior: Prior, least_g: float, left_out: int
) -> float:
    """Return ln of the probability of the readings: errors of `least_g` or more, coefficients of a prior.

    `columns` (n, 4) are specific forces and ones, `unit` what 1 g is in the signals; `left_out` readings of the
    record are not in the table.
    """
    signal = table.signal / unit
    sizes = np.geomspace(least_g, max(LARGEST_G, least_g), SIZES) ** 2
    of_reading, of_position = (v.ravel() for v in np.meshgrid(sizes, np.append(0.0, sizes)))
    within, means = _split(table, np.concatenate([columns, signal], axis=1))
    precision = 1.0 / of_reading
    freedom = len(table) - sum(count for count, _ in means.values())
    normal = within * precision[:, None, None]
    log_det = -freedom * np.log(precision)
    for repeats, (count, gram) in means.items():
        weight = 1.0 / (of_reading + repeats * of_position)
        normal = normal + gram * weight[:, None, None]
        log_det = log_det - count * np.log(weight)
    total = np.zeros(len(precision))
    for channel in range(3):
        total += _of_channel(normal, log_det, prior.mean[:, channel], prior.u[:, channel], 4 + channel)
    lost = -0.5 * 3 * left_out
    return float(np.logaddexp.reduce(total) - np.log(len(total)) + lost)


def _of_channel(normal: Floats, log_det: Floats, mean: Floats, u: Floats, own: int) -> Floats:
    """Return ln of the evidence of a channel for each pair of sizes, but for ln(2 pi)/2 for each reading."""
    inner, right, square = normal[:, :4, :4], normal[:, :4, own], normal[:, own, own]
    around = right - inner @ mean
    left = square - 2 * right @ mean + np.einsum("a,gab,b->g", mean, inner, mean)
    whole = inner + np.diag(u**-2)
    taken = np.einsum("ga,ga->g", around, np.linalg.solve(whole, around[:, :, None])[:, :, 0])
    size = np.linalg.slogdet(whole * np.outer(u, u))[1]
    return np.asarray(-0.5 * (log_det + size + left - taken))


def _split(table: Oriented, columns: Floats) -> tuple[Floats, dict[int, tuple[int, Floats]]]:
    """Return X^T X of what differs among the repeats of a position, and that of the positions' means.

    The latter by the number of repeats, with how many positions have so many; to a degree the same position.
    """
    label = np.unique(table.label, return_inverse=True)[1].ravel()
    key = np.stack([table.mount, label, np.round(np.degrees(table.angle_rad)).astype(np.int64)], axis=1)
    _, group = np.unique(key, axis=0, return_inverse=True)
    repeats = np.bincount(group.ravel())
    sums = np.zeros((len(repeats), columns.shape[1]))
    np.add.at(sums, group.ravel(), columns)
    mean = sums / np.sqrt(repeats)[:, None]
    of_repeats = {
        int(m): (int(np.sum(repeats == m)), mean[repeats == m].T @ mean[repeats == m])
        for m in np.unique(repeats)
    }
    return columns.T @ columns - mean.T @ mean, of_repeats
