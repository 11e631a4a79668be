"""The search in one run, linearised again about the effects found until it is accurate enough."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Protocol

import numpy as np

from bench.base.arrays import Floats
from bench.calibration.design import FIXED
from bench.calibration.result import CalibrationError
from bench.diagnosis.candidates import SLIP, Candidates, make_candidates
from bench.diagnosis.evidence import Data, Threshold, ThresholdCache, Whitened
from bench.diagnosis.linear import LinearSystem, make_linear
from bench.diagnosis.naming import MOST_EFFECTS, Naming, Scored, name
from bench.diagnosis.noise_grid import (
    RATIOS,
    Repeats,
    grid_with_rounding,
    make_noise_grid,
    noise_of_repeats,
    with_rounding,
)
from bench.diagnosis.noise_kinds import (
    SlowNoise,
    WeighedDown,
    beside_all_sizes,
    sizes_left,
    slow_noise,
    weigh_down,
    with_slow_noise,
)
from bench.diagnosis.posterior import applied_of, fit_found, noise_size
from bench.model.forward import ForwardModel
from bench.model.geometry import Block
from bench.readings.table import Readings

CLEAR: Final = 6.0
"""What is so far above the threshold is there whatever the ratio of the noises."""
HARDLY: Final = 2.0
"""A name that is no further above the threshold must reach it beside slow noise, too."""
PLAUSIBLE: Final = 1.0
"""Prior odds of slow noise where something seems to be missing."""
TOO_LARGE: Final = 0.7
"""Repeats that say more than the noise over this have what was found in them, as a reading that stands apart is."""
SAME_SIZE: Final = 0.1
"""Relative difference within which the channels' noise sizes count as the same."""


@dataclass(frozen=True)
class Prepared:
    """Readings prepared for the search: linear system, whitened candidates, data products and threshold.

    `bend` (N,) is the nonlinear part of the finds, subtracted from the response. `weighed` is the correction
    for heavy tails of the noise. `slow` is the slow noise among the random columns.
    """

    linear: LinearSystem
    repeats: Repeats
    candidates: Candidates
    whitened: Whitened
    data: Data
    limit: Threshold
    bend: Floats
    weighed: WeighedDown | None = None
    slow: tuple[SlowNoise, ...] = ()


Prepare = Callable[[LinearSystem, Threshold, float], Prepared]
"""Prepares readings for a search, with the limit of such readings and the most that their noise is."""


class ReweightedSearch(Protocol):
    """Looks for all again in readings that are weighed otherwise: about what `prepared` is about."""

    def __call__(
        self, prepared: Prepared, linear: LinearSystem, limit: Threshold | None = None, most: float = np.inf
    ) -> tuple[Prepared, Naming]:
        """Prepare and search `linear`, with the `limit` of such readings and the `most` noise where known."""


def noise_as_it_is(prepared: Prepared, naming: Naming, again: ReweightedSearch) -> tuple[Prepared, Naming]:
    """Look for all again where what is left has heavy tails, and where its channels differ.

    What explains more of the readings than all that was found, as channels with noise of their own may, stands in
    its place. Readings that are rounded alike tell nothing of their noise: that of rounding is believed.
    """
    if prepared.whitened.grid.known:
        return prepared, naming
    prepared, naming = _own_sizes_instead(prepared, naming, again)
    noise = noise_size(prepared.whitened, prepared.data, naming.columns)
    if noise.reading < TOO_LARGE * prepared.repeats.sigma:
        prepared, naming = again(prepared, prepared.linear, prepared.limit, noise.reading)
        noise = noise_size(prepared.whitened, prepared.data, naming.columns)
    weighed = weigh_down(prepared.linear, prepared.candidates, naming, noise)
    if weighed is not None:
        # the noise is smaller for it, and the limits of the stand are larger beside it
        less = replace(prepared.linear, response=prepared.linear.response + weighed.pull)
        prepared, naming = again(replace(prepared, weighed=weighed), less, prepared.limit, noise.reading)
    sizes = sizes_left(
        prepared.linear, prepared.candidates, prepared.whitened, prepared.data, naming.columns
    ).sizes
    if np.max(np.abs(np.log(sizes / prepared.linear.by_channel))) < SAME_SIZE:
        return prepared, naming
    noise = noise_size(prepared.whitened, prepared.data, naming.columns)
    return again(prepared, replace(prepared.linear, by_channel=sizes), most=noise.reading)


def _own_sizes_instead(
    prepared: Prepared, naming: Naming, again: ReweightedSearch
) -> tuple[Prepared, Naming]:
    """Look for all again where channels with noise of their own sizes explain more than all that was found.

    A channel with more noise than the others looks as if something were missing in it alone, and what takes that up
    leaves the channels alike. What is really missing is the better explanation by far: it knows where and when.
    """
    if not naming.found or np.any(prepared.linear.by_channel != 1.0):
        return prepared, naming
    told = sizes_left(prepared.linear, prepared.candidates, prepared.whitened, prepared.data, ())
    if told.evidence < sum(found.total for found in naming.found):
        return prepared, naming
    return again(prepared, replace(prepared.linear, by_channel=told.sizes))


def beside_slow_noise(prepared: Prepared, naming: Naming, prepare: Prepare) -> tuple[Prepared, Naming]:
    """Look for all again beside slow noise, where that stands in the place of all that was found (`_instead`).

    What is found clearly is there: never does it, or what was found beside it, pass for slow noise.
    """
    strongest = max((found.total for found in naming.found), default=-np.inf)
    if prepared.whitened.grid.known or strongest > prepared.limit.value + CLEAR:
        return prepared, naming
    noise = noise_size(prepared.whitened, prepared.data, naming.columns)
    slow = _instead(prepared, naming, noise.reading)
    if not slow:
        return prepared, naming
    again = prepare(with_slow_noise(prepared.linear, slow), prepared.limit, noise.reading)
    again = replace(again, bend=prepared.bend, weighed=prepared.weighed, slow=slow)
    return again, name(again.whitened, again.data, again.limit)


def _instead(prepared: Prepared, naming: Naming, noise: float) -> tuple[SlowNoise, ...]:
    """Return the slow noise that stands in the place of what was found, nothing where that holds.

    It is that of the channels in which it shows by itself. Where that explains less, what was found must reach the
    threshold beside slow noise of all channels, too, whatever its size: a name that hardly does without, and what
    has none. A slip that reaches the threshold of slips is there by that.
    """
    sure = slow_noise(
        prepared.linear, prepared.whitened, Scored.beside(prepared.whitened, prepared.data, ()).ratio
    )
    if sure and sum(one.odds for one in sure) >= sum(found.evidence for found in naming.found):
        return sure
    limit, strongest = prepared.limit.value, max((found.total for found in naming.found), default=-np.inf)
    named = all(found.variant.named for found in naming.found)
    if strongest < limit or (named and strongest > limit + HARDLY) or _slipped(prepared.limit, naming):
        return ()
    beside = beside_all_sizes(prepared.linear, prepared.whitened, noise, PLAUSIBLE)
    if beside is None or beside.total >= limit:
        return ()
    return sure or beside.slow


def _slipped(limit: Threshold, naming: Naming) -> bool:
    """Whether a slip was found that reaches the threshold of slips."""
    return any(found.variant.family == SLIP and limit.by_slip(found.of_slip) for found in naming.found)


def in_the_noise_of(
    prepared: LinearSystem, weighed: WeighedDown | None, linear: LinearSystem
) -> LinearSystem:
    """Return a system of the same readings and another model, its noise as it was found: `prepared`, `weighed`.

    Of several blocks the sizes alone: their rows stand in another order.
    """
    linear = replace(linear, by_channel=prepared.by_channel, by_run=prepared.by_run)
    if prepared.readings.block is not None:
        return linear
    pull = 0.0 if weighed is None else weighed.pull
    of_noise = prepared.random[:, prepared.random.shape[1] - prepared.of_noise :]
    return replace(
        linear,
        response=linear.response + pull,
        random=np.column_stack([linear.random, of_noise]),
        of_noise=prepared.of_noise,
    )


BENT: Final = 0.3
"""What an effect may change a reading beyond its columns, in units of noise, and count as linear."""
STEPS: Final = 6
"""Steps after which what is not linear yet stays as it is: it is left over, and told."""
FINER: Final = (0.6, 0.77, 1.0, 1.3, 1.67)
"""Ratios about that of the noises as they were found: parts of it."""


@dataclass(frozen=True)
class _Task:
    readings: Readings
    model: ForwardModel
    stand: Mapping[str, float]
    setting_rad: float
    resolution: float
    cache: ThresholdCache
    absent: Collection[str]

    def linear(self, readings: Readings) -> LinearSystem:
        """Make readings linear; with the error of rounding that repeats, where the last digit is coarse."""
        linear = make_linear(readings, self.model, self.stand)
        repeats = noise_of_repeats(linear, self.resolution)
        return with_rounding(linear, self.resolution, repeats.sigma)


def search_run(
    readings: Readings,
    model: ForwardModel,
    stand: Mapping[str, float],
    setting_rad: float,
    cache: ThresholdCache,
    resolution: float,
    absent: Collection[str] = (),
) -> tuple[Prepared, Naming]:
    """Prepare readings and find what is missing: the first find is made linear before the others are looked for.

    The noise is taken as it is (`noise_as_it_is`), and beside slow noise all is looked for again.

    `stand` holds standard uncertainties by the names in `STAND_ANGLES`, rad, `setting_rad` that of a setting,
    `resolution` the last digit of the signals. Effects that are `absent` from the bench are not looked for.
    Raises `CalibrationError` where there is too little to fit.
    """
    task = _Task(readings, model, stand, setting_rad, resolution, cache, absent)

    def again(
        prepared: Prepared, linear: LinearSystem, limit: Threshold | None = None, most: float = np.inf
    ) -> tuple[Prepared, Naming]:
        fresh = _prepared(task, linear, limit, most)
        return _searched_again(task, replace(fresh, bend=prepared.bend, weighed=prepared.weighed))

    first = _searched_again(task, _prepared(task, task.linear(readings)))
    prepared, naming = noise_as_it_is(*first, again)
    prepared, naming = beside_slow_noise(prepared, naming, partial(_prepared, task))
    return prepared, _closer(task, prepared, naming)


def _closer(task: _Task, prepared: Prepared, naming: Naming) -> Naming:
    """Find again what hardly reached the threshold, with the ratio of the noises on a finer grid about its own.

    Between two ratios of the grid of the search a setting error is up to 1.4 times as large as it is taken for, and
    effects that act as it does look as much more than they are.
    """
    if not naming.found or min(found.total for found in naming.found) > prepared.limit.value + CLEAR:
        return naming
    linear, coarse = prepared.linear, prepared.whitened.grid
    noise = noise_size(prepared.whitened, prepared.data, naming.columns)
    ratio = noise.setting_rad / noise.reading * linear.typical_slope
    if ratio < RATIOS[1]:
        return naming
    grid = make_noise_grid(linear, coarse.sigma, task.setting_rad, [ratio * part for part in FINER])
    whitened = Whitened.of(replace(grid, known=coarse.known), prepared.candidates)
    return name(whitened, whitened.reduce(linear.response[:, None]), prepared.limit)


def _searched_again(task: _Task, prepared: Prepared) -> tuple[Prepared, Naming]:
    """Return the finds, linearised again about them until the system is accurate enough."""
    most = 1
    naming = name(prepared.whitened, prepared.data, prepared.limit, most)
    for _ in range(STEPS):
        closer = _relinearised(task, prepared, naming) if naming.found else None
        if closer is None:
            if not naming.found or most == MOST_EFFECTS:
                return prepared, naming
            most = MOST_EFFECTS
        prepared = closer or prepared
        naming = name(prepared.whitened, prepared.data, prepared.limit, most)
    return prepared, name(prepared.whitened, prepared.data, prepared.limit)


def _prepared(
    task: _Task, linear: LinearSystem, limit: Threshold | None = None, most: float = np.inf
) -> Prepared:
    """Prepare readings for the search; with the `limit` of such readings and the `most` noise where known."""
    repeats = noise_of_repeats(linear, task.resolution)
    repeats = replace(repeats, sigma=min(repeats.sigma, most))
    grid = grid_with_rounding(linear, repeats.sigma, task.setting_rad, task.resolution)
    candidates = make_candidates(linear, repeats.sigma, absent=task.absent)
    whitened = Whitened.of(grid, candidates)
    limit = limit or task.cache.threshold(linear, whitened, task.setting_rad)
    data = whitened.reduce(linear.response[:, None])
    return Prepared(linear, repeats, candidates, whitened, data, limit, np.zeros(len(linear)))


def _relinearised(task: _Task, prepared: Prepared, naming: Naming) -> Prepared | None:
    """Return the readings linearised about the finds; None where they are linear enough already."""
    linear, candidates = prepared.linear, prepared.candidates
    noise = noise_size(prepared.whitened, prepared.data, naming.columns)
    fitted = fit_found(linear, candidates, naming, noise)
    parts = [(f.variant, fitted.amplitudes[place]) for f, place in naming.parts() if f.variant.named]
    if not parts:
        return None
    effects = tuple(a for v, value in parts for a in applied_of(candidates, v, value, 0.0 * value))
    block = Block.from_vector(linear.block.vector + fitted.mean[:FIXED])
    change = linear.view.own(linear.model, effects, block)
    columns = [column for variant, _ in parts for column in variant.columns]
    sizes = np.concatenate([value for _, value in parts])
    moved = linear.rows_of(change)
    bend = moved - candidates.columns[:, columns] @ sizes - prepared.bend
    if float(np.max(np.abs(bend))) < BENT * noise.reading:
        return None
    readings = task.readings
    try:
        again = task.linear(replace(readings, signal=readings.signal - change))
    except CalibrationError:  # what was found is too large to be true
        return None
    told = make_candidates(again, prepared.repeats.sigma, absent=task.absent)
    if told.kinds != candidates.kinds:
        return None
    back = told.columns[:, columns] @ sizes
    pull = 0.0 if prepared.weighed is None else prepared.weighed.pull
    response = again.response + back + pull
    about = replace(again, readings=readings, response=response, by_channel=linear.by_channel)
    grid = grid_with_rounding(about, prepared.repeats.sigma, task.setting_rad, task.resolution)
    whitened = Whitened.of(grid, told)
    data = whitened.reduce(about.response[:, None])
    return Prepared(
        about, prepared.repeats, told, whitened, data, prepared.limit, moved - back, prepared.weighed
    )
