"""Free positions: alone, on real data with results of other programs; joined to oriented readings."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares

from bench.base.arrays import Floats
from bench.calibration import CalibrationError, Noise, calibrate
from bench.calibration.design import FreeRows, make_problem
from bench.calibration.free import modulus_columns, modulus_rows
from bench.calibration.intrinsic import intrinsic_of
from bench.calibration.result import SpoiledFit
from bench.model import CATALOGUE, AppliedEffect, Block, ForwardModel
from bench.model.geometry import COEFFICIENTS
from bench.readings.csv import read_csv
from bench.readings.table import make_readings
from bench.validation.paper_bench import ARCSEC, STAND_U, TRUTH, U0, K, design, simulate, specific_force
from bench.validation.registry import REFERENCE as DATA
from tests.support.commands import printed
from tests.support.honest_runs import (
    MODEL,
    ROLL_U,
    STAND_WITH_ROLL,
    free_forces,
    run_joined,
    simulate_with_roll,
    with_free,
)
from tests.support.results import calibration_json

KYZ, KZY = COEFFICIENTS.index("Kyz"), COEFFICIENTS.index("Kzy")


def real(name, g_m_s2=9.80665, estimator="gls"):
    return calibrate(read_csv(DATA / f"{name}.csv", ["1", "2"]), MODEL, {}, g_m_s2, estimator)


def free_alone(count, noise_v, seed, signal=None):
    rng = np.random.default_rng(seed)
    forces = free_forces(count, rng)
    made = forces @ K.T + U0 + rng.normal(0, noise_v, (count, 3)) if signal is None else signal
    return make_readings(
        ["F"] * len(made), [1] * len(made), [*range(1, len(made) + 1)], np.full(len(made), np.nan), made
    )


# --- alone ------------------------------------------------------------------------------------------


def test_xsens_as_imu_tk_has_it():
    """imu_tk itself, mended and run on all samples: these are the means of its 38 intervals."""
    found = real("xsens-38", 9.81744).triangular
    np.testing.assert_allclose(found.bias, [33123.8383, 33275.1630, 32364.4946], atol=0.02)
    np.testing.assert_allclose(found.scale, [0.0024130183, 0.0024269964, 0.0024118430], rtol=1e-5)
    assert np.array_equal(np.diag(found.T), [1, 1, 1])
    assert np.array_equal(np.tril(found.T, -1), np.zeros((3, 3)))


def test_free_positions_alone_tell_all_nine_and_no_mounting():
    """Seed 41, 60 positions, a channel of each sign: within 4 u of the Gram matrix of the true K; nothing held."""
    signs = np.diag([1.0, -1.0, 1.0])
    forces = free_forces(60, np.random.default_rng(41))
    signal = forces @ (signs @ K).T + U0 + np.random.default_rng(42).normal(0, 2e-5, (60, 3))
    found = calibrate(free_alone(0, 0.0, 41, signal), MODEL, {}, 9.81)
    own = intrinsic_of(found)
    gram = signs @ K @ K.T @ signs
    S = np.sqrt(np.diag(gram))
    angles = [np.degrees(np.arccos(gram[i, j] / (S[i] * S[j]))) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert np.all(np.abs(own.values - np.concatenate([S, angles, U0 / S])) < 4 * own.u)
    assert own.u[3:6].max() < 1e-2
    assert own.held == ()
    assert "no stand enters free positions" in own.mounting


@pytest.mark.parametrize(
    ("name", "before_mg", "after_mg"), [("innalabs-24", 15.47, 0.426), ("innalabs-49", 15.71, 0.836)]
)
def test_innalabs_as_published(name, before_mg, after_mg):
    """Root mean square of |a| - 1 before and after, as the authors' program gives it."""
    readings = read_csv(DATA / f"{name}.csv", ["1", "2"])
    before = np.linalg.norm(readings.signal, axis=1) - 1
    assert np.sqrt(np.mean(before**2)) * 1e3 == pytest.approx(before_mg, abs=0.005)
    assert real(name).modulus_rms_g * 1e3 == pytest.approx(after_mg, abs=0.0005)


def test_the_outliers_of_innalabs_49_are_found():
    """Points 22 and 29: without them 0.66 mg by the first fit, 0.59 mg after fitting again."""
    plain, robust = real("innalabs-49"), real("innalabs-49", estimator="robust")
    assert sorted(o.point for o in robust.outliers) == [22, 29]
    assert all(o.channel == "modulus" and o.weight == 0 and o.sigma > 4 for o in robust.outliers)
    kept = ~np.isin(plain.free.point, [22, 29])
    assert np.sqrt(np.mean(plain.modulus_error[kept] ** 2)) * 1e3 == pytest.approx(0.66, abs=0.005)
    assert robust.modulus_rms_g * 1e3 == pytest.approx(0.59, abs=0.005)
    assert len(robust.modulus_error) == 49
    assert [o.size for o in robust.outliers] == pytest.approx(
        [float(robust.modulus_error[o.row - 1]) for o in robust.outliers], rel=1e-6
    )
    assert sum("outlier found" in note for note in plain.notes) == 2
    clean = real("innalabs-24", estimator="robust")
    assert clean.outliers == ()


def test_value_and_covariance_are_those_of_scipy():
    """Nine parameters by scipy's Levenberg-Marquardt on |a| - 1, u from its Jacobian; the noise is small enough."""
    result = real("xsens-38", 9.81744)
    signal = result.free.signal
    upper = np.triu_indices(3)

    def error(p):
        N = np.zeros((3, 3))
        N[upper] = p[:6]
        return np.linalg.norm((signal - p[6:] * 4000) @ N.T, axis=1) - 1

    start = np.concatenate([np.array([1, 0, 0, 1, 0, 1]) / 4100, [8.2, 8.2, 8.2]])
    fit = least_squares(error, start, method="lm", x_scale=np.array([*[1e-4] * 6, 1.0]).repeat([1] * 6 + [3]))
    s2 = 2 * fit.cost / (len(signal) - 9)
    covariance = s2 * np.linalg.inv(fit.jac.T @ fit.jac)
    np.testing.assert_allclose(result.block.U0, fit.x[6:] * 4000, atol=0.02)
    # u of ours is wider by sqrt(nu/(nu - 2)) for 29 degrees of freedom, and weighs each row a little differently
    np.testing.assert_allclose(
        result.u[9:], np.sqrt(np.diag(covariance)[6:]) * 4000 * np.sqrt(29 / 27), rtol=0.02
    )
    assert result.triangular.u_scale == pytest.approx(
        9.81744 * np.sqrt(np.diag(covariance)[[0, 3, 5]]) * np.sqrt(29 / 27), rel=0.02
    )
    assert np.array_equal(result.u[[3, 6, 7]], [0, 0, 0])


@pytest.mark.slow
def test_uncertainty_of_free_positions_alone_is_honest():
    """(estimate - truth)/u over 80 runs of 20 positions, seeds [6, k]; truth is K turned to upper triangular."""
    # K = truth times a rotation, truth upper triangular with a positive diagonal: K K^T = truth truth^T
    truth = np.linalg.cholesky((K @ K.T)[::-1, ::-1])[::-1, ::-1]
    z = []
    for k in range(80):
        result = calibrate(free_alone(20, 1e-4, [6, k]), MODEL, {}, 9.81)
        z.append(
            (result.block.vector - np.concatenate([truth.ravel(), U0]))[result.u > 0] / result.u[result.u > 0]
        )
    low, high = np.sqrt(stats.chi2.ppf([1e-5, 1 - 1e-5], 40) / 40)
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert np.all((rms > 0.95 * low) & (rms < 1.05 * high)), rms.round(3)
    assert 0.95 < np.sqrt(np.mean(np.square(z))) < 1.05


def test_what_free_positions_do_not_show_is_said():
    result = calibration_json(calibrate(free_alone(30, 1e-4, 1), MODEL, STAND_U, 9.81))
    assert "common rotation of the block's axes" in result["not_observable"][0]
    assert "sign of each channel" in result["not_observable"][1]
    assert result["noise"]["source"] == "residuals"
    assert result["residual"]["p"] is None
    assert result["readings"]["used"] == 30
    assert result["stand"] == {}


def test_too_few_or_alike_positions_are_refused():
    with pytest.raises(CalibrationError, match="9 free positions are too few"):
        calibrate(free_alone(9, 1e-4, 1), MODEL, {}, 9.81)
    # two great circles: no position has y and z inclined together
    readings = simulate(np.random.default_rng(1), 1e-4)
    with pytest.raises(
        CalibrationError, match=r"54 free positions do not determine the nine coefficients.* yz"
    ):
        calibrate(free_alone(0, 0, 1, readings.signal), MODEL, {}, 9.81)
    # the eight directions of an octant: a bowl that no ellipsoid closes is refused, whatever it looks like
    rng = np.random.default_rng(2)
    hyperboloid = rng.normal(size=(30, 3))
    hyperboloid[:, 2] = np.sign(hyperboloid[:, 2]) * np.sqrt(
        1 + hyperboloid[:, 0] ** 2 + hyperboloid[:, 1] ** 2
    )
    with pytest.raises(CalibrationError, match="do not lie on an ellipsoid"):
        calibrate(free_alone(0, 0, 1, hyperboloid), MODEL, {}, 9.81)


@pytest.mark.slow
def test_command_line_with_counts(bench):
    result = json.loads(
        printed(bench("calibrate", DATA / "xsens-38.csv", "--g", 9.81744, "--json", "-", "--out", "here"))
    )
    assert (result["unit"], result["per"], result["g_m_s2"]) == ("counts", "g", 9.81744)
    assert result["triangular"]["scale_ms2_per_unit"]["value"][0] == pytest.approx(0.0024130183, rel=1e-5)
    assert result["free_positions"]["rms_g"] == pytest.approx(100e-6, rel=0.01)
    Kxx, per_ms2 = result["coefficients"]["Kxx"], result["coefficients_per_ms2"]["Kxx"]
    assert per_ms2["value"] * 9.81744 == pytest.approx(Kxx["value"], rel=1e-12)
    assert result["coefficients_per_ms2"]["unit"] == "counts/(m/s^2)"
    out = printed(bench("calibrate", DATA / "innalabs-49.csv", "--estimator", "robust", "--out", "here"))
    assert out.count("outlier: ") == 2
    assert "point 22" in out
    assert bench("report", DATA / "innalabs-49.csv", "--out", "here")[0] == 0
    page = Path("here/innalabs-49.html").read_text(encoding="utf-8")
    assert "Free positions" in page


# --- joined -----------------------------------------------------------------------------------------


def verification_rows(readings, psi, noise=0.0):
    """The readings and four verification points, the block turned by psi about z of the platform."""
    theta = np.radians([45.0, 135.0, 225.0, 315.0])
    signal = specific_force(["V"] * 4, theta, psi=psi) @ K.T + U0 + noise
    return make_readings(
        [*readings.installation.tolist(), *["V"] * 4],
        [*readings.pass_number.tolist(), *[1] * 4],
        [*readings.point.tolist(), *range(1, 5)],
        np.concatenate([readings.angle_rad, theta]),
        np.concatenate([readings.signal, signal]),
    )


@pytest.mark.parametrize(("psi_deg", "rank"), [(45.0, 17), (0.0, 16)])
def test_rank_with_the_modulus_at_the_verification_points(psi_deg, rank):
    """20 unknowns: four angles an installation. Of the two third angles psi = 45 degrees shows the sum."""
    readings = verification_rows(simulate(None, 0.0), np.radians(psi_deg))
    verification = readings.verification()
    problem = make_problem(
        MODEL,
        readings.oriented().conditions(),
        STAND_WITH_ROLL,
        FreeRows(verification.signal, verification.conditions()),
    )
    block, others = Block(K, U0), np.zeros(8)
    moduli = modulus_rows(problem, block, others)
    rows = np.vstack([problem.jacobian(block, others).reshape(-1, 20), moduli.jacobian])
    size = np.linalg.svd(rows / np.linalg.norm(rows, axis=0), compute_uv=False)
    assert np.sum(size > 1e-4 * size[0]) == rank
    np.testing.assert_allclose(moduli.left, 0, atol=1e-14)


def test_joined_verification_points_show_the_third_mounting_angle():
    """A sum of 100 arcsec of alpha5 makes 5 parts in 10^4 of Kyz and Kzy; joined, it is found and taken off."""
    installation, pass_number, point, phi = design()
    signal = specific_force(installation, phi, alpha5=50 * ARCSEC) @ K.T + U0
    rng = np.random.default_rng(8)
    noise = rng.normal(0, 2e-5, signal.shape)
    table = make_readings(installation, pass_number, point, phi, signal + noise)
    table = verification_rows(table, np.pi / 4, rng.normal(0, 2e-5, (4, 3)))
    loose = STAND_U | {"mounting_roll": 100 * ARCSEC}
    apart = calibrate(table, MODEL, loose, 9.81)
    joined = calibrate(table, MODEL, loose, 9.81, join_verification=True)
    # only the sum is shown: the difference stays as it was, and goes into Kyz and Kzy with opposite signs
    for result, u in ((apart, 100 * np.sqrt(2)), (joined, 8.0)):
        both = result.stand["alpha5[1]"].value + result.stand["alpha5[2]"].value
        assert abs(both - 100) < 4 * u
    error = (joined.block.vector - TRUTH)[[KYZ, KZY]]
    sum_u = np.sqrt(
        joined.covariance[KYZ, KYZ] + joined.covariance[KZY, KZY] + 2 * joined.covariance[KYZ, KZY]
    )
    sum_u_apart = np.sqrt(
        apart.covariance[KYZ, KYZ] + apart.covariance[KZY, KZY] + 2 * apart.covariance[KYZ, KZY]
    )
    assert abs(error.sum()) < 4 * sum_u
    assert sum_u < sum_u_apart / 10
    assert any("do not check it independently" in note for note in joined.notes)
    assert calibration_json(joined)["free_positions"]["used"] == 4


def test_joined_estimate_is_that_of_the_textbook():
    """Against V^-1 of all rows written out, moduli and their noise among them; sizes given."""
    sizes = Noise(1e-4, 1e-5, np.inf, "given")
    readings = simulate_with_roll(np.random.default_rng(9), 1e-4, 3, 12)
    result = calibrate(readings, MODEL, STAND_WITH_ROLL, 9.81, noise=sizes)
    installation, phi = readings.installation[:54].tolist(), readings.angle_rad[:54]
    second = np.array(installation) == "2"

    def predicted(p):
        theta, angles = p[:12], p[12:].reshape(2, 4)
        a1, a2, a3, a5 = np.where(second[:, None], angles[1], angles[0]).T
        force = specific_force(installation, phi, a1, a2, a3, 0.0, a5)
        oriented = (force @ theta[:9].reshape(3, 3).T + theta[9:]).ravel()
        free = np.linalg.norm(
            np.linalg.solve(theta[:9].reshape(3, 3), (readings.signal[54:] - theta[9:]).T), axis=0
        )
        return np.concatenate([oriented, free])

    p = np.concatenate([result.block.vector, [e.value * ARCSEC for e in result.stand.values()]])
    steps = np.array([1e-5] * 12 + [1e-5] * 8)
    J = np.stack(
        [(predicted(p + h) - predicted(p - h)) / (2 * s) for s, h in zip(steps, np.diag(steps), strict=True)],
        axis=1,
    )
    h = 1e-5
    force = [specific_force(installation, phi, alpha4=setting_step) @ K.T for setting_step in (h, -h)]
    slope = (force[0] - force[1]) / (2 * h)
    weight = np.zeros((174, 174))
    for i in range(54):
        V = 1e-8 * np.eye(3) + 1e-10 * np.outer(slope[i], slope[i])
        weight[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = np.linalg.inv(V)
    force = np.linalg.solve(K, (readings.signal[54:] - U0).T).T
    w = np.linalg.norm(force / np.linalg.norm(force, axis=1)[:, None] @ np.linalg.inv(K), axis=1)
    weight[162:, 162:] = np.diag(1 / (1e-4 * w) ** 2)
    prior = np.concatenate([np.zeros(12), np.tile(1 / np.square([*STAND_U.values(), ROLL_U]), 2)])
    covariance = np.linalg.inv(J.T @ weight @ J + np.diag(prior))
    np.testing.assert_allclose(result.u, np.sqrt(np.diag(covariance))[:12], rtol=1e-3)
    # at the estimate the gradient of the whole is zero
    left = np.concatenate([readings.signal[:54].ravel(), np.ones(12)]) - predicted(p)
    gradient = covariance @ (J.T @ weight @ left - prior * p)
    assert np.all(np.abs(gradient) < 1e-2 * np.sqrt(np.diag(covariance)))


@pytest.mark.slow
@pytest.mark.parametrize("passes", [1, 3])
def test_uncertainty_with_free_positions_is_honest(passes):
    """40 runs, sizes of the noise unknown, a third mounting angle in each installation; seed [12, k]."""
    z = run_joined(12, range(40), 1e-4, passes)
    low, high = np.sqrt(stats.chi2.ppf([1e-5, 1 - 1e-5], 40) / 40)
    rms = np.sqrt(np.mean(z**2, axis=0))
    assert np.all((rms > 0.95 * low) & (rms < 1.05 * high)), rms.round(3)


def test_effects_are_taken_off_before_the_modulus():
    """Noise-free: the block's quadratic part, and the model has it; without it the moduli are far from 1 g."""
    K2 = np.array([300e-6, -200e-6, 100e-6])
    forces = free_forces(15, np.random.default_rng(3))
    readings = with_free(simulate(None, 0.0, K2=K2), forces, np.diag(K) * K2 * forces**2)
    model = ForwardModel(
        MODEL.installations, (AppliedEffect(CATALOGUE["quadratic_nonlinearity"], {"K2": K2}),), "bent"
    )
    problem = make_problem(
        model,
        readings.oriented().conditions(),
        STAND_U,
        FreeRows(readings.signal[54:], readings.select(~readings.is_oriented).conditions()),
    )
    values = np.concatenate([np.zeros(6), K2])
    assert np.abs(modulus_rows(problem, Block(K, U0), values).left).max() < 1e-12
    assert np.abs(modulus_rows(problem, Block(K, U0), np.zeros(9)).left).max() > 1e-4
    result = calibrate(readings, model, STAND_U, 9.81)
    np.testing.assert_allclose(result.block.vector, TRUTH, atol=1e-7)
    assert np.abs(result.modulus_error).max() < 1e-7


def test_derivatives_of_a_modulus_include_the_effects():
    """Early, block and voltmeter effects, compared with differences of the moduli themselves."""
    sizes = {"quadratic_nonlinearity": {"K2": np.array([3e-3, -2e-3, 1e-3])}, "wrong_gravity": {"excess": 2e-3},
             "channel_crosstalk": {"fraction": 0.0}, "voltmeter_gain": {"gain": 1e-3}}  # fmt: skip
    effects = tuple(
        AppliedEffect(CATALOGUE[name], {k: np.asarray(v) for k, v in of.items()})
        for name, of in sizes.items()
    )
    readings = with_free(simulate(None, 0.0), free_forces(12, np.random.default_rng(4)), 0.0)
    free = FreeRows(readings.signal[54:], readings.select(~readings.is_oriented).conditions())
    problem = make_problem(
        ForwardModel(MODEL.installations, effects), readings.oriented().conditions(), STAND_U, free
    )
    point = np.concatenate([TRUTH, problem.prior_mean])

    def left(at: Floats) -> Floats:
        return modulus_rows(problem, Block.from_vector(at[:12]), at[12:]).left

    found = modulus_rows(problem, Block(K, U0), problem.prior_mean).jacobian
    for j, step in enumerate(np.diag([*np.full(12, 1e-5), *1e-2 * problem.prior_u])):
        expected = (left(point - step) - left(point + step)) / (2 * step[j])
        np.testing.assert_allclose(found[:, j], expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())


def test_free_positions_may_stay_out():
    table = with_free(simulate(np.random.default_rng(1), 1e-4), free_forces(6, np.random.default_rng(2)), 0.0)
    joined = calibrate(table, MODEL, STAND_U, 9.81)
    apart = calibrate(table, MODEL, STAND_U, 9.81, join_free=False)
    alone = calibrate(table.oriented(), MODEL, STAND_U, 9.81)
    np.testing.assert_array_equal(apart.block.vector, alone.block.vector)
    assert np.all(joined.u <= apart.u * (1 + 1e-6))
    assert len(joined.modulus_error) == 6
    assert apart.free is None
    assert "6 free positions are not used: as asked" in apart.notes
    closed = calibrate(table, MODEL, STAND_U, 9.81, "closed-form")
    assert any("needs oriented readings" in note for note in closed.notes)
    with pytest.raises(CalibrationError, match="use gls or robust"):
        calibrate(table, MODEL, STAND_U, 9.81, "closed-form", join_verification=True)


@pytest.mark.parametrize(("estimator", "join_free"), [("closed-form", True), ("gls", False)])
def test_free_positions_alone_must_join(estimator, join_free):
    with pytest.raises(
        CalibrationError, match="must join the fit; use the estimator gls or robust, without --no-"
    ):
        calibrate(free_alone(60, 1e-5, 1), MODEL, STAND_U, 9.81, estimator, join_free=join_free)


def test_the_price_of_the_third_mounting_angle_with_joined_verification_points():
    """What is said of it is what a turn of 30 arcsec in installation 1 does to a fit that takes it as zero."""
    installation, pass_number, point, phi = design()
    first = np.array([i == "1" for i in installation])
    signal = specific_force(installation, phi, alpha5=np.where(first, 30 * ARCSEC, 0.0)) @ K.T + U0
    table = verification_rows(
        make_readings(installation, pass_number, point, phi, signal), np.pi / 4, np.zeros((4, 3))
    )
    sizes = Noise(1e-4, 1e-5, np.inf, "given")
    result = calibrate(table, MODEL, STAND_U, 9.81, noise=sizes, join_verification=True)
    sentence = next(s for s in result.assumed if s.startswith("mounting_roll"))
    assert "joined by |a| = 1 g would show the sum of alpha5[1] and alpha5[2], if the bench" in sentence
    told = re.search(r"1 arcsec in installation 1 puts (\S+) µV/g into Kyz", sentence)
    moved = (result.block.vector - TRUTH)[KYZ] / 30
    assert float(told[1]) * 1e-6 == pytest.approx(moved, rel=0.02)
    # at the verification points the block is not turned: nothing shows it there
    still = verification_rows(
        make_readings(installation, pass_number, point, phi, signal), 0.0, np.zeros((4, 3))
    )
    unseen = calibrate(still, MODEL, STAND_U, 9.81, noise=sizes, join_verification=True)
    assert any("mounting_roll" in s and "nothing in these readings shows it" in s for s in unseen.assumed)


def test_assumptions_of_many_mountings_stay_readable():
    noisy = [simulate(np.random.default_rng(seed), 1e-4, passes=1) for seed in range(6)]
    table = make_readings(
        np.concatenate([t.installation for t in noisy]).tolist(),
        np.concatenate([t.pass_number for t in noisy]).tolist(),
        np.concatenate([t.point for t in noisy]).tolist(),
        np.concatenate([t.angle_rad for t in noisy]),
        np.vstack([t.signal for t in noisy]),
        series=np.repeat(np.arange(1, 7), 18).tolist(),
    )
    roll, turn, *_ = calibrate(table, MODEL, STAND_U, 9.81).assumed
    assert "1 arcsec in one of the 6 mountings in installation 1 puts" in roll
    assert turn.startswith("alpha2, alpha3 of 12 mountings: in some combination a common turn")
    assert max(len(roll), len(turn)) < 400


@pytest.mark.parametrize("passes", [1, 3])
@pytest.mark.parametrize("modulus_g", [0.999, 0.9])
def test_a_moving_position_is_named_and_not_the_noise(passes, modulus_g):
    """Seed 3, noise 100 µV; the fourth of 24 positions was moving: gls names it, and takes no noise from it."""
    rng = np.random.default_rng(3)
    readings = simulate_with_roll(rng, 1e-4, passes, 24)
    signal = readings.signal.copy()
    moving = int(np.flatnonzero(readings.installation == "F")[3])
    signal[moving] = U0 + modulus_g * (signal[moving] - U0)
    found = calibrate(replace(readings, signal=signal), MODEL, STAND_WITH_ROLL, 9.81)
    named = [note for note in found.notes if "outlier found" in note]
    assert len(named) == 1
    said = re.search(rf"row {moving + 1} \(installation F.*modulus: off by (\S+) g", named[0])
    assert float(said[1]) == pytest.approx(modulus_g - 1.0, abs=1e-4)  # u is 40 µg
    if passes > 1:  # without repeats the noise is that of all residuals
        assert not found.lack_of_fit.accepted()
        assert found.noise.reading == pytest.approx(1e-4, rel=0.3)
        assert found.birge > 2


def test_effects_so_large_that_no_force_changes_the_readings_are_refused_in_words():
    """As in fits to readings of a pass whose angles are all wrong."""
    problem = SimpleNamespace(
        model=SimpleNamespace(name="paper + scale_step", effects=("scale_step",)),
        by_stages=lambda *_: np.zeros((1, 3, 12)),
    )
    still = SimpleNamespace(readings=np.zeros((1, 3)))
    with pytest.raises(SpoiledFit, match=r"the effects of model paper \+ scale_step are too large"):
        modulus_columns(problem, Block(K, U0), np.zeros(0), lambda _: still, np.ones((1, 3)), slice(None))
