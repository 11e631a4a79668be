"""Which degree in temperature the data give each coefficient, and what is left in doubt by that choice.

Backward elimination on the covariance of the full fit: holding a term at zero is a linear operation on an
estimate with its covariance, so no step needs another fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from bench.analysis.temperature.fit import ThermalFit
from bench.base.arrays import Floats, Ints, Mask

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
