"""Generalised least squares of coefficients that are linear in functions of temperature.

Every coefficient is a sum of basis functions of the row (powers of the temperature, the side from which it was
reached, a plateau's own), so all temperatures are fitted at once: the stand's angles are common to a mounting
however many temperatures it saw, and readings of a plateau that alone would not determine twelve coefficients
still tell what they can.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.analysis.calibration.design import STEP_RAD, Problem, coefficient_columns
from bench.analysis.calibration.gls import (
    MOST_ITERATIONS,
    NEARLY_STILL,
    STANDS_STILL,
    System,
    estimate_noise,
    misfit_test,
    solve,
)
from bench.analysis.calibration.noise import whiten
from bench.analysis.calibration.result import LackOfFit, Noise
from bench.base.arrays import Floats, Ints, Mask, u_of
from bench.model.block import Block, linear_columns

WEAKEST: Final = 1e-3
"""Columns of unit length whose least singular value is below this part of the largest are not determined."""


@dataclass(frozen=True)
class ThermalProblem:
    """Readings (n, 3), the basis functions of their rows (n, m), and the terms (12, m) that are unknown.

    `problem` has the conditions, with a mount for each mounting, and the stand's angles; `groups` (n,)
    numbers the repeats; `floor` is the least noise believed, in the unit of the signal.
    """

    problem: Problem
    signal: Floats
    basis: Floats
    terms: Mask
    groups: Ints
    floor: float

    def force(self, others: Floats, setting_rad: float = 0.0) -> Floats:
        """Return the specific force of each row on the axes of the block, g, shape (n, 3)."""
        still = Block(np.eye(3), np.zeros(3))
        problem = self.problem
        return problem.model.specific_force(
            problem.conditions, problem.stand_matrix(others), still, setting_rad
        )

    def predict(self, values: Floats, others: Floats, setting_rad: float = 0.0) -> Floats:
        """Return the readings (n, 3) for values (12, m) of the terms and others (q,) of the stand's angles."""
        coefficients = self.basis @ values.T
        return row_outputs(coefficients, self.force(others, setting_rad))

    def slope(self, values: Floats, others: Floats) -> Floats:
        """Return du/dphi (n, 3), as `Problem.slope` does."""
        forward, back = (self.predict(values, others, step) for step in (STEP_RAD, -STEP_RAD))
        return (forward - back) / (2 * STEP_RAD)

    def jacobian(self, values: Floats, others: Floats) -> Floats:
        """Return the derivatives of the readings by the unknown terms, then the angles, (n, 3, t + q)."""
        one_each = coefficient_columns(self.force(others))
        coefficient, function = np.nonzero(self.terms)
        by_term = one_each[:, :, coefficient] * self.basis[:, None, function]
        by_angle = np.empty((*self.signal.shape, len(others)))
        for j in range(len(others)):
            step = np.zeros_like(others)
            step[j] = STEP_RAD
            difference = self.predict(values, others + step) - self.predict(values, others - step)
            by_angle[:, :, j] = difference / (2 * STEP_RAD)
        return np.concatenate([by_term, by_angle], axis=2)

    def determined(self) -> bool:
        """Whether the rows determine all terms, were every coefficient to have all functions of the basis."""
        force = self.force(self.problem.prior_mean)
        columns = linear_columns(force)
        whole = (columns[:, :, None] * self.basis[:, None, :]).reshape(len(force), -1)
        if whole.shape[1] > whole.shape[0]:
            return False
        length = np.linalg.norm(whole, axis=0)
        if np.any(length == 0):
            return False
        size = np.linalg.svd(whole / length, compute_uv=False)
        return bool(size[-1] > WEAKEST * size[0])


@dataclass(frozen=True)
class ThermalFit:
    """Estimates `values` (12, m), zero where a term was not fitted; `covariance` (t, t) of those that were.

    The fitted terms in order of `numpy.nonzero(terms)`. `misfit` is the chi-square left, the priors' part
    included; `residuals` and `slope` (n, 3).
    """

    values: Floats
    terms: Mask
    covariance: Floats
    others: Floats
    noise: Noise
    misfit: float
    residuals: Floats
    slope: Floats

    @property
    def vector(self) -> Floats:
        """The fitted terms, shape (t,)."""
        return self.values[self.terms]


def row_outputs(coefficients: Floats, force: Floats) -> Floats:
    """Return U = K a + U0 with coefficients (n, 12) of each row's own and forces (n, 3), shape (n, 3)."""
    scale = coefficients[:, :9].reshape(-1, 3, 3)
    return np.asarray(np.einsum("nij,nj->ni", scale, force) + coefficients[:, 9:], dtype=np.float64)


def fit(task: ThermalProblem, noise: Noise | None = None) -> ThermalFit:
    """Fit the terms; the sizes of the noise are estimated from the readings unless given."""
    values, others = _first_guess(task), task.problem.prior_mean
    count = int(task.terms.sum())
    sizes = noise or _estimated_noise(task, values, others)
    moved = np.inf
    for _ in range(MOST_ITERATIONS):
        system = _linearise(task, values, others)
        found = solve(task.problem, system, sizes.widened(), others)
        step, covariance = found.step, found.covariance
        values[task.terms] += step[:count]
        others = others + step[count:]
        moved = float(np.max(np.abs(step) / u_of(covariance)))
        if moved <= STANDS_STILL:
            break
        if noise is None and moved > NEARLY_STILL:
            sizes = _estimated_noise(task, values, others)
    residuals = task.signal - task.predict(values, others)
    whitened = whiten(residuals[:, :, None], system.slope, sizes)
    pulls = (others - task.problem.prior_mean) / task.problem.prior_u
    misfit = float(np.sum(whitened**2) + np.sum(pulls**2))
    own = covariance[:count, :count]
    return ThermalFit(values, task.terms, own, others, sizes, misfit, residuals, system.slope)


def _linearise(task: ThermalProblem, values: Floats, others: Floats) -> System:
    left = task.signal - task.predict(values, others)
    return System(left, task.jacobian(values, others), task.slope(values, others))


def _estimated_noise(task: ThermalProblem, values: Floats, others: Floats) -> Noise:
    system = _linearise(task, values, others)
    return estimate_noise(task.problem, system, task.groups, others, task.floor)


def _first_guess(task: ThermalProblem) -> Floats:
    """Ordinary least squares at the nominal geometry, channel by channel."""
    columns = linear_columns(task.force(task.problem.prior_mean))
    values = np.zeros(task.terms.shape)
    for channel in range(3):
        own = [*range(3 * channel, 3 * channel + 3), 9 + channel]
        where, function = np.nonzero(task.terms[own])
        design = columns[:, where] * task.basis[:, function]
        solution, *_ = np.linalg.lstsq(design, task.signal[:, channel], rcond=None)
        values[np.array(own)[where], function] = solution
    return values


def judge(task: ThermalProblem, result: ThermalFit) -> LackOfFit:
    """Compare what a fit leaves with the scatter of repeats at the same temperature (F test)."""
    return misfit_test(
        result.misfit, result.residuals, result.slope, result.noise, task.groups, int(task.terms.sum())
    )
