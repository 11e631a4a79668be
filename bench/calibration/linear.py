"""Estimators with fixed weights, such as equation (8) of the paper and ordinary least squares."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from bench.base.arrays import Floats
from bench.calibration import gls
from bench.calibration.design import FIXED, Problem, coefficient_columns
from bench.calibration.gls import Estimator
from bench.model.geometry import Block


def least_squares_gain(problem: Problem) -> Floats:
    """Return the map (12, n, 3) of ordinary least squares at zero stand angles, with equal weights."""
    still = problem.stand_matrix(np.zeros(0))
    unit = Block(np.eye(3), np.zeros(3))
    plain = replace(problem.model, effects=())
    columns = coefficient_columns(plain.specific_force(problem.conditions, still, unit))
    inverse = np.linalg.pinv(columns.reshape(-1, FIXED))
    return np.asarray(inverse, dtype=np.float64).reshape(FIXED, len(columns), 3)


def linear_estimate(
    problem: Problem, signal: Floats, fit: gls.Fit, gain: Floats, shared: Floats | None = None
) -> gls.Fit:
    """Return the coefficients by the linear map `gain` (12, n, 3), with their covariance.

    The covariance is due to noise, stand and effects. `fit` is the generalised least squares fit to the same
    readings `signal` (n, 3). Its coefficients convert the prior means of stand angles and effects to signals,
    which are subtracted first. `fit` also provides the noise and the misfit: with fixed weights, stand angles
    would remain in the residuals and look like a lack of fit. `shared` (3n, 3n) is the covariance of readings
    that share errors.
    """
    others = problem.prior_mean
    taken_off = np.zeros_like(signal)
    if np.any(others):
        plain = replace(problem, model=replace(problem.model, effects=()), effects=())
        still = np.zeros(len(problem.stand))
        taken_off = problem.predict(fit.block, others) - plain.predict(fit.block, still)
    block = Block.from_vector(np.einsum("pni,ni->p", gain, signal - taken_off))
    noise, slope = fit.noise.widened(), fit.slope
    # G R G^T from R = sigma_u^2 I + sigma_phi^2 d d^T of each reading, then the stand's angles
    along = np.einsum("pni,ni->pn", gain, slope) * noise.setting_rad
    flat = (gain * noise.by_channel).reshape(FIXED, -1)
    of_noise = flat @ flat.T + along @ along.T
    if shared is not None:
        of_noise = gain.reshape(FIXED, -1) @ shared @ gain.reshape(FIXED, -1).T
    columns = problem.by_prior(problem.jacobian(block, others)[:, :, FIXED:])
    fixed = np.einsum("pni,niq->pq", gain, columns)
    covariance = of_noise + fixed @ fixed.T
    residuals = signal - problem.predict(block, others)
    return replace(fit, block=block, others=others, covariance=covariance, gain=gain, residuals=residuals)


ESTIMATOR: Final = Estimator(
    "least-squares", "all readings alike", gain=lambda problem, _: least_squares_gain(problem), also=("ols",)
)
