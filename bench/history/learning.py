"""Learning of the errors that runs of one bench share: restricted likelihood, tests for contradicting runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import CHANNELS, Floats, Mask
from bench.base.languages import message
from bench.calibration.noise import KnownStand
from bench.calibration.result import CalibrationError
from bench.history.learned import Contradiction, Learned, Variance
from bench.history.run_sums import (
    SEEN,
    Layout,
    RunFit,
    RunSums,
    between_runs,
    body_of,
    known_noise,
    pooled_noise,
    scatter_of,
)
from bench.stats import holm
from bench.stats.reml import scoring_step

LEAST: Final = 1e-8
"""The least variance, relative to the stated one; it is practically zero."""
START: Final = 0.05
STEP: Final = 0.02
"""Relative step of the numerical derivative of the score that gives the observed information."""
ROUNDS: Final = 100
AT_REST: Final = 1e-4
MOST_CHANGE: Final = 5.0


@dataclass(frozen=True)
class Beliefs:
    """Prior beliefs about the means and about the variances.

    `precision` (m,) is the stated variance of each mean divided by its prior variance. `centre` (k,) and `spread`
    (k,) are the mean and the standard deviation of each variance that keeps its prior. They are NaN for a variance
    that is estimated from the runs.
    """

    precision: Floats
    centre: Floats
    spread: Floats

    @property
    def held(self) -> Mask:
        """Which variances keep their prior, (k,)."""
        return np.asarray(np.isfinite(self.centre))


@dataclass(frozen=True)
class LikelihoodPoint:
    """The likelihood at given variances: -2 ln L, score (k,), information (k, k), means and their covariance.

    `means` (m + waves,) are the m means followed by the harmonics of the head; `covariance` is their joint
    covariance.
    """

    minus_two_log: float
    score: Floats
    information: Floats
    means: Floats
    covariance: Floats


@dataclass(frozen=True)
class Weighed:
    """Sums of squares and products of (B, F, y) of each run, weighted for given variances.

    `whole` (runs, w, w) are the sums weighted by V^-1, and `log_det` (runs,) is ln det V/R. R is the covariance of
    the noise alone; V includes the shared variances. `RunSums` explains B and y, `RunSums.by_mean` explains F; B
    has `columns` columns.
    """

    whole: Floats
    log_det: Floats
    columns: int

    @classmethod
    def of(cls, body: RunSums, theta: Floats, means: int) -> Weighed:
        """Return the sums of `body`, weighted for variances `theta` (k,); `means` is the number of means."""
        c = body.columns
        gram = body.by_mean(means)
        root = np.sqrt(np.append(theta, 0.0)[body.random])
        inner = np.eye(c) + root[:, :, None] * gram[:, :c, :c] * root[:, None, :]
        lower = np.linalg.cholesky(inner)
        half = np.linalg.solve(lower, root[:, :, None] * gram[:, :c])
        logs = 2.0 * np.sum(np.log(np.diagonal(lower, axis1=1, axis2=2)), axis=1)
        return cls(gram - np.swapaxes(half, 1, 2) @ half, logs, c)

    def means(self, beliefs: Beliefs, without: int | None = None) -> tuple[Floats, Floats]:
        """Return means and harmonics (m + waves,) and their covariance, from all runs or all but run `without`."""
        c, m = self.columns, len(beliefs.precision)
        normal = self.whole[:, c:-1, c:-1].sum(axis=0)
        right = self.whole[:, c:-1, -1].sum(axis=0)
        if without is not None:
            normal = normal - self.whole[without, c:-1, c:-1]
            right = right - self.whole[without, c:-1, -1]
        places = np.arange(m)
        normal[places, places] += beliefs.precision
        # regularise: a harmonic that no run determines gets a huge variance and affects nothing else
        normal[np.diag_indices_from(normal)] += 1e-12 * np.maximum(np.diag(normal), 1e-12)
        covariance = np.linalg.inv(normal)
        return covariance @ right, covariance


def at(body: RunSums, theta: Floats, beliefs: Beliefs) -> LikelihoodPoint:
    """Return the restricted likelihood at variances (k,), which are divided by the stated variances.

    Harmonics of the head have no prior.
    """
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
    return LikelihoodPoint(value + float(off @ off), score - off / spread, information, means, covariance)


def fitted(body: RunSums, beliefs: Beliefs, start: Floats | None = None) -> Floats:
    """Return the non-negative variances (k,) that maximise the likelihood, divided by the stated variances.

    The method is Fisher scoring in relative steps.
    """
    theta = np.full(len(beliefs.centre), START) if start is None else np.maximum(start, 100 * LEAST)
    best, damping = at(body, theta, beliefs), 0.0
    for _ in range(ROUNDS):
        moved = scoring_step(theta, best.score, best.information, LEAST, 1e-6 + damping, 1e-12, MOST_CHANGE)
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


def observed_information(body: RunSums, theta: Floats, beliefs: Beliefs) -> Floats:
    """Return the negative second derivatives of ln L (k, k), priors included, by differences of the score."""
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


NAMED_P: Final = 0.01
"""Significance level of a contradicting run, for all runs together."""
LOOKED_AT_P: Final = 0.1
"""If a run's preliminary p-value is below this, the variances are estimated again without the run."""
MOST_PART: Final = 1 / 3
"""The largest fraction of runs left out; if more contradict, the runs do not share one state of the bench."""
ANGLES: Final = message("its angles of the stand")
FIT: Final = message("what it leaves beyond the scatter of its repeats")
SCATTER: Final = message("the scatter of its repeats")


def odd_runs(runs: list[RunFit], body: RunSums, theta: Floats, beliefs: Beliefs) -> list[Contradiction]:
    """Test whether each run contradicts the others in stand angles, in misfit or in scatter of repeats.

    Return the results of all tests with Holm's p-values, the smallest first.
    """
    found = [*_angles(body, theta, beliefs), *_fit(body, at(body, theta, beliefs).means), *_scatter(runs)]
    found.sort(key=lambda one: one.p)
    adjusted = holm(np.array([one.p for one in found]))
    return [replace(one, p=p) for one, p in zip(found, adjusted.tolist(), strict=True)]


def _angles(body: RunSums, theta: Floats, beliefs: Beliefs) -> list[Contradiction]:
    found = []
    weighed = Weighed.of(body, theta, len(beliefs.precision))
    for r, name in enumerate(body.names):
        size, p = _angle_test(body, r, theta, *weighed.means(beliefs, without=r))
        if p < LOOKED_AT_P:
            # a contradicting run inflates the variances and so hides itself: estimate them without it
            others = body.without([r])
            refit = fitted(others, beliefs, theta)
            size, p = _angle_test(
                body, r, refit, *Weighed.of(others, refit, len(beliefs.precision)).means(beliefs)
            )
        if np.isfinite(size):
            found.append(Contradiction(name, ANGLES, size, p))
    return found


def _angle_test(
    body: RunSums, r: int, theta: Floats, means: Floats, covariance: Floats
) -> tuple[float, float]:
    """Test the angles of run `r` against their prediction from the other runs.

    Returns the reduced chi-square and the p-value.
    """
    c = body.columns
    own = np.flatnonzero(body.mean[r] >= 0)
    by_means = body.by_mean(len(means) - body.waves)[r][own, c:-1]
    sized = np.append(theta, 0.0)[body.random[r]]
    S = body.gram[r, :c, :c]
    left = body.gram[r, own, -1] - by_means @ means
    spread = S[np.ix_(own, own)] + (S[own] * sized) @ S[own].T + by_means @ covariance @ by_means.T
    size, axes = np.linalg.eigh(S[np.ix_(own, own)])
    axes = axes[:, size > SEEN]
    freedom = axes.shape[1]
    if not freedom:
        return float("nan"), 1.0
    z = axes.T @ left
    chi2 = float(z @ np.linalg.solve(axes.T @ spread @ axes, z))
    return chi2 / freedom, float(special.fdtrc(freedom, max(len(body.names) - 1, 1), chi2 / freedom))


def _fit(body: RunSums, means: Floats) -> list[Contradiction]:
    """Test each run's lack of fit, without the part due to the head's harmonics, against that of the other runs."""
    waves = means[len(means) - body.waves :]
    c = body.columns
    H = slice(c, c + body.waves)
    chi2 = np.empty(len(body.names))
    for r, gram in enumerate(body.gram):
        angles = np.flatnonzero(body.mean[r] >= 0)
        left = gram[angles, -1] - gram[angles, H] @ waves
        size, axes = np.linalg.eigh(gram[np.ix_(angles, angles)])
        seen = size > SEEN
        explained = np.sum((axes[:, seen].T @ left) ** 2 / size[seen])
        off = -2.0 * waves @ gram[H, -1] + waves @ gram[H, H] @ waves
        chi2[r] = max(float(body.chi2[r] + off - explained), 1e-3)
    return _held_against(body.names, chi2 / body.dof, body.dof, FIT, upper=True)


def _scatter(runs: list[RunFit]) -> list[Contradiction]:
    told = [run for run in runs if run.scatter.settings]
    if len(told) < 2:
        return []
    ratio, dof = scatter_of(told, pooled_noise(told))
    return _held_against(tuple(run.name for run in told), ratio, dof, SCATTER, upper=False)


def _held_against(
    names: tuple[str, ...], ratio: Floats, dof: Floats, what: str, *, upper: bool
) -> list[Contradiction]:
    """Test each of several mean squares against the remaining ones; `dof` are their degrees of freedom.

    The test allows for the variation between the remaining runs. It is one-sided with `upper`, otherwise two-sided.
    """
    usable = np.flatnonzero(dof > 0)
    found = []
    for r in usable:
        others = usable[usable != r]
        if not len(others):
            continue
        mean, spread2, told = between_runs(ratio[others], dof[others])
        x = float(np.log(ratio[r]) - special.digamma(dof[r] / 2) + np.log(dof[r] / 2))
        u = np.sqrt(special.polygamma(1, dof[r] / 2) + spread2 + told)
        t = (x - mean) / float(u)
        # Student's t if the variation between runs was estimated from the others
        above = special.ndtr(-t) if spread2 == 0.0 else special.stdtr(max(len(others) - 1, 1), -t)
        p = float(above if upper else 2 * min(above, 1 - above))
        found.append(Contradiction(names[r], what, float(np.exp(x - mean)), p))
    return found


@dataclass(frozen=True)
class Agreed:
    """The runs that agree with one another, their sums and noise (4,), and the contradicting runs.

    `most` is true if more than the fraction `MOST_PART` of the runs contradict.
    """

    runs: list[RunFit]
    body: RunSums
    noise: Floats
    contradicting: tuple[Contradiction, ...]
    most: bool


def agreed(runs: list[RunFit], body: RunSums, noise: Floats, beliefs: Beliefs, layout: Layout) -> Agreed:
    """Remove runs that contradict the others, most significant first, one at a time; return the result."""
    named: list[Contradiction] = []
    kept = list(runs)
    most = int(len(runs) * MOST_PART)
    theta = fitted(body, beliefs)
    while len(kept) > 2:
        oddest = odd_runs(kept, body, theta, beliefs)[0]
        if oddest.p >= NAMED_P:
            return Agreed(kept, body, noise, tuple(named), most=False)
        if len(named) >= most:
            return Agreed(kept, body, noise, (*named, oddest), most=True)
        named.append(oddest)
        kept = [run for run in kept if run.name != oddest.run]
        noise = pooled_noise(kept)
        body = body_of(kept, noise, layout)
        theta = fitted(body, beliefs, theta)
    return Agreed(kept, body, noise, tuple(named), most=False)


LEAST_RUNS: Final = 2
SHOWN: Final = 0.1
"""An angle is visible in a run that gives at least this fraction of the stated information on it."""
ALIKE: Final = 0.9
"""Two angles are inseparable if the cosine between their effects exceeds this."""
HELD_CENTRE: Final = 0.5
HELD_SPREAD: Final = 1 / np.sqrt(12.0)
"""Prior mean and standard deviation of an undetermined remount variance: uniform from 0 to the stated variance."""
MEANS_OF_HELD: Final = 1.0 / HELD_CENTRE
"""Precision of an angle's mean if the remount variance is undetermined: both share the stated variance."""
HALF_ITSELF: Final = 0.5
"""A variance is undetermined if its u exceeds this fraction of the variance, and also the u of the prior."""


def learn(
    runs: Sequence[RunFit],
    stand_u: Mapping[str, float],
    *,
    by_installation: bool = False,
    waves: bool = True,
) -> Learned:
    """Return the errors that runs of one bench share; `stand_u` are the stated u of the stand angles, rad.

    With `by_installation`, each installation has separate mean angles, as if each had a separate bracket;
    otherwise all share the means of the stand. With `waves`, the eccentricity and ellipticity of the head's scale
    are estimated. Raises `CalibrationError` if there are too few runs or repeats, or signals in different units.
    """
    if len(runs) < LEAST_RUNS:
        raise CalibrationError(
            f"{len(runs)} run cannot show which errors all runs share; give {LEAST_RUNS} runs or more"
        )
    units = {run.unit: run.name for run in runs}
    if len(units) > 1:
        each = ", ".join(f"{name} in {unit}" for unit, name in sorted(units.items()))
        raise CalibrationError(
            f"the runs have signals in different units ({each}); leave out the runs in other units"
        )
    kept = list(runs)
    layout = Layout.of(kept, stand_u, by_installation=by_installation, waves=waves)
    noise = pooled_noise(kept)
    body = body_of(kept, noise, layout)
    free = Beliefs(np.ones(len(layout.means)), *np.full((2, len(layout.kinds) + 3), np.nan))
    beliefs, reasons = told_by_runs(body, layout, free)
    found = agreed(kept, body, noise, beliefs, layout)
    if found.contradicting:
        beliefs, reasons = told_by_runs(found.body, layout, free)
    return _learned(found, layout, fitted(found.body, beliefs), beliefs, reasons)


def told_by_runs(body: RunSums, layout: Layout, free: Beliefs) -> tuple[Beliefs, dict[str, str]]:
    """Return the beliefs with undetermined variances fixed at their priors, and reasons by kind of angle.

    Among variances that cannot be separated, the one with the smallest stated u is fixed first, and so on until the
    remaining variances are determined.
    """
    beliefs, reasons = free, {}
    for j, kind in enumerate(layout.kinds):
        if not _shown(body, j):
            beliefs, reasons[kind] = (
                _holding(beliefs, layout, j),
                message("no reading of these runs shows it"),
            )
    while True:
        theta = fitted(body, beliefs)
        untold = _undetermined(body, theta, beliefs, layout)
        if not untold:
            return beliefs, reasons
        j, why = min(untold.items(), key=lambda one: layout.stated[one[0]])
        beliefs, reasons[layout.kinds[j]] = _holding(beliefs, layout, j), why


def _holding(beliefs: Beliefs, layout: Layout, j: int) -> Beliefs:
    """Return the beliefs with the variance of angle kind `j` fixed at its prior.

    The prior of the mean of this kind gets the rest of the stated variance.
    """
    centre, spread = beliefs.centre.copy(), beliefs.spread.copy()
    centre[j], spread[j] = HELD_CENTRE, HELD_SPREAD
    own = np.array([name == layout.kinds[j] for name, _ in layout.means])
    return Beliefs(np.where(own, MEANS_OF_HELD, beliefs.precision), centre, spread)


def _shown(body: RunSums, j: int) -> bool:
    """Return whether any run has at least `SHOWN` of the stated information on the angle kind `j`."""
    own = np.diagonal(body.gram[:, : body.columns, : body.columns], axis1=1, axis2=2)[body.random == j]
    return bool(np.max(own, initial=0.0) > SHOWN)


def _undetermined(body: RunSums, theta: Floats, beliefs: Beliefs, layout: Layout) -> dict[int, str]:
    """Return why these runs do not determine the variance of an angle, by index of the angle."""
    information = at(body, theta, beliefs).information
    k = len(layout.kinds)
    size = np.maximum(np.sqrt(np.diag(information)), 1e-6)
    scaled = information / np.outer(size, size) + 1e-9 * np.eye(len(size))
    covariance = np.linalg.inv(scaled) / np.outer(size, size)
    found = {}
    for j in range(k):
        u = np.sqrt(covariance[j, j])
        if beliefs.held[j] or u <= max(HELD_SPREAD, HALF_ITSELF * theta[j]):
            continue
        found[j] = _why(body, j, layout)
    return found


def _why(body: RunSums, j: int, layout: Layout) -> str:
    """Return why the runs do not determine an angle; the reason names angles inseparable from it, if any."""
    together = set()
    for gram, random in zip(body.gram, body.random, strict=True):
        own = np.flatnonzero(random == j)
        for kind in range(len(layout.kinds)):
            for i, other in product(own, np.flatnonzero(random == kind)):
                size = np.sqrt(gram[i, i] * gram[other, other])
                if kind != j and size > SEEN and abs(gram[i, other]) > ALIKE * size:
                    together.add(layout.kinds[kind])
    if together:
        others = " and ".join(sorted(together))
        return message(f"in these runs it shows only together with {others}")
    return message("these runs are too few, or too noisy, to show it")


# --- from variances to sizes --------------------------------------------------------------------------


def _learned(
    found: Agreed, layout: Layout, theta: Floats, beliefs: Beliefs, reasons: dict[str, str]
) -> Learned:
    runs, body, noise = found.runs, found.body, found.noise
    there = at(body, theta, beliefs)
    spread = variances_of(theta, observed_information(body, theta, beliefs), there.information)
    names = [*layout.kinds, *(f"drift[{channel}]" for channel in CHANNELS)]
    unit = np.concatenate([layout.stated, np.full(3, layout.walk)])
    variances = tuple(
        Variance(name, float(size), float(u), float(one), bool(held))
        for name, size, u, one, held in zip(
            names, theta, np.sqrt(np.diag(spread)), unit, beliefs.held, strict=True
        )
    )
    m = len(layout.means)
    scale = np.array(
        [layout.stated[layout.kinds.index(name)] for name, _ in layout.means] + [1.0] * body.waves
    )
    known, noise_dof = known_noise(runs, noise)
    dof = means_dof(body, theta, beliefs, spread)
    covariance = there.covariance * np.outer(scale, scale)
    remount = {v.name: v.u_next for v in variances[: len(layout.kinds)]}
    wider = np.array([max(nu, 4.0) / (max(nu, 4.0) - 2.0) for nu in dof[:m]])
    known_stand = KnownStand(
        layout.means, there.means[:m] * scale[:m],
        covariance[:m, :m] * np.sqrt(np.outer(wider, wider)), remount, known,
    )  # fmt: skip
    return Learned(
        runs=tuple(run.name for run in runs),
        unit=runs[0].unit,
        keys=layout.means,
        means=there.means * scale,
        covariance=covariance,
        means_dof=dof,
        stated=scale[:m] / np.sqrt(beliefs.precision),
        waves=body.waves,
        variances=variances,
        variances_covariance=spread * np.outer(unit**2, unit**2),
        noise=np.sqrt(noise),
        noise_dof=noise_dof,
        known=known_stand,
        not_told=reasons,
        contradicting=found.contradicting,
        too_many_contradict=found.most,
    )


def variances_of(theta: Floats, information: Floats, expected: Floats) -> Floats:
    """Return the covariance (k, k) of the variances (k,) from their observed `information` (k, k).

    A variance of zero is uncorrelated with all others. Where few runs leave a likelihood without a peak, the
    `expected` information replaces the observed one.
    """
    k = len(theta)
    inside = np.flatnonzero(theta > 1e-6)
    spread = np.zeros((k, k))
    own = information[np.ix_(inside, inside)]
    if len(inside) and np.linalg.eigvalsh(own)[0] <= 0.0:
        own = expected[np.ix_(inside, inside)]
    if len(inside):
        size = np.sqrt(np.maximum(np.diag(own), 1e-12))
        spread[np.ix_(inside, inside)] = np.linalg.pinv(
            own / np.outer(size, size), hermitian=True
        ) / np.outer(size, size)
    for j in set(range(k)) - set(inside.tolist()):
        spread[j, j] = 1.0 / max(abs(information[j, j]), 1e-12)
    return spread


def means_dof(body: RunSums, theta: Floats, beliefs: Beliefs, spread: Floats) -> Floats:
    """Return the degrees of freedom (m + waves,) of the means' variances, by Satterthwaite's approximation.

    They are 2 c^2 / (g^T W g): c is the variance of a mean, g its gradient by the variance components, and W
    their covariance `spread` (k, k). Sources: F. E. Satterthwaite, Biometrics Bull. 2 (1946) 110; A. H. Fai,
    P. L. Cornelius, J. Stat. Comput. Simul. 54 (1996) 363.
    """
    here = np.diag(at(body, theta, beliefs).covariance)
    slopes = np.zeros((len(here), len(theta)))
    for j in range(len(theta)):
        step = 0.01 * max(theta[j], 1e-3)
        moved = theta.copy()
        moved[j] += step
        slopes[:, j] = (np.diag(at(body, moved, beliefs).covariance) - here) / step
    taken = np.einsum("mk,kl,ml->m", slopes, spread, slopes)
    return np.asarray(2.0 * here**2 / np.maximum(taken, 1e-300))
