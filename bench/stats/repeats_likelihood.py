"""The restricted likelihood of repeats of readings, maximised for many runs at once.

In each group the deviations of repeats from their mean have a covariance R = diag(v_x, v_y, v_z) + v_phi d d^T;
d are the derivatives of the signals by the head angle. S are sums of squares and products of the deviations,
with f degrees of freedom; R_k is the derivative of R by variance k. Fisher scoring uses the information 1/2
tr(R^-1 R_k R^-1 R_l) and the score 1/2 tr(R^-1 R_k R^-1 (S - f R)), with R^-1 in closed form (Sherman and
Morrison). A score test decides whether all channels have one variance.
Sources: D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320, sections 4 and 5; C. R. Rao, Proc. Camb. Phil. Soc. 44
(1948) 50; Y. Chung, S. Rabe-Hesketh et al., Psychometrika 78 (2013) 685, for priors of variances.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, Ints, Mask
from bench.stats.reml import scoring_step

LEAST_DOF: Final = 4.0
"""Least degrees of freedom of a noise size; if the readings give fewer, a prior adds the difference.

With four, the relative uncertainty of a size is about 35 % (JCGM 100:2008, G.4.2).
"""

OWN: Final = np.eye(4)
"""Design matrix for separate parameters: the variances of x, y, z and of the setting."""
COMMON: Final = np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
"""Design matrix for two parameters: one variance for all three channels, and that of the setting."""

LEAST_SETTING: Final = 1e-6
"""Least variance of the setting, as seen in the signals, as a fraction of the variance of the reading."""
LEAST_CHANNEL: Final = 1e-6
"""Least variance of a channel as a fraction of the mean of the three; below it, digits are lost by cancellation."""
ROUNDS: Final = 60
EQUAL_P: Final = 0.2
"""Channels count as equally noisy from this p-value on; it is high, because a wrong size would enter every u."""

DIGITS: Final = 4.0
"""A variance below this multiple of the squared last digit is due to rounding, not to the channel's noise."""

AT_REST: Final = 1e-4
"""Convergence limit: no parameter moves by more than this part of itself."""


def sizes_of(
    scatter: Floats,
    freedom: Ints | Floats,
    slope: Floats,
    floor: float | Floats,
    by: Floats = OWN,
    start: Floats | None = None,
    about: Floats | None = None,
) -> Floats:
    """Return the REML variances of x, y, z (unit^2) and of the head's setting (rad^2), shape (runs, 4).

    `scatter` (runs, groups, 3, 3) are sums of squares and products, `freedom` (groups,) their degrees of freedom,
    `slope` (runs, groups, 3) is du/dphi, unit/rad. `floor` (runs,), or one number, is the least standard deviation
    of the noise. With `by` = `OWN` each channel has a separate variance, with `COMMON` all three have the same.
    `start` (runs, 4) are start values. If all slopes of a run are zero, its setting has the variance zero. `about`
    (runs,) gives each channel's variance a scaled inverse chi-square prior about this value, with `LEAST_DOF`
    degrees of freedom, which keeps it from zero.
    """
    weight = freedom.astype(np.float64)
    slope2 = _mean_slope2(slope, weight)
    least = np.broadcast_to(np.square(floor), slope2.shape)
    if start is None:
        own = np.maximum(np.einsum("rgii->ri", scatter) / weight.sum(), least[:, None])
        start = np.concatenate([own, _shown(own.mean(axis=1) / 3, slope2)[:, None]], axis=1)
    # a parameter starts at the mean of the variances that it represents
    theta = start @ (by / by.sum(axis=0))
    least = np.maximum(least, LEAST_CHANNEL * (theta @ by.T)[:, :3].mean(axis=1))
    bottom = np.repeat(least[:, None], theta.shape[1], axis=1)
    open_rows = np.arange(len(theta))
    for _ in range(ROUNDS):
        at = theta[open_rows]
        bottom[open_rows, -1] = LEAST_SETTING * _shown((at @ by.T)[:, :3].mean(axis=1), slope2[open_rows])
        prior = None if about is None else about[open_rows, None]
        moved = _step(scatter[open_rows], weight, slope[open_rows], at, bottom[open_rows], by, prior)
        theta[open_rows] = moved
        open_rows = open_rows[(np.abs(moved - at) > AT_REST * at).any(axis=1)]
        if not len(open_rows):
            break
    found: Floats = theta @ by.T
    found[slope2 <= 0.0, 3] = 0.0
    return found


@dataclass(frozen=True)
class Sizes:
    """The noise variances (runs, 4) of x, y, z and the head's setting, with degrees of freedom.

    `dof` (runs, 3) are the degrees of freedom of the channels. `p_equal` (runs,) is the p-value of the hypothesis
    that the channels have equal variances. If it is at least `EQUAL_P`, the run has one variance for all three
    channels.
    """

    variances: Floats
    dof: Floats
    p_equal: Floats

    @property
    def alike(self) -> Mask:
        """Mask of the runs that have one variance for all three channels, shape (runs,)."""
        return np.asarray(self.p_equal >= EQUAL_P)


def believed_sizes(
    scatter: Floats, freedom: Ints | Floats, slope: Floats, floor: float | Floats, *, one_size: bool = False
) -> Sizes:
    """Return the noise variances of many runs, separate for each channel if the channels differ.

    All channels have one variance with `one_size`, or if their common variance is at most `DIGITS` `floor`^2,
    as from rounding alone. `scatter`, `freedom`, `slope` and `floor` are as in `sizes_of`.
    """
    common = sizes_of(scatter, freedom, slope, floor, COMMON)
    variances, count = common.copy(), len(common)
    # two of three signals determine a common size, the third the setting error
    dof = np.full((count, 3), 2.0 * float(freedom.sum()))
    if one_size:
        return Sizes(variances, dof, np.ones(count))
    p = equality(scatter, freedom, slope, variances)
    p = np.where(variances[:, 0] <= DIGITS * np.square(floor), 1.0, p)
    own = np.flatnonzero(p < EQUAL_P)
    if len(own):
        at_least = np.broadcast_to(floor, (count,))[own]
        variances[own] = sizes_of(scatter[own], freedom, slope[own], at_least, OWN, variances[own])
        dof[own] = freedom_of(freedom, slope[own], variances[own])[:, :3]
    few = own[np.min(dof[own], axis=1) < LEAST_DOF]
    if len(few):
        # with few repeats the setting error may absorb a channel's whole scatter: add the common size as a prior
        at_least = np.broadcast_to(floor, (count,))[few]
        variances[few] = sizes_of(
            scatter[few], freedom, slope[few], at_least, OWN, common[few], about=common[few, 0]
        )
        dof[few] = freedom_of(freedom, slope[few], variances[few], LEAST_DOF)[:, :3]
    return Sizes(variances, dof, p)


def equality(scatter: Floats, freedom: Ints | Floats, slope: Floats, common: Floats) -> Floats:
    """Return the p-value (runs,) of equal variances of the channels, by Rao's score test.

    `common` (runs, 4) are the variances that maximise the likelihood under this hypothesis. The setting's variance
    is left out of the test if it is at its lower bound.
    """
    score, information = _score_and_information(scatter, freedom.astype(np.float64), slope, common)
    score, information = score * common, information * common[:, :, None] * common[:, None, :]
    held = score[:, 3] < -1e-3 * information[:, 0, 0]
    held |= ~(information[:, 3, 3] > 0.0)
    score[held, 3] = information[held, 3, :3] = information[held, :3, 3] = 0.0
    information[held, 3, 3] = 1.0
    # score and information are twice those of ln L
    misfit = 0.5 * np.einsum("ri,ri->r", score, np.linalg.solve(information, score[:, :, None])[:, :, 0])
    return np.asarray(special.chdtrc(2, np.maximum(misfit, 0.0)))


def freedom_of(freedom: Ints | Floats, slope: Floats, variances: Floats, prior_dof: float = 0.0) -> Floats:
    """Return the degrees of freedom (runs, 4) of the `variances` (runs, 4) of x, y, z and the setting.

    They are 2 v^2/var(v), with var(v) from the information on all four variances. Degrees of freedom spent on the
    setting error are therefore not counted for the channels. `prior_dof` is added for each channel.
    """
    information = _information(_Inverse.of(variances, slope), freedom.astype(np.float64))
    scaled = information * variances[:, :, None] * variances[:, None, :]
    places = np.arange(4)
    # a small ridge keeps a setting variance without slope, or at its bound, from affecting the others
    scaled[:, places, places] += 1e-9 * scaled.max(axis=(1, 2))[:, None]
    scaled[:, places[:3], places[:3]] += prior_dof
    inverted = np.linalg.inv(scaled)
    return np.asarray(1.0 / np.einsum("rii->ri", inverted))


@dataclass(frozen=True)
class _Inverse:
    """The inverse of the covariance R of each group, R^-1 = diag(`own`) - `part` w w^T, where w = diag(`own`) d.

    `own` (runs, 1, 3) are inverse variances; `by_own` is w (runs, groups, 3), and `part` is (runs, groups).
    `by_slope` is R^-1 d, `along` is d^T R^-1 d.
    """

    own: Floats
    by_own: Floats
    part: Floats
    by_slope: Floats
    along: Floats

    @classmethod
    def of(cls, variances: Floats, slope: Floats) -> _Inverse:
        own = 1.0 / variances[:, None, :3]
        by_own = own * slope
        alone = np.einsum("rgi,rgi->rg", slope, by_own)
        shrink = 1.0 / (1.0 + variances[:, 3:] * alone)
        return cls(own, by_own, variances[:, 3:] * shrink, by_own * shrink[:, :, None], alone * shrink)

    def times(self, columns: Floats) -> Floats:
        """Return R^-1 times `columns` (runs, groups, 3, q)."""
        across = self.by_own[:, :, None, :] @ columns * self.part[:, :, None, None]
        return np.asarray(self.own[..., None] * columns - self.by_own[..., None] * across)

    @property
    def diagonal(self) -> Floats:
        """The diagonal of R^-1, (runs, groups, 3)."""
        return np.asarray(self.own - self.part[:, :, None] * self.by_own**2)


def _information(inverse: _Inverse, weight: Floats) -> Floats:
    """Return tr(R^-1 R_k R^-1 R_l) summed over groups, shape (runs, 4, 4): twice the information."""
    runs = len(inverse.along)
    weighed = inverse.part[:, :, None] * inverse.by_own**2
    information = np.empty((runs, 4, 4))
    # the squares of the elements of own - part w w^T
    information[:, :3, :3] = (weighed * weight[:, None]).transpose(0, 2, 1) @ weighed
    places = np.arange(3)
    information[:, places, places] += weight.sum() * inverse.own[:, 0] ** 2 - 2.0 * inverse.own[:, 0] * (
        weight @ weighed
    )
    information[:, :3, 3] = information[:, 3, :3] = weight @ inverse.by_slope**2
    information[:, 3, 3] = inverse.along**2 @ weight
    return information


def _score_and_information(
    scatter: Floats, weight: Floats, slope: Floats, variances: Floats
) -> tuple[Floats, Floats]:
    """Return twice the gradient of ln L by the variances (runs, 4), and twice the information (runs, 4, 4)."""
    inverse = _Inverse.of(variances, slope)
    by_scatter = inverse.times(scatter)
    # the diagonal of R^-1 S R^-1, from R^-1 S
    crossed = np.einsum("rgij,rgj->rgi", by_scatter, inverse.by_own) * inverse.part[:, :, None]
    both = np.einsum("rgii->rgi", by_scatter) * inverse.own - crossed * inverse.by_own
    score = np.empty((len(variances), 4))
    score[:, :3] = both.sum(axis=1) - weight @ inverse.diagonal
    shown = np.einsum("rgi,rgij,rgj->rg", inverse.by_slope, scatter, inverse.by_slope)
    score[:, 3] = shown.sum(axis=1) - inverse.along @ weight
    return score, _information(inverse, weight)


def _mean_slope2(slope: Floats, weight: Floats) -> Floats:
    return np.asarray(np.einsum("rgi,rgi->rg", slope, slope) @ weight / weight.sum())


def _shown(variance: Floats, slope2: Floats) -> Floats:
    """Return the variance of the setting, rad^2, that causes the `variance` of the signals, unit^2.

    `slope2` is the mean squared slope of the signals; the result is 1 where it is zero.
    """
    return np.where(slope2 > 0.0, variance / np.where(slope2 > 0.0, slope2, 1.0), 1.0)


def _step(
    scatter: Floats,
    weight: Floats,
    slope: Floats,
    theta: Floats,
    bottom: Floats,
    by: Floats,
    prior: Floats | None,
) -> Floats:
    score, information = _score_and_information(scatter, weight, slope, theta @ by.T)
    score, information = score @ by, by.T @ information @ by
    if prior is not None:
        own, channels = theta[:, :-1], np.arange(theta.shape[1] - 1)
        score[:, :-1] += LEAST_DOF * (prior - own) / own**2
        information[:, channels, channels] += LEAST_DOF * prior / own**3
    return scoring_step(theta, score, information, bottom, 0.0, 1e-12)
