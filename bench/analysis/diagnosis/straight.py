"""One run searched, about a point near enough that what is large is linear there, too.

A slip of a degree shows in second order by ten times the noise. So where what is found changes the readings by
more than its columns say, the forward model takes it off them, the coefficients are guessed anew, and what the
columns say is put back: a step of Gauss and Newton, after which all is as before, but linear.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from bench.analysis.calibration import CalibrationError
from bench.analysis.calibration.design import FIXED
from bench.analysis.diagnosis.applied import applied_of
from bench.analysis.diagnosis.candidates import make_candidates
from bench.analysis.diagnosis.evidence import Whitened
from bench.analysis.diagnosis.linear import LinearSystem, make_linear
from bench.analysis.diagnosis.looked import CLEAR, Looked, beside_slow_noise, noise_as_it_is
from bench.analysis.diagnosis.naming import MOST_EFFECTS, Naming, name
from bench.analysis.diagnosis.noise_grid import RATIOS, make_noise_grid
from bench.analysis.diagnosis.posterior import fit_found, noise_size
from bench.analysis.diagnosis.repeats import noise_of_repeats
from bench.analysis.diagnosis.rounding import grid_with_rounding, with_rounding
from bench.analysis.diagnosis.threshold import Threshold, ThresholdCache
from bench.model import Block, ForwardModel
from bench.readings.table import Readings

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


def look(
    readings: Readings,
    model: ForwardModel,
    stand: Mapping[str, float],
    setting_rad: float,
    cache: ThresholdCache,
    resolution: float,
    absent: Collection[str] = (),
) -> tuple[Looked, Naming]:
    """Prepare readings and find what is missing: the first find is made linear before the others are looked for.

    The noise is taken as it is (`noise_as_it_is`), and beside slow noise all is looked for again.

    `stand` holds standard uncertainties by the names in `STAND_ANGLES`, rad, `setting_rad` that of a setting,
    `resolution` the last digit of the signals. Effects that are `absent` from the bench are not looked for.
    Raises `CalibrationError` where there is too little to fit.
    """
    task = _Task(readings, model, stand, setting_rad, resolution, cache, absent)

    def again(
        looked: Looked, linear: LinearSystem, limit: Threshold | None = None, most: float = np.inf
    ) -> tuple[Looked, Naming]:
        fresh = _prepared(task, linear, limit, most)
        return _straight(task, replace(fresh, bend=looked.bend, weighed=looked.weighed))

    first = _straight(task, _prepared(task, task.linear(readings)))
    looked, naming = noise_as_it_is(*first, again)
    looked, naming = beside_slow_noise(looked, naming, partial(_prepared, task))
    return looked, _closer(task, looked, naming)


def _closer(task: _Task, looked: Looked, naming: Naming) -> Naming:
    """Find again what hardly reached the threshold, with the ratio of the noises on a finer grid about its own.

    Between two ratios of the grid of the search a setting error is up to 1.4 times as large as it is taken for, and
    effects that act as it does look as much more than they are.
    """
    if not naming.found or min(found.total for found in naming.found) > looked.limit.value + CLEAR:
        return naming
    linear, coarse = looked.linear, looked.whitened.grid
    noise = noise_size(looked.whitened, looked.data, naming.columns)
    ratio = noise.setting_rad / noise.reading * linear.typical_slope
    if ratio < RATIOS[1]:
        return naming
    grid = make_noise_grid(linear, coarse.sigma, task.setting_rad, [ratio * part for part in FINER])
    whitened = Whitened.of(replace(grid, known=coarse.known), looked.candidates)
    return name(whitened, whitened.reduce(linear.response[:, None]), looked.limit)


def _straight(task: _Task, looked: Looked) -> tuple[Looked, Naming]:
    """Find what is missing, about a point near enough."""
    most = 1
    naming = name(looked.whitened, looked.data, looked.limit, most)
    for _ in range(STEPS):
        straight = _straightened(task, looked, naming) if naming.found else None
        if straight is None:
            if not naming.found or most == MOST_EFFECTS:
                return looked, naming
            most = MOST_EFFECTS
        looked = straight or looked
        naming = name(looked.whitened, looked.data, looked.limit, most)
    return looked, name(looked.whitened, looked.data, looked.limit)


def _prepared(
    task: _Task, linear: LinearSystem, limit: Threshold | None = None, most: float = np.inf
) -> Looked:
    """Prepare readings for the search; with the `limit` of such readings and the `most` noise where known."""
    repeats = noise_of_repeats(linear, task.resolution)
    repeats = replace(repeats, sigma=min(repeats.sigma, most))
    grid = grid_with_rounding(linear, repeats.sigma, task.setting_rad, task.resolution)
    candidates = make_candidates(linear, repeats.sigma, absent=task.absent)
    whitened = Whitened.of(grid, candidates)
    limit = limit or task.cache.threshold(linear, whitened, task.setting_rad)
    data = whitened.reduce(linear.response[:, None])
    return Looked(linear, repeats, candidates, whitened, data, limit, np.zeros(len(linear)))


def _straightened(task: _Task, looked: Looked, naming: Naming) -> Looked | None:
    """Return the readings about what was found; None where they are linear in it as they are."""
    linear, candidates = looked.linear, looked.candidates
    noise = noise_size(looked.whitened, looked.data, naming.columns)
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
    bend = moved - candidates.columns[:, columns] @ sizes - looked.bend
    if float(np.max(np.abs(bend))) < BENT * noise.reading:
        return None
    readings = task.readings
    try:
        again = task.linear(replace(readings, signal=readings.signal - change))
    except CalibrationError:  # what was found is too large to be true
        return None
    told = make_candidates(again, looked.repeats.sigma, absent=task.absent)
    if told.kinds != candidates.kinds:
        return None
    back = told.columns[:, columns] @ sizes
    pull = 0.0 if looked.weighed is None else looked.weighed.pull
    response = again.response + back + pull
    about = replace(again, readings=readings, response=response, by_channel=linear.by_channel)
    grid = grid_with_rounding(about, looked.repeats.sigma, task.setting_rad, task.resolution)
    whitened = Whitened.of(grid, told)
    data = whitened.reduce(about.response[:, None])
    return Looked(about, looked.repeats, told, whitened, data, looked.limit, moved - back, looked.weighed)
