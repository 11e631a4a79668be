"""The samples of a reading: scatter, drift and Grubbs' test against scipy and published tables."""

import numpy as np
import pytest
from scipy import stats

from bench.run.samples import describe, grubbs_critical


@pytest.mark.parametrize(
    ("n", "published"),
    [(3, 1.155), (4, 1.496), (5, 1.764), (8, 2.274), (10, 2.482), (15, 2.806), (20, 3.001), (30, 3.236)],
)
def test_critical_values_are_those_of_grubbs_table(n, published):
    """Grubbs and Beck, Technometrics 14 (1972), table I, upper 0.5 %: two-sided 1 %."""
    assert grubbs_critical(n) == pytest.approx(published, abs=1e-3)


@pytest.mark.parametrize("n", [3, 10, 512])
def test_mean_sd_and_drift_agree_with_scipy(n):
    x = np.random.default_rng([11, n]).normal(2.1, 1e-4, n)
    told = describe({"x": x})["x"]
    line = stats.linregress(np.arange(n), x)
    assert told.mean == pytest.approx(np.mean(x), rel=1e-14)
    assert told.sd == pytest.approx(np.std(x, ddof=1), rel=1e-9)
    assert told.drift == pytest.approx(line.slope * (n - 1), rel=1e-7)
    assert told.drift_p == pytest.approx(line.pvalue, rel=1e-6)


def test_false_outliers_and_drifts_are_as_rare_as_stated():
    """4000 readings: the counts lie within four standard deviations of 1 % and of 5 %."""
    rng = np.random.default_rng(5)
    told = [describe({"x": rng.normal(0.0, 1.0, 10)})["x"] for _ in range(4000)]
    outliers = sum(one.outlier is not None for one in told)
    drifts = sum(one.drift_p < 0.05 for one in told)
    assert abs(outliers - 40) < 4 * np.sqrt(40)
    assert abs(drifts - 200) < 4 * np.sqrt(190)


def test_an_outlier_is_named_and_left_where_it_is():
    x = [1.0, 1.1, 0.9, 1.05, 0.95, 9.0, 1.0, 1.1, 0.9, 1.0]
    told = describe({"y": x})["y"]
    assert told.outlier.sample == 6
    assert told.outlier.value == 9.0
    assert told.mean == pytest.approx(np.mean(x))


@pytest.mark.parametrize("n", range(3, 13))
def test_of_few_samples_none_is_an_outlier_for_how_the_others_were_rounded(n):
    """The last digit of an unknown meter: the rest are equal, which is the largest deviation that can be."""
    largest = (n - 1) / np.sqrt(n)
    told = describe({"x": [2.1] * (n - 1) + [2.10001]})["x"].outlier
    assert (told is not None) == (grubbs_critical(n) < 0.95 * largest)
    if told is not None:
        assert told.sigma == pytest.approx(largest)


@pytest.mark.parametrize("level", [0.0, 2.177087, -0.1])
def test_equal_samples_have_neither_scatter_nor_drift_nor_outlier(level):
    told = describe({"x": [level] * 10})["x"]
    assert (told.sd, told.drift, told.drift_p, told.outlier) == (0.0, 0.0, 1.0, None)


def test_one_and_two_samples_have_what_they_can_have():
    told = describe({"x": [1.0], "y": [1.0, 3.0], "z": [1.0, 2.0, 3.0]})
    assert (told["x"].mean, told["x"].sd, told["x"].drift) == (1.0, None, None)
    assert told["y"].sd == pytest.approx(np.sqrt(2.0))
    assert told["y"].drift is None
    assert (told["z"].drift, told["z"].drift_p) == (pytest.approx(2.0), 0.0)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ([], "no samples"),
        ([1.0, float("nan")], "1 of 2 samples are not finite"),
        ([float("inf")], "1 of 1 samples are not finite"),
    ],
)
def test_samples_that_are_none_are_refused_with_the_channel(values, words):
    with pytest.raises(ValueError, match=f"channel y: {words}"):
        describe({"y": values})
