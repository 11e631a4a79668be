"""Run lengths against published tables, and the limits that follow from them."""

import numpy as np
import pytest

from bench.stats.control_charts import ewma_arl, ewma_k, mewma_arl, mewma_limit, shewhart_arl, shewhart_k

SHIFTS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
LUCAS_SACCUCCI = {
    (0.40, 3.054): (500, 224, 71.2, 28.4, 14.3, 5.9, 3.5, 2.5, 2.0, 1.4),
    (0.25, 2.998): (500, 170, 48.2, 20.1, 11.1, 5.5, 3.6, 2.7, 2.3, 1.7),
    (0.20, 2.962): (500, 150, 41.8, 18.2, 10.5, 5.5, 3.7, 2.9, 2.4, 1.9),
    (0.10, 2.814): (500, 106, 31.3, 15.9, 10.3, 6.1, 4.4, 3.4, 2.9, 2.2),
    (0.05, 2.615): (500, 84.1, 28.8, 16.4, 11.4, 7.1, 5.2, 4.2, 3.5, 2.7),
}
"""Technometrics 32 (1990), table 3, as Montgomery has it: run lengths by (lambda, L) after a shift of so many s."""

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


def test_simulated_run_lengths_agree_with_the_integral_equation():
    """Seed 5; 4,000 runs of mean 10.5 and standard deviation below 7: 4.5 standard errors are 0.5."""
    rng = np.random.default_rng(5)
    state, alive, lengths = np.zeros(4000), np.arange(4000), np.zeros(4000)
    limit = 2.962 * np.sqrt(0.2 / 1.8)
    for step in range(1, 400):
        state = 0.2 * (1.0 + rng.normal(size=len(alive))) + 0.8 * state
        out = np.abs(state) > limit
        lengths[alive[out]] = step
        alive, state = alive[~out], state[~out]
    assert len(alive) == 0
    assert lengths.mean() == pytest.approx(ewma_arl(0.2, 2.962, 1.0), abs=0.5)
