"""How large the noise of each run is beside the others': what repeats say before anything is sought.

A run of another day, or read by other meters, has noise of its own size, and weighs by it. The sizes come from
repeats alone, so that what is missing in a run never passes for its noise. Runs are of one size where chance
makes sizes so different: Bartlett's test, its statistic divided by what the kurtosis of the readings adds to its
mean, for with heavy tails sizes scatter more. Sources: M. S. Bartlett, Proc. R. Soc. Lond. A 160 (1937) 268;
G. E. P. Box, S. L. Andersen, J. R. Stat. Soc. B 17 (1955) 1.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from scipy import special

from bench.analysis.diagnosis.linear import LinearSystem, RunSizes
from bench.analysis.diagnosis.repeats import LEAST_FREEDOM, Likeliest, likeliest, parts_of_repeats
from bench.base.arrays import Floats

UNEQUAL_P: Final = 0.01
"""Runs have sizes of their own where chance alone makes them so different less often than this."""


def with_sizes_of_runs(linear: LinearSystem, least: float) -> LinearSystem:
    """Return the system in which each run has noise of its own size, where the runs are not alike.

    `least` is the least noise that is believed, unit of the signal: below it digits tell, not runs. Where a run has
    too few repeats to tell its noise all count as alike.
    """
    by_run = _by_run(linear, least)
    return linear if by_run is None else replace(linear, by_run=by_run)


def _by_run(linear: LinearSystem, least: float) -> RunSizes | None:
    readings = linear.readings
    numbers = np.unique(readings.run)
    if len(numbers) < 2:
        return None
    found: list[Likeliest] = []
    for number in numbers:
        parts = parts_of_repeats(linear, readings.run == number)
        if parts.freedom < LEAST_FREEDOM:
            return None
        found.append(likeliest(parts))
    freedom = np.array([one.freedom for one in found])
    variance = np.maximum([one.sigma**2 for one in found], least**2)
    if p_alike(variance, freedom, _kurtosis(found)) >= UNEQUAL_P:
        return None
    rows = np.bincount(readings.run[linear.rows.reading], minlength=len(numbers))
    return RunSizes(np.sqrt(variance / np.average(variance, weights=rows)), freedom)


def p_alike(variance: Floats, freedom: Floats, kurtosis: float) -> float:
    """Return the probability of variances (runs,) so different where all are alike, each of so many degrees.

    `kurtosis` is the excess of what they are of.
    """
    runs, whole = len(variance), float(freedom.sum())
    apart = whole * np.log(np.average(variance, weights=freedom)) - float(freedom @ np.log(variance))
    apart /= 1.0 + (float(np.sum(1.0 / freedom)) - 1.0 / whole) / (3.0 * (runs - 1))
    return float(special.chdtrc(runs - 1, max(float(apart), 0.0) / (1.0 + max(kurtosis, 0.0) / 2.0)))


def _kurtosis(found: list[Likeliest]) -> float:
    """Return the excess kurtosis of what the repeats leave, each run in units of its own noise."""
    squares = np.concatenate([one.scaled for one in found])
    return float(np.mean(squares**2) / np.mean(squares) ** 2 - 3.0)
