"""Calibrations of one block over time: what changed beyond its uncertainty, and what drifts."""

from bench.history.comparison import Changes, Comparison, Drift, Snapshot, compare

__all__ = ["Changes", "Comparison", "Drift", "Snapshot", "compare"]
