"""The noise terms behind an Allan deviation: a sum of powers of the averaging time, fitted with uncertainty.

sigma^2(tau) = 3 Q^2/tau^2 + N^2/tau + (2 ln 2/pi) B^2 + K^2 tau/3 + R^2 tau^2/2: quantisation, white noise
(velocity random walk), bias instability, rate random walk (of the acceleration), drift. Source: IEEE Std 952-1997,
annex C, and IEEE Std 1293-2018 for accelerometers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy import optimize, special

from bench.analysis.stability.allan import AllanCurve
from bench.base.arrays import Floats, Ints, Mask, u_of


@dataclass(frozen=True)
class Term:
    """A noise term: its symbol, what it is called, its unit over the signal's, how it enters sigma^2.

    sigma^2 = `factor` x^2 tau^`power`; `alpha` is the power of frequency in its spectrum; `alike` the
    correlation of the Allan variances at tau and 2 tau where it prevails (found by simulation).
    """

    symbol: str
    name: str
    unit: str
    factor: float
    power: int
    alpha: int
    alike: float


TERMS: Final = (
    Term("Q", "quantisation", " s", 3.0, -2, 2, 0.5),
    Term("N", "white noise", "/√Hz", 1.0, -1, 0, 0.55),
    Term("B", "bias instability", "", 2.0 * float(np.log(2.0)) / np.pi, 0, -1, 0.7),
    Term("K", "rate random walk", "/√s", 1.0 / 3.0, 1, -2, 0.9),
    Term("R", "drift", "/s", 0.5, 2, -2, 0.95),
)
SHOWN: Final = 2.0
"""A term is shown when its square is more than this many standard uncertainties from nothing."""
ROUNDS: Final = 50
MISFIT_P: Final = 0.001


@dataclass(frozen=True)
class NoiseTerms:
    """Squares of Q, N, B, K, R (5,) with covariance (5, 5) and what they make of the curve.

    `freedom` (k,) are the degrees of freedom of the curve's values; `p` is the probability of a misfit so large:
    small where lines in the spectrum (vibration) make the curve none of these terms; below 0.001 the covariance
    is widened by the misfit (Birge's ratio).
    """

    squares: Floats
    covariance: Floats
    freedom: Floats
    p: float

    @property
    def values(self) -> Floats:
        """Q, N, B, K, R, each at least 0, shape (5,)."""
        return np.sqrt(np.maximum(self.squares, 0.0))

    @property
    def shown(self) -> Mask:
        """Which terms the record shows, shape (5,)."""
        return self.squares > SHOWN * u_of(self.covariance)

    @property
    def u(self) -> Floats:
        """Standard uncertainties of the terms shown, NaN for the others, shape (5,)."""
        value = np.where(self.shown, self.values, np.nan)
        return np.asarray(u_of(self.covariance) / (2.0 * value), dtype=np.float64)

    @property
    def upper(self) -> Floats:
        """Upper limits of the terms at about 97.5 %, shape (5,)."""
        return np.asarray(np.sqrt(self.squares + 2.0 * u_of(self.covariance)), dtype=np.float64)

    def deviation(self, tau_s: Floats | float) -> Floats:
        """Return the Allan deviation that the terms make at averaging times (…)."""
        return np.asarray(np.sqrt(_columns(np.asarray(tau_s, dtype=np.float64)) @ self.squares))

    def slope(self, tau_s: Floats | float) -> Floats:
        """Return d log sigma / d log tau at averaging times (…): -1/2 where white noise prevails."""
        tau = np.asarray(tau_s, dtype=np.float64)
        parts = _columns(tau) * self.squares
        powers = np.array([term.power for term in TERMS])
        return np.asarray(parts @ powers / (2.0 * parts.sum(axis=-1)), dtype=np.float64)

    def to_json(self) -> dict[str, Any]:
        """Return the terms by symbol, in the unit of the signal and seconds; null where not shown."""
        rows = zip(TERMS, self.values, self.u, self.upper, self.shown, strict=True)
        return {
            term.symbol: {
                "value": float(value) if shown else None,
                "u": float(u) if shown else None,
                "upper": float(upper),
                "called": term.name,
            }
            for term, value, u, upper, shown in rows
        }


def fit_terms(curve: AllanCurve) -> NoiseTerms:
    """Fit the five terms, none negative, to an Allan deviation at averages of 1, 2, 4, … samples.

    Weighted by the degrees of freedom of each value, with the variances that the fit itself predicts (Fisher's
    scoring of scaled chi-squares); the covariance counts with the likeness of neighbouring values.
    """
    columns, measured = _columns(curve.tau_s), curve.deviation**2
    squares, white = _start(curve, columns, measured), curve.freedom(np.zeros(len(measured)))
    for _ in range(ROUNDS):
        predicted = columns @ squares
        kind = np.argmax(columns * squares, axis=1)
        # quantisation would have thousands of degrees at any time: no record of something real does
        freedom = np.minimum(white, curve.freedom(np.array([TERMS[k].alpha for k in kind])))
        weight = np.sqrt(freedom / 2.0) / predicted
        scaled, scale = _unit_columns(columns * weight[:, None])
        new = optimize.nnls(scaled, measured * weight)[0] / scale
        still = np.allclose(columns @ new, predicted, rtol=1e-9)
        squares = new
        if still:
            break
    predicted = columns @ squares
    spread = _spread(predicted, freedom, kind)
    weighted = (columns * weight[:, None]) / scale
    free = squares > 0
    covariance = np.zeros((len(TERMS), len(TERMS)))
    # a term at its bound of nothing leaves the others as they are; how large it could be, all five tell
    for solved, of in ((np.ones_like(free), ~free), (free, free)):
        solver = np.zeros((len(TERMS), len(measured)))
        solver[solved] = np.linalg.pinv(weighted[:, solved]) * weight
        whole = solver @ spread @ solver.T / np.outer(scale, scale)
        covariance[np.ix_(of, of)] = whole[np.ix_(of, of)]
    left = measured - predicted
    chi2 = float(left @ np.linalg.solve(spread, left))
    dof = max(len(measured) - int(free.sum()), 1)
    p = float(special.chdtrc(dof, chi2))
    if p < MISFIT_P:
        covariance *= chi2 / dof
    return NoiseTerms(squares, covariance, freedom, p)


def _columns(tau_s: Floats) -> Floats:
    """What one of each square adds to the Allan variance at averaging times (…), shape (…, 5)."""
    powers = np.array([float(term.power) for term in TERMS])
    factors = np.array([term.factor for term in TERMS])
    return np.asarray(factors * tau_s[..., None] ** powers, dtype=np.float64)


def _start(curve: AllanCurve, columns: Floats, measured: Floats) -> Floats:
    """All terms alike at the middle of the curve, so that none begins at its bound."""
    middle = len(measured) // 2
    return np.asarray(measured[middle] / columns[middle] / len(TERMS), dtype=np.float64)


def _unit_columns(columns: Floats) -> tuple[Floats, Floats]:
    scale = np.linalg.norm(columns, axis=0)
    return columns / scale, scale


def _spread(predicted: Floats, freedom: Floats, kind: Ints) -> Floats:
    """Covariance (k, k) of the measured variances: 2 sigma^4/edf each, neighbours alike as their noise makes."""
    alike = np.array([TERMS[k].alike for k in kind])
    steps = np.concatenate([[0.0], np.cumsum(np.log(np.sqrt(alike[1:] * alike[:-1])))])
    correlation = np.exp(-np.abs(steps[:, None] - steps[None, :]))
    size = predicted * np.sqrt(2.0 / freedom)
    return np.asarray(correlation * np.outer(size, size), dtype=np.float64)
