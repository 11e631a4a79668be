"""Variance components: the balanced one-way layout has them in closed form."""

import numpy as np
import pytest
from scipy import special

from bench.calibration.components import walk_since
from bench.stats.reml import Mixed, Projection, asked_for, maximise

GROUPS, REPEATS = 12, 4


def one_way(seed, between, within):
    rng = np.random.default_rng(seed)
    labels = np.repeat(np.arange(GROUPS), REPEATS)
    y = 5.0 + rng.normal(0, between, GROUPS)[labels] + rng.normal(0, within, len(labels))
    member = (labels[:, None] == np.arange(GROUPS)).astype(float)
    n = len(y)
    return Mixed(y, np.ones((n, 1)), (np.eye(n), member), np.zeros((n, n)))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_one_way_layout_in_closed_form(seed):
    """Within: the mean square within; between: (mean square between less that)/repeats."""
    mixed = one_way(seed, 2.0, 1.0)
    cells = mixed.y.reshape(GROUPS, REPEATS)
    within = np.sum((cells - cells.mean(axis=1, keepdims=True)) ** 2) / (GROUPS * (REPEATS - 1))
    between = (REPEATS * np.var(cells.mean(axis=1), ddof=1) - within) / REPEATS
    assert between > 0
    theta, _ = maximise(mixed, np.array([1.0, 1.0]), np.ones(2))
    np.testing.assert_allclose(theta, [within, between], rtol=1e-2)


def test_what_is_not_there_is_nothing():
    """Seed 10 has a mean square between below that within: the estimate lies at its lower end."""
    mixed = one_way(10, 0.0, 1.0)
    cells = mixed.y.reshape(GROUPS, REPEATS)
    within = np.sum((cells - cells.mean(axis=1, keepdims=True)) ** 2) / (GROUPS * (REPEATS - 1))
    assert REPEATS * np.var(cells.mean(axis=1), ddof=1) < within
    theta, _ = maximise(mixed, np.array([1.0, 0.5]), np.ones(2))
    assert theta[1] == 0.0


def test_a_component_that_is_there_is_asked_for_and_one_that_is_not_as_seldom_as_is_said():
    """With the size within estimated from the repeats: p of the analysis of variance, far into its tail."""
    dof = GROUPS - 1, GROUPS * (REPEATS - 1)
    for seed, between in ((9, 0.0), (9, 0.7), (10, 2.0)):
        mixed = one_way(seed, between, 1.0)
        cells = mixed.y.reshape(GROUPS, REPEATS)
        within = np.sum((cells - cells.mean(axis=1, keepdims=True)) ** 2) / dof[1]
        at = Projection.at(mixed.only(np.array([True, False])), np.array([within]))
        ratio = REPEATS * np.var(cells.mean(axis=1), ddof=1) / within
        found = asked_for(at, mixed.columns, 1, dof[1]).chance[0]
        assert found == pytest.approx(special.fdtrc(*dof, ratio), rel=1e-6)
    assert found < 1e-6


def test_what_the_readings_leave_open_is_the_mean_over_its_likelihood():
    """One-way layout, within known to be 1: the mean of the variance between over the likelihood, by quadrature."""
    mixed = one_way(11, 0.6, 1.0)
    base = mixed.only(np.array([True, False]))
    found = asked_for(Projection.at(base, np.ones(1)), mixed.columns, 1, np.inf).expected[0]
    between = np.sum((mixed.y.reshape(GROUPS, REPEATS).mean(axis=1) - mixed.y.mean()) ** 2) * REPEATS
    theta = np.linspace(0.0, 6.0, 4001)
    size = 1.0 + REPEATS * theta
    likelihood = np.exp(-0.5 * (GROUPS - 1) * np.log(size) - 0.5 * between / size)
    mean = np.sum(theta * likelihood) / np.sum(likelihood)
    # one normal step from nothing stands in for the likelihood, which has a longer tail
    assert 0.4 * mean < found < 1.3 * mean


def test_a_walk_that_goes_on_has_the_covariance_of_drawn_ones():
    """20,000 walks (seed 12) of 40 steps: five standard errors of a covariance."""
    rng = np.random.default_rng(12)
    walks = np.cumsum(rng.normal(size=(20_000, 40)), axis=1)
    time_s = np.arange(40.0) + 1.0
    about = walks - walks[:, :30].mean(axis=1, keepdims=True)
    size = np.mean(about[:, :30] ** 2)
    ours = walk_since(time_s[:30], time_s[[32, 39]])
    drawn = about[:, [32, 39]].T @ about[:, [32, 39]] / len(walks) / size
    np.testing.assert_allclose(ours, drawn, atol=5 * np.sqrt(2 / 20_000) * ours.max() + 0.02 * ours.max())
