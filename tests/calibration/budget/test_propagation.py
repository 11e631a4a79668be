"""Propagation against published cases and another library: GUM H.1 to H.3; Supplement 1, 9.2 and 9.3.

The sensitivities are the tests' own; what is under test are degrees of freedom, factors, intervals, validation.
"""

import GTC
import numpy as np
import pytest

from bench.calibration.budget.propagation import (
    Propagated,
    coverage_factor,
    drawn,
    effective_dof,
    numerical_tolerance,
    require_trials,
    summary,
    validate,
)
from bench.calibration.result import CalibrationError
from bench.model import Distribution

UNIT_RECTANGLE = Distribution(np.sqrt(3.0), "rectangular")
TRIALS = 400_000


def independent(value, rows, u, dof=np.inf):
    """Outputs of independent inputs: a source each."""
    rows = np.atleast_2d(rows)
    parts = (rows * u) ** 2
    return Propagated(np.atleast_1d(value), (rows * np.square(u)) @ rows.T,
                      effective_dof(parts, np.broadcast_to(dof, parts.shape[1:])))  # fmt: skip


def together(value, rows, covariance, dof):
    """Outputs of inputs that were found together: one source."""
    whole = rows @ covariance @ rows.T
    return Propagated(value, whole, effective_dof(np.diag(whole)[:, None], [dof]))


def sampled(function, draws, probability=0.95):
    return summary(np.asarray(function(draws)).reshape(len(draws), -1), probability)


def draws_of(seed, *inputs):
    rng = np.random.default_rng(seed)
    return np.stack([mean + drawn(d, (TRIALS,), rng) for mean, d in inputs], axis=-1)


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


def test_end_gauge_of_h1():
    """l = ls + d - ls (da theta + as dtheta), nm: u = 32 nm, 16 degrees of freedom, U99 = 93 nm."""
    # ls, mean difference, its random and systematic comparator effects, delta alpha, delta theta
    u = np.array([25.0, 5.8, 3.9, 6.7, 1e-6 / np.sqrt(3.0), 0.05 / np.sqrt(3.0)])
    sensitivity = [1.0, 1.0, 1.0, 1.0, -50_000_623.0 * -0.1, -50_000_623.0 * 11.5e-6]
    result = independent(50_000_838.0, sensitivity, u, [18, 24, 5, 8, 50, 2])
    assert result.u[0] == pytest.approx(32.0, abs=0.5)
    assert np.floor(result.dof[0]) == 16
    assert coverage_factor(16, 0.99) == pytest.approx(2.92, abs=0.005)
    assert coverage_factor(16, 0.99) * result.u[0] == pytest.approx(93.0, abs=1.0)


VOLTS = np.array([5.007, 4.994, 5.005, 4.990, 4.999])
AMPERES = np.array([19.663, 19.639, 19.640, 19.685, 19.678]) * 1e-3
PHASE = np.array([1.0456, 1.0438, 1.0468, 1.0428, 1.0433])


def impedance(x):
    """R, X, Z of V, I, phi along the last axis."""
    ratio = x[..., 0] / x[..., 1]
    return np.stack([ratio * np.cos(x[..., 2]), ratio * np.sin(x[..., 2]), ratio], axis=-1)


def test_impedance_of_h2_linear_and_as_a_vector_by_monte_carlo():
    """The published values, then JCGM 102:2011, 7: 200 000 normal draws of the three inputs."""
    samples = np.stack([VOLTS, AMPERES, PHASE])
    mean, covariance = samples.mean(axis=1), np.cov(samples) / 5
    v, i, phi = mean
    c, s = np.cos(phi), np.sin(phi)
    jacobian = np.array(
        [[c / i, -v * c / i**2, -v / i * s], [s / i, -v * s / i**2, v / i * c], [1 / i, -v / i**2, 0]]
    )
    linear = together(impedance(mean), jacobian, covariance, 4)
    np.testing.assert_allclose(linear.value, [127.732, 219.847, 254.260], atol=5e-4)
    # published from rounded correlations
    np.testing.assert_allclose(linear.u, [0.071, 0.295, 0.236], atol=7e-4)
    r = linear.correlation
    np.testing.assert_allclose([r[0, 1], r[0, 2], r[1, 2]], [-0.588, -0.485, 0.993], atol=5e-4)
    np.testing.assert_allclose(linear.dof, 4.0)
    rng = np.random.default_rng(1)
    found = sampled(impedance, mean + rng.standard_normal((200_000, 3)) @ np.linalg.cholesky(covariance).T)
    np.testing.assert_allclose(found.mean, linear.value, atol=4 * linear.u.max() / np.sqrt(200_000) + 1e-3)
    np.testing.assert_allclose(found.u, linear.u, rtol=4 / np.sqrt(400_000) + 1e-3)
    size = np.outer(linear.u, linear.u)
    np.testing.assert_allclose(found.covariance / size, linear.covariance / size, atol=0.01)


T_C = np.array([21.521, 22.012, 22.512, 23.003, 23.507, 23.999, 24.513, 25.002, 25.503, 26.010, 26.511])
B_C = np.array([-0.171, -0.169, -0.166, -0.159, -0.164, -0.165, -0.156, -0.157, -0.159, -0.161, -0.160])


def test_thermometer_of_h3():
    """Intercept and slope of a line, and its correction at 30 degrees, from eleven observations."""
    columns = np.column_stack([np.ones(11), T_C - 20.0])
    gain = np.linalg.pinv(columns)
    s = np.sqrt(np.sum((B_C - columns @ gain @ B_C) ** 2) / 9)
    assert s == pytest.approx(0.0035, abs=5e-5)
    rows = np.vstack([gain, gain[0] + 10.0 * gain[1]])
    result = together(rows @ B_C, rows, s**2 * np.eye(11), 9)
    half_digit = np.array([5e-5, 5e-6, 5e-5])
    assert np.all(np.abs(result.value - [-0.1712, 0.00218, -0.1494]) <= half_digit)
    assert np.all(np.abs(result.u - [0.0029, 0.00067, 0.0041]) <= half_digit)
    assert result.correlation[0, 1] == pytest.approx(-0.930, abs=5e-4)
    np.testing.assert_allclose(result.dof, 9.0)


# --- Supplement 1 -------------------------------------------------------------------------------------

FOUR = {
    # inputs of mean zero, u of the sum, ends by Monte Carlo and linear, what validates at two digits
    "normal 9.2.2": ([Distribution(1.0)] * 4, 2.0, 3.92, 3.92, True),
    "rectangular 9.2.3": ([UNIT_RECTANGLE] * 4, 2.0, 3.88, 3.92, True),
    "one dominates 9.2.4": (
        [UNIT_RECTANGLE] * 3 + [Distribution(10 * np.sqrt(3.0), "rectangular")], 10.1, 17.0, 19.9, False,
    ),
}  # fmt: skip


@pytest.mark.parametrize(("inputs", "u", "end", "linear_end", "valid"), FOUR.values(), ids=FOUR)
def test_the_sum_of_four_inputs_of_9_2(inputs, u, end, linear_end, valid):
    found = sampled(lambda x: x.sum(axis=-1), draws_of(2, *((0.0, d) for d in inputs)))
    assert found.u[0] == pytest.approx(u, rel=0.006)
    np.testing.assert_allclose(found.symmetric[0], [-end, end], atol=0.06 if u > 5 else 0.04)
    if end == linear_end:
        np.testing.assert_allclose(found.shortest[0], [-end, end], atol=0.04)
    linear = independent(0.0, np.ones(4), np.array([d.u for d in inputs]))
    assert linear.expanded(0.95)[0] == pytest.approx(linear_end, abs=0.05)
    assert validate(linear, found, 2).validated[0] == valid
    if end != linear_end:  # 3.88 beside 3.92: valid at a tolerance of 0.05, not of 0.005
        assert not validate(linear, found, 3).validated[0]


def test_mass_calibration_of_9_3():
    """Deviation of a weight from nominal, mg: the density terms vanish to first order, not in truth."""

    def deviation(x):
        mass, difference, air, weight, reference = np.moveaxis(x, -1, 0)
        return (mass + difference) * (1 + (air - 1.2) * (1 / weight - 1 / reference)) - 100_000.0

    draws = draws_of(
        6,
        (100_000.0, Distribution(0.050)),
        (1.234, Distribution(0.020)),
        (1.2, Distribution(0.1, "rectangular")),
        (8000.0, Distribution(1000.0, "rectangular")),
        (8000.0, Distribution(50.0, "rectangular")),
    )
    found = sampled(deviation, draws)
    assert found.mean[0] == pytest.approx(1.2341, abs=4 * 0.0754 / np.sqrt(TRIALS) + 5e-5)
    assert found.u[0] == pytest.approx(0.0754, rel=4 / np.sqrt(2 * TRIALS) + 1e-3)
    np.testing.assert_allclose(found.shortest[0], [1.0834, 1.3825], atol=2e-3)
    linear = independent(1.234, [1.0, 1.0, 0.0, 0.0, 0.0], np.array([0.050, 0.020, 0.0577, 577.0, 28.9]))
    assert linear.u[0] == pytest.approx(0.0539, abs=5e-5)
    verdict = validate(linear, found, 1)
    assert verdict.tolerance[0] == pytest.approx(0.005)
    assert not verdict.validated[0]


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
    with pytest.raises(CalibrationError, match="between 0 and 1"):
        coverage_factor(5.0, 95.0)
    with pytest.raises(CalibrationError, match="give 2000 or more"):
        require_trials(100, 0.95)
    with pytest.raises(CalibrationError, match="the function fails"), np.errstate(invalid="ignore"):
        sampled(np.log, draws_of(1, (0.0, Distribution(1.0))))
