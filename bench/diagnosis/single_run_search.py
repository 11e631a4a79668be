"""The search for effects in one run; the system is linearised again about the effects found until accurate."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from bench.base.arrays import Floats
from bench.calibration.design import FIXED
from bench.calibration.result import CalibrationError
from bench.diagnosis.candidates import (
    SINGLE,
    Candidates,
    make_candidates,
    replace_columns,
    with_terms,
    without_copies,
)
from bench.diagnosis.evidence import Data, Search, Threshold, ThresholdCache, Whitened
from bench.diagnosis.levels import BY_CHANCE, STEPS, UNSEEN
from bench.diagnosis.linear import LinearSystem, make_linear
from bench.diagnosis.naming import ALIAS, MOST_EFFECTS, Naming, Scored, name
from bench.diagnosis.noise_grid import (
    Repeats,
    grid_with_rounding,
    noise_of_repeats,
    with_rounding,
)
from bench.diagnosis.noise_kinds import LOG_PRIOR, log_density, log_null, noise_hypotheses
from bench.diagnosis.open_parts import beside, with_other_shapes
from bench.diagnosis.posterior import applied_of, fit_found, noise_size
from bench.model.forward import ForwardModel
from bench.model.geometry import Block
from bench.readings.table import Readings


@dataclass(frozen=True)
class Prepared:
    """Readings prepared for the search: linear system, whitened candidates, and threshold.

    `repeats` is the noise from repeats; `data`, the scalar products of the residuals with the columns of the
    candidates; `limit`, the threshold. `bend` (N,) is the nonlinear part of the effects found, which is
    already subtracted from the response. `log_odds` is ln of the prior odds of the noise hypotheses accepted,
    minus the cost of their parameters. `chosen` maps the kind of each of these hypotheses to its words.
    """

    linear: LinearSystem
    repeats: Repeats
    candidates: Candidates
    whitened: Whitened
    data: Data
    limit: Threshold
    bend: Floats
    log_odds: float = 0.0
    chosen: Mapping[str, str] = field(default_factory=dict)

    def log_evidence(self, naming: Naming) -> float:
        """Return ln of the evidence of this noise, up to a constant, with as many effects as `naming` has.

        The evidence of each effect is averaged over all families, so that the choice of noise does not depend on
        the names.
        """
        total = Search.beside(self.whitened, ()).log_evidence(self.data) + log_null(self.whitened.grid)
        known: list[int] = []
        for found in naming.found:
            total += Scored.beside(self.whitened, self.data, known).total
            known += found.variant.columns
        return self.log_odds + total


Reconsider = Callable[[Prepared, LinearSystem, float], tuple[Prepared, Naming]]
"""Searches a system with another noise, of at most the size given, starting from the finds of prepared readings."""


def choose_noise(prepared: Prepared, naming: Naming, again: Reconsider) -> tuple[Prepared, Naming]:
    """Return the readings with the noise hypothesis of the largest evidence, and the effects found with it.

    `again` searches a system with another noise. If no hypothesis is better, `prepared` and `naming` are returned
    unchanged. They are also returned if repeats share a rounding error, because repeats then do not show the
    noise.
    """
    if prepared.whitened.grid.known:
        return prepared, naming
    score = prepared.log_evidence(naming)
    for _ in range(len(LOG_PRIOR)):
        rivals = []
        # heavy tails may replace the single readings found, beside the same effects
        beside_tails = tuple(one for one in naming.found if one.variant.family not in SINGLE)
        for found in dict.fromkeys([(), beside_tails, naming.found]):
            effects = replace(naming, found=found).columns
            columns = prepared.candidates.columns[:, list(effects)]
            noise, grid = noise_size(prepared.whitened, prepared.data, effects), prepared.whitened.grid
            own = prepared.log_evidence(replace(naming, found=found))
            own -= log_density(prepared.linear, columns, grid)
            for one in noise_hypotheses(prepared.linear, columns, noise):
                if one.what == "tails" and any(of.variant.family in SINGLE for of in found):
                    continue  # tails explain single readings, too
                about = own + one.log_odds + log_density(one.linear, columns, grid)
                if about > score + np.log(BY_CHANCE):
                    rivals.append((about, one, noise.reading))
        tried = []
        for _, one, most in sorted(rivals, key=lambda rival: -rival[0])[:2]:
            searched, named = again(prepared, one.linear, most)
            searched = replace(
                searched,
                log_odds=prepared.log_odds + one.log_odds,
                chosen={**prepared.chosen, one.what: one.words},
            )
            tried.append((searched.log_evidence(named), searched, named))
        better = max(tried, key=lambda state: state[0], default=None)
        if better is None or better[0] <= score + ALIAS**2 / 2.0:
            return prepared, naming
        score, prepared, naming = better
    return prepared, naming


def in_the_noise_of(prepared: LinearSystem, linear: LinearSystem) -> LinearSystem:
    """Return `linear` with the kind of noise of `prepared`, a system of the same readings.

    The two systems may differ in their models. With several blocks, whose rows are in another order, `linear`
    gets only the noise by channel and by run.
    """
    linear = replace(linear, by_channel=prepared.by_channel, by_run=prepared.by_run)
    if prepared.readings.block is not None:
        return linear
    of_noise = prepared.random[:, prepared.random.shape[1] - prepared.of_noise :]
    return replace(
        linear,
        by_row=prepared.by_row,
        by_place=prepared.by_place,
        random=np.column_stack([linear.random, of_noise]),
        of_noise=prepared.of_noise,
    )


@dataclass(frozen=True)
class SearchTask:
    """What every search needs besides the readings.

    `stand` has the standard uncertainties of the stand angles (`STAND_ANGLES`) by name, rad; `setting_rad` is the
    standard uncertainty of a setting of the head. `resolution` is the step of the last digit of the signals.
    Effects named in `absent` are not searched.
    """

    model: ForwardModel
    stand: Mapping[str, float]
    setting_rad: float
    resolution: float
    cache: ThresholdCache
    absent: Collection[str] = ()

    def linear(self, readings: Readings) -> LinearSystem:
        """Return the linear system of readings of one run, with the rounding error that repeats share."""
        linear = make_linear(readings, self.model, self.stand)
        return with_rounding(linear, self.resolution, self.repeats(linear).sigma)

    def repeats(self, linear: LinearSystem, most: float = np.inf) -> Repeats:
        """Return the noise from repeats, but no more than `most`."""
        repeats = noise_of_repeats(linear, self.resolution)
        return replace(repeats, sigma=min(repeats.sigma, most))

    def whiten(self, linear: LinearSystem, candidates: Candidates, sigma: float) -> tuple[Whitened, Data]:
        """Return the whitened candidates, and their scalar products with the residuals.

        `sigma` is a first estimate of the noise of a reading.
        """
        grid = grid_with_rounding(linear, sigma, self.setting_rad, self.resolution)
        whitened = Whitened.of(grid, candidates)
        return whitened, whitened.reduce(linear.response[:, None])


def search_run(task: SearchTask, readings: Readings) -> tuple[Prepared, Naming]:
    """Return readings of one run prepared for the search, and the effects found in them.

    The system is linearised again about the first effect found before further ones are searched. The noise
    hypothesis is chosen by evidence (`choose_noise`). Raises `CalibrationError` if the readings do not
    determine the coefficients.
    """

    def again(prepared: Prepared, linear: LinearSystem, most: float) -> tuple[Prepared, Naming]:
        repeats = task.repeats(linear, most)
        whitened, data = task.whiten(linear, prepared.candidates, repeats.sigma)
        fresh = replace(prepared, linear=linear, repeats=repeats, whitened=whitened, data=data)
        return _searched_again(task, fresh)

    first = _searched_again(task, _prepared(task, task.linear(readings)))
    prepared, naming = choose_noise(*first, again)
    return prepared, _beside_shapes(task, prepared, naming)


def _beside_shapes(task: SearchTask, prepared: Prepared, naming: Naming) -> Naming:
    """Return the effects still found if the largest one in `naming` may have parts of other shapes.

    If its true shape lies between two shapes of the catalogue's grid, it leaves residuals that other effects
    would explain.
    """
    largest = max(naming.found, key=lambda found: found.size, default=None)
    if largest is None or len(naming.found) < 2 or not largest.variant.named:
        return naming
    alone = Naming((largest,), naming.left)
    noise = noise_size(prepared.whitened, prepared.data, naming.columns)
    sized = fit_found(prepared.linear, prepared.candidates, alone, noise)
    (shapes,) = beside(prepared.candidates, alone, sized)
    wide = with_other_shapes(prepared.linear, shapes)
    if wide is prepared.linear:
        return naming
    whitened, data = task.whiten(wide, prepared.candidates, prepared.whitened.grid.sigma)
    kept = name(whitened, data, prepared.limit, begun=[largest], among=lambda _: True).found
    return name(prepared.whitened, prepared.data, prepared.limit, 0, begun=kept)


def _searched_again(task: SearchTask, prepared: Prepared) -> tuple[Prepared, Naming]:
    """Return readings and finds after linearising and searching again until the system is accurate."""
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


def _prepared(task: SearchTask, linear: LinearSystem) -> Prepared:
    """Prepare readings for the search."""
    repeats = task.repeats(linear)
    grid = grid_with_rounding(linear, repeats.sigma, task.setting_rad, task.resolution)
    candidates = make_candidates(linear, repeats.sigma, absent=task.absent)
    candidates = without_copies(with_terms(candidates, linear), grid.white[len(grid.white) // 2])
    whitened = Whitened.of(grid, candidates)
    limit = task.cache.threshold(linear, whitened, task.setting_rad)
    data = whitened.reduce(linear.response[:, None])
    return Prepared(linear, repeats, candidates, whitened, data, limit, np.zeros(len(linear)))


def _relinearised(task: SearchTask, prepared: Prepared, naming: Naming) -> Prepared | None:
    """Return the readings linearised again about the finds; None if the present linearisation suffices."""
    linear, candidates = prepared.linear, prepared.candidates
    noise = noise_size(prepared.whitened, prepared.data, naming.columns)
    fitted = fit_found(linear, candidates, naming, noise)
    parts = [(f.variant, fitted.amplitudes[place]) for f, place in naming.sizes() if f.variant.named]
    if not parts:
        return None
    effects = tuple(a for v, value in parts for a in applied_of(candidates, v, value, 0.0 * value))
    block = Block.from_vector(linear.block.vector + fitted.mean[:FIXED])
    change = linear.view.own(linear.model, effects, block)
    columns = [column for variant, _ in parts for column in variant.sizes]
    sizes = np.concatenate([value for _, value in parts])
    moved = linear.rows_of(change)
    bend = moved - candidates.columns[:, columns] @ sizes - prepared.bend
    if float(np.max(np.abs(bend))) < UNSEEN * noise.reading:
        return None
    readings = linear.readings
    try:
        again = task.linear(replace(readings, signal=readings.signal - change))
    except CalibrationError:  # what was found is too large to be true
        return None
    told = with_terms(make_candidates(again, prepared.repeats.sigma, absent=task.absent), again)
    if told.kinds != candidates.kinds:
        return None
    told = replace_columns(candidates, told.columns)
    back = told.columns[:, columns] @ sizes
    about = in_the_noise_of(linear, replace(again, readings=readings, response=again.response + back))
    whitened, data = task.whiten(about, told, prepared.repeats.sigma)
    return replace(prepared, linear=about, candidates=told, whitened=whitened, data=data, bend=moved - back)
