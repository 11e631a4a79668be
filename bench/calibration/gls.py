"""Generalised least squares on all readings, with the stand's errors as random effects.

The setting error is common to the three channels of a point. Axis tilt, zero offset and mounting error are common
to a mounting, with the standard uncertainties that the bench file states. The exact forward model is linearised
about the current estimate until the estimate converges. The result is the maximum a posteriori estimate; for these
small angles its covariance is that of generalised least squares.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import linalg, special

from bench.base.arrays import Floats, Ints, rms
from bench.calibration.design import FIXED, FreeRows, Problem
from bench.calibration.free import NO_MODULI, Modulus, modulus_rows
from bench.calibration.noise import (
    LEAST_REPEATS,
    LikelihoodResiduals,
    RepeatedNoise,
    SharedRounding,
    noise_from_repeats,
    noise_from_residuals,
    repeat_groups,
    rounding_variance,
    scatter_of_repeats,
    whiten,
    whiten_back,
)
from bench.calibration.result import CalibrationError, LackOfFit, Noise, SpoiledFit, widening
from bench.model.conditions import Conditions
from bench.model.geometry import COEFFICIENTS, Block
from bench.readings.table import Readings

MOST_ITERATIONS: Final = 20
STANDS_STILL: Final = 5e-3
"""The fit has converged when no unknown moves by more than this fraction of its standard uncertainty.

The remaining error is smaller still because of the small curvature of the model, about 1e-5.
"""
NEARLY_STILL: Final = 1e-2
"""Once no unknown moves by more than this fraction of its u, the noise is not estimated again."""
ESTIMATIONS: Final = 8
"""Largest number of noise estimations in a fit: the sizes may alternate between two likelihood maxima."""
FAR_FROM_STILL: Final = 0.1
"""The fit has failed if an unknown still moves by more than this fraction of its u in the last iteration."""
LEAST_NOISE: Final = 1e-8
"""Lower limit of the noise as a fraction of the largest signal, far below the noise of a voltmeter.

With less noise, terms of second order in the stand's angles seem to determine what no reading shows.
"""


@dataclass(frozen=True)
class Shift:
    """An additional unknown without prior in one observation, which thereby loses its weight in the fit.

    `row` is the index of a reading, from 0. With `channel` 0, 1 or 2, the unknown is an offset of signal x, y or z
    in an oriented reading, in the unit of the signal. With `SETTING` it is an error of the head's angle in an
    oriented reading, rad, which moves all three signals along du/dphi. With `MODULUS` it is an offset of |a| in a
    free reading, g.
    """

    row: int
    channel: int


SETTING: Final = 3
MODULUS: Final = 4


@dataclass(frozen=True)
class Fit:
    """Estimates of all unknowns of a problem: the 12 coefficients `block`, then the q `others`.

    `covariance` (12 + q, 12 + q) is their joint covariance; it uses the estimated `noise`, widened for its
    degrees of freedom. `gain` (12 + q, n, 3) is the linear map from the n oriented readings to the unknowns;
    `free_gain` (12 + q, m, 3), the map from the m readings of unknown orientation (free readings). `misfit`
    is the chi-square of residuals and priors, without shifted signals. `residuals` (n, 3) are in the unit of
    the signal; `modulus` (m,) is |a| - 1 of the free readings, g; neither has the shifts subtracted. `slope`
    (n, 3) is du/dphi. `shift` (k,) are the estimates of the k shifts, and `u_shift` (k,) their u for the
    noise without widening. `system` is the linear system of the last step, with the final residuals.
    """

    block: Block
    others: Floats
    covariance: Floats
    gain: Floats
    free_gain: Floats
    noise: Noise
    misfit: float
    residuals: Floats
    slope: Floats
    modulus: Floats
    shifts: tuple[Shift, ...]
    shift: Floats
    u_shift: Floats
    system: System


def fit(
    problem: Problem,
    signal: Floats,
    start: Block,
    noise: Noise | None = None,
    resolution: float = 0.0,
    shifts: tuple[Shift, ...] = (),
    *,
    one_size: bool = False,
) -> Fit:
    """Fit the problem to readings `signal` (n, 3), starting from the block `start`.

    The noise is estimated unless given. It is at least that of rounding to `resolution` (a rectangular distribution
    of this width). The channels have equal noise with `one_size`, or if their noise does not differ significantly.
    Each of `shifts` is an additional unknown without prior. Raises `CalibrationError` if the fit does not converge.
    """
    block, others = start, problem.prior_mean
    floor = noise_floor(signal, resolution, problem.free)
    groups = _groups_without(problem, shifts)
    places = _places(problem, len(shifts), len(others))
    moved, repeats = np.inf, RepeatedNoise(floor, groups, one_size=one_size)
    for iteration in range(MOST_ITERATIONS):
        system = linearise(problem, signal, block, others, shifts)
        if noise is not None:
            sizes = noise
        elif moved > NEARLY_STILL and iteration < ESTIMATIONS:
            of_repeats = repeats.sizes(system.left, system.slope)
            if of_repeats is None:
                sizes = estimate_noise(problem, system, groups, others, floor)
            else:
                sizes = of_repeats if problem.noise is None else problem.noise.joined(of_repeats)
        own = solve(problem, system, sizes.widened(), others)
        step = np.zeros(FIXED + len(others))
        step[places.unknowns] = own.step[places.own]
        block = Block.from_vector(block.vector + step[:FIXED])
        others = others + step[FIXED:]
        # a shift enters no derivative, so convergence does not depend on it
        steps = np.abs(own.step[places.own]) / np.sqrt(np.diag(own.covariance)[places.own])
        moved = float(np.max(steps))
        if moved <= STANDS_STILL:
            break
    else:
        if not moved < FAR_FROM_STILL:
            raise _not_converged(problem, system, int(places.unknowns[np.argmax(steps)]), moved)
    gain = own.gain(system, sizes.widened())
    return _result(problem, system, block, others, sizes, places, own.step, own.covariance, gain, shifts)


def _not_converged(problem: Problem, system: System, unknown: int, moved: float) -> CalibrationError:
    """Return the exception for a fit that did not converge; it names the unknown that still moves."""
    names = (*COEFFICIENTS, *problem.names())
    left = rms(system.left) if len(system.left) else rms(system.free.left)
    unit = "" if len(system.left) else " g"
    return SpoiledFit(
        f"the fit did not converge: after {MOST_ITERATIONS} steps {names[unknown]} still moves by {moved:.2g} of "
        f"its standard uncertainty, and the model leaves {left:.2g}{unit} of the readings (root mean square)",
        "check for rows of another installation, block or unit",
    )


@dataclass(frozen=True)
class System:
    """The linear system of one step of the fit.

    Its p unknowns are the active coefficients, then the shifts, then the other unknowns of the problem. `left` (n,
    3) is measured minus predicted signals. `jacobian` (n, 3, p) are the derivatives of the readings by the
    unknowns; `slope` (n, 3) is du/dphi. `free` are the equations of the moduli. If the noise grows with the signal,
    left, jacobian and slope are multiplied by `level` (n, 3), so that all signals of a channel have equal noise.
    """

    left: Floats
    jacobian: Floats
    slope: Floats
    free: Modulus = NO_MODULI
    level: Floats | float = 1.0


def linearise(
    problem: Problem, signal: Floats, block: Block, others: Floats, shifts: tuple[Shift, ...] = ()
) -> System:
    """Return the linear system for readings `signal` (n, 3) about the point (`block`, `others`)."""
    linear = problem.linear(block, others)
    free = modulus_rows(problem, block, others)
    jacobian, by_free = linear.jacobian, free.jacobian
    if problem.upper:
        kept = np.concatenate([problem.active, np.arange(FIXED, FIXED + len(others))])
        jacobian, by_free = jacobian[:, :, kept], by_free[:, kept]
    if shifts:
        at = len(problem.active)
        own, own_free = np.zeros((*signal.shape, len(shifts))), np.zeros((len(by_free), len(shifts)))
        for j, shift in enumerate(shifts):
            if shift.channel == MODULUS:
                own_free[shift.row, j] = 1.0
            elif shift.channel == SETTING:
                own[shift.row, :, j] = linear.slope[shift.row]
            else:
                own[shift.row, shift.channel, j] = 1.0
        jacobian = np.concatenate([jacobian[:, :, :at], own, jacobian[:, :, at:]], axis=2)
        by_free = np.concatenate([by_free[:, :at], own_free, by_free[:, at:]], axis=1)
    left, free = signal - linear.predicted, replace(free, jacobian=by_free)
    if problem.growth is None:
        return System(left, jacobian, linear.slope, free)
    level = 1.0 / np.hypot(1.0, problem.growth * (signal - block.U0))
    if problem.free is not None:
        free = replace(free, larger=np.hypot(1.0, problem.growth * (problem.free.signal - block.U0)))
    return System(level * left, level[:, :, None] * jacobian, level * linear.slope, free, level)


@dataclass(frozen=True)
class _Places:
    """Indices that place the unknowns of one step of the fit.

    `unknowns` are the indices of these unknowns among all 12 + q; `own` and `shifts` are the indices, within the
    step, of the active coefficients and of the shifts.
    """

    unknowns: Ints
    own: Ints
    shifts: Ints


def _places(problem: Problem, shifts: int, others: int) -> _Places:
    active = len(problem.active)
    own = np.concatenate([np.arange(active), np.arange(active + shifts, active + shifts + others)])
    unknowns = np.concatenate([problem.active, np.arange(FIXED, FIXED + others)])
    return _Places(unknowns, own, np.arange(active, active + shifts))


def finish(problem: Problem, fit: Fit, covariance: Floats, noise: Noise) -> Fit:
    """Return a fit after repeating its last step with another covariance of the readings.

    `covariance` (3n + m, 3n + m) is that of the 3n signals and m moduli; `noise` is the noise in it. The
    linearisation does not change.
    """
    system, others = fit.system, fit.others
    places = _places(problem, len(fit.shifts), len(others))
    n, p = len(system.left), system.jacobian.shape[2]
    rows = np.concatenate([system.jacobian.reshape(3 * n, p), system.free.jacobian])
    target = np.concatenate([system.left.ravel(), system.free.left])
    lower = np.linalg.cholesky(covariance)
    whitened = linalg.solve_triangular(lower, np.column_stack([rows, target]), lower=True)
    scale = np.concatenate([np.ones(p - len(others)), problem.prior_u])
    prior = np.zeros((len(others), p + 1))
    prior[:, p - len(others) : p] = problem.prior_rows
    prior[:, p] = -problem.pulls(others)
    scaled = np.concatenate([whitened[:, :p] * scale, prior[:, :p]])
    solved = solve_rows(scaled, np.concatenate([whitened[:, p], prior[:, p]]), scale)
    found, inverse, q = solved.step, solved.inverse, solved.q
    back = linalg.solve_triangular(lower, q[: len(target)], lower=True, trans="T")
    gain = inverse @ back.T
    step = np.zeros(FIXED + len(others))
    step[places.unknowns] = found[places.own]
    block = Block.from_vector(fit.block.vector + step[:FIXED])
    further = others + step[FIXED:]
    return _result(problem, system, block, further, noise, places, found, solved.covariance, gain, fit.shifts)


def noise_floor(signal: Floats, resolution: float, free: FreeRows | None = None) -> float:
    """Return the lower limit of the noise of signals (n, 3) and `free`, in their unit.

    It is that of rounding to `resolution`, or `LEAST_NOISE` of the largest signal if this is more.
    """
    largest = float(np.max(np.abs(signal), initial=0.0))
    if free is not None:
        largest = max(largest, float(np.max(np.abs(free.signal), initial=0.0)))
    return float(max(LEAST_NOISE * largest, resolution / np.sqrt(12.0)))


def _groups_without(problem: Problem, shifts: tuple[Shift, ...]) -> Ints:
    """Return the repeat group of each reading (n,); a reading with a shift is alone in its group."""
    if not len(problem.conditions):
        return np.zeros(0, dtype=np.int64)
    groups = repeat_groups(problem.conditions)
    rows = sorted({shift.row for shift in shifts if shift.channel != MODULUS})
    if rows:
        groups[rows] = len(groups) + np.arange(len(rows))
        groups = np.unique(groups, return_inverse=True)[1]
    return groups


def _result(
    problem: Problem, system: System, block: Block, others: Floats, sizes: Noise, places: _Places,
    found: Floats, covariance: Floats, gain: Floats, shifts: tuple[Shift, ...],
) -> Fit:  # fmt: skip
    """Return the fit after its last step `found`, which is so small that the residuals are linear in it.

    The misfit excludes shifted signals.
    """
    free = system.free
    own = system.jacobian[:, :, places.own] @ found[places.own]
    own_free = free.jacobian[:, places.own] @ found[places.own]
    system = replace(system, left=system.left - own, free=replace(free, left=free.left - own_free))
    n = len(system.left)
    shift = found[places.shifts]
    kept = system.left - system.jacobian[:, :, places.shifts] @ shift
    kept_free = system.free.left - system.free.jacobian[:, places.shifts] @ shift
    whitened = whiten(kept[:, :, None], system.slope, sizes)
    misfit = np.sum(whitened**2) + np.sum(problem.pulls(others) ** 2)
    misfit += np.sum((kept_free / system.free.noise(sizes)) ** 2)
    whole, whole_gain = np.zeros((FIXED + len(others),) * 2), np.zeros((FIXED + len(others), gain.shape[1]))
    whole[np.ix_(places.unknowns, places.unknowns)] = covariance[np.ix_(places.own, places.own)]
    whole_gain[places.unknowns] = gain[places.own]
    by_row = whole_gain[:, : 3 * n].reshape(len(whole), n, 3) * system.level
    # the row of a free reading is 1 - |a|: its derivatives have the opposite sign of those of |a|
    by_free = -whole_gain[:, 3 * n :, None] * system.free.by_signal
    as_it_is = 1.0 / widening(sizes.reading_dof)
    u_shift = as_it_is * np.sqrt(np.diag(covariance)[places.shifts])
    return Fit(
        block, others, whole, by_row, by_free, sizes, float(misfit), system.left / system.level,
        system.slope / system.level, -system.free.left, shifts, shift, u_shift, system,
    )  # fmt: skip


def estimate_noise(problem: Problem, system: System, groups: Ints, others: Floats, floor: float) -> Noise:
    """Return the noise from repeats within `groups` (n,), or from all residuals if the repeats are too few.

    The estimate from residuals also uses the problem's prior of the noise. `floor` (unit of the signal) is the
    lower limit of the noise.
    """
    left, slope, free, known = system.left, system.slope, system.free, problem.noise
    if len(left):
        scatter = scatter_of_repeats(left, slope, groups)
        if scatter.settings >= LEAST_REPEATS:
            return noise_from_repeats(scatter, floor)
    # the likelihood lets random effects scatter about their prior means: add their estimates to the residuals
    fixed = system.jacobian.shape[2] - len(others)
    off = others - problem.prior_mean
    whole = left + system.jacobian[:, :, fixed:] @ off
    columns = np.concatenate([system.jacobian, whole[:, :, None]], axis=2)
    moduli = np.zeros((0, columns.shape[2]))
    if len(free.left):
        moduli = np.column_stack([free.jacobian, free.left + free.jacobian[:, fixed:] @ off])
    for of in (columns, moduli):
        of[..., fixed:-1] = problem.by_prior(of[..., fixed:-1])
    # few residuals determine one size only, so known ratios between the channels are kept
    ratio = np.ones(3) if known is None else known.channels / rms(known.channels)
    moduli = moduli / np.linalg.norm(free.by_signal * ratio, axis=1)[:, None]
    found = noise_from_residuals(
        LikelihoodResiduals(columns / ratio[:, None], slope / ratio, moduli, fixed), floor, known
    )
    if np.ptp(ratio) == 0.0:
        return found
    x, y, z = (found.reading * ratio).tolist()
    return replace(found, channels=(x, y, z), channel_dof=(found.reading_dof,) * 3)


@dataclass(frozen=True)
class Solution:
    """One step of the fit: the change (p,) of the p unknowns, and their covariance (p, p).

    `step` is `inverse` (p, p) times the transpose of `q` times the whitened residuals. `q` has p columns, and a row
    for each of 3n signals, m moduli and the priors.
    """

    step: Floats
    covariance: Floats
    inverse: Floats
    q: Floats

    def gain(self, system: System, noise: Noise) -> Floats:
        """Return the linear map (p, 3n + m) from the 3n signals and m moduli to the p unknowns."""
        n, _, p = system.jacobian.shape
        whitened = (self.inverse @ self.q[: 3 * n].T).reshape(p, n, 3)
        gain = np.moveaxis(whiten_back(np.moveaxis(whitened, 0, 2), system.slope, noise), 2, 0)
        m = len(system.free.left)
        of_free = self.inverse @ self.q[3 * n : 3 * n + m].T / system.free.noise(noise)
        return np.concatenate([gain.reshape(p, 3 * n), of_free], axis=1)


def solve(problem: Problem, system: System, noise: Noise, others: Floats) -> Solution:
    """Return one step of the fit; `others` (q,) are the present values of the unknowns after the coefficients."""
    return solve_rows(*whitened_rows(problem, system, noise, others))


def solve_rows(rows: Floats, target: Floats, scale: Floats) -> Solution:
    """Return the least-squares solution of rows (n, p) of unit noise and their targets (n,), by QR.

    Column j belongs to unknown j divided by `scale` (p,).
    """
    q, r = np.linalg.qr(rows)
    inverse = np.linalg.solve(r, np.eye(len(r))) * scale[:, None]
    return Solution(inverse @ (q.T @ target), inverse @ inverse.T, inverse, q)


def whitened_rows(
    problem: Problem, system: System, noise: Noise, others: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return the whitened equations of one iteration: rows (3n + m + q, p), their targets, and scale (p,).

    The rows are 3n for n readings, then m for moduli and q for priors; each has unit variance. Column j belongs to
    unknown j divided by its scale. `others` are the present values of the unknowns after the coefficients.
    """
    n, _, p = system.jacobian.shape
    free = system.free
    prior_u = problem.prior_u
    fixed = p - len(prior_u)
    scale = np.concatenate([np.ones(fixed), prior_u])
    prior_rows = np.zeros((p - fixed, p))
    prior_rows[:, fixed:] = problem.prior_rows
    columns = np.concatenate([system.jacobian, system.left[:, :, None]], axis=2)
    both = whiten(columns, system.slope, noise).reshape(3 * n, p + 1)
    blocks, targets = [both[:, :p] * scale], [both[:, p]]
    if len(free.left):
        size = free.noise(noise)
        blocks.append(free.jacobian * scale / size[:, None])
        targets.append(free.left / size)
    blocks.append(prior_rows)
    targets.append(-problem.pulls(others))
    return np.vstack(blocks), np.concatenate(targets), scale


def lack_of_fit(problem: Problem, result: Fit, rounding: SharedRounding | None = None) -> LackOfFit:
    """Test the residuals of a fit against the scatter of repeats by an F test.

    If the noise was given, the test is a chi-square test against this noise. A `rounding` error that repeats share
    counts as noise.
    """
    unknowns = len(problem.active) + len(result.shifts) + sizes_told(problem, result) - len(result.modulus)
    groups = _groups_without(problem, result.shifts)
    misfit, system = result.misfit, result.system
    if rounding is not None:
        misfit -= rounding.relief(result.residuals, result.slope, result.noise)
    return misfit_test(misfit, system.left, system.slope, result.noise, groups, unknowns)


def sizes_told(problem: Problem, fit: Fit) -> int:
    """Return how many parameters of effects without a stated u the readings determine.

    A stated prior adds as much to the misfit as its unknown takes away. A weak prior adds nothing, and its unknown
    takes away only as much as the readings determine it: nothing, for example, for head marks without readings.
    """
    variances = np.diag(fit.covariance)[FIXED + len(problem.stand) :]
    weak = np.array([not effect.stated for effect in problem.effects], dtype=np.bool_)
    prior_u = np.array([effect.prior_u for effect in problem.effects])
    return round(float(np.sum(1.0 - np.minimum(variances[weak] / prior_u[weak] ** 2, 1.0))))


def misfit_test(
    misfit: float, residuals: Floats, slope: Floats, noise: Noise, groups: Ints, unknowns: int
) -> LackOfFit:
    """Test the chi-square `misfit` of a fit; `unknowns` is the number of fitted unknowns without a prior.

    `residuals` and `slope` (n, 3) and the repeat `groups` (n,) are as in `scatter_of_repeats`.
    """
    size = rms(residuals)
    dof = residuals.size - unknowns
    if np.isinf(noise.dof):
        return LackOfFit(size, misfit, dof, float(special.chdtrc(dof, misfit)))
    if not residuals.size:
        return LackOfFit(size, float("nan"), max(dof, 0), float("nan"))
    scatter = scatter_of_repeats(residuals, slope, groups)
    dof -= 3 * scatter.settings
    if noise.source != "repeats" or dof <= 0:
        return LackOfFit(size, float("nan"), max(dof, 0), float("nan"))
    variances = np.array([*noise.by_channel**2, noise.setting_rad**2])
    chi2 = max(misfit - scatter.chi_square(variances), 0.0)
    # the denominator is 1 by construction: the noise was estimated from the scatter of repeats
    return LackOfFit(size, chi2, dof, float(special.fdtrc(dof, noise.dof, chi2 / dof)))


@dataclass(frozen=True)
class WeightingTask:
    """The input of `Estimator.weigh`: readings `signal` (n, 3) and their fit by generalised least squares.

    `refit` repeats the `fit` with shifts for the signals that are to have no weight.
    """

    problem: Problem
    signal: Floats
    fit: Fit
    refit: Callable[[tuple[Shift, ...]], Fit]


def _as_it_is(task: WeightingTask) -> Fit:
    return task.fit


@dataclass(frozen=True)
class Estimator:
    """An estimator of the coefficients; `phrase` describes it in a few words, `also` are aliases.

    An estimator with fixed weights uses oriented readings alone; its `gain` returns its linear map (12, n, 3). Any
    other estimator has `weigh`, which returns its fit; a budget uses the map of its fit to readings without errors
    or outliers. `counts_as` names another estimator with the same map, if there is one. `angles_rad` returns the
    angles (n,) that the estimator assumes, and raises `CalibrationError` for unsuitable readings; if it is None,
    the estimator uses the angles of the readings.
    """

    name: str
    phrase: str
    weigh: Callable[[WeightingTask], Fit] = _as_it_is
    gain: Callable[[Problem, Readings], Floats] | None = None
    angles_rad: Callable[[Readings], Floats] | None = None
    drops_outliers: bool = False
    also: tuple[str, ...] = ()
    counts_as: str = ""

    @property
    def weighs_all(self) -> bool:
        """Whether the estimator can use readings for which only the modulus is known."""
        return self.gain is None


ESTIMATOR: Final = Estimator("gls", "all readings, weighted")


# --- rounding to the last digit: whether repeats share its error, and what it adds ------------------------------


SMOOTHED: Final = 2.0
"""Above this multiple of the variance of rounding, repeats share less than 1 % of the noise variance."""
LEAST_ALONE: Final = 0.01
"""Least part of the noise variance that is independent in each reading if repeats share a rounding error.

Without it the covariance of repeats that round alike would be singular.
"""
MOST_SIGNALS: Final = 1500
"""Above this number of signals no shared errors are searched for: the matrices would take minutes."""


def is_rounded(noise: Noise, floor: float) -> bool:
    """Return whether noise, which is at least `floor`, the standard deviation of rounding, hardly exceeds it."""
    return bool(noise.by_channel.min() ** 2 <= SMOOTHED * floor**2)


def rounding_of(problem: Problem, fit: Fit, resolution: float) -> SharedRounding | None:
    """Return the error of rounding to `resolution` that repeats share; None if the noise smooths it away.

    Also None if the noise is not from repeats, or the signals are more than `MOST_SIGNALS`.
    """
    digit = resolution / np.sqrt(12.0)
    large = 3 * len(problem.conditions) > MOST_SIGNALS
    if large or fit.noise.source != "repeats" or not is_rounded(fit.noise, digit):
        return None
    noise = np.minimum(fit.noise.by_channel, _quiet(problem.conditions, fit))
    return SharedRounding(_orientations(problem.conditions), rounding_variance(noise, digit))


def _quiet(conditions: Conditions, fit: Fit) -> Floats:
    """Return the standard deviation (3,) of repeats at small signals, where noise that grows smooths least."""
    groups = repeat_groups(conditions)
    count = np.bincount(groups)
    power = np.abs(fit.system.jacobian[:, :, :9] @ fit.block.K.ravel())
    quiet = power <= np.max(power, axis=0) / 2
    mean = np.stack([np.bincount(groups, one) / count for one in fit.residuals.T], axis=1)
    squares = np.sum(quiet * (fit.residuals - mean[groups]) ** 2, axis=0)
    freedom = np.sum(quiet * (1.0 - 1.0 / count[groups])[:, None], axis=0)
    return np.asarray(np.sqrt(np.divide(squares, freedom, out=np.full(3, np.inf), where=freedom > 0)))


def rounded_alike(conditions: Conditions, noise: Floats, floor: float) -> Floats:
    """Return what the rounding errors that repeats share add to the covariance (N, N) of independent noise.

    `noise` (N,), which includes rounding, is that of the signals of n oriented readings and of N - 3n moduli.
    `floor` is the standard deviation of rounding.
    """
    n = 3 * len(conditions)
    size = np.sqrt(rounding_variance(noise[:n], floor))
    groups = _orientations(conditions)
    alike = np.kron(np.equal.outer(groups, groups), np.eye(3)) * np.outer(size, size)
    np.fill_diagonal(alike, LEAST_ALONE * np.diag(alike))
    return np.asarray(linalg.block_diag(alike, np.zeros((len(noise) - n,) * 2)))


def _orientations(conditions: Conditions) -> Ints:
    """Return a number per reading, equal for equal angles in a mounting: they have equal signals.

    So have those a whole turn later. The angle read back differs by arcseconds.
    """
    turn = np.round(np.degrees(conditions.angle_rad) * 100.0).astype(np.int64) % 36000
    return np.asarray(np.unique(conditions.mount * 36000 + turn, return_inverse=True)[1])
