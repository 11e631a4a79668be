"""Linear propagation: degrees of freedom against another library, regions against draws, what is refused."""

import GTC
import numpy as np
import pytest

from bench.calibration.budget.propagation import (
    Inputs,
    Propagated,
    about,
    coverage_factor,
    effective_dof,
    linear_noise,
    monte_carlo,
    numerical_tolerance,
    propagate,
)
from bench.calibration.result import CalibrationError
from bench.model import Distribution


def test_independent_inputs_as_gtc_has_them():
    """A linear function of six inputs, seed 1: value, u and degrees of freedom to 1e-12."""
    rng = np.random.default_rng(1)
    x, u, c, dof = rng.normal(size=6), rng.uniform(0.1, 1.0, 6), rng.normal(size=6), [3, 5, 8, 13, 40, np.inf]
    uncertain = [GTC.ureal(*one) for one in zip(x, u, dof, strict=True)]
    theirs = sum(a * b for a, b in zip(c, uncertain, strict=True))
    ours = propagate([c @ x], [c], Inputs.independent(x, u, dof))
    assert ours.value[0] == pytest.approx(GTC.value(theirs), rel=1e-12)
    assert ours.u[0] == pytest.approx(GTC.uncertainty(theirs), rel=1e-12)
    assert ours.dof[0] == pytest.approx(GTC.dof(theirs), rel=1e-12)
    expanded = GTC.reporting.k_factor(GTC.dof(theirs), 95) * GTC.uncertainty(theirs)
    assert ours.expanded(0.95)[0] == pytest.approx(expanded, rel=1e-6)


def test_inputs_found_together_as_gtc_has_them():
    r = np.array([[1.0, -0.3, 0.5], [-0.3, 1.0, 0.1], [0.5, 0.1, 1.0]])
    u, c = np.array([1.0, 2.0, 0.5]), np.array([[1.0, 0.5, -2.0], [0.0, 1.0, 1.0]])
    uncertain = GTC.multiple_ureal([0.0, 0.0, 0.0], u.tolist(), 7)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        GTC.set_correlation(r[i, j], uncertain[i], uncertain[j])
    theirs = [sum(a * b for a, b in zip(row, uncertain, strict=True)) for row in c]
    ours = propagate(np.zeros(2), c, Inputs.together(np.zeros(3), u, r, 7))
    np.testing.assert_allclose(ours.u, [GTC.uncertainty(one) for one in theirs], rtol=1e-12)
    assert ours.correlation[0, 1] == pytest.approx(GTC.get_correlation(*theirs), rel=1e-12)
    np.testing.assert_allclose(ours.dof, 7.0)


def test_no_finite_dof_is_infinite():
    assert np.isinf(effective_dof(np.array([[1.0, 2.0]]), [np.inf, np.inf])[0])
    assert np.isinf(effective_dof(np.array([[0.0, 2.0]]), [3.0, np.inf])[0])
    assert coverage_factor(np.inf) == pytest.approx(2.0, abs=1e-4)


@pytest.mark.parametrize(("dof", "bound"), [(np.inf, 0.003), (8.0, 0.003)])
def test_a_region_covers_what_it_says(dof, bound):
    """The ellipsoid for two outputs of normal or t draws, 100 000 of them: four standard errors."""
    rng = np.random.default_rng(3)
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    k = Propagated(np.zeros(2), covariance, np.full(2, dof)).region_factor(0.95)
    draws = rng.multivariate_normal(np.zeros(2), covariance, 100_000)
    if np.isfinite(dof):
        draws /= np.sqrt(rng.chisquare(dof, 100_000) / dof)[:, None]
    inside = np.einsum("ni,ij,nj->n", draws, np.linalg.inv(covariance), draws) <= k**2
    assert np.mean(inside) == pytest.approx(0.95, abs=bound)
    if np.isinf(dof):
        assert k == pytest.approx(2.45, abs=5e-3)


def test_mistakes_are_told():
    inputs = Inputs.independent([1.0, 2.0], [0.1, 0.1])
    with pytest.raises(CalibrationError, match="do not fit 2 inputs"):
        propagate([0.0], [[1.0, 2.0, 3.0]], inputs)
    impossible = Inputs.together(
        np.zeros(3), np.ones(3), [[1.0, 0.9, -0.9], [0.9, 1.0, 0.9], [-0.9, 0.9, 1.0]]
    )
    with pytest.raises(CalibrationError, match="negative eigenvalue"):
        propagate([0.0], [[1.0, 1.0, 1.0]], impossible)
    across = Inputs(np.zeros(2), np.array([[1.0, 0.5], [0.5, 1.0]]), (3.0, 4.0))
    with pytest.raises(CalibrationError, match="different groups are correlated"):
        propagate([0.0], [[1.0, 1.0]], across)
    with pytest.raises(CalibrationError, match="between 0 and 1"):
        coverage_factor(5.0, 95.0)


def test_too_few_trials_are_refused():
    with pytest.raises(CalibrationError, match="take 2000 or more"):
        monte_carlo(lambda x: x, about(0.0, Distribution(1.0)), np.random.default_rng(1), 100, 0.95)


def test_a_function_without_a_number_is_refused():
    with pytest.raises(CalibrationError, match="gives no number"), np.errstate(invalid="ignore"):
        monte_carlo(np.log, about(0.0, Distribution(1.0)), np.random.default_rng(1), 4000, 0.95)


@pytest.mark.parametrize(
    ("u", "digits", "delta"),
    [(0.035, 2, 0.0005), (0.035, 1, 0.005), (2.0, 2, 0.05), (0.0996, 2, 0.005), (0.0, 2, 0.0)],
)
def test_numerical_tolerance(u, digits, delta):
    """JCGM 101:2008, 7.9.2: half a unit of the last digit; 0.0996 rounds to 0.10."""
    assert numerical_tolerance(u, digits) == pytest.approx(delta)


def test_a_scaled_t_has_its_wider_spread():
    """u sqrt(nu/(nu - 2)) for finite degrees of freedom (JCGM 101:2008, 6.4.9.4)."""
    found = monte_carlo(lambda x: x, about(1.0, Distribution(0.5), 10.0), np.random.default_rng(2), 200_000)
    assert found.u[0] == pytest.approx(0.5 * np.sqrt(10 / 8), rel=0.01)


def test_fast_noise_agrees_with_the_linear_covariance():
    """300 001 trials, an odd number of inputs; a variance to 5 standard errors, sqrt(2/n)."""
    rng = np.random.default_rng(4)
    gain, sigma = rng.normal(size=(4, 7)), rng.uniform(0.5, 2.0, 7)
    found = linear_noise(gain, sigma, 5, 300_001)
    expected = (gain * sigma**2) @ gain.T
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert found.trials == 300_001
    np.testing.assert_allclose(found.covariance / size, expected / size, atol=5 * np.sqrt(2 / 300_000))
    np.testing.assert_allclose(found.mean / found.u, 0.0, atol=5 / np.sqrt(300_000))
