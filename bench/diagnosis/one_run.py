"""What one of several runs has alone: looked for in each, beside what was found in all of them together."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Mask
from bench.base.computing import tracked
from bench.diagnosis.candidates import Candidates, Column, make_candidates
from bench.diagnosis.evidence import Data, Whitened
from bench.diagnosis.linear import LinearSystem, make_linear
from bench.diagnosis.multi_run_system import candidates_of, make_system
from bench.diagnosis.naming import Found, Naming, Scored, name
from bench.diagnosis.noise_grid import NoiseGrid
from bench.diagnosis.posterior import noise_size, posterior
from bench.diagnosis.repeats import (
    grid_with_rounding,
    noise_of_repeats,
    with_rounding,
    with_sizes_of_runs,
)
from bench.diagnosis.single_run_search import Looked, noise_as_it_is
from bench.diagnosis.threshold import Threshold, ThresholdCache
from bench.diagnosis.weighing import WeighedDown
from bench.model import ForwardModel
from bench.readings.table import Readings

TOGETHER: Final = 0.004
"""How often the search over several runs together may find something where nothing is."""

ALONE: Final = 0.002
"""How often that in each of them may, all runs taken together."""


@dataclass(frozen=True)
class _Run:
    """A run by itself: its rows of the whole, what might be missing in it, and the maps to units of its noise."""

    rows: Mask
    linear: LinearSystem
    candidates: Candidates
    grid: NoiseGrid

    def whitened(self) -> Whitened:
        """Return its candidates in units of the noise; most runs have nothing alone, and need no products."""
        return Whitened.of(self.grid, self.candidates, few_known=True)


COMMON: Final = 5
"""What more than one run in so many shows by itself is not theirs alone."""

UNLIKELY: Final = 5.0
"""What a run has alone stays beside what all have when its ln odds are so much above none."""


@dataclass(frozen=True)
class _EachRun:
    """How each run is searched by itself: limits of the stand, the last digit, thresholds, the noise of a reading.

    `weighed` says by how much rows of all runs are weighed down.
    """

    stand_u: Mapping[str, float]
    setting_rad: float
    resolution: float
    cache: ThresholdCache
    absent: Collection[str]
    sigma: float = 0.0
    weighed: WeighedDown | None = None


def look_at_runs(
    readings: Readings,
    model: ForwardModel,
    stand: Mapping[str, float],
    setting_rad: float,
    cache: ThresholdCache,
    resolution: float,
    absent: Collection[str] = (),
) -> tuple[Looked, Naming]:
    """Prepare readings of several runs and find what is missing; arguments and errors as of `look` for one."""
    each = _EachRun(stand, setting_rad, resolution, cache, absent)

    def again(
        looked: Looked, linear: LinearSystem, limit: Threshold | None = None, most: float = np.inf
    ) -> tuple[Looked, Naming]:
        fresh, naming = _looked(linear, replace(each, weighed=looked.weighed), limit, most)
        return replace(fresh, weighed=looked.weighed), naming

    whole = make_system(readings, model, stand)
    whole = with_sizes_of_runs(whole, resolution / np.sqrt(12.0))
    whole = with_rounding(whole, resolution, noise_of_repeats(whole, resolution).sigma)
    return noise_as_it_is(*_looked(whole, each), again)


def _looked(
    linear: LinearSystem, each: _EachRun, limit: Threshold | None = None, most: float = np.inf
) -> tuple[Looked, Naming]:
    """Look in all runs together and in each, with the noise that the system has; `limit`, `most` where known."""
    repeats = noise_of_repeats(linear, each.resolution)
    repeats = replace(repeats, sigma=min(repeats.sigma, most))
    whitened = Whitened.of(
        grid_with_rounding(linear, repeats.sigma, each.setting_rad, each.resolution),
        candidates_of(linear, repeats.sigma, each.absent),
    )
    limit = limit or each.cache.threshold(linear, whitened, each.setting_rad).at(TOGETHER)
    whitened, naming = _name_in_all_and_each(linear, whitened, limit, replace(each, sigma=repeats.sigma))
    data = whitened.reduce(linear.response[:, None])
    bend = np.zeros(len(linear))
    return Looked(linear, repeats, whitened.candidates, whitened, data, limit, bend), naming


def _name_in_all_and_each(
    linear: LinearSystem, whitened: Whitened, limit: Threshold, each: _EachRun
) -> tuple[Whitened, Naming]:
    """Find what all runs have and what one has alone; return it with the candidates that it is among.

    What a few have alone is looked for first, or it would pass for something that all have; then what all have
    beside it; then again what one has beside that.
    """
    response = linear.response[:, None]
    data = whitened.reduce(response)
    many = len(np.unique(linear.readings.run))
    runs = list(tracked(_runs(linear, each), "runs, each by itself", many))
    of_one = each.cache.threshold(runs[0].linear, runs[0].whitened(), each.setting_rad).at(ALONE / many)
    at_first = _look_in_each(whitened.candidates, runs, np.zeros(len(linear)), of_one)
    grown, alone = at_first
    if alone and len({one.variant.mounts for one in alone}) <= max(1, many // COMMON):
        whitened = Whitened.of(whitened.grid, grown)
        data = whitened.reduce(response)
    else:
        alone = ()
    naming = name(whitened, data, limit, begun=alone)
    if naming.found:
        in_all = _common(linear, whitened, data, naming)
        grown, more = _look_in_each(whitened.candidates, runs, in_all, of_one)
    else:  # the runs are what they were
        grown, more = at_first
    if not alone and not more:
        return whitened, naming
    whitened = Whitened.of(whitened.grid, grown) if more else whitened
    data = whitened.reduce(response)
    begun = [*alone, *more]
    for _ in range(len(begun)):
        naming = name(whitened, data, limit, begun=begun)
        kept = [one for one in begun if _stays(whitened, data, naming, one)]
        if len(kept) == len(begun):
            break
        begun = kept
    else:
        naming = name(whitened, data, limit, begun=begun)
    return whitened, naming


def _stays(whitened: Whitened, data: Data, naming: Naming, one: Found) -> bool:
    """Whether what a run has alone is still there beside all that was found, or gave its place to another form."""
    if one.variant not in [found.variant for found in naming.found]:
        return True
    others = [i for found in naming.found if found.variant != one.variant for i in found.variant.columns]
    scores = Scored.beside(whitened, data, others).scores
    return float(scores.variants[whitened.candidates.variants.index(one.variant), 0]) > UNLIKELY


def _common(linear: LinearSystem, whitened: Whitened, data: Data, naming: Naming) -> Floats:
    """Return what was found puts into the rows of all runs, shape (N,)."""
    columns = whitened.candidates.columns[:, list(naming.columns)]
    fitted = posterior(linear, columns, noise_size(whitened, data, naming.columns))
    return columns @ fitted.amplitudes


def _look_in_each(
    candidates: Candidates, runs: Sequence[_Run], in_all: Floats, limit: Threshold
) -> tuple[Candidates, tuple[Found, ...]]:
    """Look in each run for what it has alone, beside what all have in their rows (N,).

    Return the candidates with the columns of what was found added, and what was found. One threshold, that of the
    first run, serves for all, at a part of the probability for each. Coefficients are free in every run: what one
    has of another zero or scale factor is no find here.
    """
    found: list[Found] = []
    for run in runs:
        whitened = run.whitened()
        response = run.linear.response - in_all[run.rows]
        for one in name(whitened, whitened.reduce(response[:, None]), limit).found:
            candidates, embedded = _embedded(candidates, one, run)
            found.append(embedded)
    return candidates, tuple(found)


def _runs(linear: LinearSystem, each: _EachRun) -> Iterator[_Run]:
    readings = linear.readings
    of_row = readings.run[linear.rows.reading]
    for number in np.unique(readings.run):
        table = replace(readings.select(readings.run == number), block=None)
        rows: Mask = of_row == number
        alone = make_linear(table, linear.model, each.stand_u)
        pull = 0.0 if each.weighed is None else each.weighed.pull[rows]
        alone = replace(alone, response=alone.response + pull, by_channel=linear.by_channel)
        sigma = each.sigma * (1.0 if linear.by_run is None else float(linear.by_run.sizes[number]))
        alone = with_rounding(alone, each.resolution, sigma)
        grid = grid_with_rounding(alone, sigma, each.setting_rad, each.resolution)
        yield _Run(rows, alone, make_candidates(alone, sigma, absent=each.absent), grid)


def _embedded(candidates: Candidates, one: Found, run: _Run) -> tuple[Candidates, Found]:
    """Return the candidates with the columns of what a run has alone, zero in all others, and the find in them."""
    labels, own = _labels(run.linear.readings), run.candidates
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
