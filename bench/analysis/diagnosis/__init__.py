"""Find where simulation and readings disagree, name the missing effect, add it, show how the gap shrinks."""

from bench.analysis.diagnosis.pipeline import diagnose
from bench.analysis.diagnosis.result import Diagnosis, NamedEffect
from bench.analysis.diagnosis.threshold import Threshold, ThresholdCache

__all__ = ["Diagnosis", "NamedEffect", "Threshold", "ThresholdCache", "diagnose"]
