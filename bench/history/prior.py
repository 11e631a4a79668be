"""What the units of a type tell of a further one before it is measured, and a calibration with that.

Means of units scatter by what units differ by and by their calibrations' own errors. The covariance between units
is that of their scatter less the latter; its correlations are shrunk where units are few; it is widened as an
estimate of so many degrees of freedom is. What no repetition shows (errors of a bench, of meters) is in the mean.
Sources: J. Schäfer, K. Strimmer, Stat. Appl. Genet. Mol. Biol. 4 (2005) 32 (shrinking); JCGM 101:2008, 6.4.9.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from bench.base.arrays import Floats, Ints, u_of
from bench.calibration.result import CalibrationError
from bench.history.measured import STANDARD_GRAVITY, ComparedCalibrations, coded
from bench.model.geometry import COEFFICIENTS

LEAST_UNITS: Final = 6
"""From fewer units a covariance of twelve coefficients is not worth the name."""


CONFLICT_P: Final = 0.01
"""A prior is not used where it and the readings disagree as chance does less often than this."""


LEAST_DOF: Final = 4.0


LEAST_REPEATS: Final = 10
"""Repeated calibrations from which their own scatter is known."""


@dataclass(frozen=True)
class Prior:
    """A further unit of type `kind`: `mean` (12,) and `covariance` (12, 12), in `signal` per standard g.

    `between` (12,) is what units differ by, 1 sigma, `mean_u` (12,) the u of the mean; `dof` the degrees of
    freedom, `shrunk` the part that was taken off the correlations. `units` and `benches` are those behind it.
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

    def per(self, g_m_s2: float) -> tuple[Floats, Floats]:
        """Return mean (12,) and covariance (12, 12) with scale factors per a local g."""
        factor = np.where(np.arange(len(COEFFICIENTS)) < 9, g_m_s2 / STANDARD_GRAVITY, 1.0)
        return self.mean * factor, self.covariance * np.outer(factor, factor)


def prior_of(measured: ComparedCalibrations) -> Prior:
    """Return what calibrations of several units of one type tell of a further unit of it.

    Raises `CalibrationError` for units of several types, or too few of them.
    """
    kinds, _ = coded(measured.kind)
    units, unit = coded(measured.unit)
    if len(kinds) > 1:
        raise CalibrationError(f"a prior is of one type of unit; there are {', '.join(kinds.tolist())}")
    if len(units) < LEAST_UNITS:
        raise CalibrationError(
            f"{len(units)} units of type {kinds[0]}: a prior needs {LEAST_UNITS} or more, each calibrated"
        )
    own, notes = _own(measured, unit)
    means, of_means = _means(measured.vector, own, unit, len(units))
    mean, between, shrunk = _between(means, of_means)
    m = len(units)
    benches = np.unique(measured.bench)
    alike = measured.covariance.mean(axis=0) - own.mean(axis=0)
    of_mean = (between + of_means.mean(axis=0)) / m + _positive(alike) / len(benches)
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
    """Return the part (n, 12, 12) of stated covariances that each calibration has of its own, and notes.

    It is what repeated calibrations of a unit scatter by, at most what is stated; nothing, where few were
    repeated: then all the scatter of units is theirs.
    """
    count = np.bincount(unit)
    dof = int(np.sum(count - 1))
    if dof < LEAST_REPEATS:
        note = (
            f"{dof} repeated calibrations do not show which part of u is a calibration's own: all that units "
            "differ by is taken as theirs"
        )
        return np.zeros_like(measured.covariance), (note,)
    w = 1.0 / measured.variance
    sums = np.stack([np.bincount(unit, c) for c in w.T], axis=1)
    mean = np.stack([np.bincount(unit, c) for c in (w * measured.vector).T], axis=1) / sums
    chi2 = np.sum(w * (measured.vector - mean[unit]) ** 2, axis=0)
    part = np.sqrt(np.minimum(1.0, chi2 / dof))
    return measured.covariance * np.outer(part, part), ()


def _means(vector: Floats, own: Floats, unit: Ints, count: int) -> tuple[Floats, Floats]:
    """Return the plain means (m, 12) of units, and what their own errors give them (m, 12, 12)."""
    many = np.bincount(unit, minlength=count).astype(float)
    means = np.stack([np.bincount(unit, c, count) for c in vector.T], axis=1) / many[:, None]
    flat = own.reshape(len(own), -1)
    sums = np.stack([np.bincount(unit, c, count) for c in flat.T], axis=1)
    return means, (sums / many[:, None] ** 2).reshape(count, *own.shape[1:])


def _between(means: Floats, of_means: Floats) -> tuple[Floats, Floats, float]:
    """Return mean (12,), covariance between units (12, 12), and by how much correlations were shrunk.

    The total variance of means is known as an estimate of m - 1 degrees of freedom is: its expectation is larger by
    (m - 1)/(m - 3); what own errors give is taken off it.
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
    # twelve degrees of freedom for no correlation: few units have some directions too narrow by chance
    shrunk = max(shrunk, len(scale) / (m - 1 + len(scale)))
    own_scale = np.sqrt(np.where(shown > 0, shown, 1.0))
    between = _positive(raw / np.outer(own_scale, own_scale) * np.outer(shown > 0, shown > 0))
    size = np.sqrt(np.maximum(np.diag(between), 1e-12))
    between = between / np.outer(size, size)
    correlated = np.where(off, (1.0 - shrunk) * between, 1.0)
    return mean, correlated * np.sqrt(np.outer(variance, variance)), shrunk


def _positive(matrix: Floats) -> Floats:
    """Return the nearest matrix without negative eigenvalues."""
    size, along = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray((along * np.maximum(size, 0.0)) @ along.T)


@dataclass(frozen=True)
class Joined:
    """A calibration with a prior: `vector` (12,), `covariance` (12, 12), `part` (12, 12) what the prior counts.

    `chi2` for twelve and `p` test whether prior and readings agree; `used` is false where not, and then the
    calibration stands as it was. `pull` (12,) is readings less prior over its u.
    """

    vector: Floats
    covariance: Floats
    part: Floats
    chi2: float
    p: float
    pull: Floats

    @property
    def used(self) -> bool:
        """Whether the prior was used."""
        return self.p >= CONFLICT_P


def join(calibration: Floats, own: Floats, alike: Floats, prior: Prior, g_m_s2: float) -> Joined:
    """Join a calibration (12,), per local g, and a prior, by generalised least squares.

    `own` (12, 12) is the part of the calibration's covariance that its readings have; `alike` what no reading
    shows, as gain of a meter: earlier calibrations had it too, and the prior takes nothing off it.
    """
    mean, covariance = prior.per(g_m_s2)
    gap = calibration - mean
    between = own + covariance
    scale = u_of(between)
    solved = np.linalg.solve(between / np.outer(scale, scale), gap / scale)
    chi2 = float(gap / scale @ solved)
    # the prior's part of the covariance is an estimate, and widened as one
    of_prior = float(np.mean(np.diag(covariance) / np.diag(between)))
    dof = max(prior.dof / of_prior**2, LEAST_DOF)
    p = float(special.fdtrc(len(gap), dof, chi2 / len(gap) * dof / (dof - 2.0)))
    part = np.asarray(np.linalg.solve(between, own).T, dtype=np.float64)
    if p < CONFLICT_P:
        return Joined(calibration, own + alike, np.zeros_like(own), chi2, p, gap / scale)
    left = np.eye(len(gap)) - part
    joined = left @ own @ left.T + part @ covariance @ part.T + alike
    return Joined(calibration - part @ gap, joined, part, chi2, p, gap / scale)
