"""Least squares of coefficients over temperature, and the degree that the data give each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, Ints, Mask, u_of
from bench.calibration.design import STEP_RAD, Problem, coefficient_columns
from bench.calibration.gls import (
    MOST_ITERATIONS,
    NEARLY_STILL,
    STANDS_STILL,
    System,
    estimate_noise,
    misfit_test,
    solve,
)
from bench.calibration.noise import whiten
from bench.calibration.result import LackOfFit, Noise
from bench.model.geometry import Block, linear_columns

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


STAYS_P: Final = 0.05
"""A highest term stays when chance alone would make one so large less often than this."""

NEXT: Final = 2
"""Terms above the degree chosen whose absence is in doubt."""


@dataclass(frozen=True)
class DegreeChoice:
    """Degrees (12,), and doubts (2, 12, D + 1): what each of the next two terms would change, were it let in.

    One of the two is even and one is odd in temperature. Zero where the full degree leaves none out.
    """

    degrees: Ints
    doubts: Floats


def choose_degrees(full: ThermalFit, highest: int) -> DegreeChoice:
    """Choose the degrees from a fit in which every coefficient has powers 0…`highest` (the first columns).

    The least significant of the highest terms is dropped, one at a time, until an F test with the noise's
    degrees of freedom finds each of them larger than chance.
    """
    coefficient, function = np.nonzero(full.terms)
    degrees = np.full(len(full.terms), highest, dtype=np.int64)
    while np.any(degrees > 0):
        keep = (function > highest) | (function <= degrees[coefficient])
        value, covariance = held_at_zero(full.vector, full.covariance, keep)
        top = function[keep] == degrees[coefficient[keep]]
        top &= function[keep] > 0
        ratio = value[top] ** 2 / np.diag(covariance)[top]
        p = special.fdtrc(1.0, min(full.noise.dof, 1e9), ratio)
        worst = int(np.argmax(p))
        if p[worst] <= STAYS_P:
            break
        degrees[coefficient[keep][top][worst]] -= 1
    return DegreeChoice(degrees, _doubts(full, highest, degrees))


def held_at_zero(value: Floats, covariance: Floats, keep: Mask) -> tuple[Floats, Floats]:
    """Return the least-squares estimate and covariance of the terms kept (t,), the others held at zero."""
    pull = np.linalg.solve(covariance[np.ix_(~keep, ~keep)], covariance[np.ix_(~keep, keep)])
    return value[keep] - value[~keep] @ pull, covariance[np.ix_(keep, keep)] - covariance[
        np.ix_(keep, ~keep)
    ] @ pull


def _doubts(full: ThermalFit, highest: int, degrees: Ints) -> Floats:
    coefficient, function = np.nonzero(full.terms)
    doubts = np.zeros((NEXT, len(degrees), highest + 1))
    for step in range(NEXT):
        for j in np.flatnonzero(degrees + step < highest):
            new_one = (coefficient == j) & (function == degrees[j] + 1 + step)
            keep = (function > highest) | (function <= degrees[coefficient]) | new_one
            value, covariance = held_at_zero(full.vector, full.covariance, keep)
            own = (coefficient[keep] == j) & (function[keep] <= highest)
            new = int(np.flatnonzero(new_one[keep])[0])
            change = covariance[:, new] * value[new] / covariance[new, new]
            doubts[step, j, function[keep][own]] = change[own]
    return doubts
