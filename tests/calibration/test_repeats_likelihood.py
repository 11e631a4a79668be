"""Sizes of the noise of many runs at once, beside the likelihood written out and maximised by other means."""

import numpy as np
import pytest
from scipy.optimize import minimize

from bench.stats.repeats_likelihood import COMMON, OWN, believed_sizes, freedom_of, sizes_of

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
