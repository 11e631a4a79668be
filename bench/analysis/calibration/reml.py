"""Restricted maximum likelihood of variance components.

y = X b + sum over k of Z_k e_k, the e_k of variance theta_k: V = sum of theta_k Z_k Z_k^T + what is known. With
P = V^-1 - V^-1 X (X^T V^-1 X)^-1 X^T V^-1 the score of theta_k is 1/2 (y^T P V_k P y - tr(P V_k)), its information
1/2 tr(P V_k P V_l). Steps take the average information 1/2 y^T P V_k P V_l P y, without products of matrices.
Sources: D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320; A. R. Gilmour, R. Thompson, B. R. Cullis,
Biometrics 51 (1995) 1440.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import linalg, special

from bench.base.arrays import Floats, Mask

ROUNDS: Final = 40
AT_REST: Final = 3e-3
"""Sizes are known to some per cent at best: no parameter moves by more than this part of itself."""
MOST_CHANGE: Final = 4.0
LEAST: Final = 1e-6
"""Least variance of a component, as a part of its scale: there it is as good as none."""


@dataclass(frozen=True)
class Mixed:
    """Data `y` (N,) with fixed effects `X` (N, p), components `Z` of (N, q_k) and a `known` part (N, N)."""

    y: Floats
    X: Floats
    Z: tuple[Floats, ...]
    known: Floats

    def covariance(self, theta: Floats) -> Floats:
        """Return V (N, N) for variances (k,)."""
        whole = self.known.copy()
        for size, columns in zip(theta.tolist(), self.Z, strict=True):
            if size:
                whole += size * (columns @ columns.T)
        return whole

    def only(self, kept: Mask) -> Mixed:
        """Return the same with some of the components, (k,) true."""
        return Mixed(self.y, self.X, tuple(z for z, k in zip(self.Z, kept, strict=True) if k), self.known)


@dataclass(frozen=True)
class Projection:
    """P (N, N) at some variances, with P y (N,)."""

    P: Floats
    Py: Floats

    @classmethod
    def at(cls, mixed: Mixed, theta: Floats) -> Projection:
        """Return that for variances (k,). Raises `numpy.linalg.LinAlgError` where V is singular."""
        factor = linalg.cho_factor(mixed.covariance(theta), lower=True, check_finite=False)
        inverse = linalg.cho_solve(factor, np.eye(len(mixed.y)), check_finite=False)
        q, _ = np.linalg.qr(linalg.solve_triangular(factor[0], mixed.X, lower=True, check_finite=False))
        back = linalg.solve_triangular(factor[0], q, lower=True, trans="T", check_finite=False)
        P = inverse - back @ back.T
        return cls(P, P @ mixed.y)

    def scores(self, Z: Sequence[Floats]) -> Floats:
        """Return the slope of ln L by each variance, shape (k,)."""
        squares = [float(np.sum((z.T @ self.Py) ** 2)) for z in Z]
        traces = [float(np.einsum("ij,ij->", self.P @ z, z)) for z in Z]
        return np.asarray(0.5 * (np.array(squares) - np.array(traces)))

    def average_information(self, Z: Sequence[Floats]) -> Floats:
        """Return 1/2 y^T P V_k P V_l P y, shape (k, k)."""
        moved = np.stack([z @ (z.T @ self.Py) for z in Z], axis=1)
        return np.asarray(0.5 * moved.T @ self.P @ moved)

    def information(self, Z: Sequence[Floats]) -> Floats:
        """Return the expected information 1/2 tr(P V_k P V_l), shape (k, k)."""
        ends = np.cumsum([0, *(z.shape[1] for z in Z)])
        whole = np.concatenate(list(Z), axis=1)
        squares = (whole.T @ self.P @ whole) ** 2
        rows = np.add.reduceat(squares, ends[:-1], axis=0)
        return np.asarray(0.5 * np.add.reduceat(rows, ends[:-1], axis=1))


def maximise(
    mixed: Mixed, start: Floats, scale: Floats, believed: Floats | None = None
) -> tuple[Floats, Projection]:
    """Return the variances (k,) of greatest restricted likelihood, none negative, and P there.

    `start` (k,) where to begin, `scale` (k,) sizes below a millionth of which count as nothing, `believed` (k,) the
    least that is believed of each.
    """
    bottom = np.zeros_like(start) if believed is None else believed
    least = np.maximum(LEAST * scale, bottom)
    theta = np.maximum(start, least)
    for _ in range(ROUNDS):
        at = Projection.at(mixed, theta)
        slope = at.scores(mixed.Z) * theta
        curvature = at.average_information(mixed.Z) * np.outer(theta, theta)
        free = (theta > least) | (slope > 0)
        step = np.zeros(len(theta))
        own = curvature[np.ix_(free, free)]
        own = own + np.diag(0.05 * np.diag(own) + 1e-9 * np.trace(own))
        step[free] = np.linalg.solve(own, slope[free])
        moved = np.maximum(theta * np.clip(1.0 + step, 1 / MOST_CHANGE, MOST_CHANGE), least)
        still = np.all(np.abs(moved - theta) <= AT_REST * theta + 10 * LEAST * scale)
        theta = moved
        if still:
            break
    theta = np.where(theta <= 10 * LEAST * scale, bottom, theta)
    return theta, Projection.at(mixed, theta)


def asked_for(at: Projection, Z: Sequence[Floats], inside: Sequence[Floats]) -> Floats:
    """Return, for components that are not yet in, the probability of such a score where there is none, shape (k,).

    `inside` are the components whose variances are being estimated: what they take is taken off the information. A
    score is a quadratic form, taken as a chi-square with the degrees of freedom that its mean and variance give
    (Satterthwaite, Biometrics Bull. 2 (1946) 110): of few degrees, as a drift has, large ones are not rare.
    """
    score = at.scores(Z)
    whole = at.information([*Z, *inside])
    k = len(Z)
    across = whole[:k, k:]
    scale = np.sqrt(np.diag(whole)[k:])
    inner = whole[k:, k:] / np.outer(scale, scale)
    taken = np.einsum("ki,ij,kj->k", across / scale, np.linalg.pinv(inner, rcond=1e-8), across / scale)
    own = np.diag(whole)[:k]
    left = own - taken
    told = left > 1e-6 * own
    size = np.where(told, score / np.sqrt(np.where(told, left, 1.0)), -np.inf)
    traces = np.array([float(np.einsum("ij,ij->", at.P @ z, z)) for z in Z])
    freedom = traces**2 / (2.0 * own)
    return np.asarray(special.chdtrc(freedom, np.maximum(freedom + size * np.sqrt(2.0 * freedom), 0.0)))
