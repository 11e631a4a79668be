"""The likelihood of what runs share, against dense matrices written out again and against statsmodels."""

import numpy as np
import pandas as pd
import pytest
from scipy import linalg
from statsmodels.regression.mixed_linear_model import MixedLM

from bench.history.learning import Beliefs, at, fitted, maximise
from bench.history.run_sums import Body


def drawn(seed, runs=6, repeats=4, columns=3, waves=2):
    """Runs y = X b + B t + H h + noise of unit size, two own coefficients each: dense arrays, and their sums."""
    rng = np.random.default_rng(seed)
    parts, grams = [], []
    for _ in range(runs):
        n = 8 * repeats
        X, B, H = rng.normal(size=(n, 2)), rng.normal(size=(n, columns)), rng.normal(size=(n, waves))
        t = np.array([0.7, -0.4, 0.2])[:columns] + rng.normal(size=columns) * np.sqrt(
            [0.5, 0.5, 2.0][:columns]
        )
        y = X @ rng.normal(size=2) + B @ t + H @ np.full(waves, 0.3) + rng.normal(size=n)
        q, _ = np.linalg.qr(X)
        W = np.column_stack([B, H, y])
        W = W - q @ (q.T @ W)
        parts.append((X, B, H, y))
        grams.append(W.T @ W)
    random, mean = np.array([[0, 0, 1]] * runs)[:, :columns], np.array([[0, 1, 1]] * runs)[:, :columns]
    names = tuple(f"run {r}" for r in range(runs))
    return parts, Body(names, np.array(grams), random, mean, waves, np.zeros(runs), np.ones(runs))


def dense(parts, theta, precision):
    """-2 ln L of all readings at once, and the means: y normal about X b + (B, H) m, b free, m with its prior."""
    y = np.concatenate([part[3] for part in parts])
    X = linalg.block_diag(*[part[0] for part in parts])
    F = np.concatenate([np.column_stack([B[:, 0], B[:, 1] + B[:, 2], H]) for _, B, H, _ in parts])
    V = linalg.block_diag(
        *[np.eye(len(B)) + (B * np.array([theta[0], theta[0], theta[1]])) @ B.T for _, B, _, _ in parts]
    )
    whole = np.column_stack([X, F])
    inverse = np.linalg.inv(V)
    normal = whole.T @ inverse @ whole
    places = X.shape[1] + np.arange(2)
    normal[places, places] += precision
    found = np.linalg.solve(normal, whole.T @ inverse @ y)
    value = np.linalg.slogdet(V)[1] + np.linalg.slogdet(normal)[1]
    value += y @ inverse @ y - found @ (whole.T @ inverse @ y)
    return value, found[X.shape[1] :], np.linalg.inv(normal)[X.shape[1] :, X.shape[1] :]


def free(precision, variances=2):
    return Beliefs(np.asarray(precision, float), *np.full((2, variances), np.nan))


def test_the_sums_of_runs_give_the_likelihood_of_all_their_readings():
    """Seed 1. Up to a constant; means and their covariance to the digits of doubles."""
    parts, body = drawn(1)
    precision = np.array([0.8, 1.3])
    one, two = np.array([0.4, 1.5]), np.array([1.2, 0.3])
    for theta in (one, two):
        _, means, covariance = dense(parts, theta, precision)
        here = at(body, theta, free(precision))
        np.testing.assert_allclose(here.means, means, rtol=1e-9)
        np.testing.assert_allclose(here.covariance, covariance, rtol=1e-8, atol=1e-12)
    expected = dense(parts, one, precision)[0] - dense(parts, two, precision)[0]
    found = at(body, one, free(precision)).minus_two_log - at(body, two, free(precision)).minus_two_log
    assert found == pytest.approx(expected, abs=1e-8)


def test_the_score_is_the_slope_of_the_likelihood_also_where_a_variance_keeps_its_prior():
    _, body = drawn(2)
    beliefs = Beliefs(np.array([1.0, 1.0]), np.array([np.nan, 0.5]), np.array([np.nan, 0.29]))
    theta, step = np.array([0.6, 0.9]), 1e-5
    for j in range(2):
        up, down = theta.copy(), theta.copy()
        up[j], down[j] = theta[j] + step, theta[j] - step
        slope = at(body, up, beliefs).minus_two_log - at(body, down, beliefs).minus_two_log
        assert at(body, theta, beliefs).score[j] == pytest.approx(-slope / (4 * step), rel=1e-5)


def test_at_the_greatest_likelihood_nothing_is_left_to_gain():
    _, body = drawn(3, runs=12)
    theta = fitted(body, free([1.0, 1.0]))
    best = at(body, theta, free([1.0, 1.0])).minus_two_log
    for factor in (0.97, 1.03):
        for j in range(2):
            moved = theta.copy()
            moved[j] *= factor
            assert at(body, moved, free([1.0, 1.0])).minus_two_log > best


def test_a_balanced_design_is_that_of_statsmodels():
    """One way, seed 4, 12 runs of 5 readings: mean, variance between runs, observed information."""
    rng = np.random.default_rng(4)
    runs, repeats = 12, 5
    y = 3.0 + 0.8 * rng.normal(size=(runs, 1)) + rng.normal(size=(runs, repeats))
    told = pd.DataFrame({"y": y.ravel(), "one": 1.0, "run": np.repeat(np.arange(runs), repeats)})
    judge = MixedLM(told["y"], told[["one"]], groups=told["run"]).fit(reml=True)
    W = [np.column_stack([np.ones(repeats), own]) / np.sqrt(judge.scale) for own in y]
    zeros = np.zeros((runs, 1), dtype=np.int64)
    body = Body(
        tuple("abcdefghijkl"), np.array([w.T @ w for w in W]), zeros, zeros, 0, np.zeros(runs), np.ones(runs)
    )
    shared = maximise(body, free([1e-12], 1))
    between = float(judge.cov_re.iloc[0, 0])
    assert shared.theta[0] == pytest.approx(between, rel=1e-3)
    assert shared.at.means[0] == pytest.approx(judge.fe_params.iloc[0], rel=1e-6)
    assert np.sqrt(shared.at.covariance[0, 0]) == pytest.approx(judge.bse_fe.iloc[0], rel=1e-3)
    # closed form of the balanced case: var(t) = 2 (t + s/n)^2/(runs - 1) for a known noise
    closed = 2 * (shared.theta[0] + judge.scale / repeats) ** 2 / (runs - 1)
    assert 1 / shared.information[0, 0] == pytest.approx(closed, rel=2e-2)
