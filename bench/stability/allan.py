"""Overlapping Allan deviation with confidence limits.

Sources: W. J. Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008), 5.2.4 and 5.4; the
deviation and its degrees of freedom are those of allantools. A signal at rest stands in the place of frequency.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import special

from bench.calibration.result import CalibrationError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

LONGEST_PART: Final = 4
"""Averaging times go up to the record's length over this: beyond, one or two values decide."""
CONFIDENCE: Final = 0.95


@dataclass(frozen=True)
class AllanCurve:
    """Allan deviation `deviation` (k,) at `tau_s` (k,), averages of `multiples` (k,) samples of `samples`."""

    tau_s: Floats
    deviation: Floats
    multiples: Ints
    samples: int

    def freedom(self, alpha: Floats) -> Floats:
        """Equivalent degrees of freedom (k,) where the noise's spectrum goes as f^alpha, alpha (k,) 2…-2.

        Source: C. A. Greenhall and W. J. Riley, "Uncertainty of stability variances based on finite
        differences", PTTI 2003, as in allantools.
        """
        from allantools.ci import edf_greenhall  # type: ignore[import-untyped]

        rows = zip(self.multiples.tolist(), np.asarray(alpha).tolist(), strict=True)
        edf = [edf_greenhall(int(a), 2, m, self.samples + 1, overlapping=True) for m, a in rows]
        return np.maximum(np.asarray(edf, dtype=np.float64), 1.0)

    def limits(self, freedom: Floats) -> tuple[Floats, Floats]:
        """Return lower and upper limit (k,) of the deviation at 95 % (chi-square with these degrees)."""
        tail = (1.0 - CONFIDENCE) / 2.0
        low = self.deviation * np.sqrt(freedom / special.chdtri(freedom, tail))
        high = self.deviation * np.sqrt(freedom / special.chdtri(freedom, 1.0 - tail))
        return np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)


def allan_curve(signal: Floats, interval_s: float, multiples: Sequence[int] | None = None) -> AllanCurve:
    """Return the overlapping Allan deviation of samples (n,), one every `interval_s`.

    At averages of 1, 2, 4, … samples up to a quarter of the record, or of `multiples`. Raises
    `CalibrationError` when the signal never changes.
    """
    import allantools  # type: ignore[import-untyped]

    if np.ptp(signal) == 0.0:
        raise CalibrationError(
            "a signal is the same in every sample; check its cable, and that the record has enough digits"
        )
    most = len(signal) // LONGEST_PART
    asked = 2 ** np.arange(int(np.log2(most)) + 1) if multiples is None else np.asarray(multiples)
    tau, deviation, _, _ = allantools.oadev(
        signal - signal.mean(), rate=1.0 / interval_s, data_type="freq", taus=asked * interval_s
    )
    found = np.round(tau / interval_s).astype(np.int64)
    return AllanCurve(np.asarray(tau), np.asarray(deviation), found, len(signal))
