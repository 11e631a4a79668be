"""The specific risks of verdicts against how often they are wrong, in short."""

import numpy as np
import pytest

from benchmarks.verdict_risk import Decided, compared, main


@pytest.mark.slow
def test_stated_risks_are_those_that_come_true(capsys):
    """Seed 1, 120 calibrations with 240 points each: within 10 % or 0.002, and three standard errors."""
    assert main(["--runs", "120", "--joint", "20", "--seed", "1"]) == 0
    assert "false rejection, points" in capsys.readouterr().out


def test_a_risk_that_is_stated_too_small_is_noticed():
    rng = np.random.default_rng(3)
    stated = rng.uniform(0.02, 0.4, (50, 400))
    honest = [Decided(p, rng.random(400) < p) for p in stated]
    assert compared("honest", honest) == []
    assert len(compared("too small", [Decided(p, rng.random(400) < 1.4 * p) for p in stated])) > 2
