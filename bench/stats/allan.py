"""Overlapping Allan deviation with its degrees of freedom, and a fit of five noise terms to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import optimize, special

from bench.base.arrays import Floats, Ints, Mask, u_of
from bench.base.computing import CalibrationError
from bench.base.languages import message

LONGEST_PART: Final = 4
"""Least ratio of record length to averaging time: longer averages would leave only one or two differences."""
CONFIDENCE: Final = 0.95
LAGS: Final = 100
"""Greenhall and Riley's J_max: largest number of windows whose correlations are summed one by one."""
LONG_RECORD: Final = {0: (2.0 / 3.0, 1.0 / 3.0), -1: (0.852, 0.375), -2: (1.079, 0.368)}
"""Greenhall and Riley's table 2 for second differences: (a0, a1) by alpha; 1/edf = (a0 - a1/r)/r, r = windows/m."""


@dataclass(frozen=True)
class AllanCurve:
    """An Allan curve: `deviation` (k,) at averaging times `tau_s` (k,).

    `multiples` (k,) are the averaging times in numbers of samples; `samples` is the number of valid samples.
    """

    tau_s: Floats
    deviation: Floats
    multiples: Ints
    samples: int

    def freedom(self, alpha: Floats) -> Floats:
        """Return the equivalent degrees of freedom (k,), at least 1, for noise with a spectrum f^alpha.

        alpha (k,) is 2 (quantisation), 0 (white), -1 (flicker) or -2 (random walk). Raises `KeyError` for any other
        alpha.
        """
        rows = zip(self.multiples.tolist(), np.asarray(alpha).tolist(), strict=True)
        return np.array([max(_freedom(int(a), m, self.samples), 1.0) for m, a in rows], dtype=np.float64)

    def limits(self, freedom: Floats) -> tuple[Floats, Floats]:
        """Return both ends (k,) of the 95 % intervals of `deviation`, by chi-square with `freedom` (k,)."""
        tail = (1.0 - CONFIDENCE) / 2.0
        low = self.deviation * np.sqrt(freedom / special.chdtri(freedom, tail))
        high = self.deviation * np.sqrt(freedom / special.chdtri(freedom, 1.0 - tail))
        return np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)


def allan_curve(
    signal: Floats,
    interval_s: float,
    multiples: Sequence[int] | None = None,
    *,
    gaps: bool = False,
    name: str = "signal",
) -> AllanCurve:
    """Return the overlapping Allan deviation of samples (n,), one every `interval_s`.

    The averages are over 1, 2, 4, … samples up to a quarter of the record, or over those of `multiples` for which
    the record has at least two differences. With `gaps`, samples may be NaN, and an average needs half of its
    samples. Error messages call the signal `name`. Raises `CalibrationError` if the record is too short, the signal
    never changes, or a sample is not a number.
    """
    known = np.isfinite(signal)
    if not (gaps or np.all(known)):
        raise CalibrationError(
            f"{name}: sample {int(np.argmin(known)) + 1} is not a number; an Allan deviation needs a record "
            "without gaps; cut the record there"
        )
    if np.ptp(signal[known]) == 0.0:
        raise CalibrationError(
            f"{name}: the signal is the same in every sample; check its cable, and record more digits"
        )
    most = len(signal) // LONGEST_PART
    asked = 2 ** np.arange(int(np.log2(most)) + 1) if multiples is None else np.unique(multiples)
    found = asked[(asked > 0) & (2 * asked < len(signal))].astype(np.int64)
    if not len(found):
        raise CalibrationError(
            f"{name}: {len(signal)} samples are too few for the averaging times asked for; ask for shorter ones"
        )
    # subtract the mean: in running sums a large mean would cost the noise its last digits
    sums = np.concatenate([[0.0], np.cumsum(np.where(known, signal - signal[known].mean(), 0.0))])
    counts = np.concatenate([[0], np.cumsum(known)])
    whole = bool(known.all())
    each = [_deviation(sums, m) if whole else _of_known(sums, counts, m) for m in found.tolist()]
    deviation = np.array(each, dtype=np.float64)
    shown = np.isfinite(deviation)
    found = found[shown]
    return AllanCurve(found.astype(np.float64) * interval_s, deviation[shown], found, int(known.sum()))


def _of_known(sums: Floats, counts: Ints, m: int) -> float:
    """Return the deviation at averages of m samples, from running sums and counts (n + 1,) of the valid samples."""
    count = counts[m:] - counts[:-m]
    mean = (sums[m:] - sums[:-m]) / np.maximum(count, 1)
    enough = 2 * count >= m
    pairs = enough[m:] & enough[:-m]
    return float(np.sqrt(np.mean((mean[m:] - mean[:-m])[pairs] ** 2) / 2.0)) if pairs.any() else float("nan")


def _deviation(sums: Floats, m: int) -> float:
    """Return the overlapping Allan deviation at averages of m samples, from running sums (n + 1,).

    Source: NIST SP 1065, eq. 11.
    """
    second = sums[2 * m :] - 2.0 * sums[m:-m] + sums[: -2 * m]
    return float(np.sqrt(np.mean(second**2) / 2.0) / m)


def _freedom(alpha: int, m: int, samples: int) -> float:
    """Return the degrees of freedom at m samples: Greenhall and Riley's cases 2 and 4, with d = 2, F = S = m."""
    windows = samples + 1 - 2 * m
    r = windows / m
    if alpha == 2:  # white phase noise correlates only differences one or two averages apart
        one, two = max(1.0 - 1.0 / r, 0.0), max(1.0 - 2.0 / r, 0.0)
        return windows / (1.0 + 2.0 * (16.0 * one + two) / 36.0)
    a0, a1 = LONG_RECORD[alpha]
    lags = min(windows, 3 * m)
    if lags <= LAGS:
        return _summed(alpha, lags, windows, m, m if 3 * m <= LAGS else np.inf)
    return r / (a0 - a1 / r) if r > 3.0 else _summed(alpha, LAGS, LAGS, LAGS / r, np.inf)


def _summed(alpha: int, lags: int, windows: int, stride: float, width: float) -> float:
    """Return the degrees of freedom from covariances at 0 … `lags` strides (Greenhall and Riley, eq. 10)."""
    j = np.arange(lags + 1)
    alike = _covariance(j / stride, alpha, width)
    weight = 2.0 * (1.0 - j / windows)
    weight[[0, -1]] /= 2.0
    return windows / float(weight @ (alike / alike[0]) ** 2)


def _covariance(t: Floats, alpha: int, width: float) -> Floats:
    """Return the covariance (…), up to a factor, of second differences `t` averages apart.

    The averages have `width` samples each; an infinite width means a continuous signal. Source: Greenhall and
    Riley, eq. 7 to 9.
    """
    apart = np.asarray(t)[..., None] + np.arange(-2.0, 3.0)
    if np.isinf(width):
        averaged = _kernel(apart, alpha + 2)
    else:
        near = apart[..., None] + np.array([-1.0, 0.0, 1.0]) / width
        averaged = _kernel(near, alpha) @ np.array([1.0, -2.0, 1.0])
    return np.asarray(averaged @ np.array([1.0, -4.0, 6.0, -4.0, 1.0]), dtype=np.float64)


def _kernel(t: Floats, alpha: int) -> Floats:
    """Return the covariance of two phases that are `t` (…) averages apart, up to its sign.

    It is |t|^(3 - alpha), for odd alpha multiplied by ln |t|.
    """
    size = np.abs(t)
    power = size ** (3 - alpha)
    return np.asarray(power if alpha % 2 == 0 else special.xlogy(power, size), dtype=np.float64)


@dataclass(frozen=True)
class NoiseTerm:
    """A noise term: symbol, name, unit (relative to that of the signal), and contribution to sigma^2.

    A term with the coefficient x contributes `factor` x^2 tau^`power`. `alpha` is the power of frequency in its
    spectrum. `alike` is the correlation, from simulations, between the Allan variances at tau and 2 tau if this
    term prevails.
    """

    symbol: str
    name: str
    unit: str
    factor: float
    power: int
    alpha: int
    alike: float


TERMS: Final = (
    NoiseTerm("Q", message("quantisation", "heading"), " s", 3.0, -2, 2, 0.5),
    NoiseTerm("N", message("white noise"), "/√Hz", 1.0, -1, 0, 0.55),
    NoiseTerm("B", message("bias instability"), "", 2.0 * float(np.log(2.0)) / np.pi, 0, -1, 0.7),
    NoiseTerm("K", message("rate random walk"), "/√s", 1.0 / 3.0, 1, -2, 0.9),
    NoiseTerm("R", "drift", "/s", 0.5, 2, -2, 0.95),
)
SHOWN: Final = 2.0
"""A term is shown if its square is more than this many standard uncertainties above zero."""
ROUNDS: Final = 50
MISFIT_P: Final = 0.001


@dataclass(frozen=True)
class NoiseTerms:
    """Fitted noise terms: squares of Q, N, B, K, R (5,) with covariance (5, 5), and the test of the fit.

    `freedom` (k,) are the degrees of freedom of the curve's values. `p` is the p-value of the misfit; it is small
    if the spectrum has lines (vibration), which these terms do not describe. If `p` is below 0.001, the covariance
    is multiplied by the reduced chi-square of the misfit (squared Birge ratio).
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
        """Mask of the significant terms: squares of more than `SHOWN` standard uncertainties, shape (5,)."""
        return self.squares > SHOWN * u_of(self.covariance)

    @property
    def u(self) -> Floats:
        """Standard uncertainties of the significant terms, NaN for all other terms, shape (5,)."""
        value = np.where(self.shown, self.values, np.nan)
        return np.asarray(u_of(self.covariance) / (2.0 * value), dtype=np.float64)

    @property
    def upper(self) -> Floats:
        """Upper limits of the terms at a one-sided level of about 97.5 %, shape (5,)."""
        return np.asarray(np.sqrt(self.squares + 2.0 * u_of(self.covariance)), dtype=np.float64)

    def deviation(self, tau_s: Floats | float) -> Floats:
        """Return the Allan deviation of the fitted terms at averaging times (…)."""
        return np.asarray(np.sqrt(_columns(np.asarray(tau_s, dtype=np.float64)) @ self.squares))

    def slope(self, tau_s: Floats | float) -> Floats:
        """Return d log sigma / d log tau at averaging times (…), such as -1/2 if white noise prevails."""
        tau = np.asarray(tau_s, dtype=np.float64)
        parts = _columns(tau) * self.squares
        powers = np.array([term.power for term in TERMS])
        return np.asarray(parts @ powers / (2.0 * parts.sum(axis=-1)), dtype=np.float64)


def fit_terms(curve: AllanCurve) -> NoiseTerms:
    """Fit the five terms, none negative, to an Allan deviation at averages of 1, 2, 4, … samples.

    Each value is weighted by its degrees of freedom, with the variances that the fit predicts (Fisher
    scoring of scaled chi-squares). The covariance accounts for the correlation of neighbouring values.
    """
    columns, measured = _columns(curve.tau_s), curve.deviation**2
    squares, white = _start(curve, columns, measured), curve.freedom(np.zeros(len(measured)))
    for _ in range(ROUNDS):
        predicted = columns @ squares
        kind = np.argmax(columns * squares, axis=1)
        # pure quantisation would give thousands of degrees of freedom, which no real record has
        freedom = np.minimum(white, curve.freedom(np.array([TERMS[k].alpha for k in kind])))
        weight = np.sqrt(freedom / 2.0) / predicted
        scaled, scale = _unit_columns(columns * weight[:, None])
        new = optimize.nnls(scaled, measured * weight)[0] / scale
        still = np.allclose(columns @ new, predicted, rtol=1e-9, atol=0.0)
        squares = new
        if still:
            break
    predicted = columns @ squares
    spread = _spread(predicted, freedom, kind)
    weighted = (columns * weight[:, None]) / scale
    free = squares > 0
    covariance = np.zeros((len(TERMS), len(TERMS)))
    # terms at zero do not affect the covariance of the others; their own covariance is from a fit of all five
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
    """Return the Allan variance of each noise term of coefficient 1 at averaging times (…), shape (…, 5)."""
    powers = np.array([float(term.power) for term in TERMS])
    factors = np.array([term.factor for term in TERMS])
    return np.asarray(factors * tau_s[..., None] ** powers, dtype=np.float64)


def _start(curve: AllanCurve, columns: Floats, measured: Floats) -> Floats:
    """Return start values for the squared coefficients of the terms.

    Each term contributes an equal part of the variance in the middle of the curve.
    """
    middle = len(measured) // 2
    return np.asarray(measured[middle] / columns[middle] / len(TERMS), dtype=np.float64)


def _unit_columns(columns: Floats) -> tuple[Floats, Floats]:
    scale = np.linalg.norm(columns, axis=0)
    return columns / scale, scale


def _spread(predicted: Floats, freedom: Floats, kind: Ints) -> Floats:
    """Return the covariance (k, k) of the measured Allan variances.

    Each value has the variance 2 sigma^4/edf; values at neighbouring averaging times are correlated.
    """
    alike = np.array([TERMS[k].alike for k in kind])
    steps = np.concatenate([[0.0], np.cumsum(np.log(np.sqrt(alike[1:] * alike[:-1])))])
    correlation = np.exp(-np.abs(steps[:, None] - steps[None, :]))
    size = predicted * np.sqrt(2.0 / freedom)
    return np.asarray(correlation * np.outer(size, size), dtype=np.float64)
