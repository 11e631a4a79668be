"""Join points above 1 g, measured on a centrifuge, with a fit at 1 g."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import linalg, special

from bench.base.arrays import Floats
from bench.calibration.design import FIXED, Problem
from bench.calibration.gls import Fit
from bench.calibration.result import CalibrationError
from bench.model.conditions import Conditions
from bench.model.geometry import Block
from bench.readings.csv import CentrifugePoints

ROUNDS: Final = 8
ROUNDING: Final = 1e-14
STEP_G: Final = 1e-4
STILL: Final = 1e-3
"""The joint fit has converged when an iteration changes no unknown by more than this fraction of its u."""


@dataclass(frozen=True)
class AboveOneG:
    """Points above 1 g that joined a fit at 1 g, and a test of their agreement with it.

    `force` (n, 3) is the specific force at the points, g. `gain` (12 + q, n, 3) is the linear map from the signals
    at the points to the unknowns. `chi2` is the chi-square of the points against the fit at 1 g. `dof` are its
    degrees of freedom: the number of signals minus the number of unknowns that the readings at 1 g do not
    determine.
    """

    force: Floats
    gain: Floats
    chi2: float
    dof: int

    @property
    def points(self) -> int:
        """The number of points."""
        return len(self.force)

    @property
    def largest_g(self) -> float:
        """The largest specific force, g."""
        return float(np.max(np.linalg.norm(self.force, axis=1)))

    @property
    def p(self) -> float:
        """The p-value of `chi2`; 1 without degrees of freedom."""
        return float(special.chdtrc(self.dof, self.chi2)) if self.dof > 0 else 1.0


def join(
    problem: Problem, fit: Fit, points: CentrifugePoints, g_m_s2: float, opened: int
) -> tuple[Fit, AboveOneG]:
    """Return the joint fit of the readings at 1 g and the `points`, and the test of their agreement.

    The `fit` at 1 g, with its covariance, is the prior. `opened` is the number of unknowns that the readings at 1 g
    do not determine. Raises `CalibrationError` if the iteration does not converge.
    """
    force = points.force_ms2 / g_m_s2
    conditions, kept = Conditions.of(["1"] * len(force), np.zeros(len(force))), np.isfinite(points.signal)
    start = np.concatenate([fit.block.vector, fit.others])
    scale = np.sqrt(np.diag(fit.covariance))
    size, along = np.linalg.eigh(fit.covariance / np.outer(scale, scale))
    told = along.T / np.sqrt(np.maximum(size, ROUNDING * size[-1]))[:, None]
    # the signals are linear in each unknown by itself: differences are exact for any step
    ahead = 1e-3 * float(np.max(np.abs(fit.block.K))) * np.eye(len(start))[:FIXED]
    steps = [*ahead, *(np.pad(problem.other_step(j), (FIXED, 0)) for j in range(len(fit.others)))]

    def predicted(vector: Floats, acting: Floats) -> Floats:
        model = replace(problem.model, effects=problem.effects_at(vector[FIXED:]))
        return model.readings_at(acting, conditions, Block.from_vector(vector[:FIXED]))

    at = start
    for _ in range(ROUNDS):
        H = np.stack(
            [(predicted(at + s, force) - predicted(at - s, force))[kept] / (2 * np.sum(s)) for s in steps],
            axis=1,
        )
        noise = _noise(predicted, at, points, g_m_s2, fit.noise.widened().by_channel)
        lower = linalg.cholesky(noise[np.ix_(kept.ravel(), kept.ravel())], lower=True)
        whitened = linalg.solve_triangular(
            lower, np.column_stack([H * scale, (points.signal - predicted(at, force))[kept]]), lower=True
        )
        rows = np.concatenate([told, whitened[:, :-1]])
        target = np.concatenate([told @ ((start - at) / scale), whitened[:, -1]])
        q, r = np.linalg.qr(rows)
        inverse = linalg.solve_triangular(r, np.eye(len(start)))
        step = inverse @ (q.T @ target)
        at = at + scale * step
        if np.max(np.abs(step)) < STILL:
            break
    else:
        raise CalibrationError(
            f"{points.source}: the joint fit did not converge; check units and axes of the forces"
        )
    chi2 = float(np.sum((target - rows @ step) ** 2))
    own = scale[:, None] * inverse
    gain = own @ linalg.solve_triangular(lower, q[len(start) :], lower=True, trans="T").T
    rest, covariance = np.eye(len(start)) - gain @ H, own @ own.T
    through = np.zeros((len(at), *kept.shape))
    through[:, kept] = gain
    joined = replace(
        fit, block=Block.from_vector(at[:FIXED]), others=at[FIXED:], covariance=covariance,
        gain=np.einsum("pq,qni->pni", rest, fit.gain),
    )  # fmt: skip
    return joined, AboveOneG(force, through, chi2, int(kept.sum()) - opened)


def _noise(
    predicted: Callable[[Floats, Floats], Floats], at: Floats, points: CentrifugePoints, g_m_s2: float,
    reading: Floats,
) -> Floats:  # fmt: skip
    """Return the covariance (3n, 3n) of the points' signals: noise of the readings and errors of the force.

    `reading` (3,) is the noise of one signal of each channel.
    """
    force, size = points.force_ms2 / g_m_s2, np.linalg.norm(points.force_ms2, axis=1)[:, None] / g_m_s2
    along = force / np.where(size > 0.0, size, 1.0)
    slope = (predicted(at, force + STEP_G * along) - predicted(at, force - STEP_G * along)) / (2 * STEP_G)
    own = linalg.block_diag(*(row[:, None] for row in slope * points.u_ms2[:, None] / g_m_s2))
    shared = (slope * size * points.u_relative[:, None]).ravel()
    return np.asarray(np.diag(np.tile(reading**2, len(slope))) + own @ own.T + np.outer(shared, shared))
