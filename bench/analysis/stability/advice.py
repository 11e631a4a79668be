"""How long a reading should average, and with which samples and power-line cycles it does so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from bench.analysis.calibration.result import CalibrationError
from bench.analysis.stability.allan import AllanCurve
from bench.analysis.stability.noise_terms import NoiseTerms

FLAT: Final = -0.25
"""Slope of the logarithms at which the deviation counts as flat: half of that of white noise."""
LEAST_SAMPLES: Final = 10
"""A reading has so many samples at least, so that their scatter tells of the noise."""
REJECTS_LINE: Final = 1.0
"""Integration times of whole power-line cycles reject the line; shorter ones do not."""


@dataclass(frozen=True)
class Averaging:
    """The averaging time that a signal deserves, s, what is left of the noise then, and why this time.

    `reached` is false where a size was asked for that no averaging time of the record reaches.
    """

    tau_s: float
    deviation: float
    why: str
    reached: bool = True


@dataclass(frozen=True)
class ReadingAdvice:
    """Samples of a reading and power-line cycles of each; `tau_s` is the time that they average over."""

    samples: int
    nplc: float
    tau_s: float

    def line(self) -> str:
        """Return the line of a procedure file."""
        return f"reading: {{samples: {self.samples}, nplc: {self.nplc:g}}}"


def averaging(curve: AllanCurve, terms: NoiseTerms, wanted: float | None = None) -> Averaging:
    """Return the averaging time for a signal.

    With `wanted`, the shortest of the curve's times at which the upper limit (95 %) of the Allan deviation is
    no more. Else where the noise terms stop falling: the slope there is half of that of white noise, and longer
    averages gain little; or the longest time that the curve has, where they still fall.
    """
    _, high = curve.limits(terms.freedom)
    if wanted is not None:
        enough = high <= wanted
        if np.any(enough):
            k = int(np.argmax(enough))
            return Averaging(float(curve.tau_s[k]), float(curve.deviation[k]), "the size asked for")
        k = int(np.argmin(high))
        why = f"the size asked for is not reached; here it is least, at most {high[k]:.2g}"
        return Averaging(float(curve.tau_s[k]), float(curve.deviation[k]), why, reached=False)
    fine = np.geomspace(curve.tau_s[0], curve.tau_s[-1], 400)
    flat = terms.slope(fine) >= FLAT
    if flat[0]:
        tau, why = float(curve.tau_s[0]), "the deviation does not fall from the first sample on"
    elif np.any(flat):
        tau, why = float(fine[int(np.argmax(flat))]), "from here on longer averages gain little"
    else:
        tau, why = float(curve.tau_s[-1]), "the deviation still falls; the record is too short to show more"
    return Averaging(tau, float(np.interp(tau, curve.tau_s, curve.deviation)), why)


def reading_advice(
    tau_s: float, line_frequency_hz: float, nplc: Sequence[float], most_samples: int
) -> ReadingAdvice:
    """Return samples and NPLC whose product averages over `tau_s` at least.

    The longest integration time that leaves ten samples, of the meter's `nplc` (power-line cycles) that
    reject the line. Raises `CalibrationError` when the meter cannot average so long in one reading.
    """
    cycles = tau_s * line_frequency_hz
    usable = sorted(n for n in nplc if n >= REJECTS_LINE)
    if not usable:
        raise CalibrationError("the voltmeters have no integration time of a whole power-line cycle")
    fitting = [n for n in usable if n * LEAST_SAMPLES <= cycles] or usable[:1]
    each = fitting[-1]
    samples = max(LEAST_SAMPLES, int(np.ceil(cycles / each - 1e-9)))
    if samples > most_samples:
        raise CalibrationError(
            f"an averaging time of {tau_s:.3g} s takes {samples} samples of {each:g} power-line cycles, but a "
            f"reading has {most_samples} at most; ask for a larger size with --size"
        )
    return ReadingAdvice(samples, each, samples * each / line_frequency_hz)
