"""The statistics of a chart: the handbook's example, others' t and F, false rejections of small baselines."""

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.multivariate import test_mvmean as hotelling
from statsmodels.stats.weightstats import DescrStatsW

from bench.calibration.result import CalibrationError
from bench.stats.control_charts import Centre, centre_of, judge, without_one

HANDBOOK = np.array([
    52.0, 47.0, 53.0, 49.3, 50.1, 47.0, 51.0, 50.1, 51.2, 50.5,
    49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6, 52.1,
])  # fmt: skip
EWMA = np.array([
    50.60, 49.52, 50.56, 50.18, 50.16, 49.21, 49.75, 49.85, 50.26, 50.33,
    50.11, 49.36, 49.52, 50.05, 49.38, 49.92, 50.73, 51.23, 51.94, 51.99,
])  # fmt: skip
"""NIST/SEMATECH e-Handbook, 6.3.2.4: mean 50, s = 2.0539, lambda = 0.3, limits 52.5884 and 47.4115."""


def known(mean: float, p: int = 1) -> Centre:
    return Centre(np.full(p, mean), np.zeros((p, p)), np.ones(()), np.inf, 10**9)


def test_the_handbooks_ewma_comes_out_with_its_limits():
    values = HANDBOOK[:, None]
    found = judge(known(50.0), values, np.full((20, 1, 1), 2.0539**2), 0.3, settled=True)
    assert 50.0 + found.deviation[:, 0] == pytest.approx(EWMA, abs=0.006)
    # the handbook rounds the factor to 0.4201
    assert 3.0 * found.u[-1, 0] == pytest.approx(2.5884, abs=2e-3)
    assert not np.any(np.abs(found.z) > 3.0)


def test_the_first_values_of_an_ewma_have_less_scatter():
    """Montgomery, equation 9.25: sigma² lambda/(2 - lambda) (1 - (1 - lambda)^(2 t))."""
    found = judge(known(0.0), np.zeros((3, 1)), np.ones((3, 1, 1)), 0.1)
    assert found.u[:, 0] ** 2 == pytest.approx([0.01, 0.01 * 1.81, 0.01 * (1.81 + 0.9**4)])


def test_a_new_value_is_judged_by_students_t():
    values = np.array([[3.0], [4.0], [6.0], [5.0], [4.5]])
    centre = centre_of(values, np.ones((5, 1, 1)), "scaled")
    found = judge(centre, np.array([[9.0]]), np.ones((1, 1, 1)))
    # a new value against a sample: the pooled t of two samples, of which one has one value
    t, p, _ = DescrStatsW([9.0]).get_compare(DescrStatsW(values[:, 0])).ttest_ind()
    assert abs(found.z[0, 0]) == pytest.approx(abs(t))
    assert found.p[0, 0] == pytest.approx(p)
    assert found.p_joint[0] == pytest.approx(p)


def test_hotellings_t2_of_scatter_is_that_of_another_program():
    rng = np.random.default_rng(3)
    sample = rng.normal(size=(30, 4)) @ rng.normal(size=(4, 4))
    centre = centre_of(sample, np.tile(np.eye(4), (30, 1, 1)), "scatter")
    point = sample.mean(axis=0) + 2.0
    found = judge(centre, point[None], np.eye(4)[None])
    # theirs tests the mean: a new value has 1 + 1/m in place of 1/m
    other = hotelling(sample, point)
    assert found.t2[0] * (1.0 + 1.0 / 30) * 30 == pytest.approx(other.t2)
    assert found.p_joint[0] == pytest.approx(stats.f.sf(found.t2[0] * 26 / (4 * 29), 4, 26))


def test_limits_are_where_the_probabilities_are():
    rng = np.random.default_rng(4)
    sample, unit = rng.normal(size=(20, 3)), np.tile(np.eye(3), (20, 1, 1))
    for basis in ("stated", "scaled", "scatter"):
        centre = centre_of(sample, unit, basis)
        assert centre.p_joint(np.array(centre.joint_limit(0.003))) == pytest.approx(0.003)
        assert centre.p_single(np.array(centre.single_limit(0.003))) == pytest.approx(0.003)


@pytest.mark.parametrize(
    ("basis", "runs", "factor"),
    [("stated", 1, 1.0), ("scaled", 3, 1.0), ("scaled", 6, 1.7), ("scatter", 8, 0.5)],
)
def test_a_chart_of_few_baseline_runs_rejects_as_often_as_it_says(basis, runs, factor):
    """Seed 11; 8,000 baselines, each with two runs after it: 4 standard errors of 5 % are 17 % of it."""
    rng = np.random.default_rng(11)
    p, charts, nominal = 4, 8000, 0.05
    mixed = rng.normal(size=(p, p)) + 2.0 * np.eye(p)
    covariance = np.tile(mixed @ mixed.T, (runs, 1, 1))
    values = factor * rng.normal(size=(charts, runs + 2, p)) @ mixed.T
    centre = centre_of(values[:, :runs], covariance, basis)
    shewhart = judge(centre, values[:, runs:], covariance[[0, 0]] if runs < 2 else covariance[:2])
    ewma = judge(centre, values[:, runs:], np.tile(covariance[0], (2, 1, 1)), 0.2)
    for found in (shewhart, ewma):
        for rate in (np.mean(found.p_joint < nominal), np.mean(found.p[..., 0] < nominal)):
            assert rate == pytest.approx(nominal, rel=0.17)


def test_errors_that_runs_share_do_not_average_out_in_the_ewma():
    shared = np.ones((50, 1, 1))
    found = judge(known(0.0), np.zeros((50, 1)), np.full((50, 1, 1), 1e-6), 0.1, shared)
    assert found.u[-1, 0] == pytest.approx(1.0, abs=0.01)


def test_runs_of_different_u_are_weighed():
    values, covariances = np.array([[0.0], [10.0], [0.0]]), np.array([[[1.0]], [[100.0]], [[1.0]]])
    centre = centre_of(values, covariances, "stated")
    assert centre.value[0] == pytest.approx(0.1 / 2.01)
    assert centre.covariance[0, 0] == pytest.approx(1.0 / 2.01)


def test_a_run_of_the_baseline_is_judged_by_the_others():
    values = np.array([[0.0, 0.1], [0.2, -0.1], [9.0, 0.0], [-0.1, 0.0], [0.1, 0.1]])
    alone = without_one(values, np.tile(np.eye(2), (5, 1, 1)), "scaled")
    assert np.argmin(alone) == 2
    assert alone[2] < 1e-3
    assert without_one(values[:3], np.tile(np.eye(2), (3, 1, 1)), "scaled") is None


def test_too_few_runs_are_refused_with_what_to_do():
    with pytest.raises(
        CalibrationError, match="need a baseline of 14 runs for 12 coefficients, and there are 13"
    ):
        centre_of(np.zeros((13, 12)), np.tile(np.eye(12), (13, 1, 1)), "scatter")
