"""The specific risks of verdicts against how often they are wrong, in short."""

import numpy as np
import pytest
from scipy import stats

from benchmarks.verdict_risk import Decided, compared, main, two_sided, within_chance


@pytest.mark.slow
def test_stated_risks_are_those_that_come_true(capsys):
    """Seed 1, 24 calibrations with 240 points each: within 10 % or 0.002, and three standard errors."""
    assert main(["--runs", "24", "--joint", "20", "--seed", "1"]) == 0
    assert "false rejection, points" in capsys.readouterr().out


def test_a_risk_that_is_stated_too_small_is_noticed():
    rng = np.random.default_rng(3)
    stated = rng.uniform(0.02, 0.4, (50, 400))
    honest = [Decided(p, rng.random(400) < p) for p in stated]
    assert compared("honest", honest) == []
    assert len(compared("too small", [Decided(p, rng.random(400) < 1.4 * p) for p in stated])) > 2


def test_chance_is_that_of_events_of_different_probability():
    """Against the binomial distribution, and 700 blocks (seed 3) of which too many, or too few, are wrong."""
    exact = 2 * stats.binom(40, 0.1).sf(8)
    assert two_sided(np.full(40, 0.1), 9) == pytest.approx(exact)
    assert two_sided(np.array([0.0, 1.0, 0.5]), 2) == pytest.approx(1.0)
    rng = np.random.default_rng(3)
    stated = rng.uniform(0.0, 0.3, 700)
    assert within_chance(stated, rng.random(700) < stated) == []
    assert within_chance(stated, rng.random(700) < 1.7 * stated)
    assert within_chance(stated, rng.random(700) < 0.3 * stated)


@pytest.mark.slow
def test_risks_of_blocks_of_a_stated_population_are_those_that_come_true():
    """40 blocks, seed 1, of the 700 of the campaign."""
    assert main(["--blocks", "40", "--seed", "1"]) == 0
