"""Find where simulation and readings disagree, name the missing effect, add it, show how the gap shrinks."""

from bench.discrepancy.diagnose import diagnose
from bench.discrepancy.result import Diagnosis, NamedEffect
from bench.discrepancy.threshold import Threshold, ThresholdCache

__all__ = ["Diagnosis", "NamedEffect", "Threshold", "ThresholdCache", "diagnose"]
