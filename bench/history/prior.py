"""A prior for an unmeasured unit from calibrated units of its type, and its combination with a calibration.

The means of units scatter by the variation between units and by calibration errors. The covariance between units is
the covariance of the means minus that of the calibration errors. Its correlations are shrunk, the more strongly the
fewer the units; its variances are enlarged for their finite degrees of freedom. Errors that no repetition reveals
(of a bench or its meters) are included in the uncertainty of the mean. Sources: J. Schäfer, K. Strimmer, Stat.
Appl. Genet. Mol. Biol. 4 (2005) 32 (shrinkage); JCGM 101:2008, 6.4.9.4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, Ints, u_of
from bench.base.languages import message
from bench.calibration.result import CalibrationError
from bench.history.measured import STANDARD_GRAVITY, ComparedCalibrations, coded, of_gravity, to_gravity
from bench.stats import chi_square

LEAST_UNITS: Final = 6
"""Least number of units that give a meaningful covariance of twelve coefficients."""
CONFLICT_P: Final = 0.01
"""A prior is used only if its agreement with the readings has at least this p-value."""
LEAST_DOF: Final = 4.0
LEAST_REPEATS: Final = 10
"""The least number of repeated calibrations that determines the scatter of calibrations."""


@dataclass(frozen=True)
class Prior:
    """The prior of an unmeasured unit of type `kind`: `mean` (12,) and `covariance` (12, 12).

    Both are in `signal` per standard g. `between` (12,) is the standard deviation between units, and `mean_u` (12,)
    is the standard uncertainty of the mean. `dof` are the degrees of freedom. `shrunk` is the fraction by which
    correlations were reduced. `units` and `benches` count the units and benches from which the prior was computed.
    """

    kind: str
    signal: str
    mean: Floats
    covariance: Floats
    between: Floats
    mean_u: Floats
    dof: int
    shrunk: float
    units: tuple[str, ...]
    benches: tuple[str, ...]
    calibrations: int
    last: str
    simulated: bool
    notes: tuple[str, ...] = ()

    def per(self, g_m_s2: float, gravity_u: float = 0.0) -> tuple[Floats, Floats]:
        """Return the mean (12,) and the covariance (12, 12), for a local g with the relative u `gravity_u`."""
        factor = to_gravity(STANDARD_GRAVITY, g_m_s2)
        mean = self.mean * factor
        of_g = of_gravity(mean, gravity_u)
        return mean, self.covariance * np.outer(factor, factor) + np.outer(of_g, of_g)


def prior_of(measured: ComparedCalibrations) -> Prior:
    """Return the prior for an unmeasured unit from calibrations of units of one type.

    Raises `CalibrationError` for units of several types, or for too few units.
    """
    kinds, _ = coded(measured.kind)
    units, unit = coded(measured.unit)
    if len(kinds) > 1:
        raise CalibrationError(
            f"the conditions match units of several types ({', '.join(kinds.tolist())}), but "
            "a prior is for one; add type=…"
        )
    if len(units) < LEAST_UNITS:
        raise CalibrationError(
            f"{len(units)} units of type {kinds[0]} are too few for a prior; calibrate {LEAST_UNITS} units or "
            "more"
        )
    of_g = measured.gravity
    measured = replace(measured, covariance=measured.covariance - of_g[:, :, None] * of_g[:, None, :])
    own, notes = _own(measured, unit)
    means, of_means = _means(measured.vector, own, unit, len(units))
    mean, between, shrunk = _between(means, of_means)
    m = len(units)
    benches = np.unique(measured.bench)
    alike = measured.covariance.mean(axis=0) - own.mean(axis=0)
    of_mean = (between + of_means.mean(axis=0)) / m + _positive(alike) / len(benches)
    of_mean += of_g.T @ of_g / len(of_g) / len(np.unique(measured.place))
    return Prior(
        kind=str(kinds[0]),
        signal=measured.signal,
        mean=mean,
        covariance=between + of_mean,
        between=u_of(between),
        mean_u=u_of(of_mean),
        dof=m - 1,
        shrunk=shrunk,
        units=tuple(units.tolist()),
        benches=tuple(benches.tolist()),
        calibrations=len(measured),
        last=str(np.max(measured.when).astype("datetime64[D]")),
        simulated=measured.simulated,
        notes=notes,
    )


def _own(measured: ComparedCalibrations, unit: Ints) -> tuple[Floats, tuple[str, ...]]:
    """Return the part (n, 12, 12) of the stated covariances that is independent between calibrations, and notes.

    It is the scatter of repeated calibrations of a unit, limited to the stated covariance. With too few repeats it
    is zero, so that all scatter of the means is attributed to the units.
    """
    count = np.bincount(unit)
    dof = int(np.sum(count - 1))
    if dof < LEAST_REPEATS:
        note = message(
            f"{dof} repeated calibrations do not show which part of u belongs to a calibration; all "
            "differences count as the units'"
        )
        return np.zeros_like(measured.covariance), (note,)
    w = 1.0 / measured.variance
    sums = np.stack([np.bincount(unit, c) for c in w.T], axis=1)
    mean = np.stack([np.bincount(unit, c) for c in (w * measured.vector).T], axis=1) / sums
    chi2 = np.sum(w * (measured.vector - mean[unit]) ** 2, axis=0)
    part = np.sqrt(np.minimum(1.0, chi2 / dof))
    return measured.covariance * np.outer(part, part), ()


def _means(vector: Floats, own: Floats, unit: Ints, count: int) -> tuple[Floats, Floats]:
    """Return the unweighted means (m, 12) of units, and their covariances (m, 12, 12) due to calibration errors."""
    many = np.bincount(unit, minlength=count).astype(float)
    means = np.stack([np.bincount(unit, c, count) for c in vector.T], axis=1) / many[:, None]
    flat = own.reshape(len(own), -1)
    sums = np.stack([np.bincount(unit, c, count) for c in flat.T], axis=1)
    return means, (sums / many[:, None] ** 2).reshape(count, *own.shape[1:])


def _between(means: Floats, of_means: Floats) -> tuple[Floats, Floats, float]:
    """Return the mean (12,), the covariance between units (12, 12), and the shrinkage of its correlations.

    The total variance of the means is estimated with m - 1 degrees of freedom, so that its posterior expectation is
    larger by the factor (m - 1)/(m - 3). The variance due to calibration errors is subtracted from it.
    """
    m = len(means)
    mean = means.mean(axis=0)
    total = np.cov(means.T)
    errors = of_means.mean(axis=0)
    raw = total - errors
    shown = np.maximum(np.diag(raw), 0.0)
    variance = shown * (m - 1) / (m - 3) + np.diag(errors) * 2.0 / (m - 3)
    scale = np.sqrt(np.diag(total))
    correlation = total / np.outer(scale, scale)
    off = ~np.eye(len(scale), dtype=bool)
    spread = np.sum((1.0 - correlation[off] ** 2) ** 2) / (m - 1)
    shrunk = float(min(1.0, spread / max(float(np.sum(correlation[off] ** 2)), 1e-12)))
    # at least as if twelve more degrees of freedom showed no correlation: else few units may by chance give too
    # narrow a spread in some directions
    shrunk = max(shrunk, len(scale) / (m - 1 + len(scale)))
    own_scale = np.sqrt(np.where(shown > 0, shown, 1.0))
    between = _positive(raw / np.outer(own_scale, own_scale) * np.outer(shown > 0, shown > 0))
    size = np.sqrt(np.maximum(np.diag(between), 1e-12))
    between = between / np.outer(size, size)
    correlated = np.where(off, (1.0 - shrunk) * between, 1.0)
    return mean, correlated * np.sqrt(np.outer(variance, variance)), shrunk


def _positive(matrix: Floats) -> Floats:
    """Return the nearest symmetric matrix without negative eigenvalues."""
    size, along = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray((along * np.maximum(size, 0.0)) @ along.T)


@dataclass(frozen=True)
class Joined:
    """A calibration combined with a prior: `vector` (12,) with its `covariance` (12, 12).

    `part` (12, 12) is the weight of the prior. `chi2` measures how far readings and prior disagree. Its p-value `p`
    is from an F distribution, because the prior's covariance is an estimate. If they disagree, the calibration is
    unchanged and `used` is false. `pull` (12,) is the calibration minus the prior mean, divided by the u of this
    difference.
    """

    vector: Floats
    covariance: Floats
    part: Floats
    chi2: float
    p: float
    pull: Floats

    @property
    def used(self) -> bool:
        """Whether the prior agreed with the readings and was used."""
        return self.p >= CONFLICT_P


def join(
    calibration: Floats, own: Floats, alike: Floats, prior: Prior, g_m_s2: float, gravity_u: float = 0.0
) -> Joined:
    """Combine a calibration (12,) with a prior by generalised least squares.

    The calibration is per a local g of `g_m_s2`, with the relative u `gravity_u`. `own` (12, 12) is the part of
    the calibration's covariance due to its readings. `alike` (12, 12) is the part that readings do not reveal,
    such as a meter's gain: earlier calibrations shared it, so the prior does not reduce it.
    """
    mean, covariance = prior.per(g_m_s2, gravity_u)
    gap = calibration - mean
    between = own + covariance
    scale, chi2 = u_of(between), chi_square(gap, between)
    # the prior's part of the covariance is an estimate: hence the F distribution with its degrees of freedom
    of_prior = float(np.mean(np.diag(covariance) / np.diag(between)))
    dof = max(prior.dof / of_prior**2, LEAST_DOF)
    p = float(special.fdtrc(len(gap), dof, chi2 / len(gap) * dof / (dof - 2.0)))
    part = np.asarray(np.linalg.solve(between, own).T, dtype=np.float64)
    if p < CONFLICT_P:
        return Joined(calibration, own + alike, np.zeros_like(own), chi2, p, gap / scale)
    left = np.eye(len(gap)) - part
    joined = left @ own @ left.T + part @ covariance @ part.T + alike
    return Joined(calibration - part @ gap, joined, part, chi2, p, gap / scale)
