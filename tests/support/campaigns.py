"""Tests that draw what goes wrong: one seed by default, and as many as `BENCH_SEEDS` says for a campaign.

BENCH_SEEDS=50 .venv/bin/python -m pytest -n auto tests/run/test_wire_faults.py
"""

import os


def seeds(first: int) -> range:
    """Return the seeds of a test, of which only the first one is used by default."""
    return range(first, first + int(os.environ.get("BENCH_SEEDS", "1")))
