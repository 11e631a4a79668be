"""The check (9)-(10) at the verification points, against closed forms and Monte Carlo."""

import numpy as np
import pytest

from bench.analysis.calibration import CalibrationError, calibrate, verify
from bench.model import Block, ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from bench.readings.table import make_readings
from tests.support.paper_bench import STAND_U, TRUTH, U0, K, simulate, specific_force

THETA = np.radians([45.0, 135.0, 225.0, 315.0])
PSI = np.radians(45.0)
NONE = np.zeros((12, 12))
BLOCK = Block(K, U0)


def turned(psi=PSI, noise=0.0):
    """The four verification points with the block turned by psi about z, measured by the block of (11)."""
    signal = specific_force(["V"] * 4, THETA, psi=psi) @ K.T + U0 + noise
    return make_readings(["V"] * 4, [1] * 4, [1, 2, 3, 4], THETA, signal)


def altered_z(factor):
    scaled = K.copy()
    scaled[2] *= factor
    return Block(scaled, U0)


def test_the_true_coefficients_pass_with_nothing_left():
    result = verify(turned(), BLOCK, NONE, 0.0, 3e-4)
    assert result.passed
    assert [p.angle_deg for p in result.points] == pytest.approx([45, 135, 225, 315])
    assert max(abs(p.delta_g) for p in result.points) < 1e-15
    assert [p.u for p in result.points] == [0, 0, 0, 0]


def test_error_of_the_modulus_in_closed_form():
    """A bias of channel x alone: a is off by the first column of N, and (9) is its modulus less one."""
    off = np.array([1e-3, 0.0, 0.0])
    result = verify(turned(noise=off), BLOCK, NONE, 0.0, 3e-4)
    a = specific_force(["V"] * 4, THETA, psi=PSI) + np.linalg.inv(K) @ off
    expected = np.sqrt(a[:, 0] ** 2 + a[:, 1] ** 2 + a[:, 2] ** 2) - 1
    np.testing.assert_allclose([p.delta_g for p in result.points], expected, atol=1e-15)
    np.testing.assert_allclose([p.g_p for p in result.points], 1 + expected, atol=1e-15)
    assert np.abs(expected).max() > 1e-4


def test_a_scale_factor_of_z_wrong_by_a_tenth_of_a_percent_fails():
    """psi = 45 degrees: a_z^2 = 1/2, so sqrt(1 + ((1/f)^2 - 1)/2) - 1 = -5e-4 at every point (row z of K)."""
    result = verify(turned(), altered_z(1.001), NONE, 0.0, 3e-4)
    assert not result.passed
    assert not any(p.passed for p in result.points)
    # U0z stays, and a_z scales by 1/f only with it: the channel's own output is K a
    force = np.linalg.solve(altered_z(1.001).K, K @ specific_force(["V"] * 4, THETA, psi=PSI).T).T
    np.testing.assert_allclose(
        [p.delta_g for p in result.points], np.linalg.norm(force, axis=1) - 1, atol=1e-15
    )
    assert [p.delta_g for p in result.points] == pytest.approx([-5e-4] * 4, rel=0.02)


@pytest.mark.parametrize(("limit", "passed"), [(5.2e-4, True), (4.8e-4, False)])
def test_the_limit_decides(limit, passed):
    result = verify(turned(), altered_z(1.001), NONE, 0.0, limit)
    assert result.passed is passed
    assert result.limit_g == limit


def test_one_point_beyond_the_limit_is_enough():
    readings = turned()
    readings.signal[2, 0] *= 1.01
    result = verify(readings, BLOCK, NONE, 0.0, 3e-4)
    assert [p.passed for p in result.points] == [True, True, False, True]
    assert not result.passed


def test_uncertainty_by_monte_carlo():
    """4000 draws of coefficients from the covariance of a calibration and of the voltmeter's noise."""
    model = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})
    calibration = calibrate(simulate(np.random.default_rng(3), 1e-4), model, STAND_U, 9.81)
    rng = np.random.default_rng(4)
    draws = rng.multivariate_normal(TRUTH, calibration.covariance, 4000)
    exact = turned().signal
    moduli = []
    for draw in draws:
        signal = exact + rng.normal(0, 1e-4, (4, 3))
        a = np.linalg.solve(draw[:9].reshape(3, 3), (signal - draw[9:]).T)
        moduli.append(np.linalg.norm(a, axis=0))
    result = verify(turned(), BLOCK, calibration.covariance, 1e-4, 3e-4)
    # a standard deviation from 4000 draws: four standard errors
    np.testing.assert_allclose([p.u for p in result.points], np.std(moduli, axis=0), rtol=4 / np.sqrt(8000))


def test_a_calibrated_block_passes():
    """Calibrated from simulated readings, checked at the verification points: well within 3e-4 g."""
    model = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})
    calibration = calibrate(simulate(np.random.default_rng(5), 1e-4), model, STAND_U, 9.81)
    result = verify(turned(), calibration.block, calibration.covariance, 1e-4, 3e-4)
    assert result.passed
    assert all(abs(p.delta_g) < 4 * p.u for p in result.points)


@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.arange(1.0, 10.0).reshape(3, 3), K * np.nan])
def test_a_singular_matrix_is_refused(matrix):
    with pytest.raises(CalibrationError, match="singular"):
        verify(turned(), Block(matrix, U0), NONE, 0.0, 3e-4)


def test_a_table_without_verification_points_is_refused():
    with pytest.raises(CalibrationError, match=r"no verification point \(installation V\)"):
        verify(simulate(None, 0.0), BLOCK, NONE, 0.0, 3e-4)


def test_result_as_promised():
    result = verify(turned(), BLOCK, NONE, 0.0, 3e-4).to_json()
    assert result["limit_g"] == 3e-4
    assert result["rule"] == "simple acceptance"
    assert result["passed"] is True
    assert set(result["points"][0]) >= {"angle_deg", "g_p", "delta_g", "u", "passed"}
