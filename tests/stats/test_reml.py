"""Restricted likelihood: components in closed form, sizes of the noise, repeats against their stated u."""

import numpy as np
import pytest
from scipy import special
from scipy.optimize import minimize

from bench.calibration.components import walk_since
from bench.stats.reml import Mixed, Projection, asked_for, maximise
from bench.stats.repeats import compare_repeats
from bench.stats.repeats_likelihood import COMMON, OWN, believed_sizes, freedom_of, sizes_of

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


# --- sizes of the noise from repeats --------------------------------------------------------------


SIZES = np.array([0.3e-4, 1e-4, 3e-4])
SETTING = 3e-5


def drawn(seed, runs, sizes=SIZES, groups=18, repeats=3):
    """Scatter of groups of repeats (runs, groups, 3, 3) with their slopes, drawn as single deviations."""
    rng = np.random.default_rng(seed)
    slope = np.repeat(rng.normal(size=(groups, 3))[None] * 2, runs, axis=0)
    errors = rng.normal(size=(runs, groups, repeats, 3)) * sizes
    errors = errors + rng.normal(0, SETTING, (runs, groups, repeats, 1)) * slope[:, :, None, :]
    errors = errors - errors.mean(axis=2, keepdims=True)
    return np.einsum("rgki,rgkj->rgij", errors, errors), np.full(groups, repeats - 1), slope


def written_out(log_variances, scatter, freedom, slope):
    total = 0.0
    for S, f, d in zip(scatter, freedom, slope, strict=True):
        V = np.diag(np.exp(log_variances[:3])) + np.exp(log_variances[3]) * np.outer(d, d)
        total += f * np.linalg.slogdet(V)[1] + np.trace(np.linalg.solve(V, S))
    return total


@pytest.mark.slow
def test_each_channel_has_its_own_where_they_differ():
    """Seed 31, 4 runs: the greatest likelihood by Nelder-Mead from the true sizes."""
    scatter, freedom, slope = drawn(31, 4)
    ours = sizes_of(scatter, freedom, slope, 1e-9, OWN)
    for r in range(4):
        best = minimize(
            written_out, np.log([*SIZES**2, SETTING**2]), args=(scatter[r], freedom, slope[r]),
            method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9, "maxiter": 4000},
        )  # fmt: skip
        np.testing.assert_allclose(np.log(ours[r]), best.x, atol=2e-3)


def test_sizes_are_right_on_the_average_and_as_uncertain_as_their_freedom_says():
    """Seed 32, 400 runs. Four standard errors of mean and of variance."""
    scatter, freedom, slope = drawn(32, 400)
    found = sizes_of(scatter, freedom, slope, 1e-9, OWN)[:, :3] / SIZES**2
    dof = freedom_of(freedom, slope, np.repeat([[*SIZES**2, SETTING**2]], 400, axis=0))[0, :3]
    np.testing.assert_allclose(found.mean(axis=0), 1.0, atol=4 * np.sqrt(2 / dof.min() / 400))
    np.testing.assert_allclose(found.var(axis=0) / (2 / dof), 1.0, atol=4 * np.sqrt(2.5 / 400) + 0.1)


def test_equal_channels_are_taken_as_one_and_unequal_ones_never():
    """Seed 33, 300 runs: a test at 0.2 keeps eight in ten; 0.3, 1, 3 is told in every run."""
    alike = believed_sizes(*drawn(33, 300, np.full(3, 1e-4)), 1e-9)
    assert np.mean(alike.alike) == pytest.approx(0.8, abs=4 * np.sqrt(0.16 / 300) + 0.03)
    assert np.ptp(alike.variances[alike.alike][:, :3], axis=1) == pytest.approx(0.0, abs=1e-20)
    assert not np.any(believed_sizes(*drawn(33, 300), 1e-9).alike)


def test_without_any_noise_the_floor_is_believed():
    scatter, freedom, slope = drawn(34, 2)
    found = sizes_of(scatter * 0.0, freedom, slope, 1e-9, COMMON)
    np.testing.assert_allclose(np.sqrt(found[:, :3]), 1e-9, rtol=1e-3)


@pytest.mark.slow
def test_few_repeats_never_give_a_channel_hardly_any_noise():
    """Seed 35, 4,000 runs of equal channels: the setting error can take all of x, so that alone x goes to zero.

    A variance of five degrees of freedom is a thousandth of the truth once in 10^7.
    """
    scatter, freedom, slope = drawn(35, 4000, np.full(3, 3e-5), groups=4)
    alone = sizes_of(scatter, freedom, slope, 1e-12, OWN)[:, :3] / 3e-5**2
    believed = believed_sizes(scatter, freedom, slope, 1e-12)
    found = believed.variances[:, :3] / 3e-5**2
    assert np.any(alone < 1e-3)
    assert np.all(found > 1e-3)
    assert np.all(believed.dof >= 4.0)
    told_poorly = ~believed.alike & np.any(alone < 0.1, axis=1)
    assert np.any(told_poorly)
    assert np.mean(1.0 / found[told_poorly]) < 2.0  # as with four degrees of freedom, for which u is widened


U = 1e-3


def repeats(seed, term, size=20 * U, groups=4, count=9, kinds=3):
    """Values and u (groups, count, kinds); the term moves the groups alike, as one switch-on moves all sensors."""
    rng = np.random.default_rng(seed)
    u = U * np.exp(rng.normal(0.0, 0.5, (1, count, 1))) * np.ones((groups, count, kinds))
    common = rng.standard_normal((1, count, kinds))
    moves = {
        "none": 0.0 * common,
        "restart": size * common,
        "drift": size * np.cumsum(common, axis=1),
        "scale": size / U * u * common,
    }
    return moves[term] + u * rng.standard_normal(u.shape) + rng.normal(0.0, 1.0, (groups, 1, kinds)), u


def test_honest_u_is_left_alone():
    found = [compare_repeats(*repeats(seed, "none")) for seed in range(8)]
    assert not any(one.too_small for one in found)
    assert all(one.term is None and one.held_after is None for one in found)
    assert np.mean([one.scatter for one in found]) == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("term", ["restart", "drift", "scale"])
def test_u_that_is_too_small_is_said_to_be_and_the_term_makes_it_honest(term):
    found = [compare_repeats(*repeats(seed, term)) for seed in range(6)]
    assert all(one.too_small and one.scatter > 5.0 for one in found)
    names = [one.term.name for one in found]
    assert names.count(term) >= 4
    # a 95 % interval holds 1 in 4 of 6 or more, but for a chance of 2 in 1000
    assert sum(one.held_after.low < 1.0 < one.held_after.high for one in found) >= 4
    assert all(np.all(one.term.u > repeats(0, term)[1].min()) for one in found)


def test_missing_repeats_weigh_nothing():
    value, u = repeats(1, "restart", groups=3)
    value[0, 2], u[0, 2] = np.nan, np.nan
    value[1], u[1] = np.nan, np.nan
    found = compare_repeats(value, u)
    assert found.too_small
    assert np.isnan(found.term.u[1]).all()
    alone = compare_repeats(value[[0, 2]], u[[0, 2]])
    assert found.held_after.value == pytest.approx(alone.held_after.value, rel=0.02)


def test_two_repeats_have_a_ratio_and_no_more():
    value, u = repeats(2, "restart", count=2)
    found = compare_repeats(value, u)
    assert found.scatter > 1.5
    assert (found.held_before, found.term, found.too_small) == (None, None, False)
