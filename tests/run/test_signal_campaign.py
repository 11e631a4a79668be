"""Signals to whole runs over real wires: a few of the trials of `benchmarks/signal_campaign.py`."""

from __future__ import annotations

import signal

import pytest

from benchmarks import signal_campaign
from benchmarks.signal_campaign import PATTERNS, PHASES, TROUBLES, Trial, draw, worker

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="a system without SIGHUP"),
]
NEVER_S = 120.0
"""No trial is judged by its time here: a machine that is busy is not a fault."""
INT, TERM = signal.SIGINT, signal.SIGTERM
TRIALS = [
    Trial(0, "turn", "single", (INT,), 0.0, "none"),
    Trial(1, "run_failed", "burst", (TERM, INT, INT, TERM, INT, INT, TERM), 0.0, "meter hangs"),
    Trial(2, "run_finished", "double", (INT, TERM), 0.0, "none"),
    Trial(3, "temperature", "late second", (INT, INT), 0.1, "chamber hangs"),
    Trial(4, "run_started", "single", (TERM,), 0.2, "terminal closed"),
]


def test_the_bench_is_left_safe_at_every_signal(monkeypatch):
    monkeypatch.setattr(signal_campaign, "LIMIT_S", NEVER_S)
    outcomes = worker(TRIALS)
    assert [(outcome.trial, outcome.violations) for outcome in outcomes if outcome.violations] == []
    assert {outcome.state for outcome in outcomes} >= {"interrupted", "failed", "finished"}


def test_a_campaign_draws_every_phase_pattern_and_trouble():
    trials = draw(200, 1)
    assert {trial.phase for trial in trials} == set(PHASES)
    assert {trial.pattern for trial in trials} == set(PATTERNS)
    assert {trial.trouble for trial in trials} == set(TROUBLES)
    assert {number for trial in trials for number in trial.signals} == {INT, TERM, signal.SIGHUP}
