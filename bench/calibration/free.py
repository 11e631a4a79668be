"""Readings for which only the modulus is known: free positions, and verification points that join the fit.

At rest |N(U - U0)| = 1 g in any orientation (paper (9)). Such a reading adds the row 1 - |a| to the fit, with the
noise of the three signals propagated through d|a|/dU.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Final

import numpy as np

from bench.base.arrays import Floats, Mask
from bench.calibration.design import FIXED, FreeRows, Problem
from bench.calibration.mistakes import refuse_still
from bench.calibration.result import CalibrationError, Noise, SpoiledFit, Triangular
from bench.model.conditions import Conditions
from bench.model.forward import ForwardModel, Stages
from bench.model.geometry import STAND_ANGLES, Block, modulus_slopes

MOST_ROUNDS: Final = 50
STANDS_STILL_G: Final = 1e-14
STEP_G: Final = 1e-5
"""Step of the central differences by the specific force, g: so small that every effect is linear over it."""
LEAST_POSITIONS: Final = 10
"""Least number of free positions: nine unknowns, and one more position to estimate the noise."""
LEAST_PART: Final = 1e-3
"""Least ratio of the smallest to the largest singular value with which positions determine the ellipsoid."""
PRODUCTS: Final = ("xx", "yy", "zz", "xy", "xz", "yz", "x", "y", "z")


@dataclass(frozen=True)
class Modulus:
    """The equations |a| = 1 g of m free readings, linearised about a point of the fit.

    `left` (m,) is 1 - |a|, g. `jacobian` (m, 12 + q) are the derivatives of |a| by the 12 coefficients and the q
    other unknowns. `by_signal` (m, 3) is d|a|/dU, g/unit. The noise of the signals is `larger` (m, 3) times that
    at zero signal.
    """

    left: Floats
    jacobian: Floats
    by_signal: Floats
    larger: Floats | float = 1.0

    def noise(self, sizes: Noise) -> Floats:
        """Return the standard deviation (m,) of |a|, g, for the noise `sizes` of the signals."""
        return np.asarray(np.linalg.norm(self.by_signal * self.larger * sizes.by_channel, axis=1))


NO_MODULI: Final = Modulus(np.zeros(0), np.zeros((0, 0)), np.zeros((0, 3)))


def modulus_rows(problem: Problem, block: Block, others: Floats) -> Modulus:
    """Return the rows of the problem's free readings, linearised about the point (`block`, `others`)."""
    if problem.free is None:
        return Modulus(np.zeros(0), np.zeros((0, FIXED + len(others))), np.zeros((0, 3)))
    return problem.kept(_moduli, block, others)


def _moduli(problem: Problem, block: Block, others: Floats) -> Modulus:
    free, model = problem.free, replace(problem.model, effects=problem.effects_at(others))
    assert free is not None  # noqa: S101 - the caller has it
    force = _force(model, free, block)
    still = np.zeros((len(free.conditions.mounts), len(STAND_ANGLES)))

    def at(acting: Floats) -> Stages:
        return Stages(model, block, free.conditions, still, force=acting)

    columns = modulus_columns(problem, block, others, at, force, slice(None))
    return Modulus(1.0 - np.linalg.norm(force, axis=1), columns, modulus_slopes(force, block)[1])


def modulus_columns(
    problem: Problem,
    block: Block,
    others: Floats,
    at: Callable[[Floats], Stages],
    force: Floats,
    rows: Mask | slice,
) -> Floats:
    """Return the derivatives (m, 12 + q) of |a| by all unknowns at the force `force` (m, 3), g, of the `rows`.

    `at` returns the stages of the model for a force of these rows. Since the readings U(a, p) are given, da/dp is
    -(dU/da)^-1 dU/dp. The modulus does not depend on the angles of the stand.
    """
    if not problem.model.effects:
        return np.pad(modulus_slopes(force, block)[0], ((0, 0), (0, len(others))))
    by_unknown = problem.by_stages(at(force), block, others)[rows]
    pairs = [(at(force + step).readings, at(force - step).readings) for step in STEP_G * np.eye(3)]
    by_force = np.stack([(up - down)[rows] for up, down in pairs], axis=2) / (2 * STEP_G)
    along = force / np.linalg.norm(force, axis=1, keepdims=True)
    try:
        inverse = np.linalg.inv(by_force)
    except np.linalg.LinAlgError:
        raise _too_large(problem.model) from None
    return np.asarray(-np.einsum("mi,mij,mjp->mp", along, inverse, by_unknown, optimize=True))


def _too_large(model: ForwardModel) -> SpoiledFit:
    return SpoiledFit(
        f"the effects of model {model.name} are too large for these readings",
        "check the sizes in the model file",
    )


def _force(model: ForwardModel, free: FreeRows, block: Block) -> Floats:
    """Return the specific force (m, 3) of free readings, found by iteration on the forward model.

    Raises `CalibrationError` if an effect needs data that these readings lack, such as a head angle.
    """
    force = block.specific_force(free.signal)
    for _ in range(MOST_ROUNDS if model.effects else 0):
        left = free.signal - model.readings_at(force, free.conditions, block)
        step = np.linalg.solve(block.K, left.T).T
        force = force + step
        if not np.all(np.isfinite(force)):
            lacking = effects_without_data(model, block.specific_force(free.signal), free.conditions, block)
            if not lacking:
                raise _too_large(model)
            raise CalibrationError(
                f"{lacking}; remove the effect from the model file or, if readings of known orientation remain, "
                "use 'bench calibrate' with --no-join-free and without --join-verification"
            )
        if np.max(np.abs(step)) < STANDS_STILL_G:
            break
    return force


def effects_without_data(model: ForwardModel, force: Floats, conditions: Conditions, block: Block) -> str:
    """Return a sentence on effects of the model that need data which free positions lack; "" for none.

    `force` (m, 3) are rough values of the specific force, g.
    """
    alone = [replace(model, effects=(one,)) for one in model.effects]
    lacking = [not np.isfinite(one.readings_at(force, conditions, block)).all() for one in alone]
    names = ", ".join(dict.fromkeys(a.effect.name for a in compress(model.effects, lacking)))
    needed = "needs a head angle, a time or a temperature, which free positions lack"
    return f"model {model.name}: {names} {needed}" if names else ""


# --- free positions alone ---------------------------------------------------------------------------


def first_guess_free(signal: Floats, nominal: Sequence[float] | None = None) -> Block:
    """Return a first guess of the block, with upper triangular K, from signals (m, 3) of free positions alone.

    The scale factors get the signs of the `nominal` ones (x, y, z); without these all are positive. The ellipsoid
    (U - b)^T A (U - b) = 1 is fitted by linear least squares; A = N^T N with N upper triangular. Raises
    `CalibrationError` if the positions do not determine the nine coefficients.
    """
    if len(signal) < LEAST_POSITIONS:
        raise CalibrationError(
            f"{len(signal)} free positions are too few for the nine coefficients of a calibration without "
            f"orientations; measure {LEAST_POSITIONS} or more, all round"
        )
    middle = (signal.max(axis=0) + signal.min(axis=0)) / 2
    size = np.ptp(signal, axis=0) / 2
    refuse_still(signal)
    x, y, z = ((signal - middle) / size).T
    columns = np.column_stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, x, y, z])
    _, found, directions = np.linalg.svd(columns, full_matrices=False)
    if found[-1] < LEAST_PART * found[0]:
        part = np.abs(directions[-1])
        untold = [name for name, p in zip(PRODUCTS, part, strict=True) if p > 0.3 * part.max()]
        raise CalibrationError(
            f"{len(signal)} free positions do not determine the nine coefficients: they hardly show "
            f"{', '.join(untold)} of the ellipsoid of signals; add positions with two and three axes "
            "inclined, up and down"
        )
    q, *_ = np.linalg.lstsq(columns, np.ones(len(signal)), rcond=None)
    matrix = np.array([[q[0], q[3], q[4]], [q[3], q[1], q[5]], [q[4], q[5], q[2]]])
    block = _block_of_ellipsoid(matrix, q[6:], middle, size)
    return block if nominal is None else Block(block.K * np.sign(nominal), block.U0)


def _block_of_ellipsoid(matrix: Floats, linear: Floats, middle: Floats, size: Floats) -> Block:
    """Return the block that maps the unit sphere to v^T matrix v + linear v = 1, v = (U - middle)/size."""
    centre = -np.linalg.solve(matrix, linear) / 2
    shape = matrix / (1 + centre @ matrix @ centre)
    if np.min(np.linalg.eigvalsh(shape)) <= 0:
        raise CalibrationError(
            "the free positions do not lie on an ellipsoid, as readings at rest of |a| = 1 g must; remove "
            "readings in motion, or measure more directions"
        )
    upper: Floats = np.linalg.cholesky(shape).T / size
    return Block(np.asarray(np.linalg.inv(upper), dtype=np.float64), middle + centre * size)


def triangular(block: Block, covariance: Floats, g_m_s2: float) -> Triangular:
    """Convert a block with upper triangular K, and its `covariance` (12, 12), to a = T S (U - b), m/s^2.

    S is positive whatever the signs of the scale factors are. Source: Tedaldi, Pretto, Menegatti (ICRA 2014),
    equation (10), whose convention imu_tk uses.
    """
    signs = np.sign(np.diag(block.K))
    flip = np.concatenate([np.tile(signs, 3), np.ones(3)])
    covariance = covariance * np.outer(flip, flip)
    inverse = np.linalg.inv(block.K * signs)
    scale = np.diag(inverse)
    skew = inverse / scale
    # dN = -N dK N for each element of K
    change = -np.einsum("ai,jb->ijab", inverse, inverse).reshape(9, 3, 3)
    by_scale = change[:, np.arange(3), np.arange(3)]
    by_skew = (change - skew * by_scale[:, None, :]) / scale
    own = covariance[:9, :9]
    u_scale = np.sqrt(np.einsum("pi,pq,qi->i", by_scale, own, by_scale))
    u_skew = np.sqrt(np.einsum("pij,pq,qij->ij", by_skew, own, by_skew).clip(0.0))
    return Triangular(
        bias=block.U0,
        scale=g_m_s2 * scale,
        T=skew,
        u_bias=np.sqrt(np.diag(covariance)[9:]),
        u_scale=g_m_s2 * u_scale,
        u_skew=np.triu(u_skew, 1),
    )
