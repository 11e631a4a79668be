"""How large the noise is by the readings so far, in units of what the bench file states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import gammaincinv

from bench.analysis.calibration.design import FIXED
from bench.analysis.calibration.noise import whiten
from bench.analysis.planning.stand import Stand, whitened
from bench.base.arrays import Floats
from bench.readings.table import Readings

BELIEVED: Final = 6.0
"""What the bench file states of the noise counts as so many signals: little, and enough before there is any."""

SURE: Final = 0.8
"""A mounting is left for good with visits that are enough at noise which is larger with a probability of 1
- SURE."""


@dataclass(frozen=True)
class Scale:
    """The noise in units of what the bench file states: `chi2` of `dof` signals beyond the unknowns."""

    chi2: float = 0.0
    dof: int = 0

    @property
    def size(self) -> float:
        """The estimate, with the bench file's word."""
        return float(np.sqrt((BELIEVED + self.chi2) / (BELIEVED + self.dof)))

    @property
    def bound(self) -> float:
        """What the noise is below with the probability `SURE`."""
        freedom = BELIEVED + self.dof
        return float(self.size * np.sqrt(freedom / (2.0 * gammaincinv(0.5 * freedom, 1.0 - SURE))))


NOTHING_KNOWN: Final = Scale()
"""Before there is a reading: what the bench file states."""


def scale_of(stand: Stand, readings: Readings) -> Scale:
    """Return the noise that readings tell, with what is unknown of block and stand taken out.

    They need not determine the coefficients: one mounting tells of the noise, too.
    """
    own = readings.oriented()
    if not len(own):
        return Scale()
    rows, problem = whitened(stand, own.conditions())
    left = own.signal - problem.predict(stand.block, problem.prior_mean)
    response = whitened_response(stand, left, problem.slope(stand.block, problem.prior_mean))
    matrix = rows.reshape(-1, rows.shape[2])
    prior = np.eye(rows.shape[2])[FIXED:]
    whole = np.vstack([matrix, prior])
    target = np.concatenate([response.ravel(), np.zeros(len(prior))])
    solution = np.linalg.lstsq(whole, target, rcond=1e-9)[0]
    misfit = target - whole @ solution
    rank = int(np.linalg.matrix_rank(matrix[:, :FIXED], tol=1e-9 * float(np.linalg.norm(matrix))))
    return Scale(float(misfit @ misfit), max(matrix.shape[0] - rank, 0))


def whitened_response(stand: Stand, left: Floats, slope: Floats) -> Floats:
    """Return residuals (n, 3) in units of the noise, as the derivatives are."""
    return np.asarray(whiten(left[:, :, None], slope, stand.noise)[:, :, 0])
