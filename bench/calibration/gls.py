"""Generalised least squares on all readings, the stand's errors as random effects.

The setting error is common to the three channels of a point; axis tilt, zero offset and mounting error are
common to a mounting and have the sizes that the bench file states. The exact forward model is made linear
about the current estimate until it stands still (maximum a posteriori; for these small angles its
covariance is that of generalised least squares).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import special

from bench.calibration.design import FIXED, Problem
from bench.calibration.noise import (
    LEAST_REPEATS,
    noise_from_repeats,
    noise_from_residuals,
    repeat_groups,
    scatter_of_repeats,
    whiten,
)
from bench.calibration.result import LackOfFit, Noise
from bench.model.block import Block

Floats = NDArray[np.float64]

MOST_ITERATIONS: Final = 20
STANDS_STILL: Final = 1e-6
"""The fit has converged when no unknown moves by more than this part of its standard uncertainty."""
NEARLY_STILL: Final = 1e-2
"""Below this part the sizes of the noise are no longer estimated anew: they would not change."""
LEAST_NOISE: Final = 1e-11
"""Least noise believed, as a part of the largest signal: keeps noise-free data solvable."""


@dataclass(frozen=True)
class Fit:
    """Estimates of all unknowns of a problem and their joint covariance (12 + q, 12 + q).

    `noise` is as estimated, the covariance has it widened. `gain` (12 + q, n, 3) is the linear map from
    readings to unknowns; `misfit` the chi-square left, the priors' part included; `residuals` (n, 3) in the
    unit of the signal.
    """

    block: Block
    others: Floats
    covariance: Floats
    gain: Floats
    noise: Noise
    misfit: float
    residuals: Floats
    slope: Floats


def fit(
    problem: Problem, signal: Floats, start: Block, noise: Noise | None = None, resolution: float = 0.0
) -> Fit:
    """Fit the problem to readings `signal` (n, 3) from a first guess; noise sizes not given are estimated.

    Noise is never believed below that of rounding to `resolution`, a rectangular distribution of that width.
    """
    block, others = start, problem.prior_mean
    floor = max(LEAST_NOISE * float(np.max(np.abs(signal))), resolution / np.sqrt(12.0))
    groups = repeat_groups(problem.conditions)
    state: tuple[Floats, Floats, Floats, Noise] | None = None
    sizes, moved = noise, np.inf
    for _ in range(MOST_ITERATIONS):
        slope = problem.slope(block, others)
        jacobian = problem.jacobian(block, others)
        left = signal - problem.predict(block, others)
        if sizes is None or (noise is None and moved > NEARLY_STILL):
            sizes = _noise(problem, left, jacobian, slope, groups, others, floor)
        step, covariance, gain = _solve(problem, jacobian, left, slope, sizes.widened(), others)
        block = Block.from_vector(block.vector + step[:FIXED])
        others = others + step[FIXED:]
        state = (covariance, gain, slope, sizes)
        moved = float(np.max(np.abs(step) / np.sqrt(np.diag(covariance))))
        if moved <= STANDS_STILL:
            break
    if state is None:  # pragma: no cover - MOST_ITERATIONS is positive
        raise RuntimeError("no iteration was made")
    covariance, gain, slope, sizes = state
    residuals = signal - problem.predict(block, others)
    whitened = whiten(residuals[:, :, None], slope, sizes)
    pulls = (others - problem.prior_mean) / problem.prior_u
    misfit = float(np.sum(whitened**2) + np.sum(pulls**2))
    return Fit(block, others, covariance, gain, sizes, misfit, residuals, slope)


def _noise(
    problem: Problem,
    left: Floats,
    jacobian: Floats,
    slope: Floats,
    groups: NDArray[np.int64],
    others: Floats,
    floor: float,
) -> Noise:
    scatter = scatter_of_repeats(left, slope, groups)
    if scatter.settings >= LEAST_REPEATS:
        return noise_from_repeats(scatter, floor)
    # the likelihood has the random effects about their prior means, so their estimates are not taken off
    whole = left + jacobian[:, :, FIXED:] @ (others - problem.prior_mean)
    scaled = jacobian.copy()
    scaled[:, :, FIXED:] *= problem.prior_u
    return noise_from_residuals(whole, scaled, slope, FIXED, floor)


def _solve(
    problem: Problem, jacobian: Floats, left: Floats, slope: Floats, noise: Noise, others: Floats
) -> tuple[Floats, Floats, Floats]:
    """One step: the change of the unknowns, their covariance, and the gain from readings to unknowns."""
    n, _, p = jacobian.shape
    prior_u, prior_mean = problem.prior_u, problem.prior_mean
    scale = np.concatenate([np.ones(FIXED), prior_u])
    rows = whiten(jacobian, slope, noise).reshape(3 * n, p) * scale
    prior_rows = np.zeros((p - FIXED, p))
    prior_rows[:, FIXED:] = np.eye(p - FIXED)
    target = np.concatenate(
        [whiten(left[:, :, None], slope, noise).reshape(3 * n), (prior_mean - others) / prior_u]
    )
    q, r = np.linalg.qr(np.vstack([rows, prior_rows]))
    inverse = np.linalg.solve(r, np.eye(p)) * scale[:, None]
    covariance = inverse @ inverse.T
    step = inverse @ (q.T @ target)
    # R^(-1/2) is symmetric, so the gain from raw readings is the whitened gain, whitened once more
    whitened_gain = (inverse @ q[: 3 * n].T).reshape(p, n, 3)
    gain = np.moveaxis(whiten(np.moveaxis(whitened_gain, 0, 2), slope, noise), 2, 0)
    return step, covariance, gain


def lack_of_fit(problem: Problem, result: Fit) -> LackOfFit:
    """Compare what the model leaves with the scatter of repeats (F test), or with noise that was given."""
    residuals, noise = result.residuals, result.noise
    rms = float(np.sqrt(np.mean(residuals**2)))
    # a stated prior adds as much to the misfit as its unknown takes away; a weak one adds nothing
    dof = residuals.size - FIXED - sum(not e.stated for e in problem.effects)
    if np.isinf(noise.dof):
        return LackOfFit(rms, result.misfit, dof, float(special.chdtrc(dof, result.misfit)))
    groups = repeat_groups(problem.conditions)
    scatter = scatter_of_repeats(residuals, result.slope, groups)
    dof -= 3 * scatter.settings
    if noise.source != "repeats" or dof <= 0:
        return LackOfFit(rms, float("nan"), max(dof, 0), float("nan"))
    variance = noise.reading**2
    along = variance + (noise.setting_rad * scatter.slope) ** 2
    pure_error = float(np.sum(scatter.across) / variance + np.sum(scatter.along / along))
    chi2 = max(result.misfit - pure_error, 0.0)
    # the scatter over its own freedom is 1 by construction: the noise was estimated from it
    return LackOfFit(rms, chi2, dof, float(special.fdtrc(dof, noise.dof, chi2 / dof)))
