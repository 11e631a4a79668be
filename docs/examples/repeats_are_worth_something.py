"""A test of the estimator `first-pass`: if it leaves readings out, its u must be larger."""

import bench


def test_repeats_are_worth_something():
    both = [bench.calibrate("readings.csv", estimator=name) for name in ("first-pass", "least-squares")]
    alone, every = (result.coefficients["Kxx"].u_readings for result in both)
    assert alone > every
