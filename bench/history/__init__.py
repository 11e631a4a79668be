"""Calibrations of one block over time: what changed beyond its uncertainty, and what drifts."""
