"""What one of several runs has alone: looked for in each, beside what was found in all of them together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.analysis.diagnosis.candidates import Candidates, Column, make_candidates
from bench.analysis.diagnosis.evidence import Whitened
from bench.analysis.diagnosis.linear import LinearSystem, make_linear
from bench.analysis.diagnosis.naming import Found, Naming, name
from bench.analysis.diagnosis.noise_grid import make_noise_grid
from bench.analysis.diagnosis.posterior import NoiseSize, fit_found
from bench.analysis.diagnosis.threshold import Threshold, ThresholdCache
from bench.base.arrays import Floats, Mask
from bench.base.progress import tracked
from bench.readings.table import Readings

TOGETHER: Final = 0.004
"""How often the search over several runs together may find something where nothing is."""

ALONE: Final = 0.002
"""How often that in each of them may, all runs taken together."""


@dataclass(frozen=True)
class _Run:
    """A run by itself: its rows of the whole, with what all runs have in common taken off."""

    rows: Mask
    linear: LinearSystem


def look_in_each(
    linear: LinearSystem,
    candidates: Candidates,
    naming: Naming,
    noise: NoiseSize,
    stand_u: Mapping[str, float],
    setting_rad: float,
    cache: ThresholdCache,
) -> tuple[Candidates, tuple[Found, ...]]:
    """Look in each run for what it has alone; return the candidates with its columns added, and what was found.

    One threshold, that of the first run, serves for all, at a part of the probability for each. Coefficients are
    free in every run: what one has of another zero or scale factor is no find here.
    """
    common = fit_found(linear, candidates, naming, noise).amplitudes
    in_all = candidates.columns[:, list(naming.columns)] @ common
    limit: Threshold | None = None
    found: list[Found] = []
    numbers = np.unique(linear.readings.run)
    for run in tracked(list(_runs(linear, in_all, stand_u)), "runs, each by itself"):
        own = make_candidates(run.linear, noise.reading)
        whitened = Whitened.of(make_noise_grid(run.linear, noise.reading, setting_rad), own)
        if limit is None:
            limit = cache.threshold(run.linear, whitened, setting_rad).at(ALONE / len(numbers))
        alone = name(whitened, whitened.reduce(run.linear.response[:, None]), limit)
        for one in alone.found:
            candidates, embedded = _embedded(candidates, own, one, run)
            found.append(embedded)
    return candidates, tuple(found)


def _runs(linear: LinearSystem, in_all: Floats, stand_u: Mapping[str, float]) -> Iterator[_Run]:
    readings = linear.readings
    of_row = readings.run[linear.rows.reading]
    for number in np.unique(readings.run):
        table = replace(readings.select(readings.run == number), block=None)
        rows: Mask = of_row == number
        alone = make_linear(table, linear.model, stand_u)
        yield _Run(rows, replace(alone, response=alone.response - in_all[rows]))


def _embedded(candidates: Candidates, own: Candidates, one: Found, run: _Run) -> tuple[Candidates, Found]:
    """Return the candidates with the columns of what a run has alone, zero in all others, and the find in them."""
    labels = _labels(run.linear.readings)
    chosen = list(one.variant.columns)
    first = candidates.columns.shape[1]
    columns = np.zeros((len(candidates.columns), len(chosen)))
    columns[run.rows] = own.columns[:, chosen]
    kinds = tuple(
        Column(kind.parameter, kind.channel, kind.mounts or labels) for kind in (own.kinds[i] for i in chosen)
    )
    variant = replace(
        one.variant,
        columns=tuple(range(first, first + len(chosen))),
        mounts=one.variant.mounts or labels,
    )
    grown = Candidates(
        np.column_stack([candidates.columns, columns]),
        (*candidates.kinds, *kinds),
        np.concatenate([candidates.scale, own.scale[chosen]]),
        (*candidates.variants, variant),
    )
    return grown, replace(one, variant=variant)


def _labels(run: Readings) -> tuple[str, ...]:
    return tuple(str(mount) for mount in run.conditions().mounts)
