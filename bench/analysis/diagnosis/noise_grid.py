"""The linear system in units of its noise, for each of a grid of ratios of setting error to reading noise.

The covariance of the rows is sigma^2 (I + gamma^2 d d^T + Z Z^T): sigma the noise of a reading, gamma sigma
what a setting error of typical slope adds along d = du/dphi in units of it, Z the stand angles (and the
model's own effects) within their limits. sigma is left free; gamma runs over the grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.analysis.diagnosis.linear import LinearSystem
from bench.base.arrays import Floats

RATIOS: Final = (0.0, 0.7, 1.4, 2.6, 5.0, 12.0)
"""Grid of gamma: what a setting error of the typical slope adds, in units of a reading's noise."""

RATIO_SPREAD: Final = 1.0
"""Standard deviation of ln gamma about what the bench file states: known to a factor of three, no better."""


@dataclass(frozen=True)
class NoiseGrid:
    """For each ratio a linear map to white noise with the coefficients projected out.

    `white` (ratios, freedom, N) maps rows to freedom = N - 12 numbers, independent and of variance sigma^2
    when nothing is missing; `log_det` (ratios,) completes the restricted likelihood; `log_prior` (ratios,).
    `setting_rad_per_noise` (ratios,) is the setting error in rad for a reading noise of one. Where `sigma` is
    `known` it is believed; else the data say how large the noise is.
    """

    white: Floats
    log_det: Floats
    log_prior: Floats
    setting_rad_per_noise: Floats
    sigma: float
    known: bool = False

    @property
    def freedom(self) -> int:
        """Rows less coefficients."""
        return int(self.white.shape[1])

    def log_likelihood(self, square: Floats) -> Floats:
        """Return ln of the likelihood of residuals with this sum of squares, in units of `sigma` squared."""
        if self.known:
            return -0.5 * square
        return np.asarray(-0.5 * self.freedom * np.log(square), dtype=np.float64)


def make_noise_grid(
    linear: LinearSystem, sigma: float, setting_rad: float, ratios: Sequence[float] = RATIOS
) -> NoiseGrid:
    """Set up the maps. `sigma` is a first estimate of the reading noise, which only scales the stand's limits.

    `setting_rad` is the setting error that the bench file states (0: not known). With fewer `ratios` than
    the whole grid the search is quicker: where the noise is known well enough.
    """
    oriented = linear.setting >= 0
    slope2 = np.bincount(linear.setting[oriented], linear.slope[oriented] ** 2, linear.settings).astype(
        np.float64
    )
    typical = float(np.sqrt(np.mean(slope2)))
    known = np.log(max(setting_rad * typical / sigma, 1e-2)) if setting_rad > 0 else None
    whites, log_dets = [], []
    for ratio in ratios:
        white, log_det = _white(linear, ratio / typical, slope2, sigma)
        whites.append(white)
        log_dets.append(log_det)
    grid = np.array(ratios)
    if known is None:
        log_prior = np.full(len(grid), -np.log(len(grid)))
    else:
        distance = (np.log(np.maximum(grid, 0.25)) - known) / RATIO_SPREAD
        log_prior = -0.5 * np.minimum(distance**2, 25.0)
        log_prior = log_prior - np.logaddexp.reduce(log_prior)
    return NoiseGrid(np.stack(whites), np.array(log_dets), log_prior, grid / typical, sigma)


def _white(linear: LinearSystem, setting: float, slope2: Floats, sigma: float) -> tuple[Floats, float]:
    n = len(linear)
    factor = setting**2 * slope2
    shrink = (1.0 - 1.0 / np.sqrt(1.0 + factor)) / np.maximum(slope2, 1e-300)
    half = np.eye(n)
    for number in range(len(slope2)):
        mine = np.flatnonzero(linear.setting == number)
        d = linear.slope[mine]
        half[np.ix_(mine, mine)] -= shrink[number] * np.outer(d, d)
    fixed = half @ linear.fixed
    q, r = np.linalg.qr(fixed, mode="complete")
    beyond = q[:, fixed.shape[1] :].T @ half
    random = beyond @ (linear.random / sigma)
    covariance = np.eye(len(beyond)) + random @ random.T
    cholesky = np.linalg.cholesky(covariance)
    white = np.linalg.solve(cholesky, beyond)
    log_det = -0.5 * float(np.sum(np.log1p(factor)))
    log_det -= float(np.sum(np.log(np.diag(cholesky))))
    log_det -= float(np.sum(np.log(np.abs(np.diag(r)[: fixed.shape[1]]))))
    return white, log_det
