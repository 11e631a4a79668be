"""When a block is due: against drifts whose day is known, and histories that are too short."""

import numpy as np
import pytest

from bench.calibration.result import CalibrationError
from bench.history.drift import due, sensitivities

VECTOR = np.array([-2.0, 0.0, 0.0, 0.0, -2.0, 0.0, 0.0, 0.0, -2.0, 0.0, 0.0, 0.0])
U = 1e-7


def history(years, per_year, seed=1):
    """Calibrations once a year of a bias in x that grows, V, with hardly any error."""
    count = years + 1
    random = np.random.default_rng(seed)
    when = np.datetime64("2020-01-01") + np.arange(count) * np.timedelta64(365, "D")
    vector = VECTOR + random.normal(0.0, U, (count, 12))
    vector[:, 9] += per_year * np.arange(count)
    return when, vector, np.broadcast_to(np.eye(12) * U**2, (count, 12, 12))


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
    assert "the interval of 90 days counts" in found.why
    assert found.predicted_g is None


def test_a_calibration_that_allows_nothing_is_due_at_once():
    when, vector, covariance = history(4, 0.0)
    found = due(when, vector, covariance * 1e8, 3e-4, 365.0)
    assert found.date == when[-1]
    assert "no interval keeps it" in found.why


def test_a_block_that_stays_is_foretold_no_further_than_twenty_years():
    found = due(*history(8, 0.0), 3e-3, 365.0)
    assert (found.date - found.last) / np.timedelta64(1, "D") == pytest.approx(20 * 365.25, abs=1)
    assert "no history foretells further" in found.why


def test_without_a_calibration_nothing_is_said():
    with pytest.raises(CalibrationError, match="no calibration"):
        due(np.zeros(0, "datetime64[s]"), np.zeros((0, 12)), np.zeros((0, 12, 12)), 3e-4, 365.0)
