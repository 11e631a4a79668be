"""What else it could have been: every family's evidence beside the one that was named, and what it would change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from bench.analysis.calibration.design import FIXED
from bench.analysis.diagnosis.naming import Scored
from bench.analysis.diagnosis.posterior import posterior
from bench.analysis.diagnosis.result import Diagnosis
from bench.base.arrays import Floats
from bench.model.block import COEFFICIENTS

LISTED: Final = 8
"""Families that a ranking shows, the most plausible first."""


@dataclass(frozen=True)
class Rival:
    """A family beside what else was found: ln odds that it is there, whether the data can tell it from the named.

    `shift` (12 of each block,) is by how much the coefficients would differ were it this one, in units of their u.
    """

    family: str
    evidence: float
    tied: bool
    shift: Floats

    @property
    def largest_shift(self) -> tuple[str, float]:
        """The coefficient that would change most, and by how many u."""
        worst = int(np.argmax(np.abs(self.shift)))
        return COEFFICIENTS[worst % FIXED], float(self.shift[worst])

    def to_dict(self) -> dict[str, Any]:
        """Return the evidence and the coefficient that would change most."""
        coefficient, in_u = self.largest_shift
        return {
            "name": self.family,
            "ln_odds": self.evidence,
            "tied": self.tied,
            "largest_shift": {"coefficient": coefficient, "in_u": in_u},
        }


def rivals(diagnosis: Diagnosis) -> tuple[tuple[Rival, ...], ...]:
    """Return for each effect that was found the most plausible families in its place, itself among them.

    All that is tied is among them.
    """
    naming = diagnosis.naming
    if not naming.found:
        return ()
    linear, candidates = diagnosis.linear, diagnosis.candidates
    fixed = linear.fixed.shape[1]
    u = np.sqrt(np.diag(diagnosis.fitted.covariance))[:fixed]
    # with the same wide prior as each rival, or the priors would pass for a difference
    found = posterior(linear, candidates.columns[:, list(naming.columns)], diagnosis.noise)
    coefficients = found.mean[:fixed]
    rankings = []
    for one in naming.found:
        others = [i for f in naming.found if f is not one for i in f.variant.columns]
        scored = Scored.beside(diagnosis.whitened, diagnosis.data, others)
        ranked = sorted(scored.evidence, key=lambda family: -scored.evidence[family])
        alike = {one.variant.family, *one.ties, *one.plainer_than}
        rows = []
        for family in (f for i, f in enumerate(ranked) if i < LISTED or f in alike):
            best = max(
                (i for i, v in enumerate(candidates.variants) if v.family == family),
                key=lambda i: float(scored.scores.variants[i, 0]),
            )
            variant = one.variant if family == one.variant.family else candidates.variants[best]
            columns = candidates.columns[:, [*others, *variant.columns]]
            shift = (posterior(linear, columns, diagnosis.noise).mean[:fixed] - coefficients) / u
            rows.append(Rival(family, scored.evidence[family], family in one.ties, shift))
        rankings.append(tuple(rows))
    return tuple(rankings)
