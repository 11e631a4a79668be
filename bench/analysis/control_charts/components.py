"""Short-term and long-term variability of a check block: what repeats show, what stated u says, what days show.

Level 1 is the noise within a run, level 2 what differs from one measurement to the next (mounting, day), as far as
stated u and the scatter of the baseline tell them apart. Sources: NIST/SEMATECH e-Handbook, 2.2.3 (standard
deviations of short term, F test), 2.3.3.3 and 2.3.5; C. Croarkin, NBS Special Publication 676-II (1985), 2.4;
M. S. Bartlett, Proc. R. Soc. A 160 (1937), 268-282 (equal variances); DIN 1319-4, R. T. Birge (the ratio).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from bench.base.arrays import Floats, u_of

ALIKE_P = 0.01
"""Baseline and stated u contradict one another where chance would show as much less often than this."""


@dataclass(frozen=True)
class ShortTerm:
    """Standard deviations of short term (n,) with `dof` (n,), against `pooled` of the baseline with `pooled_dof`.

    `f` is the square of their ratio, `p` the probability of more by chance (F test, one-sided).
    """

    s: Floats
    dof: Floats
    pooled: float
    pooled_dof: float
    f: Floats
    p: Floats

    def limits(self, probability: float) -> Floats:
        """Return the largest standard deviation (n,) that chance shows more often than a probability."""
        return np.asarray(
            self.pooled
            * np.sqrt(special.fdtri(np.maximum(self.dof, 1.0), self.pooled_dof, 1.0 - probability))
        )


def short_term(s: Floats, dof: Floats, baseline_s: Floats, baseline_dof: Floats) -> ShortTerm:
    """Compare standard deviations with those of a baseline, pooled by their degrees of freedom.

    Source: NIST/SEMATECH e-Handbook, 2.2.3.1 and 2.3.5.1.
    """
    pooled_dof = float(baseline_dof.sum())
    pooled = float(np.sqrt((baseline_dof @ baseline_s**2) / pooled_dof))
    f = (s / pooled) ** 2
    # what has no degrees of freedom is no estimate: nothing can be said of it
    p = np.where(dof > 0, special.fdtrc(np.maximum(dof, 1.0), pooled_dof, f), 1.0)
    return ShortTerm(s, dof, pooled, pooled_dof, f, p)


@dataclass(frozen=True)
class Components:
    """The variability of each coefficient (p,) in a baseline of `runs` runs.

    `noise` is what reading noise makes of it (level 1), `stated` the u of one run from everything that comes anew
    with it; `scatter` is the standard deviation between runs, with `runs` - 1 degrees of freedom, `f` the square of
    its ratio to `stated` and `p` the probability of more by chance, `between` what it holds beyond stated u, and
    `between_most` the most that it may hold (95 %). `birge2` is the same ratio of all coefficients together, with
    `birge_dof` and two-sided `birge_p`; `alike_p` tells whether stated u is as right in every direction.
    """

    runs: int
    noise: Floats
    stated: Floats
    scatter: Floats
    f: Floats
    p: Floats
    between: Floats
    between_most: Floats
    birge2: float
    birge_dof: int
    birge_p: float
    alike_p: float

    @property
    def more_than_stated(self) -> Floats:
        """Probabilities (p,) for so many looks: Bonferroni over the coefficients."""
        return np.minimum(1.0, len(self.p) * self.p)


def components_of(values: Floats, covariance: Floats, noise: Floats) -> Components:
    """Return the components of a baseline (m, p), m above 1, of which each run has `covariance` (p, p)."""
    runs, p = values.shape
    left = values - values.mean(axis=0)
    stated, scatter = u_of(covariance), values.std(axis=0, ddof=1)
    f = (scatter / stated) ** 2
    excess = np.maximum(0.0, scatter**2 - stated**2)
    # a variance found from few runs may be so much larger than it seems
    largest = (runs - 1) * scatter**2 / special.chdtri(runs - 1, 0.95)
    scale, axes = np.linalg.eigh(covariance / np.outer(stated, stated))
    squares = ((left / stated) @ axes / np.sqrt(scale)) ** 2
    ratio = squares.sum(axis=0) / (runs - 1)
    total, dof = float(squares.sum()), p * (runs - 1)
    upper = float(special.chdtrc(dof, total))
    return Components(
        runs=runs,
        noise=noise,
        stated=stated,
        scatter=scatter,
        f=f,
        p=np.asarray(special.chdtrc(runs - 1, (runs - 1) * f)),
        between=np.sqrt(excess),
        between_most=np.sqrt(np.maximum(0.0, largest - stated**2)),
        birge2=total / dof,
        birge_dof=dof,
        birge_p=2.0 * min(upper, 1.0 - upper),
        alike_p=_bartlett(ratio, runs - 1),
    )


def _bartlett(variances: Floats, dof: int) -> float:
    """Return the probability of variances (p,), each with `dof`, so different by chance."""
    p = len(variances)
    gap = p * dof * np.log(variances.mean()) - dof * np.log(variances).sum()
    return float(special.chdtrc(p - 1, gap / (1.0 + (p + 1.0) / (3.0 * p * dof))))


@dataclass(frozen=True)
class DriftSeen:
    """How each coefficient (p,) of the check block drifts: `per_year` with `u`, `p` for so many looks."""

    per_year: Floats
    u: Floats
    p: Floats


def drift_of(years: Floats, values: Floats, u: Floats, dof: float) -> DriftSeen:
    """Return straight lines through coefficients (n, p) at times (n,), each value with u (p,) of `dof`."""
    centred = years - years.mean()
    spread = float(centred @ centred)
    slope = centred @ values / spread
    u_slope = u / np.sqrt(spread)
    t = np.abs(slope / u_slope)
    p = special.erfc(t / np.sqrt(2.0)) if np.isinf(dof) else 2.0 * special.stdtr(dof, -t)
    return DriftSeen(slope, u_slope, np.minimum(1.0, len(slope) * np.asarray(p)))
