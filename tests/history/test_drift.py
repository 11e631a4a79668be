"""Drift of a block from its history: the filter against dense algebra, honest predictions, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from bench.base.arrays import Floats
from bench.calibration.result import CalibrationError
from bench.history import drift
from bench.history.comparison import SECONDS_PER_YEAR
from bench.history.drift import UnitDrift, unit_drift

FIRST = np.datetime64("2020-01-01", "s")


def at(years: Floats) -> drift.Dates:
    return np.asarray(FIRST + np.round(years * SECONDS_PER_YEAR).astype("timedelta64[s]"))


def of(years: Floats, values: Floats, u: float = 1.0, common: Floats | None = None) -> UnitDrift:
    covariance = np.broadcast_to(u**2 * np.eye(12), (len(years), 12, 12))
    return unit_drift(at(years), values, covariance, common)


def test_filter_is_dense_generalised_least_squares() -> None:
    rng = np.random.default_rng(4)
    years = np.array([0.0, 0.8, 2.1, 2.5, 4.0])
    y, own = rng.normal(size=(5, 12)), rng.uniform(0.5, 2.0, (5, 12))
    found = drift._History(years, y, own)
    states, _, likelihood = found._at(
        np.broadcast_to(np.linspace(-1.0, 1.0, drift.GRID), (2, 12, drift.GRID))
    )
    k, m, later = 3, 60, 5.5
    V = np.diag(own[:, k] + states.between[k, m]) + states.walk[k, m] * np.minimum.outer(years, years)
    X = np.stack([np.ones(5), years], axis=1)
    inverse = np.linalg.inv(V)
    covariance = np.linalg.inv(X.T @ inverse @ X)
    line = covariance @ X.T @ inverse @ y[:, k]
    left = y[:, k] - X @ line
    expected = -0.5 * (np.linalg.slogdet(V)[1] - np.linalg.slogdet(covariance)[1] + left @ inverse @ left)
    assert likelihood[k].ravel()[m] == pytest.approx(expected)
    walk = states.walk[k, m] * np.minimum(years, later)
    value = np.array([1.0, later]) @ line + walk @ inverse @ left
    columns = np.array([1.0, later]) - walk @ inverse @ X
    variance = (
        columns @ covariance @ columns
        + states.walk[k, m] * later
        - walk @ inverse @ walk
        + states.between[k, m]
    )
    alone = np.zeros_like(states.weight)
    alone[:, m] = 1.0
    only = drift.States(**{**states.__dict__, "weight": alone})
    mean, spread = only.predicted(np.array([later]))
    assert mean[0, k] == pytest.approx(value)
    assert spread[0, k] == pytest.approx(variance)


@pytest.mark.slow
@pytest.mark.parametrize(("scatter", "walk"), [(0.0, 0.0), (3.0, 0.0), (0.0, 3.0)])
def test_what_is_foretold_comes_within_its_uncertainty(scatter: float, walk: float) -> None:
    rng = np.random.default_rng(17)
    z, runs = [], 20
    for _ in range(runs):
        years = np.cumsum(rng.uniform(0.5, 1.5, 11))
        steps = np.sqrt(np.diff(years, prepend=0.0))[:, None] * rng.normal(size=(11, 12))
        true = np.cumsum(walk * steps, axis=0) + years[:, None] + scatter * rng.normal(size=(11, 12))
        found = of(years[:-1], true[:-1] + rng.normal(size=(10, 12)))
        value, u = found.predicted(at(years[-1:]))
        z.append((value[0] - true[-1]) / u[0])
    outside = int(np.sum(np.abs(z) > 2.0))
    # 240 of a normal distribution, 4.6 % outside: more than 24 comes by chance once in 10,000 times
    assert outside <= 24


def test_a_rate_is_found_with_its_uncertainty_and_shown() -> None:
    rng = np.random.default_rng(2)
    years = np.linspace(0.0, 6.0, 13)
    rates = np.zeros(12)
    rates[4] = 3.0
    found = of(years, rates * years[:, None] + rng.normal(size=(13, 12)))
    assert np.flatnonzero(found.shown).tolist() == [4]
    assert abs(found.rate[4] - 3.0) < 3 * found.u_rate[4]
    # of a line alone; what sizes may be there makes it larger
    assert found.u_rate[4] > 1.0 / np.sqrt(np.sum((years - 3.0) ** 2))
    assert found.count == 13


def test_uncertainty_grows_with_time() -> None:
    rng = np.random.default_rng(3)
    found = of(np.arange(6.0), rng.normal(size=(6, 12)))
    _, u = found.predicted(at(np.array([5.0, 6.0, 8.0])))
    assert np.all(np.diff(u, axis=0) > 0)


def test_what_all_have_in_common_moves_no_rate_and_never_averages() -> None:
    rng = np.random.default_rng(5)
    years = np.arange(8.0)
    values = 0.1 * rng.normal(size=(8, 12))
    u = np.hypot(0.1, 1.0)
    stated, told = of(years, values, u), of(years, values, u, np.ones(12))
    assert np.all(told.u_rate < 0.5 * stated.u_rate)
    assert np.all(told.predicted(told.last)[1] > 1.0)
    assert np.all(stated.predicted(stated.last)[1] < 1.0)


def test_order_of_calibrations_does_not_matter() -> None:
    rng = np.random.default_rng(6)
    years, values = np.arange(5.0), rng.normal(size=(5, 12))
    turned = unit_drift(at(years)[::-1], values[::-1], np.broadcast_to(np.eye(12), (5, 12, 12)))
    np.testing.assert_allclose(turned.rate, of(years, values).rate)


def test_refusals() -> None:
    with pytest.raises(CalibrationError, match="3 calibrations or more over more than a day; there are 2"):
        of(np.arange(2.0), np.zeros((2, 12)))
    with pytest.raises(CalibrationError, match="more than a day"):
        of(np.full(4, 1.0), np.zeros((4, 12)))
    found = of(np.arange(4.0), np.random.default_rng(1).normal(size=(4, 12)))
    with pytest.raises(CalibrationError, match=r"after its last calibration \(2022-12-31\); asked for 2021-"):
        found.predicted(np.datetime64("2021-06-01"))
