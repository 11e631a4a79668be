"""Benches against one another in all twelve coefficients at once.

E_n holds one coefficient against its U; a bench may be within U in each and off in all together, where differences
point along what the coefficients' errors have little of. chi-square = d' C^-1 d of the vector of differences with
its covariance has as many degrees of freedom as there are coefficients; probabilities are of all benches, or pairs,
looked at (Holm). Sources: ISO 13528:2022, 9.7 (E_n, one quantity); R. A. Johnson, D. W. Wichern, Applied
Multivariate Statistical Analysis (2007), 4.2 (the quadratic form).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, u_of
from bench.base.looks import holm

APART_P: Final = 0.05
"""Benches are apart where chance gives any so large a difference less often than this."""


@dataclass(frozen=True)
class Together:
    """A vector of differences: `chi2` with `dof`; `p` of it alone, and of the largest of all looked at."""

    chi2: float
    dof: int
    p: float
    p_all_looks: float

    @property
    def apart(self) -> bool:
        """Whether the benches differ beyond chance."""
        return self.p_all_looks < APART_P

    def to_json(self) -> dict[str, Any]:
        """Return the promised form."""
        return {
            "chi2": self.chi2, "dof": self.dof, "p": self.p, "p_all_looks": self.p_all_looks, "apart": self.apart
        }  # fmt: skip


def together(differences: Floats, u: Floats, errors: Floats, of_errors: Floats) -> tuple[Together, ...]:
    """Judge m vectors of differences (m, 12) with standard uncertainties `u` (m, 12).

    `errors` (m, 12, 12) are covariances of the errors of calibrations, which tell how coefficients are correlated;
    `of_errors` (m, 12) is the part of u that they make. What u has beyond, such as a dark size, belongs to each
    coefficient alone.
    """
    chi2 = []
    for d, whole, covariance, own in zip(differences, u, errors, of_errors, strict=True):
        scale = u_of(covariance)
        scaled = covariance / np.outer(scale, scale) * np.outer(own, own)
        scaled[np.diag_indices(len(d))] += np.maximum(whole**2 - own**2, 0.0)
        chi2.append(float(d / whole @ np.linalg.solve(scaled / np.outer(whole, whole), d / whole)))
    dof = differences.shape[1]
    p = np.asarray(special.chdtrc(dof, np.array(chi2)), dtype=np.float64)
    rows: Sequence[tuple[float, float, float]] = list(zip(chi2, p.tolist(), holm(p).tolist(), strict=True))
    return tuple(Together(one, dof, alone, looks) for one, alone, looks in rows)
