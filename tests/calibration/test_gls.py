"""Generalised least squares against a textbook computation with the whole covariance of the readings.

The reference is written here from the definition: V = R + J P J^T over all signals, estimate
(A^T V^-1 A)^-1 A^T V^-1 y, with derivatives of the independent geometry of bench/validation/paper_bench.py.
"""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from bench.calibration import ESTIMATORS, CalibrationError, Noise, calibrate
from bench.calibration.budget.coefficients import make_budget
from bench.calibration.design import make_problem
from bench.calibration.estimators import GLS, find_estimator
from bench.calibration.gls import Estimator
from bench.calibration.noise import LikelihoodResiduals, noise_from_residuals
from bench.model import CATALOGUE, AppliedEffect, Block
from bench.model.effects import Stage
from bench.model.geometry import COEFFICIENTS
from bench.readings.csv import write_csv
from bench.readings.table import make_readings
from bench.validation.paper_bench import (
    ARCSEC,
    SETTING_U_RAD,
    STAND_U,
    TRUTH,
    U0,
    K,
    design,
    simulate,
    specific_force,
)
from tests.support.budget_bench import paper_setup, stand
from tests.support.commands import refused
from tests.support.honest_runs import MODEL
from tests.support.results import calibration_json

NAMES = ("axis_tilt", "zero_offset", "mounting_error")


class Dense:
    """The paper's procedure linearised with full matrices; unknowns K, U0 and three angles an installation."""

    def __init__(self, readings):
        self.installation = readings.installation.tolist()
        self.second = readings.installation == "2"
        self.phi = readings.angle_rad
        self.y = readings.signal.ravel()

    def force(self, stand, setting=0.0):
        a = np.where(self.second[None, :], stand[3:, None], stand[:3, None])
        return specific_force(self.installation, self.phi, *a, setting)

    def signals(self, theta, stand, setting=0.0):
        return (self.force(stand, setting) @ theta[:9].reshape(3, 3).T + theta[9:]).ravel()

    def by_coefficients(self, stand):
        force = self.force(stand)
        return np.concatenate([np.hstack([np.kron(np.eye(3), a), np.eye(3)]) for a in force])

    def by_stand(self, theta, stand, h=1e-5):
        steps = h * np.eye(6)
        pairs = [self.signals(theta, stand + s) - self.signals(theta, stand - s) for s in steps]
        return np.stack(pairs, axis=1) / (2 * h)

    def noise_covariance(self, theta, stand, sizes, h=1e-5):
        slope = (self.signals(theta, stand, h) - self.signals(theta, stand, -h)) / (2 * h)
        covariance = np.eye(len(self.y)) * sizes.reading**2
        for i in range(0, len(self.y), 3):
            d = slope[i : i + 3]
            covariance[i : i + 3, i : i + 3] += sizes.setting_rad**2 * np.outer(d, d)
        return covariance

    def estimate(self, sizes, prior_u, rounds=8):
        theta, stand = TRUTH.copy(), np.zeros(6)
        prior = np.diag(np.tile(prior_u, 2) ** 2)
        for _ in range(rounds):
            A, J = self.by_coefficients(stand), self.by_stand(theta, stand)
            V = self.noise_covariance(theta, stand, sizes) + J @ prior @ J.T
            left = self.y - self.signals(theta, stand) + J @ stand
            weighted = np.linalg.solve(V, np.column_stack([A, left]))
            normal = A.T @ weighted[:, :12]
            step = np.linalg.solve(normal, A.T @ weighted[:, 12])
            theta = theta + step
            stand = prior @ J.T @ np.linalg.solve(V, left - A @ step)
        self.theta, self.stand, self.covariance = theta, stand, np.linalg.inv(normal)


@pytest.mark.parametrize("passes", [1, 3])
def test_value_and_covariance_are_those_of_the_textbook(passes):
    readings = simulate(np.random.default_rng(21), 1e-4, passes=passes)
    sizes = Noise(1e-4, SETTING_U_RAD, np.inf, "given")
    result = calibrate(readings, MODEL, STAND_U, 9.81, noise=sizes)
    dense = Dense(readings)
    dense.estimate(sizes, [STAND_U[n] for n in NAMES])
    np.testing.assert_allclose(result.block.vector, dense.theta, atol=1e-10, rtol=0)
    np.testing.assert_allclose(result.u, np.sqrt(np.diag(dense.covariance)), rtol=1e-7)
    scale = np.outer(result.u, result.u)
    np.testing.assert_allclose(result.covariance / scale, dense.covariance / scale, atol=1e-7)
    angles = [result.stand[f"alpha{a}[{m}]"].value * ARCSEC for m in "12" for a in (1, 2, 3)]
    np.testing.assert_allclose(angles, dense.stand, atol=1e-10)
    # the lack of fit against noise that is given is chi-square of the marginal residual
    J = dense.by_stand(dense.theta, dense.stand)
    V = dense.noise_covariance(dense.theta, dense.stand, sizes)
    V += J @ np.diag(np.tile([STAND_U[n] for n in NAMES], 2) ** 2) @ J.T
    left = dense.y - dense.signals(dense.theta, dense.stand) + J @ dense.stand
    assert result.lack_of_fit.chi2 == pytest.approx(left @ np.linalg.solve(V, left), rel=1e-6)
    assert result.lack_of_fit.dof == 3 * len(readings) - 12


def test_what_the_data_tell_of_the_stand():
    """alpha1 is seen; alpha2 and alpha3 only as the sums a2[1] + a3[2] and a3[1] + a2[2]."""
    loose = dict.fromkeys(NAMES, 600 * ARCSEC)
    sizes = Noise(3e-4, 10 * ARCSEC, np.inf, "given")
    stand = calibrate(simulate(None, 0.0), MODEL, loose, 9.81, noise=sizes).stand
    assert {e.unit for e in stand.values()} == {"arcsec"}
    for m in "12":
        assert stand[f"alpha1[{m}]"].u == pytest.approx(8.1, rel=0.05)
        # half the difference stays as loose as its prior
        assert stand[f"alpha2[{m}]"].u == pytest.approx(600 / np.sqrt(2), rel=0.02)
        assert stand[f"alpha3[{m}]"].u == pytest.approx(600 / np.sqrt(2), rel=0.02)


@pytest.mark.parametrize("alpha3_arcsec", [0.0, 90.0])
def test_what_only_the_limits_hold_is_named(alpha3_arcsec):
    """The two null vectors join alpha2 and alpha3; alpha1 is not in them, however large alpha3 is."""
    installation, pass_number, point, phi = design()
    signal = specific_force(installation, phi, alpha3=alpha3_arcsec * ARCSEC) @ K.T + U0
    signal += np.random.default_rng(3).normal(0, 2e-5, signal.shape)
    readings = make_readings(installation, pass_number, point, phi, signal)
    sentences = calibrate(readings, MODEL, STAND_U, 9.81).assumed
    gauge = next(s for s in sentences if "common turn" in s)
    assert gauge.startswith("alpha2[1], alpha3[1], alpha2[2], alpha3[2]: ")
    roll = next(s for s in sentences if "alpha5" in s)
    # an arcsecond of alpha5 in installation 1 puts -Kyy arcsec into Kyz
    assert f"1 arcsec in installation 1 puts {-2.139892e6 * ARCSEC:+.3g} µV/g into Kyz" in roll
    assert any("voltmeter gain" in s for s in sentences)
    assert any("gravity" in s for s in sentences)


def test_mounting_roll_with_a_size_becomes_an_unknown_and_a_budget_line():
    """alpha5 goes whole into Kyz (installation 1) and Kzy (installation 2): 90 arcsec are 934 uV/g."""
    sizes = Noise(3e-4, 10 * ARCSEC, np.inf, "given")
    with_roll = STAND_U | {"mounting_roll": 90 * ARCSEC}
    readings = simulate(None, 0.0)
    result = calibrate(readings, MODEL, with_roll, 9.81, noise=sizes)
    added = result.covariance - calibrate(readings, MODEL, STAND_U, 9.81, noise=sizes).covariance
    u = dict(zip(COEFFICIENTS, np.sqrt(np.maximum(np.diag(added), 0)), strict=True))
    assert u["Kyz"] == pytest.approx(934e-6, rel=0.01)
    assert u["Kzy"] == pytest.approx(934e-6, rel=0.01)
    assert "alpha5[1]" in result.stand
    assert not any("assumed zero" in s for s in result.assumed)


@pytest.mark.parametrize(
    ("label", "lost", "axis"), [("1", "Kxy, Kyy, Kzy", "y"), ("2", "Kxz, Kyz, Kzz", "z")]
)
def test_one_installation_only_names_what_it_cannot_give(label, lost, axis):
    readings = simulate(np.random.default_rng(1), 1e-4)
    with pytest.raises(CalibrationError, match=f"27 readings do not determine {lost}: .*along {axis} hardly"):
        calibrate(readings.select(readings.installation == label), MODEL, STAND_U, 9.81)


def test_a_single_reading_is_refused():
    readings = simulate(None, 0.0)
    with pytest.raises(CalibrationError, match="1 reading does not determine"):
        calibrate(readings.select(np.arange(54) == 0), MODEL, STAND_U, 9.81)


@pytest.mark.parametrize(
    ("column", "rows", "value", "told"),
    [
        ("installation", slice(None), "S", "no reading in an installation of known orientation"),
        ("installation", 3, "7", r"installation 7 is unknown \(known are 1, 2\)"),
        ("signal", 12, np.nan, "installation 1, pass 2, point 4 has a signal that is not"),
        ("angle_rad", 12, np.nan, "installation 1, pass 2, point 4 has an angle that is not"),
    ],
)
def test_readings_that_cannot_be_calibrated_are_refused(column, rows, value, told):
    readings = simulate(None, 0.0)
    getattr(readings, column)[rows] = value
    with pytest.raises(CalibrationError, match=told):
        calibrate(readings, MODEL, STAND_U, 9.81)


def test_an_unknown_estimator_is_refused():
    with pytest.raises(CalibrationError, match="'best'; choose from gls, closed-form, least-squares, robust"):
        calibrate(simulate(None, 0.0), MODEL, STAND_U, 9.81, "best")


def test_missing_points_are_no_obstacle():
    """Ten readings less; the truth within four u of every coefficient."""
    readings = simulate(np.random.default_rng(4), 1e-4)
    keep = np.ones(54, dtype=bool)
    keep[[0, 3, 8, 11, 20, 27, 30, 41, 50, 53]] = False
    result = calibrate(readings.select(keep), MODEL, STAND_U, 9.81)
    assert np.all(np.abs(result.block.vector - TRUTH) < 4 * result.u)
    assert len(result.fitted) == 44


def test_angles_read_back_are_used():
    """Known deviations of half a degree cost nothing: the model knows where the head stood."""
    rng = np.random.default_rng(6)
    installation, pass_number, point, phi = design()
    read_back = phi + rng.uniform(-1, 1, len(phi)) * np.radians(0.5)
    signal = specific_force(installation, read_back) @ K.T + U0
    readings = make_readings(installation, pass_number, point, read_back, signal)
    np.testing.assert_allclose(calibrate(readings, MODEL, STAND_U, 9.81).block.vector, TRUTH, atol=1e-9)


@pytest.mark.parametrize("scale", [1e6, 1e-3])
def test_any_unit(scale):
    """Counts instead of volts: everything in the unit scales, nothing else changes."""
    readings = simulate(np.random.default_rng(9), 1e-4)
    volts = calibrate(readings, MODEL, STAND_U, 9.81)
    result = calibrate(replace(readings, signal=readings.signal * scale, unit="counts"), MODEL, STAND_U, 9.81)
    assert result.unit == "counts"
    np.testing.assert_allclose(result.block.vector, volts.block.vector * scale, atol=1e-7 * scale)
    np.testing.assert_allclose(result.u, volts.u * scale, rtol=1e-3)
    assert result.noise.reading == pytest.approx(volts.noise.reading * scale, rel=1e-3)
    assert result.lack_of_fit.p == pytest.approx(volts.lack_of_fit.p, abs=1e-3)


def test_the_order_of_the_readings_does_not_matter():
    readings = simulate(np.random.default_rng(10), 1e-4)
    order = np.random.default_rng(1).permutation(54)
    once = calibrate(readings, MODEL, STAND_U, 9.81)
    again = calibrate(readings.select(order), MODEL, STAND_U, 9.81)
    np.testing.assert_allclose(again.block.vector, once.block.vector, atol=1e-9)
    np.testing.assert_allclose(again.u, once.u, rtol=1e-4)


def test_verification_rows_are_not_fitted():
    """Three nonsense rows of kind V, S and R change nothing."""
    readings = simulate(np.random.default_rng(12), 1e-4)
    more = make_readings(
        [*readings.installation.tolist(), "V", "S", "R"],
        [*readings.pass_number.tolist(), 1, 1, 1],
        [*readings.point.tolist(), 1, 1, 1],
        np.concatenate([readings.angle_rad, [0.0, np.nan, np.nan]]),
        np.concatenate([readings.signal, np.full((3, 3), 7.0)]),
    )
    once, again = (calibrate(table, MODEL, STAND_U, 9.81) for table in (readings, more))
    np.testing.assert_array_equal(again.block.vector, once.block.vector)


def test_result_as_promised():
    """The JSON form: names, order, nulls for what is not there, the unit of the stand's angles."""
    result = calibration_json(calibrate(simulate(np.random.default_rng(2), 1e-4), MODEL, STAND_U, 9.81))
    assert result["estimator"] == "gls"
    assert result["order"] == list(COEFFICIENTS)
    assert result["coefficients"]["Kyx"]["u"] == pytest.approx(np.sqrt(result["covariance"][3][3]))
    assert result["readings"] == {"used": 54, "skipped": 0}
    assert result["model"] == "paper"
    assert result["g_m_s2"] == 9.81
    assert 0 <= result["residual"]["p"] <= 1
    assert result["noise"]["source"] == "repeats"
    single = calibration_json(
        calibrate(simulate(np.random.default_rng(2), 1e-4, passes=1), MODEL, STAND_U, 9.81)
    )
    assert single["residual"]["p"] is None
    assert single["noise"]["source"] == "residuals"


def test_noise_from_residuals_maximises_the_restricted_likelihood():
    """One pass: no other pair of sizes is likelier by the full Gaussian formula, searched by Nelder-Mead.

    -2 log L = log|V| + log|A^T V^-1 A| + r^T V^-1 r, V of all 54 signals written out.
    """
    readings = simulate(np.random.default_rng(31), 2e-5, passes=1)
    dense = Dense(readings)
    prior = np.diag(np.tile([STAND_U[n] for n in NAMES], 2) ** 2)
    A, J = dense.by_coefficients(np.zeros(6)), dense.by_stand(TRUTH, np.zeros(6))

    def minus_two_log_likelihood(log_sizes):
        sizes = Noise(*np.exp(log_sizes), np.inf, "trial")
        V = dense.noise_covariance(TRUTH, np.zeros(6), sizes) + J @ prior @ J.T
        Vi = np.linalg.inv(V)
        normal = A.T @ Vi @ A
        r = dense.y - A @ np.linalg.solve(normal, A.T @ Vi @ dense.y)
        return np.linalg.slogdet(V)[1] + np.linalg.slogdet(normal)[1] + r @ Vi @ r

    best = minimize(minus_two_log_likelihood, np.log([1.5e-4, 3e-5]), method="Nelder-Mead",
                    options={"xatol": 1e-5, "fatol": 1e-8})  # fmt: skip
    problem = make_problem(MODEL, readings.conditions(), STAND_U)
    block = Block(K, U0)
    design_matrix = problem.jacobian(block, np.zeros(6))
    design_matrix[:, :, 12:] *= problem.prior_u
    left = readings.signal - problem.predict(block, np.zeros(6))
    columns = np.concatenate([design_matrix, left[:, :, None]], axis=2)
    of = LikelihoodResiduals(columns, problem.slope(block, np.zeros(6)), np.zeros((0, 19)), 12)
    ours = noise_from_residuals(of, 1e-9)
    np.testing.assert_allclose(np.log([ours.reading, ours.setting_rad]), best.x, atol=2e-3)
    fitted = calibrate(readings, MODEL, STAND_U, 9.81).noise
    np.testing.assert_allclose(np.log([fitted.reading, fitted.setting_rad]), best.x, atol=2e-3)


# --- the estimators by name -----------------------------------------------------------------------


def half_of(task):
    """Fitted as by generalised least squares, and then only half of it believed: nonlinear as any other."""
    return replace(task.fit, gain=0.5 * task.fit.gain)


@pytest.fixture
def a_further_one(monkeypatch):
    monkeypatch.setitem(ESTIMATORS, "halved", Estimator("halved", "half of gls", half_of, also=("h",)))


def commands(readings):
    return (
        ("calibrate", readings, "--json", "-"),
        ("budget", "--procedure", "quick", "--trials", 0, "--json", "-"),
        ("require", "--accuracy", "1e-3", "--of", "Kyx", "--procedure", "quick", "--json", "-"),
    )


@pytest.fixture
def readings(tmp_path, monkeypatch):
    # other procedures take most of the time of a requirement
    monkeypatch.setattr("bench.services.planning.PROCEDURES", ())
    write_csv(simulate(np.random.default_rng(5), 1e-4), tmp_path / "r.csv")
    return tmp_path / "r.csv"


@pytest.mark.slow
@pytest.mark.usefixtures("a_further_one")
def test_every_command_takes_every_estimator_by_each_of_its_names(bench, readings):
    for estimator in ESTIMATORS.values():
        for name in (estimator.name, *estimator.also):
            # another name for the same is looked up by one function: one command is enough
            for command in commands(readings)[: 3 if name == estimator.name else 1]:
                status, out, err = bench(*command, "--estimator", name)
                assert status < 2, (command, name, err)
                named = estimator.name if command[0] == "calibrate" else estimator.counts_as or estimator.name
                assert json.loads(out)["estimator"] == named
    assert find_estimator("h").name == "halved"


@pytest.mark.slow
@pytest.mark.usefixtures("a_further_one")
def test_every_command_refuses_another_and_its_help_names_all(bench, readings):
    for command in commands(readings):
        refused(
            bench(*command, "--estimator", "magic"),
            f"no estimator 'magic'; choose from {', '.join(ESTIMATORS)}",
        )
        _, out, _ = bench(command[0], "--help-all")
        told = " ".join(out.split())
        for estimator in ESTIMATORS.values():
            assert f"({estimator.phrase})" in told, estimator.name
        assert ("robust counts as gls" in told) == (command[0] != "calibrate")


@pytest.mark.usefixtures("a_further_one")
def test_a_nonlinear_one_has_the_budget_of_where_it_comes_to_rest():
    weighed, halved = (make_budget(paper_setup(), stand(), name) for name in (GLS, "halved"))
    np.testing.assert_allclose(halved.gain, 0.5 * weighed.gain, rtol=1e-12)
    robust = make_budget(paper_setup(), stand(), "robust")
    np.testing.assert_array_equal(robust.gain, weighed.gain)


def test_the_robust_estimator_has_the_map_of_generalised_least_squares_from_clean_readings():
    """What `counts_as` takes for granted, by the estimator itself, without an outlier and with one."""
    clean = simulate(np.random.default_rng(5), 1e-4)
    plain, robust = (calibrate(clean, MODEL, STAND_U, 9.81, name) for name in (GLS, "robust"))
    assert robust.outliers == ()
    np.testing.assert_array_equal(robust.covariance, plain.covariance)
    clean.signal[13, 1] += 0.05
    struck = calibrate(clean, MODEL, STAND_U, 9.81, "robust")
    assert len(struck.outliers) == 1
    assert not np.array_equal(struck.covariance, plain.covariance)


@pytest.mark.slow
def test_the_one_that_commands_take_unasked_is_listed_first(bench, readings):
    assert next(iter(ESTIMATORS)) == GLS
    for command in commands(readings):
        assert json.loads(bench(*command)[1])["estimator"] == GLS


def test_derivatives_with_effects_at_each_stage_are_those_of_the_whole_chain():
    """Each unknown is stepped in `predict`, which evaluates every stage with every effect."""
    names = (
        "axis_wobble", "head_eccentricity", "wrong_gravity", "quadratic_nonlinearity", "hysteresis",
        "voltmeter_nonlinearity",
    )  # fmt: skip
    effects = [CATALOGUE[name] for name in names]
    assert {effect.stage for effect in effects} == set(Stage)
    applied = tuple(
        AppliedEffect(
            effect,
            {
                p.name: np.full(3 if p.per_channel else (), p.grid[-1] if p.is_shape else p.plausible)
                for p in effect.parameters
            },
        )
        for effect in effects
    )
    readings = simulate(np.random.default_rng(1), 0.0, passes=1)
    problem = make_problem(replace(MODEL, effects=applied), readings.conditions(), STAND_U)
    block, others = Block(K, U0), problem.prior_mean + 1e-4 * problem.prior_u
    found = problem.linear(block, others)
    np.testing.assert_allclose(found.predicted, problem.predict(block, others), rtol=0, atol=1e-12)
    for j in range(12 + len(others)):
        size = 1e-3 if j < 12 else float(np.max(problem.other_step(j - 12)))
        step = size * (np.arange(12 + len(others)) == j)
        up, down = (
            problem.predict(Block.from_vector(block.vector + way[:12]), others + way[12:])
            for way in (step, -step)
        )
        column = (up - down) / (2 * size)
        tolerance = 1e-6 * max(float(np.max(np.abs(column))), 1.0)
        np.testing.assert_allclose(found.jacobian[:, :, j], column, rtol=0, atol=tolerance)


def test_angles_of_a_block_mounted_once_are_stated_for_its_series():
    """Four series without a remount, as at four temperatures: stated twice as large, the roll gives its u once.

    1 arcsec of it is 10.4 µV/g of Kyz. Stated as large as it is, it gives half of its u, and the note says so.
    """
    installation, pass_number, point, phi = design()
    n, times = len(phi), 4
    signal = np.tile(simulate(None, 0.0).signal, (times, 1))
    series = np.repeat(np.arange(times) + 1, n)
    labels, again = installation * times, np.tile(phi, times)
    readings = make_readings(labels, pass_number * times, point * times, again, signal, series=series)
    given = Noise(1e-6, SETTING_U_RAD, np.inf, "given")
    u = []
    for factor in (1.0, 2.0):
        roll = {"mounting_roll": factor * 30 * ARCSEC}
        found = calibrate(readings, MODEL, STAND_U, 9.81, noise=given, assumed_u=roll)
        told = "state axis_tilt and zero_offset 2 times as large"
        assert any(told in n and "if the block stayed mounted, mounting_error and" in n for n in found.notes)
        u.append(found.u[COEFFICIENTS.index("Kyz")])
    assert u[1] == pytest.approx(30 * 10.4e-6, rel=0.02)
    assert u[0] == pytest.approx(u[1] / 2, rel=0.02)


def test_angles_of_a_platform_levelled_once_are_stated_for_the_mountings():
    """Two runs in one table, with the same α1 and α2 in both: stated √2 times as large, they give the right u.

    Stated as large as they are, they give the cross-axis terms a u that is a tenth too small.
    """
    installation, pass_number, point, phi = design()
    n, again = len(phi), np.tile(phi, 2)
    labels, run = np.array(installation * 2), np.repeat([1, 2], n)
    signal = np.tile(simulate(None, 0.0).signal, (2, 1))
    readings = make_readings(labels.tolist(), pass_number * 2, point * 2, again, signal, series=run)
    given = Noise(1e-4, SETTING_U_RAD, np.inf, "given")
    largest = []
    for times in (1.0, np.sqrt(2.0)):
        stated = STAND_U | {name: times * STAND_U[name] for name in NAMES[:2]}
        found = calibrate(readings, MODEL, stated, 9.81, noise=given)
        told = [note for note in found.notes if "state axis_tilt and zero_offset 1.41 times as large" in note]
        assert [re.search(r"installation (\w+) has 2 series", note)[1] for note in told] == ["1", "2"]
        once = found.covariance.copy()
        for column, name in enumerate(NAMES[:2]):
            for label in "12":
                angles = np.zeros((2, 2 * n))
                angles[column] = STAND_U[name] * (labels == label)
                change = (
                    specific_force(labels.tolist(), again, *angles) - specific_force(labels.tolist(), again)
                ) @ K.T
                by_run = np.stack(
                    [np.einsum("pni,ni->p", found.gain, change * (run == r)[:, None]) for r in (1, 2)]
                )
                once += np.outer(by_run.sum(axis=0), by_run.sum(axis=0)) - times**2 * by_run.T @ by_run
        largest.append(np.max(np.sqrt(np.diag(once)) / found.u))
    assert largest[0] > 1.1
    assert largest[1] < 1.02
