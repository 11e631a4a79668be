"""The search for effects in readings of one or several runs, under the kind of noise of the largest evidence.

The system of one run is linearised about the effects found, repeatedly until this is accurate. In several runs,
effects are searched in all runs together, and in each run alone.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Final

import numpy as np
from scipy.special import logsumexp

from bench.base.arrays import Floats, Mask
from bench.base.computing import tracked
from bench.calibration.design import FIXED
from bench.calibration.result import CalibrationError
from bench.diagnosis.candidates import SINGLE, Candidates, Column, make_candidates, with_terms, without_copies
from bench.diagnosis.evidence import FALSE_ALARMS, Data, Search, Threshold, ThresholdCache, Whitened
from bench.diagnosis.levels import BY_CHANCE, FEW, STEPS, UNSEEN
from bench.diagnosis.linear import LinearSystem, make_linear
from bench.diagnosis.multi_run_system import candidates_of, make_system
from bench.diagnosis.naming import ALIAS, MOST_EFFECTS, FoundEffect, Naming, Scored, name, named_again
from bench.diagnosis.noise_grid import (
    SAME_SIZE,
    NoiseGrid,
    Repeats,
    is_rounded,
    make_noise_grid,
    noise_of_repeats,
    with_rounding,
)
from bench.diagnosis.noise_kinds import LOG_PRIOR, NoiseHypothesis, log_density, log_null, noise_hypotheses
from bench.diagnosis.posterior import (
    NoiseSize,
    Posterior,
    applied_of,
    beside,
    fit_found,
    noise_size,
    posterior,
    with_other_shapes,
)
from bench.model.forward import ForwardModel
from bench.model.geometry import Block
from bench.readings.table import Readings


@dataclass(frozen=True)
class Prepared:
    """Readings prepared for the search: their linear system, noise of repeats, candidates and threshold.

    `data` are the products of the residuals with the candidates, `limit` is the threshold of the evidence.
    `setting_rad` is the setting error that the bench file states. `bend` (N,), the nonlinear part of the
    effects found, is already subtracted from the response. `log_odds` is ln of the prior odds of the chosen
    noise hypotheses, minus the cost of their parameters; `chosen` maps their kinds to words.
    """

    linear: LinearSystem
    repeats: Repeats
    whitened: Whitened
    data: Data
    limit: Threshold
    setting_rad: float
    bend: Floats
    log_odds: float = 0.0
    chosen: Mapping[str, str] = field(default_factory=dict)

    @property
    def candidates(self) -> Candidates:
        """The effects and the unnamed patterns that are searched."""
        return self.whitened.candidates

    def log_evidence(self, naming: Naming) -> float:
        """Return ln of the evidence of this noise with the effects of `naming`, up to a constant.

        The evidence of each effect is averaged over all families, so that the choice of noise does not depend
        on names.
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
    """Return the readings under the noise hypothesis with the largest evidence, and the effects found.

    `again` repeats the search under another noise hypothesis. The arguments are returned if no hypothesis is
    better. They are also returned if repeats share a rounding error, because repeats then do not show the noise.
    """
    if prepared.whitened.grid.known:
        return prepared, naming
    score = prepared.log_evidence(naming)
    for _ in range(len(LOG_PRIOR)):
        # heavy tails may replace the single readings found, beside the same effects
        beside_tails = tuple(one for one in naming.found if one.variant.family not in SINGLE)
        gains = cache(partial(_gains, prepared))
        rivals = (
            (prepared.log_evidence(Naming(found)) + gain, one, most)
            for found in dict.fromkeys([(), beside_tails, naming.found])
            for gain, one, most in gains(found)
        )
        tried = []
        for about, one, most in sorted(rivals, key=lambda rival: -rival[0])[:2]:
            if about <= score + np.log(BY_CHANCE):
                break
            searched, named = again(prepared, one.linear, most)
            if searched.whitened.grid.known:
                continue  # the evidence of a fixed noise does not compare with that of an unknown one
            searched = replace(
                searched,
                log_odds=prepared.log_odds + one.log_odds,
                chosen={**prepared.chosen, one.what: one.words},
            )
            tried.append((searched.log_evidence(named), searched, named))
        better = max(tried, key=lambda state: state[0], default=None)
        if better is not None and better[0] > score + ALIAS**2 / 2.0:
            score, prepared, naming = better
            continue
        needed = _beyond_noise(prepared, naming, gains)
        if needed is naming:
            return prepared, naming
        score, naming = prepared.log_evidence(needed), needed  # and the noise may be another one without them
    return prepared, _beyond_noise(prepared, naming, partial(_gains, prepared))


Gains = Callable[[tuple[FoundEffect, ...]], list[tuple[float, NoiseHypothesis, float]]]
"""Returns, beside some effects, the gain in ln of the evidence by each noise hypothesis, and a reading's noise."""


def _gains(prepared: Prepared, found: tuple[FoundEffect, ...]) -> list[tuple[float, NoiseHypothesis, float]]:
    """Return the `Gains` of other noise than that of `prepared`."""
    effects = Naming(found).columns
    columns = prepared.candidates.columns[:, list(effects)]
    noise, grid = noise_size(prepared.whitened, prepared.data, effects), prepared.whitened.grid
    own = log_density(prepared.linear, columns, grid)
    return [
        (one.log_odds + log_density(one.linear, columns, grid) - own, one, noise.reading)
        for one in noise_hypotheses(prepared.linear, columns, noise)
        # tails explain single readings, too
        if one.what != "tails" or all(of.variant.family not in SINGLE for of in found)
    ]


def _beyond_noise(prepared: Prepared, naming: Naming, gains: Gains) -> Naming:
    """Return the effects whose odds reach the threshold also against all noise hypotheses together.

    Effects that are kept although their odds are below it, such as those of single runs, stay.
    """
    limit = prepared.limit.value
    while naming.found:
        odds = []
        for weak in naming.found:
            rest = tuple(one for one in naming.found if one is not weak)
            of_noise = 0.0 if weak.total < limit else logsumexp([0.0, *(gain for gain, *_ in gains(rest))])
            odds.append(max(weak.total, limit) - float(of_noise))
        weakest = int(np.argmin(odds))
        if odds[weakest] >= limit:
            break
        rest = naming.found[:weakest] + naming.found[weakest + 1 :]
        naming = name(prepared.whitened, prepared.data, prepared.limit, 0, rest)
    return naming


def in_the_noise_of(prepared: LinearSystem, linear: LinearSystem) -> LinearSystem:
    """Return `linear` with the noise of `prepared`, a system of the same readings with another model.

    With several blocks, the two systems have their rows in different orders. Then `linear` gets only the
    noise by channel and by run.
    """
    linear = replace(linear, by_channel=prepared.by_channel, by_run=prepared.by_run)
    if prepared.readings.block is not None:
        return linear
    of_noise = prepared.random[:, prepared.random.shape[1] - prepared.of_noise :]
    own = linear.random[:, : linear.random.shape[1] - linear.of_noise]
    return replace(
        linear,
        by_row=prepared.by_row,
        by_place=prepared.by_place,
        random=np.column_stack([own, of_noise]),
        of_noise=prepared.of_noise,
    )


@dataclass(frozen=True)
class SearchTask:
    """The arguments that every search needs besides the readings; effects in `absent` are not searched.

    `stand_u` has the standard uncertainties, rad, of `STAND_ANGLES` and "setting_error"; `resolution` is the step
    of the last digit, unit of the signal.
    """

    model: ForwardModel
    stand_u: Mapping[str, float]
    resolution: float
    cache: ThresholdCache
    absent: Collection[str] = ()

    @property
    def setting_rad(self) -> float:
        """The standard uncertainty of a setting of the head that the bench file states, rad."""
        return self.stand_u.get("setting_error", 0.0)

    def linear(self, readings: Readings) -> LinearSystem:
        """Return the linear system of readings, with the rounding error that repeats share."""
        make = make_system if readings.run.any() else make_linear
        linear = make(readings, self.model, self.stand_u)
        return with_rounding(linear, self.resolution, self.repeats(linear).sigma)

    def repeats(self, linear: LinearSystem, most: float = np.inf) -> Repeats:
        """Return the noise from repeats, limited to at most `most`, unit of the signal."""
        repeats = noise_of_repeats(linear, self.resolution)
        return replace(repeats, sigma=min(repeats.sigma, most))

    def whiten(self, linear: LinearSystem, candidates: Candidates, sigma: float) -> tuple[Whitened, Data]:
        """Return the whitened candidates, and their products with the residuals.

        `sigma` is a first estimate of the noise of a reading, unit of the signal.
        """
        whitened = Whitened.of(self.grid(linear, sigma), candidates)
        return whitened, whitened.reduce(linear.response[:, None])

    def grid(self, linear: LinearSystem, sigma: float) -> NoiseGrid:
        """Return the noise grid for a noise estimate `sigma`.

        The noise counts as known if repeats share a rounding error; otherwise its standard deviation is integrated
        out.
        """
        return replace(
            make_noise_grid(linear, sigma, self.setting_rad), known=is_rounded(self.resolution, sigma)
        )

    def smaller_noise(self, grid: NoiseGrid, noise: NoiseSize) -> float | None:
        """Return the noise about the model with the effects, if smaller than that of `grid`; otherwise None.

        An effect that changes between repeats makes the first estimate of the noise too large, and therefore the
        prior u of the stand angles too small in units of the noise. With a coarse last digit, the first estimate
        stays.
        """
        smaller = noise.reading < (1.0 - SAME_SIZE) * grid.sigma
        return noise.reading if smaller and not is_rounded(self.resolution, noise.reading) else None


def find_effects(task: SearchTask, readings: Readings) -> tuple[Prepared, Naming]:
    """Return readings of one or several runs prepared for the search, and the effects found.

    Raises `CalibrationError` if the readings do not determine the coefficients.
    """
    several = bool(readings.run.any())

    def again(prepared: Prepared, linear: LinearSystem, most: float) -> tuple[Prepared, Naming]:
        if several:
            return _in_all_and_each(task, _prepared(task, linear, prepared.limit, most))
        repeats = task.repeats(linear, most)
        whitened, data = task.whiten(linear, prepared.candidates, repeats.sigma)
        fresh = replace(prepared, linear=linear, repeats=repeats, whitened=whitened, data=data)
        return _linearised_again(task, fresh)

    first = _prepared(task, task.linear(readings))
    found = _in_all_and_each(task, first) if several else _linearised_again(task, first)
    prepared, naming = choose_noise(*found, again)
    return prepared, naming if several else _beside_shapes(task, prepared, naming)


def _prepared(
    task: SearchTask, linear: LinearSystem, limit: Threshold | None = None, most: float = np.inf
) -> Prepared:
    """Prepare readings for the search; their noise is at most `most`. Without a `limit`, it is simulated."""
    several = bool(linear.readings.run.any())
    repeats = task.repeats(linear, most)
    grid = task.grid(linear, repeats.sigma)
    candidates = candidates_of(linear, repeats.sigma, task.absent)
    if not several:
        candidates = without_copies(with_terms(candidates, linear), grid.white[len(grid.white) // 2])
    whitened = Whitened.of(grid, candidates)
    limit = limit or task.cache.threshold(linear, whitened, task.setting_rad)
    limit = limit.at(TOGETHER) if several else limit
    data = whitened.reduce(linear.response[:, None])
    return Prepared(linear, repeats, whitened, data, limit, task.setting_rad, np.zeros(len(linear)))


# --- one run: linearised again about what was found ---------------------------------------------------


def _beside_shapes(task: SearchTask, prepared: Prepared, naming: Naming) -> Naming:
    """Return the effects that remain if the largest may have parts of other shapes.

    A true shape between two shapes of the grid leaves residuals that other effects would explain.
    """
    largest = max(naming.found, key=lambda found: found.size, default=None)
    if largest is None or len(naming.found) < 2 or not largest.variant.named:
        return naming
    alone = Naming((largest,))
    noise = noise_size(prepared.whitened, prepared.data, naming.columns)
    sized = fit_found(prepared.linear, prepared.candidates, alone, noise)
    (shapes,) = beside(prepared.candidates, alone, sized)
    wide = with_other_shapes(prepared.linear, shapes)
    if wide is prepared.linear:
        return naming
    whitened, data = task.whiten(wide, prepared.candidates, prepared.whitened.grid.sigma)
    kept = name(whitened, data, prepared.limit, begun=[largest], among=lambda _: True).found
    before = {one.variant: one for one in naming.found}
    if all(one.variant in before for one in kept):
        # the finds left out stand for parts of other shapes, without which the odds would be those of a misfit
        return Naming(tuple(before[one.variant] for one in kept))
    return named_again(prepared.whitened, prepared.data, prepared.limit, kept, kept=1)


def _linearised_again(task: SearchTask, prepared: Prepared) -> tuple[Prepared, Naming]:
    """Return readings and effects after linearising and searching again until the system is accurate."""
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


def _relinearised(task: SearchTask, prepared: Prepared, naming: Naming) -> Prepared | None:
    """Return the readings linearised and whitened again about the effects; None if not needed or possible."""
    linear, candidates = prepared.linear, prepared.candidates
    noise = noise_size(prepared.whitened, prepared.data, naming.columns)
    fitted = fit_found(linear, candidates, naming, noise)
    fresh = _with_smaller_noise(task, prepared, naming, noise, fitted)
    prepared = fresh or prepared
    sigma = prepared.whitened.grid.sigma
    parts = [(f.variant, fitted.amplitudes[place]) for f, place in naming.sizes() if f.variant.named]
    if not parts:
        return fresh
    effects = tuple(a for v, value in parts for a in applied_of(candidates, v, value, 0.0 * value))
    block = Block.from_vector(linear.block.vector + fitted.mean[:FIXED])
    change = linear.view.own(linear.model, effects, block)
    columns = [column for variant, _ in parts for column in variant.sizes]
    sizes = np.concatenate([value for _, value in parts])
    moved = linear.view.rows_of(change)
    bend = moved - candidates.columns[:, columns] @ sizes - prepared.bend
    if float(np.max(np.abs(bend))) < UNSEEN * noise.reading:
        return fresh
    readings = linear.readings
    try:
        again = task.linear(replace(readings, signal=readings.signal - change))
    except CalibrationError:  # what was found is too large to be true
        return fresh
    told = with_terms(make_candidates(again, sigma, absent=task.absent), again)
    if told.kinds != candidates.kinds:
        return fresh
    told = candidates.with_columns(told.columns, told.scale)
    back = told.columns[:, columns] @ sizes
    about = in_the_noise_of(linear, replace(again, readings=readings, response=again.response + back))
    whitened, data = task.whiten(about, told, sigma)
    return replace(prepared, linear=about, whitened=whitened, data=data, bend=moved - back)


def _with_smaller_noise(
    task: SearchTask, prepared: Prepared, naming: Naming, noise: NoiseSize, fitted: Posterior
) -> Prepared | None:
    """Return the readings whitened with the noise about the effects, if that is smaller; None otherwise."""
    linear, candidates = prepared.linear, prepared.candidates
    sigma = task.smaller_noise(prepared.whitened.grid, noise)
    if sigma is None:
        return None
    left = linear.response - candidates.columns[:, list(naming.columns)] @ fitted.amplitudes
    repeats = task.repeats(replace(linear, response=left), prepared.repeats.sigma)
    whitened, data = task.whiten(linear, candidates, sigma)
    return replace(prepared, repeats=repeats, whitened=whitened, data=data)


# --- what one of several runs has alone: looked for in each, beside what was found in all of them together ----


ALONE: Final = FALSE_ALARMS / 3
"""Probability of a false alarm in the searches of single runs, all together: most effects are in all runs."""
TOGETHER: Final = FALSE_ALARMS - ALONE
"""Probability of a false alarm in the joint search."""


@dataclass(frozen=True)
class _Run:
    """A single run with its own system, candidates and noise grid; `rows` (N,) is its mask in the joint system."""

    rows: Mask
    linear: LinearSystem
    candidates: Candidates
    grid: NoiseGrid

    def whitened(self) -> Whitened:
        """Return the whitened candidates."""
        return Whitened.of(self.grid, self.candidates)


def _in_all_and_each(task: SearchTask, prepared: Prepared) -> tuple[Prepared, Naming]:
    """Return the readings with the effects of single runs among the candidates, and all effects found.

    Effects of a few single runs, which could pass for common ones, are searched first, then common effects,
    then further ones of single runs.
    """
    linear, whitened, data, limit = prepared.linear, prepared.whitened, prepared.data, prepared.limit
    response = linear.response[:, None]
    many = len(np.unique(linear.readings.run))
    runs = list(tracked(_runs(task, linear, prepared.repeats.sigma), "runs, each by itself", many))
    of_one = limit
    if runs:
        of_one = task.cache.threshold(runs[0].linear, runs[0].whitened(), task.setting_rad).at(ALONE / many)
    at_first = _look_in_each(whitened.candidates, runs, np.zeros(len(linear)), of_one)
    grown, alone = at_first
    # what the only run that can be searched shows may as well be common to all
    if alone and len(runs) > 1 and len({one.variant.mounts for one in alone}) <= max(1, FEW * many):
        whitened.forget()
        whitened = Whitened.of(whitened.grid, grown)
        data = whitened.reduce(response)
    else:
        alone = ()
    naming = name(whitened, data, limit, begun=alone)
    if naming.found:
        in_all = _common(linear, whitened, data, naming)
        grown, more = _look_in_each(whitened.candidates, runs, in_all, of_one)
    else:  # without common finds, the first result remains valid
        grown, more = at_first
    begun = [*alone, *more]
    if more:
        whitened = Whitened.of(whitened.grid, grown)
        data = whitened.reduce(response)
        naming = name(whitened, data, limit, begun=begun)
    while len(kept := [one for one in begun if _stays(whitened, data, naming, one)]) < len(begun):
        begun = kept
        naming = name(whitened, data, limit, begun=begun)
    sigma = task.smaller_noise(whitened.grid, noise_size(whitened, data, naming.columns))
    if naming.found and sigma is not None:
        again, named = _in_all_and_each(task, _prepared(task, linear, limit, sigma))
        left = linear.response - _common(linear, again.whitened, again.data, named)
        return replace(
            again, repeats=task.repeats(replace(linear, response=left), prepared.repeats.sigma)
        ), named
    return replace(prepared, whitened=whitened, data=data), naming


def _stays(whitened: Whitened, data: Data, naming: Naming, one: FoundEffect) -> bool:
    """Return whether the effect of a single run is likely, given all others.

    True also if `naming` no longer has the effect in this form.
    """
    if one.variant not in [found.variant for found in naming.found]:
        return True
    others = [i for found in naming.found if found.variant != one.variant for i in found.variant.columns]
    evidence = Scored.beside(whitened, data, others).scores.variants[:, 0]
    return bool(evidence[whitened.candidates.variants.index(one.variant)] > -np.log(BY_CHANCE))


def _common(linear: LinearSystem, whitened: Whitened, data: Data, naming: Naming) -> Floats:
    """Return the fitted signal of all effects found in the rows of all runs, shape (N,)."""
    columns = whitened.candidates.columns[:, list(naming.columns)]
    fitted = posterior(linear, columns, noise_size(whitened, data, naming.columns))
    return columns @ fitted.amplitudes


def _look_in_each(
    candidates: Candidates, runs: Sequence[_Run], in_all: Floats, limit: Threshold
) -> tuple[Candidates, tuple[FoundEffect, ...]]:
    """Return the candidates with the effects of single runs added, and these effects.

    `in_all` (N,) is the fitted signal of the effects found in all runs, which is subtracted first. The threshold of
    the first run serves for all. As coefficients are free in every run, a different zero is no effect.
    """
    found: list[FoundEffect] = []
    for run in runs:
        whitened = run.whitened()
        response = run.linear.response - in_all[run.rows]
        for one in name(whitened, whitened.reduce(response[:, None]), limit).found:
            candidates, embedded = _embedded(candidates, one, run)
            found.append(embedded)
        whitened.forget()
    return candidates, tuple(found)


def _runs(task: SearchTask, linear: LinearSystem, sigma_of_all: float) -> Iterator[_Run]:
    """Yield the runs that determine their coefficients, which can be searched one by one.

    Effects of the other runs are found only in the search of all runs together.
    """
    readings = linear.readings
    of_row = readings.run[linear.rows.reading]
    for number in np.unique(readings.run):
        table = replace(readings.select(readings.run == number), block=None)
        rows: Mask = of_row == number
        try:
            alone = make_linear(table, linear.model, task.stand_u)
        except CalibrationError:
            continue
        by_row, by_place = (None if size is None else size[rows] for size in (linear.by_row, linear.by_place))
        alone = replace(alone, by_channel=linear.by_channel, by_row=by_row, by_place=by_place)
        sigma = sigma_of_all * (1.0 if linear.by_run is None else float(linear.by_run.sizes[number]))
        alone = with_rounding(alone, task.resolution, sigma)
        yield _Run(rows, alone, make_candidates(alone, sigma, absent=task.absent), task.grid(alone, sigma))


def _embedded(candidates: Candidates, one: FoundEffect, run: _Run) -> tuple[Candidates, FoundEffect]:
    """Return the candidates with an effect of one run added, and this effect; its columns are 0 elsewhere."""
    own = run.candidates
    labels = tuple(str(mount) for mount in run.linear.readings.conditions().mounts)
    chosen = list(one.variant.columns)
    first = candidates.columns.shape[1]
    columns = np.zeros((len(candidates.columns), len(chosen)))
    columns[run.rows] = own.columns[:, chosen]
    kinds = tuple(
        Column(kind.parameter, kind.channel, kind.mounts or labels) for kind in (own.kinds[i] for i in chosen)
    )
    variant = one.variant._replace(
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
