"""Whether units came to benches by chance, which effects of benches by the means of units take for granted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from bench.analysis.intercomparison.crossed import BENCH, UNIT, Crossed, about_sets, scales_of, solve

FLAT: Final = 1e3
"""A size so many times the scatter is as good as none stated."""


@dataclass(frozen=True)
class Allotment:
    """Whether units came to benches by chance: `chi2` with `dof`, of differences between benches by two ways.

    The first takes differences within units alone, the second the means of all units too; a bench that is given
    units of another kind is off in the second only. Source: J. A. Hausman, Econometrica 46 (1978) 1251.
    """

    chi2: float
    dof: int

    @property
    def p(self) -> float:
        """The probability of so much where units came by chance."""
        return float(special.chdtrc(self.dof, self.chi2)) if self.dof else 1.0


def allotment(found: Crossed) -> Allotment:
    """Hold the differences between benches within units against those that means of units give as well."""
    at = found.at
    crossing = at.crossing
    wide = found.sizes.copy()
    wide[BENCH] = FLAT * scales_of(crossing, found.y, found.variance)[BENCH]
    both = solve(crossing, found.y, found.variance, wide)
    wide[UNIT] = np.inf
    within = solve(crossing, found.y, found.variance, wide)
    about = about_sets(crossing)
    gap = about @ (within.bench - both.bench)
    more = about @ (within.bench_covariance - both.bench_covariance) @ about.T
    size, along = np.linalg.eigh(more)
    told = size > 1e-6 * max(float(size.max(initial=0.0)), 1e-300)
    return Allotment(float(np.sum((along.T[told] @ gap) ** 2 / size[told])), int(told.sum()))
