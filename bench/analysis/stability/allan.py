"""Overlapping Allan deviation with confidence limits.

Sources: W. J. Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008), 5.2.4 (deviation) and 5.4
(confidence); C. A. Greenhall and W. J. Riley, "Uncertainty of stability variances based on finite differences",
PTTI 2003 (degrees of freedom). A signal at rest stands in the place of frequency.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from bench.analysis.calibration.result import CalibrationError
from bench.base.arrays import Floats, Ints

LONGEST_PART: Final = 4
"""Averaging times go up to the record's length over this: beyond, one or two values decide."""
CONFIDENCE: Final = 0.95
LAGS: Final = 100
"""Greenhall and Riley's J_max: the correlations of more windows than this are not summed one by one."""
LONG_RECORD: Final = {0: (2.0 / 3.0, 1.0 / 3.0), -1: (0.852, 0.375), -2: (1.079, 0.368)}
"""Greenhall and Riley's table 2 for second differences: a0, a1 of 1/edf = (a0 - a1/r)/r by power of frequency."""


@dataclass(frozen=True)
class AllanCurve:
    """Allan deviation `deviation` (k,) at `tau_s` (k,), averages of `multiples` (k,) samples of `samples`."""

    tau_s: Floats
    deviation: Floats
    multiples: Ints
    samples: int

    def freedom(self, alpha: Floats) -> Floats:
        """Equivalent degrees of freedom (k,), 1 at least, where the noise's spectrum goes as f^alpha.

        alpha (k,) is 2 (quantisation), 0 (white), -1 (flicker) or -2 (random walk); `KeyError` for another.
        """
        rows = zip(self.multiples.tolist(), np.asarray(alpha).tolist(), strict=True)
        return np.array([max(_freedom(int(a), m, self.samples), 1.0) for m, a in rows], dtype=np.float64)

    def limits(self, freedom: Floats) -> tuple[Floats, Floats]:
        """Return lower and upper limit (k,) of the deviation at 95 % (chi-square with these degrees)."""
        tail = (1.0 - CONFIDENCE) / 2.0
        low = self.deviation * np.sqrt(freedom / special.chdtri(freedom, tail))
        high = self.deviation * np.sqrt(freedom / special.chdtri(freedom, 1.0 - tail))
        return np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)


def allan_curve(signal: Floats, interval_s: float, multiples: Sequence[int] | None = None) -> AllanCurve:
    """Return the overlapping Allan deviation of samples (n,), one every `interval_s`.

    At averages of 1, 2, 4, … samples up to a quarter of the record, or of `multiples`, in order, as far as the
    record has two differences of such averages. Raises `CalibrationError` when it has of none, when the signal
    never changes, and when a sample is not a number.
    """
    if not np.all(np.isfinite(signal)):
        raise CalibrationError("a sample is not a number; an Allan deviation needs a record without holes")
    if np.ptp(signal) == 0.0:
        raise CalibrationError(
            "a signal is the same in every sample; check its cable, and that the record has enough digits"
        )
    most = len(signal) // LONGEST_PART
    asked = 2 ** np.arange(int(np.log2(most)) + 1) if multiples is None else np.unique(multiples)
    found = asked[(asked > 0) & (2 * asked < len(signal))].astype(np.int64)
    if not len(found):
        raise CalibrationError(f"{len(signal)} samples are too few for two differences of such averages")
    # sums of what is left beside the mean: those of a large mean would swallow the noise's last digits
    sums = np.concatenate([[0.0], np.cumsum(signal - signal.mean())])
    deviation = [_deviation(sums, m) for m in found.tolist()]
    tau_s = found.astype(np.float64) * interval_s
    return AllanCurve(tau_s, np.array(deviation, dtype=np.float64), found, len(signal))


def _deviation(sums: Floats, m: int) -> float:
    """Overlapping Allan deviation at m samples of a signal's running sums (n + 1,): SP 1065, eq. 11."""
    second = sums[2 * m :] - 2.0 * sums[m:-m] + sums[: -2 * m]
    return float(np.sqrt(np.mean(second**2) / 2.0) / m)


def _freedom(alpha: int, m: int, samples: int) -> float:
    """Degrees of freedom at m samples: Greenhall and Riley's cases 2 and 4, for d = 2, F = S = m."""
    windows = samples + 1 - 2 * m
    r = windows / m
    if alpha == 2:  # windows of white phase noise are alike one and two averages apart only
        one, two = max(1.0 - 1.0 / r, 0.0), max(1.0 - 2.0 / r, 0.0)
        return windows / (1.0 + 2.0 * (16.0 * one + two) / 36.0)
    a0, a1 = LONG_RECORD[alpha]
    lags = min(windows, 3 * m)
    if lags <= LAGS:
        return _summed(alpha, lags, windows, m, m if 3 * m <= LAGS else np.inf)
    return r / (a0 - a1 / r) if r > 3.0 else _summed(alpha, LAGS, LAGS, LAGS / r, np.inf)


def _summed(alpha: int, lags: int, windows: int, stride: float, width: float) -> float:
    """Degrees of freedom from the correlations of windows 0 … lags strides apart: their eq. 10."""
    j = np.arange(lags + 1)
    alike = _covariance(j / stride, alpha, width)
    weight = 2.0 * (1.0 - j / windows)
    weight[[0, -1]] /= 2.0
    return windows / float(weight @ (alike / alike[0]) ** 2)


def _covariance(t: Floats, alpha: int, width: float) -> Floats:
    """Covariance, but for a factor, of second differences t (…) averages apart: their eq. 7 to 9.

    Of averages of `width` samples each, or of a signal without steps where it is infinite.
    """
    apart = np.asarray(t)[..., None] + np.arange(-2.0, 3.0)
    if np.isinf(width):
        averaged = _kernel(apart, alpha + 2)
    else:
        near = apart[..., None] + np.array([-1.0, 0.0, 1.0]) / width
        averaged = _kernel(near, alpha) @ np.array([1.0, -2.0, 1.0])
    return np.asarray(averaged @ np.array([1.0, -4.0, 6.0, -4.0, 1.0]), dtype=np.float64)


def _kernel(t: Floats, alpha: int) -> Floats:
    """Covariance, but for its sign, of phase t (…) apart: |t|^(3 - alpha), times ln |t| where that is even."""
    size = np.abs(t)
    power = size ** (3 - alpha)
    return np.asarray(power if alpha % 2 == 0 else special.xlogy(power, size), dtype=np.float64)
