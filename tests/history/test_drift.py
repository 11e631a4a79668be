"""Drift of a block from its history, and when it is due: against dense algebra and known drifts."""

import numpy as np
import pytest

from bench.base.arrays import Floats
from bench.calibration.result import CalibrationError
from bench.history import drift
from bench.history.comparison import SECONDS_PER_YEAR
from bench.history.drift import UnitDrift, due, history_drift, sensitivities

FIRST = np.datetime64("2020-01-01", "s")


def at(years: Floats) -> drift.Dates:
    return np.asarray(FIRST + np.round(years * SECONDS_PER_YEAR).astype("timedelta64[s]"))


def of(years: Floats, values: Floats, u: float = 1.0, common: Floats | None = None) -> UnitDrift:
    covariance = np.broadcast_to(u**2 * np.eye(12), (len(years), 12, 12))
    return history_drift(at(years), values, np.diagonal(covariance, axis1=1, axis2=2), common)


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
    turned = history_drift(at(years)[::-1], values[::-1], np.ones((5, 12)))
    np.testing.assert_allclose(turned.rate, of(years, values).rate)


def test_refusals() -> None:
    with pytest.raises(CalibrationError, match=r"3 calibrations or more over more than a day; there are 2$"):
        of(np.arange(2.0), np.zeros((2, 12)))
    with pytest.raises(CalibrationError, match="more than a day; there are 4 over 0 h"):
        of(np.full(4, 1.0), np.zeros((4, 12)))
    found = of(np.arange(4.0), np.random.default_rng(1).normal(size=(4, 12)))
    with pytest.raises(CalibrationError, match=r"2021-.* is before the last calibration \(2022-12-31T"):
        found.predicted(np.datetime64("2021-06-01"))
    for text in ("", "NaT", "1 June"):
        with pytest.raises(CalibrationError, match="expected a date such as 2027-06-01"):
            drift.day_of(text)


VECTOR = np.array([-2.0, 0.0, 0.0, 0.0, -2.0, 0.0, 0.0, 0.0, -2.0, 0.0, 0.0, 0.0])
U_DUE = 1e-7


def history(years, per_year, seed=1):
    """Calibrations once a year of a bias in x that grows, V, with hardly any error."""
    count = years + 1
    random = np.random.default_rng(seed)
    when = np.datetime64("2020-01-01") + np.arange(count) * np.timedelta64(365, "D")
    vector = VECTOR + random.normal(0.0, U_DUE, (count, 12))
    vector[:, 9] += per_year * np.arange(count)
    return when, vector, np.broadcast_to(np.eye(12) * U_DUE**2, (count, 12, 12))


def test_a_steady_drift_reaches_the_limit_when_arithmetic_says():
    when, vector, covariance = history(8, 2e-4)
    found = due(when, vector, covariance, 3e-4, 365.0)
    assert found.basis == "drift"
    # 2e-4 V a year in 2 V/g is 1e-4 g a year: three years; what is not known of the drift brings it forward
    days = (found.date - when[-1]) / np.timedelta64(1, "D")
    assert 0.9 * 3 * 365.25 < days <= 3 * 365.25
    assert found.predicted_g == pytest.approx(3e-4, rel=0.01)


def test_a_shorter_history_is_due_earlier():
    dates = [due(*history(years, 2e-4), 3e-4, 365.0) for years in (2, 4, 8)]
    left = [(one.date - one.last) / np.timedelta64(1, "D") for one in dates]
    assert left[0] < left[1] < left[2]


def test_what_no_direction_shows_at_one_g_is_no_error():
    """A turn of the block's axes changes K, and the modulus of nothing."""
    turn = np.zeros(12)
    turn[5], turn[7] = 1e-3, -1e-3
    along = sensitivities(VECTOR)
    assert np.max(np.abs(along @ turn)) < 1e-12
    assert np.max(along @ np.eye(12)[9]) == pytest.approx(0.5)


def test_two_calibrations_are_due_by_the_interval_and_say_so():
    when, vector, covariance = history(1, 2e-4)
    found = due(when, vector, covariance, 3e-4, 90.0)
    assert (found.basis, found.date) == ("interval", when[-1] + np.timedelta64(90, "D"))
    assert "the interval of 90 days applies" in found.why
    assert found.predicted_g is None


def test_a_calibration_that_allows_nothing_is_due_at_once():
    when, vector, covariance = history(4, 0.0)
    found = due(when, vector, covariance * 1e8, 3e-4, 365.0)
    assert found.date == when[-1]
    assert "no interval is short enough" in found.why


def test_a_block_that_stays_is_foretold_no_further_than_twenty_years():
    found = due(*history(8, 0.0), 3e-3, 365.0)
    assert (found.date - found.last) / np.timedelta64(1, "D") == pytest.approx(20 * 365.25, abs=1)
    assert "the history predicts no further" in found.why


def test_without_a_calibration_nothing_is_said():
    with pytest.raises(CalibrationError, match="no calibration"):
        due(np.zeros(0, "datetime64[s]"), np.zeros((0, 12)), np.zeros((0, 12, 12)), 3e-4, 365.0)
