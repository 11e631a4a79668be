"""Calibrations of one block over time: what changed beyond its uncertainty, and what drifts."""

from bench.analysis.history.comparison import Changes, Comparison, Drift, Snapshot, compare

__all__ = ["Changes", "Comparison", "Drift", "Snapshot", "compare"]
