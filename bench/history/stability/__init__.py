"""Noise and drift of a signal at rest: Allan deviation, noise terms, and how long a reading should average."""
