"""Control charts: handbook, published run lengths, the kilogram check standard, false rejections."""

from itertools import accumulate

import numpy as np
import pytest
from scipy import stats

from bench.calibration.result import CalibrationError
from bench.stats.control_charts import (
    Centre,
    StatedDof,
    centre_of,
    components_of,
    ewma_arl,
    ewma_k,
    judge,
    mewma_arl,
    mewma_limit,
    shewhart_arl,
    shewhart_k,
    without_one,
)
from bench.validation.registry import REFERENCE

HANDBOOK = np.array([
    52.0, 47.0, 53.0, 49.3, 50.1, 47.0, 51.0, 50.1, 51.2, 50.5,
    49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6, 52.1,
])  # fmt: skip
EWMA = np.array([
    50.60, 49.52, 50.56, 50.18, 50.16, 49.21, 49.75, 49.85, 50.26, 50.33,
    50.11, 49.36, 49.52, 50.05, 49.38, 49.92, 50.73, 51.23, 51.94, 51.99,
])  # fmt: skip
"""NIST/SEMATECH e-Handbook, 6.3.2.4: mean 50, s = 2.0539, lambda = 0.3, limits 52.5884 and 47.4115."""
LUCAS_SACCUCCI = {
    (0.40, 3.054): (500, 224, 71.2, 28.4, 14.3, 5.9, 3.5, 2.5, 2.0, 1.4),
    (0.25, 2.998): (500, 170, 48.2, 20.1, 11.1, 5.5, 3.6, 2.7, 2.3, 1.7),
    (0.20, 2.962): (500, 150, 41.8, 18.2, 10.5, 5.5, 3.7, 2.9, 2.4, 1.9),
    (0.10, 2.814): (500, 106, 31.3, 15.9, 10.3, 6.1, 4.4, 3.4, 2.9, 2.2),
    (0.05, 2.615): (500, 84.1, 28.8, 16.4, 11.4, 7.1, 5.2, 4.2, 3.5, 2.7),
}
SHIFTS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
"""Shifts in standard deviations.

Source: Lucas and Saccucci (1990), table 3, quoted in D. C. Montgomery, Introduction to Statistical Quality
Control.
"""


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
    from statsmodels.stats.weightstats import DescrStatsW

    values = np.array([[3.0], [4.0], [6.0], [5.0], [4.5]])
    centre = centre_of(values, np.ones((5, 1, 1)), "scaled")
    found = judge(centre, np.array([[9.0]]), np.ones((1, 1, 1)))
    # a new value against a sample: the pooled t of two samples, of which one has one value
    t, p, _ = DescrStatsW([9.0]).get_compare(DescrStatsW(values[:, 0])).ttest_ind()
    assert abs(found.z[0, 0]) == pytest.approx(abs(t))
    assert found.p[0, 0] == pytest.approx(p)
    assert found.p_joint[0] == pytest.approx(p)


def test_hotellings_t2_of_scatter_is_that_of_another_program():
    from statsmodels.stats.multivariate import test_mvmean as hotelling

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


DATA = REFERENCE / "kilogram-check.csv"
SMOOTHING = 0.2
YEAR, VALUE, SD = np.loadtxt(DATA, delimiter=",", skiprows=1).T
BASELINE = YEAR < 1985.0
MEAN, LONG_TERM = VALUE[BASELINE].mean(), VALUE[BASELINE].std(ddof=1)


def judged(smoothing=1.0, **settings):
    unit = np.ones((len(YEAR), 1, 1))
    centre = centre_of(VALUE[BASELINE, None], unit[BASELINE], "scatter")
    return judge(centre, VALUE[~BASELINE, None], unit[~BASELINE], smoothing, **settings)


def test_the_limits_are_those_of_the_scatter_before_1985():
    found = judged()
    assert found.deviation[:, 0] == pytest.approx(VALUE[~BASELINE] - MEAN)
    # a new value scatters about a mean that is itself of 99 values
    assert found.u[:, 0] == pytest.approx(LONG_TERM * np.sqrt(1 + 1 / 99))


def test_single_values_are_out_more_often_than_chance_allows():
    """At k = 2 one in 22 is out by chance: the handbook's chart has far more after 1985."""
    out = np.abs(judged().z[:, 0]) > 2.0
    before = np.abs(VALUE[BASELINE] - MEAN) > 2.0 * LONG_TERM
    assert stats.binomtest(int(before.sum()), len(before), 0.0455).pvalue > 0.05
    assert stats.binomtest(int(out.sum()), len(out), 0.0455).pvalue < 1e-5


def test_the_ewma_shows_the_shift_that_single_values_hardly_show():
    found = judged(SMOOTHING, settled=True)
    values = list(
        accumulate(VALUE[~BASELINE], lambda z, y: (1 - SMOOTHING) * z + SMOOTHING * y, initial=MEAN)
    )
    assert found.deviation[:, 0] == pytest.approx(np.array(values[1:]) - MEAN)
    ewma, shewhart = np.abs(found.z[:, 0]) > 3.0, np.abs(judged().z[:, 0]) > 3.0
    assert np.mean(ewma[-60:]) > 0.5
    assert np.mean(shewhart[-60:]) < 0.05


OF_FEW_AND_MANY = {
    (0.50, 3.071): (500, 255, 88.8, 35.9, 17.5, 6.53, 3.63, 2.50, 1.93, 1.58, 1.34, 1.07),
    (0.03, 2.437): (500, 76.7, 29.3, 17.6, 12.6, 8.07, 5.99, 4.80, 4.03, 3.49, 3.11, 2.55),
}
"""The same table at other shifts, as the manual of `spc` 0.7 for R has it (`xewma.arl`)."""
CROWDER = {
    0.50: (
        26.45, 20.12, 11.89, 7.29, 4.91, None, 2.80, 2.29,
        1.94, 1.70, 1.51, 1.37, 1.26, 1.18, 1.12, 1.08, 1.05,
    ),
    0.05: (
        127.53, 43.94, 18.97, 11.64, 8.38, 6.56, 5.41, 4.62,
        4.04, 3.61, 3.26, 2.99, 2.76, 2.56, 2.39, 2.26, 2.15,
    ),
}  # fmt: skip
"""Technometrics 29 (1987), table 1, limits at 2, shifts in steps of a quarter, after the same manual.

That manual takes the 3.95 that is printed for lambda 0.5 at a shift of 1.25 for a misprint; it is left out.
"""


def test_shewhart_charts_run_as_long_as_is_published():
    lengths = [shewhart_arl(3.0, shift) for shift in (0.0, 1.0, 2.0)]
    assert lengths == pytest.approx([370.4, 43.9, 6.3], rel=2e-3)
    assert shewhart_k(370.398) == pytest.approx(3.0, abs=1e-5)


@pytest.mark.parametrize(("design", "published"), LUCAS_SACCUCCI.items())
def test_ewma_charts_run_as_long_as_is_published(design, published):
    found = [ewma_arl(*design, shift) for shift in SHIFTS]
    # the table has three digits, or one after the point
    assert found == pytest.approx(published, rel=4e-3, abs=0.053)


@pytest.mark.parametrize(("design", "published"), OF_FEW_AND_MANY.items())
def test_ewma_charts_of_long_and_short_memory_run_as_long_as_is_published(design, published):
    shifts = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0)
    found = [ewma_arl(*design, shift) for shift in shifts]
    assert found == pytest.approx(published, rel=4e-3, abs=0.006)


@pytest.mark.parametrize(("smoothing", "published"), CROWDER.items())
def test_charts_of_narrow_limits_run_as_long_as_crowder_has_it(smoothing, published):
    rows = [(number / 4, length) for number, length in enumerate(published) if length is not None]
    found = [ewma_arl(smoothing, 2.0, shift) for shift, _ in rows]
    assert found == pytest.approx([length for _, length in rows], abs=0.011)


def test_another_program_finds_the_same_run_length():
    """SAS/QC user's guide, function EWMAARL, example: a shift of 1 s, r = 0.25, limits at 3."""
    assert ewma_arl(0.25, 3.0, 1.0) == pytest.approx(11.154267016, abs=1e-6)


def test_another_program_finds_the_same_multivariate_run_length():
    """MEWMA-ARLs of Molnau et al., J. Quality Technology 33 (2001), as the manual of `spc` has its output."""
    assert mewma_arl(0.1, 12.73, 4) == pytest.approx(199.78, rel=5e-3)


@pytest.mark.slow
def test_in_many_dimensions_it_is_that_of_simulated_charts():
    """Seed 5, 20,000 charts of 20 dimensions; that program's Markov chain of 25 states gives 199.09 there."""
    rng, charts, smoothing, limit, p = np.random.default_rng(5), 20_000, 0.1, 37.01, 20
    lengths, run, square = np.empty(charts), np.arange(charts), np.zeros(charts)
    step = 0
    while len(run):
        step += 1
        along = (1 - smoothing) * np.sqrt(square) + smoothing * rng.normal(size=len(run))
        square = along**2 + smoothing**2 * rng.chisquare(p - 1, len(run))
        out = square > limit * smoothing / (2 - smoothing)
        lengths[run[out]] = step
        run, square = run[~out], square[~out]
    error = lengths.std() / np.sqrt(charts)
    assert mewma_arl(smoothing, limit, p) == pytest.approx(lengths.mean(), abs=4 * error)


@pytest.mark.parametrize(
    ("smoothing", "published"),
    [(1.0, 3.090), (0.5, 3.071), (0.3, 3.023), (0.25, 2.998), (0.1, 2.814), (0.05, 2.615), (0.03, 2.437)],
)
def test_the_limit_for_a_run_length_of_500_is_the_published_one(smoothing, published):
    assert ewma_k(smoothing, 500.0) == pytest.approx(published, abs=1e-3)


@pytest.mark.parametrize(("dimensions", "published"), [(2, 8.64), (4, 12.73), (10, 22.67)])
def test_the_limit_of_a_multivariate_ewma_is_the_published_one(dimensions, published):
    """S. S. Prabhu and G. C. Runger, J. Quality Technology 29 (1997), 8-15: lambda 0.1, ARL 200."""
    assert mewma_limit(0.1, 200.0, dimensions) == pytest.approx(published, rel=2e-3)


def test_of_one_dimension_the_multivariate_ewma_is_the_ewma():
    assert mewma_arl(0.2, 2.962**2, 1) == pytest.approx(ewma_arl(0.2, 2.962), rel=1e-3)


def test_without_memory_a_chart_is_shewharts():
    assert mewma_arl(1.0, 9.0, 1) == pytest.approx(shewhart_arl(3.0), rel=1e-9)
    assert ewma_arl(1.0, 3.0, 1.0) == shewhart_arl(3.0, 1.0)


def test_a_baseline_of_good_runs_contradicts_the_u_of_a_noise_from_few_readings_by_chance_only():
    """Thirty runs, whose noise has 22 degrees of freedom each, for which the stated covariance is widened."""
    rng, count, runs, dof = np.random.default_rng(19), 500, 30, 22.0
    known, below = StatedDof(runs * dof, dof / (dof - 2)), 0
    for _ in range(count):
        stated = np.mean(rng.chisquare(dof, runs)) / (dof - 2) * np.eye(9)
        below += components_of(rng.normal(size=(runs, 9)), stated, np.ones(9), known).birge_p < 0.1
    assert below == pytest.approx(0.1 * count, abs=4 * np.sqrt(0.09 * count))
