"""Outliers: readings that contradict the model and all other readings, found one by one.

Candidates are each signal, each setting of the head (which moves three signals along du/dphi) and the modulus of
each free position. Each step adds a free shift for the candidate with the largest studentised residual, and
repeats the fit; a shifted reading does not count for the noise. Several outliers may mask each other. Therefore,
after the last step, all candidates up to the last significant one are outliers. The critical value allows for all
tests. Source: Rosner, Technometrics 25 (1983) 165 (generalised extreme studentised deviate), here with the
residuals of a regression.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import ARCSEC, Floats, Ints, unit_vectors
from bench.calibration.design import Problem
from bench.calibration.gls import MODULUS, SETTING, Estimator, Fit, Shift, whitened_rows
from bench.calibration.noise import LEAST_REPEATS, repeat_groups, scatter_of_repeats, whiten
from bench.calibration.result import Outlier
from bench.readings.table import Readings

LEVEL: Final = 0.01
"""Probability of finding an outlier in readings without outliers."""
QUIET: Final = 3.0
"""Least studentised residual that begins a search for several outliers: even outliers that mask each other reach
it.
"""
LOUD: Final = 3.8
"""Least studentised residual that begins a search for one outlier; a single outlier hardly inflates the noise."""
PLAINER: Final = 1.05
"""A setting is a candidate only if its residual is more than this factor times that of each of its signals."""
LEAST_PART: Final = 1e-6
"""A signal is no candidate if the fit absorbs all but this fraction of the variance of its shift."""


@dataclass(frozen=True)
class FittedRows:
    """The oriented and the free readings of a fit, with the index of each in the table (from 0)."""

    oriented: Readings
    free: Readings
    oriented_rows: Ints
    free_rows: Ints


def most_outliers(problem: Problem) -> int:
    """Return the largest number of outliers: an eighth of the readings, but at least one."""
    readings = len(problem.conditions) + (0 if problem.free is None else len(problem.free.signal))
    return max(readings // 8, 1)


def search(problem: Problem, fit: Fit, refit: Callable[[tuple[Shift, ...]], Fit], most: int) -> Fit:
    """Return the fit with a shift for each outlier, or `fit` itself if there is none.

    `fit` has no shifts, `refit` repeats it with given shifts, and `most` limits the number of outliers.
    """
    fits, significant = [fit], 0
    for step in range(most):
        worst, size = most_extreme(problem, fits[-1])
        if step == 0 and size < (QUIET if most > 1 else LOUD):
            break
        fits.append(refit((*fits[-1].shifts, worst)))
        if not fits[-1].u_shift[-1] > 0:
            break
        statistic = abs(fits[-1].shift[-1]) / fits[-1].u_shift[-1]
        if statistic > critical(looks(problem) - step, fits[-1].noise.reading_dof):
            significant = step + 1
    return fits[significant]


def looks(problem: Problem) -> int:
    """Return the number of candidates for an outlier.

    They are the signals and the setting of each oriented reading, and each modulus.
    """
    return 4 * len(problem.conditions) + (0 if problem.free is None else len(problem.free.signal))


def critical(candidates: int, dof: float) -> float:
    """Return the critical value of the largest studentised residual, for the significance level `LEVEL`."""
    p = 1.0 - LEVEL / (2 * candidates)
    return float(special.ndtri(p) if np.isinf(dof) else special.stdtrit(dof, p))


def most_extreme(problem: Problem, fit: Fit) -> tuple[Shift, float]:
    """Return the candidate with the largest studentised residual, and that residual."""
    system, n = fit.system, len(problem.conditions)
    # the rows of the priors are part of the fit, and so of its residuals
    rows, target, _ = whitened_rows(problem, system, fit.noise, fit.others)
    q, _ = np.linalg.qr(rows)
    left = target - q @ (q.T @ target)
    by_setting = unit_vectors(system.slope)[0][:, :, None]
    ways = np.concatenate([np.broadcast_to(np.eye(3), (n, 3, 3)), by_setting], axis=2)
    ways = whiten(ways, system.slope, fit.noise) if n else ways
    taken = np.einsum("nip,nij->npj", q[: 3 * n].reshape(n, 3, q.shape[1]), ways)
    own = np.einsum("nij,nij->nj", ways, ways)
    found = np.einsum("nij,ni->nj", ways, left[: 3 * n].reshape(n, 3))
    signals = _studentised(found, own - np.einsum("npj,npj->nj", taken, taken), own)
    # if du/dphi lies along one channel, setting and signal look alike: prefer the signal
    signals[:, SETTING] /= PLAINER
    m = len(system.free.left)
    free = q[3 * n : 3 * n + m]
    moduli = _studentised(left[3 * n : 3 * n + m], 1 - np.einsum("mp,mp->m", free, free), np.ones(m))
    everything = np.concatenate([signals.ravel(), moduli])
    worst = int(np.argmax(everything))
    size = float(everything[worst])
    if worst >= signals.size:
        return Shift(worst - signals.size, MODULUS), size
    return Shift(worst // 4, (0, 1, 2, SETTING)[worst % 4]), size


def heavy_tails(problem: Problem, fit: Fit) -> float:
    """Return the p-value of a test of the repeats for heavy tails; NaN if the repeats are too few.

    The test statistic is the excess kurtosis of the normalised deviations of repeats from their means. Its standard
    deviation is sqrt(24/N) for N degrees of freedom.
    """
    if not len(problem.conditions) or fit.noise.source != "repeats":
        return float("nan")
    groups, residuals, slope = repeat_groups(problem.conditions), fit.system.left, fit.system.slope
    if scatter_of_repeats(residuals, slope, groups).settings < LEAST_REPEATS:
        return float("nan")
    count = np.bincount(groups)
    means = np.stack([np.bincount(groups, column) for column in residuals.T], axis=1) / count[:, None]
    kept = count[groups] > 1
    # a deviation from the mean of m readings has (m - 1)/m of the variance
    left = (residuals - means[groups])[kept] / np.sqrt(1.0 - 1.0 / count[groups][kept])[:, None]
    size = np.sqrt(fit.noise.by_channel**2 + (fit.noise.setting_rad * slope) ** 2)
    z = left / size[kept]
    if not np.any(z):
        return float("nan")
    excess = float(np.mean(z**4) / np.mean(z**2) ** 2 - 3.0)
    # deviations within a group are correlated: N is their degrees of freedom
    free = 3.0 * float((count - 1)[count > 1].sum())
    return float(special.ndtr(-excess / np.sqrt(24.0 / free)))


def listed(fit: Fit, chosen: FittedRows) -> tuple[Outlier, ...]:
    """Return the shifts of a fit as outliers, with their row numbers in the table (from 1)."""
    found = []
    for shift, size, u in zip(fit.shifts, fit.shift, fit.u_shift, strict=True):
        free = shift.channel == MODULUS
        table = chosen.free if free else chosen.oriented
        rows = chosen.free_rows if free else chosen.oriented_rows
        channel, unit, per = _CHANNELS.get(shift.channel, ("", table.unit, 1.0))
        found.append(
            Outlier(
                row=int(rows[shift.row]) + 1,
                series=int(table.series[shift.row]),
                installation=str(table.installation[shift.row]),
                pass_number=int(table.pass_number[shift.row]),
                point=int(table.point[shift.row]),
                channel=channel or "xyz"[shift.channel],
                # the row of a modulus is 1 - |a|: an error of |a| has the opposite sign
                size=float(-size if free else size / per),
                unit=unit,
                sigma=float(abs(size) / u),
            )
        )
    return tuple(found)


_CHANNELS: Final = {SETTING: ("head", "arcsec", ARCSEC), MODULUS: ("modulus", "g", 1.0)}


def _studentised(found: Floats, variance: Floats, whole: Floats) -> Floats:
    free = variance > LEAST_PART * whole
    return np.asarray(np.where(free, np.abs(found) / np.sqrt(np.where(free, variance, 1.0)), 0.0))


ESTIMATOR: Final = Estimator(
    "robust",
    "gls without the outliers",
    lambda task: search(task.problem, task.fit, task.refit, most_outliers(task.problem)),
    drops_outliers=True,
    counts_as="gls",
)
