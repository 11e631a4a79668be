"""How a chart is designed: one false alarm rate for all that it holds a run to, shared out among its statistics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from scipy import special

from bench.analysis.control_charts.run_length import ewma_k, mewma_limit
from bench.analysis.control_charts.statistics import Basis

STATISTICS: Final = 3
"""What rejects a run: T² of the run, T² of the EWMA, and its short-term standard deviation."""
DEFAULT_ARL: Final = 370.0
DEFAULT_SMOOTHING: Final = 0.2


@dataclass(frozen=True)
class Design:
    """The average run length between false alarms of the whole, the smoothing of the EWMA, what limits are from.

    A rate is shared in equal parts by the three statistics that reject: for rare alarms their rates add up.
    """

    arl: float = DEFAULT_ARL
    smoothing: float = DEFAULT_SMOOTHING
    basis: Basis = "scaled"

    @property
    def each_arl(self) -> float:
        """The average run length of each of the three statistics by itself."""
        return STATISTICS * self.arl

    @property
    def alpha(self) -> float:
        """How often T² of a run, and its short-term standard deviation, are each beyond their limit by chance."""
        return 1.0 / self.each_arl

    def alpha_ewma(self, dimensions: int) -> float:
        """How often T² of the EWMA is beyond the limit that has its run length, at any one run, by chance."""
        return float(special.chdtrc(dimensions, mewma_limit(self.smoothing, self.each_arl, dimensions)))

    def alpha_single(self, dimensions: int) -> float:
        """The same of one coefficient among so many: their chart has the run length of T²."""
        return self.alpha / dimensions

    def alpha_single_ewma(self, dimensions: int) -> float:
        """The same of the EWMA of one coefficient among so many."""
        k = ewma_k(self.smoothing, self.each_arl * dimensions)
        return float(2.0 * special.ndtr(-k))
