"""The restricted likelihood of what runs share: a few variances, means with priors, and the waves of the head.

Of each run the sums of `Body` are all that is needed: with S = B^T P B and D the variances of the columns, V^-1 in
place of R^-1 takes (D^-1 + S)^-1 off the sums, so that a run costs a matrix of its mountings' angles and no
readings. The score of a variance is 1/2 (e^T V^-1 B_k B_k^T V^-1 e - tr(B_k^T P B_k)), P with the means swept
out, too; steps take the information 1/2 tr(V^-1 V_k V^-1 V_l), what is reported the observed one.
Source: D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320, sections 4 and 5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.analysis.learning.body import Body
from bench.base.arrays import Floats, Mask

LEAST: Final = 1e-8
"""Least variance, in terms of what was stated: there it is as good as none."""
START: Final = 0.05
STEP: Final = 0.02
"""Relative step of the differences that make the observed information from the score."""
ROUNDS: Final = 100
AT_REST: Final = 1e-4
MOST_CHANGE: Final = 5.0


@dataclass(frozen=True)
class Beliefs:
    """What was stated before: prior precision (m,) of the means in stated units, and about variances.

    `centre` (k,) and `spread` (k,) are those of a variance that keeps its prior, NaN for one that the runs tell.
    """

    precision: Floats
    centre: Floats
    spread: Floats

    @property
    def held(self) -> Mask:
        """Which variances keep their prior, (k,)."""
        return np.asarray(np.isfinite(self.centre))


@dataclass(frozen=True)
class At:
    """The likelihood at some variances: value, score (k,), information (k, k), means (m,) with covariance (m, m).

    The waves of the head stand behind the means.
    """

    minus_two_log: float
    score: Floats
    information: Floats
    means: Floats
    covariance: Floats


@dataclass(frozen=True)
class Weighed:
    """The sums (runs, w, w) of (B, F, y) of each run with V^-1 in place of R^-1, and ln det of V/R, (runs,)."""

    whole: Floats
    log_det: Floats
    columns: int

    @classmethod
    def of(cls, body: Body, theta: Floats, means: int) -> Weighed:
        """Weigh for variances (k,)."""
        c = body.columns
        gram = body.by_mean(means)
        root = np.sqrt(np.append(theta, 0.0)[body.random])
        inner = np.eye(c) + root[:, :, None] * gram[:, :c, :c] * root[:, None, :]
        lower = np.linalg.cholesky(inner)
        half = np.linalg.solve(lower, root[:, :, None] * gram[:, :c])
        logs = 2.0 * np.sum(np.log(np.diagonal(lower, axis1=1, axis2=2)), axis=1)
        return cls(gram - np.swapaxes(half, 1, 2) @ half, logs, c)

    def means(self, beliefs: Beliefs, without: int | None = None) -> tuple[Floats, Floats]:
        """Return means and waves with their covariance, of all runs or of all but one."""
        c, m = self.columns, len(beliefs.precision)
        normal = self.whole[:, c:-1, c:-1].sum(axis=0)
        right = self.whole[:, c:-1, -1].sum(axis=0)
        if without is not None:
            normal = normal - self.whole[without, c:-1, c:-1]
            right = right - self.whole[without, c:-1, -1]
        places = np.arange(m)
        normal[places, places] += beliefs.precision
        # a wave that no run shows stays open, and takes nothing
        normal[np.diag_indices_from(normal)] += 1e-12 * np.maximum(np.diag(normal), 1e-12)
        covariance = np.linalg.inv(normal)
        return covariance @ right, covariance


def at(body: Body, theta: Floats, beliefs: Beliefs) -> At:
    """Return the likelihood of variances (k,), in stated units; `beliefs` of the means, waves without a prior."""
    c, m = body.columns, len(beliefs.precision)
    weighed = Weighed.of(body, theta, m)
    whole = weighed.whole
    means, covariance = weighed.means(beliefs)
    right = whole[:, c:-1, -1].sum(axis=0)
    value = float(weighed.log_det.sum())
    value += float(whole[:, -1, -1].sum() - right @ means) - float(np.linalg.slogdet(covariance)[1])
    by_means = whole[:, :c, c:-1]
    left = whole[:, :c, -1] - by_means @ means
    own = whole[:, :c, :c]
    traces = np.diagonal(own, axis1=1, axis2=2) - np.sum((by_means @ covariance) * by_means, axis=2)
    belongs = body.belongs(len(theta))
    score = 0.5 * ((left**2 - traces).ravel() @ belongs.reshape(-1, len(theta)))
    information = 0.5 * np.einsum("rcg,rch->gh", belongs, own**2 @ belongs)
    held = beliefs.held
    spread = np.where(held, beliefs.spread, 1.0)
    off = np.where(held, (theta - np.where(held, beliefs.centre, 0.0)) / spread, 0.0)
    information[np.diag_indices_from(information)] += np.where(held, spread**-2.0, 0.0)
    return At(value + float(off @ off), score - off / spread, information, means, covariance)


@dataclass(frozen=True)
class Shared:
    """The variances (k,) of greatest restricted likelihood in stated units, and what goes with them.

    `information` (k, k) is the observed one, priors included; `at` the likelihood there.
    """

    theta: Floats
    information: Floats
    at: At


def maximise(body: Body, beliefs: Beliefs, start: Floats | None = None) -> Shared:
    """Return the variances of greatest likelihood, none below zero, with the observed information."""
    theta = fitted(body, beliefs, start)
    return Shared(theta, observed_information(body, theta, beliefs), at(body, theta, beliefs))


def fitted(body: Body, beliefs: Beliefs, start: Floats | None = None) -> Floats:
    """Return the variances (k,) of greatest likelihood alone, by scoring in relative steps."""
    theta = np.full(len(beliefs.centre), START) if start is None else np.maximum(start, 100 * LEAST)
    best, damping = at(body, theta, beliefs), 0.0
    for _ in range(ROUNDS):
        slope = best.score * theta
        curvature = best.information * np.outer(theta, theta)
        free = (theta > LEAST) | (slope > 0)
        own = curvature[np.ix_(free, free)]
        own = own + np.diag((1e-6 + damping) * np.diag(own) + 1e-12 * np.trace(own) + 1e-300)
        step = np.zeros(len(theta))
        step[free] = np.linalg.solve(own, slope[free])
        moved = np.maximum(theta * np.clip(1.0 + step, 1 / MOST_CHANGE, MOST_CHANGE), LEAST)
        there = at(body, moved, beliefs)
        if there.minus_two_log > best.minus_two_log + 1e-9:
            damping = max(4.0 * damping, 0.5)
            if damping > 1e6:
                break
            continue
        still = np.all(np.abs(moved - theta) <= AT_REST * theta + 10 * LEAST)
        theta, best, damping = moved, there, damping / 4.0 if damping > 1e-3 else 0.0
        if still:
            break
    return theta


def observed_information(body: Body, theta: Floats, beliefs: Beliefs) -> Floats:
    """Return minus the second derivatives of ln L (k, k) by differences of the score."""
    k = len(theta)
    information = np.zeros((k, k))
    for j in range(k):
        size = STEP * max(theta[j], 1e-3)
        up, down = theta.copy(), theta.copy()
        up[j] += size
        down[j] = max(down[j] - size, LEAST)
        change = at(body, up, beliefs).score - at(body, down, beliefs).score
        information[j] = -change / (up[j] - down[j])
    return np.asarray((information + information.T) / 2)
