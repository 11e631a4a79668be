"""Published cases: GUM H.1, H.2, H.3 (JCGM 100:2008) and Supplement 1, 9.2 and 9.3 (JCGM 101:2008)."""

import numpy as np
import pytest

from bench.calibration.budget.propagation import (
    Inputs,
    about,
    adaptive_monte_carlo,
    coverage_factor,
    joint,
    monte_carlo,
    propagate,
    validate,
)
from bench.model import Distribution

UNIT_RECTANGLE = Distribution(np.sqrt(3.0), "rectangular")


def test_end_gauge_of_h1():
    """l = ls + d - ls (da theta + as dtheta), nm: u = 32 nm, 16 degrees of freedom, U99 = 93 nm."""
    # ls, mean difference, its random and systematic comparator effects, delta alpha, delta theta
    value = [50_000_623.0, 215.0, 0.0, 0.0, 0.0, 0.0]
    u = [25.0, 5.8, 3.9, 6.7, 1e-6 / np.sqrt(3.0), 0.05 / np.sqrt(3.0)]
    inputs = Inputs.independent(value, u, [18, 24, 5, 8, 50, 2])
    sensitivity = [1.0, 1.0, 1.0, 1.0, -50_000_623.0 * -0.1, -50_000_623.0 * 11.5e-6]
    result = propagate([50_000_838.0], [sensitivity], inputs)
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


def impedance_inputs():
    samples = np.stack([VOLTS, AMPERES, PHASE])
    u = samples.std(axis=1, ddof=1) / np.sqrt(5)
    return Inputs.together(samples.mean(axis=1), u, np.corrcoef(samples), dof=4)


def impedance_linear():
    inputs = impedance_inputs()
    v, i, phi = inputs.value
    c, s = np.cos(phi), np.sin(phi)
    jacobian = np.array(
        [[c / i, -v * c / i**2, -v / i * s], [s / i, -v * s / i**2, v / i * c], [1 / i, -v / i**2, 0]]
    )
    return propagate(impedance(inputs.value), jacobian, inputs)


def test_impedance_of_h2():
    result = impedance_linear()
    np.testing.assert_allclose(result.value, [127.732, 219.847, 254.260], atol=5e-4)
    # published from rounded correlations
    np.testing.assert_allclose(result.u, [0.071, 0.295, 0.236], atol=7e-4)
    r = result.correlation
    np.testing.assert_allclose([r[0, 1], r[0, 2], r[1, 2]], [-0.588, -0.485, 0.993], atol=5e-4)
    np.testing.assert_allclose(result.dof, 4.0)


def test_impedance_of_h2_as_a_vector_by_monte_carlo():
    """The same as three outputs together (JCGM 102:2011, 7): 200 000 normal draws of the three inputs."""
    inputs, linear = impedance_inputs(), impedance_linear()
    root = np.linalg.cholesky(inputs.covariance)
    found = monte_carlo(
        impedance,
        lambda rng, n: inputs.value + rng.standard_normal((n, 3)) @ root.T,
        np.random.default_rng(1),
        200_000,
    )
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
    inputs = Inputs.together(B_C, np.full(11, s), np.eye(11), dof=9)
    rows = np.vstack([gain, gain[0] + 10.0 * gain[1]])
    result = propagate(rows @ B_C, rows, inputs)
    half_digit = np.array([5e-5, 5e-6, 5e-5])
    assert np.all(np.abs(result.value - [-0.1712, 0.00218, -0.1494]) <= half_digit)
    assert np.all(np.abs(result.u - [0.0029, 0.00067, 0.0041]) <= half_digit)
    assert result.correlation[0, 1] == pytest.approx(-0.930, abs=5e-4)
    np.testing.assert_allclose(result.dof, 9.0)


# --- Supplement 1, 9.2: the sum of four inputs of mean zero -----------------------------------------

TRIALS = 400_000


def total(x):
    return x.sum(axis=-1)


def four(*distributions):
    return joint(*(about(0.0, d) for d in distributions))


def linear_sum(*u):
    return propagate([0.0], [np.ones(4)], Inputs.independent(np.zeros(4), u))


def ends(found):
    return [*found.symmetric[0], *found.shortest[0]]


def test_four_normal_inputs_of_9_2_2():
    draw = four(*[Distribution(1.0)] * 4)
    found = monte_carlo(total, draw, np.random.default_rng(2), TRIALS, 0.95)
    assert found.u[0] == pytest.approx(2.0, abs=0.01)
    np.testing.assert_allclose(ends(found), [-3.92, 3.92] * 2, atol=0.04)
    linear = linear_sum(1.0, 1.0, 1.0, 1.0)
    assert linear.expanded(0.95)[0] == pytest.approx(3.92, abs=5e-3)
    assert validate(linear, found, 2).validated[0]


def test_four_rectangular_inputs_of_9_2_3():
    """Ends 3.88 beside 3.92: valid at a tolerance of 0.05, not of 0.005."""
    draw = four(*[UNIT_RECTANGLE] * 4)
    found = monte_carlo(total, draw, np.random.default_rng(3), TRIALS, 0.95)
    assert found.u[0] == pytest.approx(2.0, abs=0.01)
    np.testing.assert_allclose(found.symmetric[0], [-3.88, 3.88], atol=0.02)
    linear = linear_sum(1.0, 1.0, 1.0, 1.0)
    assert validate(linear, found, 2).tolerance[0] == pytest.approx(0.05)
    assert validate(linear, found, 2).validated[0]
    assert not validate(linear, found, 3).validated[0]


def test_one_dominant_rectangle_of_9_2_4():
    """u = 10.1, ends 17.0 beside 19.9: the linear interval is not valid."""
    draw = four(*[UNIT_RECTANGLE] * 3, Distribution(10 * np.sqrt(3.0), "rectangular"))
    found = monte_carlo(total, draw, np.random.default_rng(4), TRIALS, 0.95)
    assert found.u[0] == pytest.approx(10.1, abs=0.06)
    np.testing.assert_allclose(found.symmetric[0], [-17.0, 17.0], atol=0.06)
    linear = linear_sum(1.0, 1.0, 1.0, 10.0)
    assert linear.expanded(0.95)[0] == pytest.approx(19.9, abs=0.05)
    assert not validate(linear, found, 2).validated[0]


def test_adaptive_number_of_trials():
    """Two digits of u = 2.0: what is told is stable to 0.05, and more trials were made than one sequence."""
    draw = four(*[UNIT_RECTANGLE] * 4)
    found = adaptive_monte_carlo(total, draw, np.random.default_rng(5), 2, 0.95)
    assert found.stable
    assert found.trials >= 20_000
    assert found.u[0] == pytest.approx(2.0, abs=0.05)
    np.testing.assert_allclose(found.symmetric[0], [-3.88, 3.88], atol=0.05)
    coarse = adaptive_monte_carlo(total, draw, np.random.default_rng(5), 3, 0.95, most_trials=40_000)
    assert not coarse.stable


def test_mass_calibration_of_9_3():
    """Deviation of a weight from nominal, mg: the density terms vanish to first order, not in truth."""

    def deviation(x):
        mass, difference, air, weight, reference = np.moveaxis(x, -1, 0)
        return (mass + difference) * (1 + (air - 1.2) * (1 / weight - 1 / reference)) - 100_000.0

    draw = joint(
        about(100_000.0, Distribution(0.050)),
        about(1.234, Distribution(0.020)),
        about(1.2, Distribution(0.1, "rectangular")),
        about(8000.0, Distribution(1000.0, "rectangular")),
        about(8000.0, Distribution(50.0, "rectangular")),
    )
    found = monte_carlo(deviation, draw, np.random.default_rng(6), TRIALS, 0.95)
    assert found.mean[0] == pytest.approx(1.2341, abs=4 * 0.0754 / np.sqrt(TRIALS) + 5e-5)
    assert found.u[0] == pytest.approx(0.0754, rel=4 / np.sqrt(2 * TRIALS) + 1e-3)
    np.testing.assert_allclose(found.shortest[0], [1.0834, 1.3825], atol=2e-3)
    linear = propagate([1.234], [[1.0, 1.0, 0.0, 0.0, 0.0]], Inputs.independent(
        [100_000.0, 1.234, 1.2, 8000.0, 8000.0], [0.050, 0.020, 0.0577, 577.0, 28.9]
    ))  # fmt: skip
    assert linear.u[0] == pytest.approx(0.0539, abs=5e-5)
    verdict = validate(linear, found, 1, shortest=True)
    assert verdict.tolerance[0] == pytest.approx(0.005)
    assert not verdict.validated[0]
