"""Run lengths against published tables, and the limits that follow from them."""

import numpy as np
import pytest

from bench.analysis.control_charts.run_length import (
    ewma_arl,
    ewma_k,
    mewma_arl,
    mewma_limit,
    shewhart_arl,
    shewhart_k,
)

SHIFTS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
LUCAS_SACCUCCI = {
    (0.40, 3.054): (500, 224, 71.2, 28.4, 14.3, 5.9, 3.5, 2.5, 2.0, 1.4),
    (0.25, 2.998): (500, 170, 48.2, 20.1, 11.1, 5.5, 3.6, 2.7, 2.3, 1.7),
    (0.20, 2.962): (500, 150, 41.8, 18.2, 10.5, 5.5, 3.7, 2.9, 2.4, 1.9),
    (0.10, 2.814): (500, 106, 31.3, 15.9, 10.3, 6.1, 4.4, 3.4, 2.9, 2.2),
    (0.05, 2.615): (500, 84.1, 28.8, 16.4, 11.4, 7.1, 5.2, 4.2, 3.5, 2.7),
}
"""Technometrics 32 (1990), table 3, as Montgomery has it: run lengths by (lambda, L) after a shift of so many s."""


def test_shewhart_charts_run_as_long_as_is_published():
    lengths = [shewhart_arl(3.0, shift) for shift in (0.0, 1.0, 2.0)]
    assert lengths == pytest.approx([370.4, 43.9, 6.3], rel=2e-3)
    assert shewhart_k(370.398) == pytest.approx(3.0, abs=1e-5)


@pytest.mark.parametrize(("design", "published"), LUCAS_SACCUCCI.items())
def test_ewma_charts_run_as_long_as_is_published(design, published):
    found = [ewma_arl(*design, shift) for shift in SHIFTS]
    # the table has three digits, or one after the point
    assert found == pytest.approx(published, rel=4e-3, abs=0.053)


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
