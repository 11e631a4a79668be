"""Find where simulation and readings disagree, name the missing effect, add it, show how the gap shrinks."""

from bench.diagnosis.evidence import Threshold, ThresholdCache
from bench.diagnosis.pipeline import diagnose
from bench.diagnosis.result import Diagnosis, NamedEffect

__all__ = ["Diagnosis", "NamedEffect", "Threshold", "ThresholdCache", "diagnose"]
