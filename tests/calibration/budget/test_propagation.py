"""Propagation against another library and published cases; those of the GUM are in `bench validate`."""

import GTC
import numpy as np
import pytest

from bench.calibration.budget.propagation import (
    coverage_factor,
    drawn,
    effective_dof,
    numerical_tolerance,
    require_trials,
    validate,
)
from bench.calibration.result import CalibrationError
from bench.model import Distribution
from bench.validation import gum
from bench.validation.gum import draws_of, independent, sampled

# --- linear -------------------------------------------------------------------------------------------


def test_independent_inputs_as_gtc_has_them():
    """A linear function of six inputs, seed 1: value, u and degrees of freedom to 1e-12."""
    rng = np.random.default_rng(1)
    x, u, c, dof = rng.normal(size=6), rng.uniform(0.1, 1.0, 6), rng.normal(size=6), [3, 5, 8, 13, 40, np.inf]
    uncertain = [GTC.ureal(*one) for one in zip(x, u, dof, strict=True)]
    theirs = sum(a * b for a, b in zip(c, uncertain, strict=True))
    ours = independent(c @ x, c, u, dof)
    assert ours.u[0] == pytest.approx(GTC.uncertainty(theirs), rel=1e-12)
    assert ours.dof[0] == pytest.approx(GTC.dof(theirs), rel=1e-12)
    expanded = GTC.reporting.k_factor(GTC.dof(theirs), 95) * GTC.uncertainty(theirs)
    assert ours.expanded(0.95)[0] == pytest.approx(expanded, rel=1e-6)


def test_no_finite_dof_is_infinite():
    assert np.isinf(effective_dof(np.array([[1.0, 2.0]]), [np.inf, np.inf])[0])
    assert np.isinf(effective_dof(np.array([[0.0, 2.0]]), [3.0, np.inf])[0])
    assert coverage_factor(np.inf) == pytest.approx(2.0, abs=1e-4)


def test_impedance_of_h2_as_a_vector_by_monte_carlo():
    """JCGM 102:2011, 7: 200 000 normal draws of the three inputs; seed 1."""
    linear, mean, covariance = gum.linear_impedance()
    np.testing.assert_allclose(linear.dof, 4.0)
    rng = np.random.default_rng(1)
    draws = mean + rng.standard_normal((200_000, 3)) @ np.linalg.cholesky(covariance).T
    found = sampled(gum.impedance, draws)
    np.testing.assert_allclose(found.mean, linear.value, atol=4 * linear.u.max() / np.sqrt(200_000) + 1e-3)
    np.testing.assert_allclose(found.u, linear.u, rtol=4 / np.sqrt(400_000) + 1e-3)
    size = np.outer(linear.u, linear.u)
    np.testing.assert_allclose(found.covariance / size, linear.covariance / size, atol=0.01)


# --- Supplement 1 -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", gum.FOUR)
def test_the_sum_of_four_inputs_of_9_2(name):
    """Closer than the tolerance of `bench validate`; the shortest interval too, where the sum is nearly normal."""
    _, u, end, linear_end, _ = gum.FOUR[name]
    linear, found = gum.sum_of_four(name)
    assert found.u[0] == pytest.approx(u, rel=0.006)
    np.testing.assert_allclose(found.symmetric[0], [-end, end], atol=0.06 if u > 5 else 0.04)
    if end == linear_end:
        np.testing.assert_allclose(found.shortest[0], [-end, end], atol=0.04)
    else:  # 3.88 beside 3.92: valid at a tolerance of 0.05, not of 0.005
        assert not validate(linear, found, 3).validated[0]


@pytest.mark.parametrize(
    ("u", "digits", "delta"),
    [(0.035, 2, 0.0005), (0.035, 1, 0.005), (2.0, 2, 0.05), (0.0996, 2, 0.005), (0.0, 2, 0.0)],
)
def test_numerical_tolerance(u, digits, delta):
    """JCGM 101:2008, 7.9.2: half a unit of the last digit; 0.0996 rounds to 0.10."""
    assert numerical_tolerance(u, digits) == pytest.approx(delta)


def test_a_scaled_t_has_its_wider_spread():
    """u sqrt(nu/(nu - 2)) for finite degrees of freedom (JCGM 101:2008, 6.4.9.4)."""
    draws = drawn(Distribution(0.5), (200_000,), np.random.default_rng(2), 10.0)
    assert draws.std() == pytest.approx(0.5 * np.sqrt(10 / 8), rel=0.01)


def test_mistakes_are_told():
    with pytest.raises(CalibrationError, match="give 2198 or more"):
        require_trials(100)
    with pytest.raises(CalibrationError, match="give no finite result"), np.errstate(invalid="ignore"):
        sampled(np.log, draws_of(1, (0.0, Distribution(1.0))))
