"""Mistakes in a table: each is named with its cause, none becomes a coefficient."""

import numpy as np
import pytest

from bench.calibration import CalibrationError, calibrate
from bench.calibration.calibrate import ESTIMATORS
from bench.model import ForwardModel, Installation
from bench.readings.csv import write_csv
from bench.readings.table import make_readings
from tests.support.honest_runs import MODEL, free_forces
from tests.support.paper_bench import STAND_U, TRUTH, U0, K, design, simulate, specific_force
from tests.support.results import calibration_json

FITTING = ("gls", "least-squares", "robust")


def refused(readings, match, estimator="gls", model=MODEL):
    with pytest.raises(CalibrationError, match=match):
        calibrate(readings, model, STAND_U, 9.81, estimator)


@pytest.mark.parametrize(
    ("per_degree", "unit"), [(np.pi / 180, "radians"), (400 / 360, "gon"), (1 / 360, "whole turns")]
)
@pytest.mark.parametrize("estimator", FITTING)
def test_angles_in_another_unit(per_degree, unit, estimator):
    readings = simulate(np.random.default_rng(1), 1e-4)
    readings.angle_rad[:] = readings.angle_rad * per_degree
    refused(readings, f"the angles look like {unit}, not degrees: .*write angle_deg in degrees", estimator)


def test_angles_in_radians_on_the_command_line(bench, tmp_path):
    readings = simulate(np.random.default_rng(1), 1e-4)
    readings.angle_rad[:] = np.radians(readings.angle_rad)
    write_csv(readings, tmp_path / "r.csv")
    status, _, err = bench("calibrate", tmp_path / "r.csv", "--out", "o")
    assert status == 2
    assert err.startswith("bench: the angles look like radians")
    assert err.count("\n") == 1


def test_a_poor_fit_alone_is_not_called_a_wrong_unit():
    """A quadratic term of 5 % is no unit of angle."""
    readings = simulate(np.random.default_rng(2), 1e-4, K2=0.05)
    assert calibrate(readings, MODEL, STAND_U, 9.81).lack_of_fit.p < 1e-9


@pytest.mark.parametrize("ends", ["top", "bottom", "both"])
def test_a_saturated_channel(ends):
    """Channel y cut at 1.2 V: the readings beyond stand at the same value, whatever the head's angle."""
    readings = simulate(np.random.default_rng(3), 1e-4)
    low, high = {"top": (-9, 1.2), "bottom": (-1.2, 9), "both": (-1.2, 1.2)}[ends]
    readings.signal[:, 1] = np.clip(readings.signal[:, 1], low, high)
    for estimator in FITTING:
        refused(
            readings, r"channel y is saturated: \d+ readings stand at .*1\.2.* on a higher range", estimator
        )


def test_equal_readings_of_a_coarse_meter_are_not_called_saturated():
    """Rounded to 1 mV, the six readings with an axis straight up are all alike."""
    readings = simulate(np.random.default_rng(4), 1e-5)
    readings.signal[:] = readings.signal.round(3)
    for axis in range(3):
        assert np.sum(readings.signal[:, axis] == readings.signal[:, axis].max()) >= 3
    result = calibrate(readings, MODEL, STAND_U, 9.81)
    assert np.all(np.abs(result.block.vector - TRUTH) < 5 * result.u)


def test_a_saturated_channel_of_free_positions():
    forces = free_forces(40, np.random.default_rng(5))
    signal = np.minimum(forces @ K.T + U0, [1.0, 9, 9])
    readings = make_readings(["F"] * 40, [1] * 40, [*range(40)], np.full(40, np.nan), signal)
    refused(readings, r"channel x is saturated: \d+ readings stand at 1,")


def test_overload_is_named():
    readings = simulate(None, 0.0)
    readings.signal[30, 2] = 9.9e37
    refused(readings, "installation 2, pass 1, point 4 has an overloaded voltmeter")


def test_a_cable_that_is_off():
    """A channel with noise alone, and one that gives exactly the same."""
    readings = simulate(np.random.default_rng(6), 1e-4)
    readings.signal[:, 2] = np.random.default_rng(7).normal(0, 1e-4, 54)
    for estimator in ESTIMATORS:
        refused(
            readings,
            "channel z does not answer to the acceleration; check its cable|K is singular",
            estimator,
        )
    readings.signal[:, 2] = 0.1
    refused(readings, "channel z is the same in every reading")


def test_two_meters_on_one_channel():
    readings = simulate(np.random.default_rng(8), 1e-4)
    readings.signal[:, 2] = readings.signal[:, 1] + np.random.default_rng(9).normal(0, 1e-4, 54)
    for estimator in ESTIMATORS:
        refused(readings, "K is singular: channels y and z answer alike; are two voltmeters", estimator)


def test_three_axes_in_a_plane():
    flat = K.copy()
    flat[2] = flat[0] + flat[1]
    installation, pass_number, point, phi = design()
    signal = (
        specific_force(installation, phi) @ flat.T + U0 + np.random.default_rng(1).normal(0, 1e-4, (54, 3))
    )
    refused(make_readings(installation, pass_number, point, phi, signal), "lie in one plane")


def test_one_installation_and_free_positions_are_not_enough():
    readings = simulate(np.random.default_rng(1), 1e-4)
    refused(
        readings.select(readings.installation == "1"),
        "do not determine Kxy, Kyy, Kzy.*add the other installation",
    )


def test_any_installations_and_angles_that_have_the_rank():
    """Six orientations of a further installation and installation 2, at angles of no pattern, one pass."""
    rng = np.random.default_rng(10)
    turned = Installation.from_axes("T", ("y", "-x", "z"))
    model = ForwardModel({**MODEL.installations, "T": turned})
    phi = rng.uniform(0, 2 * np.pi, 14)
    base = specific_force(["1"] * 7, phi[:7])
    force = np.concatenate([base @ turned.block_from_platform.T, specific_force(["2"] * 7, phi[7:])])
    signal = force @ K.T + U0 + rng.normal(0, 1e-4, (14, 3))
    readings = make_readings(["T"] * 7 + ["2"] * 7, [1] * 14, [*range(1, 8)] * 2, phi, signal)
    for estimator in ("gls", "least-squares"):
        result = calibrate(readings, model, STAND_U, 9.81, estimator)
        assert np.all(np.abs(result.block.vector - TRUTH) < 5 * result.u)


def test_nominal_angles_in_place_of_those_read_back():
    """The head stood where it was asked to; its scale was read with errors of 20 arcmin."""
    rng = np.random.default_rng(11)
    readings = simulate(rng, 2e-5)
    nominal = readings.angle_rad.copy()
    readings.angle_rad[:] += rng.normal(0, np.radians(20 / 60), 54)
    readings.target_rad[:] = nominal
    by_scale = calibrate(readings, MODEL, STAND_U, 9.81)
    by_target = calibrate(readings, MODEL, STAND_U, 9.81, nominal_angles=True)
    assert by_scale.noise.setting_rad > 50 * by_target.noise.setting_rad
    assert np.all(np.abs(by_target.block.vector - TRUTH) < 4 * by_target.u)
    assert (calibration_json(by_scale)["angles"], calibration_json(by_target)["angles"]) == (
        "read back",
        "nominal",
    )
    readings.target_rad[:] = np.nan
    np.testing.assert_allclose(
        calibrate(readings, MODEL, STAND_U, 9.81, nominal_angles=True).block.vector, by_target.block.vector
    )
    readings.angle_rad[5] += 0.3
    with pytest.raises(
        CalibrationError, match="pass 1, point 6 has no nominal angle: there is no target_deg"
    ):
        calibrate(readings, MODEL, STAND_U, 9.81, nominal_angles=True)


@pytest.mark.slow
def test_least_squares_weighs_all_alike_and_is_honest():
    """Against numpy's least squares on the nominal forces; its errors over u in 100 runs, seeds [71, k]."""
    z = []
    for k in range(100):
        readings = simulate(np.random.default_rng([71, k]), 1e-4)
        result = calibrate(readings, MODEL, STAND_U, 9.81, "least-squares")
        z.append((result.block.vector - TRUTH) / result.u)
    installation, _, _, phi = design()
    columns = np.column_stack([specific_force(installation, phi), np.ones(54)])
    expected = np.linalg.lstsq(columns, readings.signal, rcond=None)[0]
    np.testing.assert_allclose(result.block.vector, [*expected[:3].T.ravel(), *expected[3]], atol=1e-12)
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    # a chi-square of 100 is out of these bounds once in 10^5
    assert np.all((rms > 0.70) & (rms < 1.33)), rms.round(3)
    assert result.stand == {}
