"""Noise sizes from repeats or residuals, and lack of fit, on simulations by bench/validation/paper_bench.py."""

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize

from bench.calibration import Noise, calibrate
from bench.calibration.noise import noise_from_repeats, repeat_groups, scatter_of_repeats
from bench.model import CATALOGUE, AppliedEffect, Conditions, ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from bench.validation.paper_bench import ARCSEC, SETTING_U_RAD, STAND_U, TRUTH, simulate, specific_force

INSTALLATIONS = {"1": INSTALLATION_1, "2": INSTALLATION_2}
MODEL = ForwardModel(INSTALLATIONS)


def with_effect(name, values=None, **options):
    return ForwardModel(INSTALLATIONS, (AppliedEffect(CATALOGUE[name], values or {}, **options),), name)


def test_repeats_are_of_one_mounting_point_and_direction():
    conditions = Conditions.of(
        ["1", "1", "1", "1", "2", "1"],
        np.zeros(6),
        point=[1, 1, 2, 1, 1, 1],
        direction=[1, 1, 1, -1, 1, 1],
        series=[1, 1, 1, 1, 1, 2],
    )
    groups = repeat_groups(conditions)
    assert groups[0] == groups[1]
    assert len(set(groups.tolist())) == 5


def test_repeats_likelihood_is_the_full_gaussian_one():
    """-2 log L of each group's deviations, covariance s_u^2 I + s_phi^2 d d^T written out, by Nelder-Mead.

    Restricted: deviations from the group's mean have count - 1 degrees of freedom.
    """
    rng = np.random.default_rng(17)
    counts = rng.integers(1, 5, 14)
    groups = np.repeat(np.arange(14), counts)
    d = rng.normal(size=(14, 3)) * 2
    noise = rng.normal(0, 2e-5, (len(groups), 3)) + rng.normal(0, 1.6e-5, len(groups))[:, None] * d[groups]
    mean = np.stack([noise[groups == g].mean(axis=0) for g in range(14)])

    def minus_two_log_likelihood(log_sizes):
        total = 0.0
        for g in range(14):
            V = np.exp(2 * log_sizes[0]) * np.eye(3) + np.exp(2 * log_sizes[1]) * np.outer(d[g], d[g])
            deviation = noise[groups == g] - mean[g]
            total += (counts[g] - 1) * np.linalg.slogdet(V)[1]
            total += np.sum(deviation * np.linalg.solve(V, deviation.T).T)
        return total

    best = minimize(minus_two_log_likelihood, np.log([3e-5, 1e-5]), method="Nelder-Mead",
                    options={"xatol": 1e-7, "fatol": 1e-10})  # fmt: skip
    ours = noise_from_repeats(scatter_of_repeats(noise + 0.3, d[groups], groups), 1e-9)
    np.testing.assert_allclose(np.log([ours.reading, ours.setting_rad]), best.x, atol=1e-3)
    assert ours.dof == 3 * (counts.sum() - 14)


def test_source_of_the_noise_follows_the_repeats():
    three = calibrate(simulate(np.random.default_rng(1), 1e-4), MODEL, STAND_U, 9.81)
    assert (three.noise.source, three.noise.dof) == ("repeats", 108)
    one = calibrate(simulate(np.random.default_rng(1), 1e-4, passes=1), MODEL, STAND_U, 9.81)
    assert one.noise.source == "residuals"
    assert np.isnan(one.lack_of_fit.p)
    # standard deviation from 42 less degrees of freedom: four of its standard errors
    assert one.noise.reading == pytest.approx(1e-4, rel=4 / np.sqrt(2 * 30))
    given = Noise(1e-4, 1e-5, np.inf, "given")
    believed = calibrate(simulate(np.random.default_rng(1), 1e-4), MODEL, STAND_U, 9.81, noise=given)
    assert believed.noise is given


def test_sizes_that_are_estimates_widen_the_uncertainty():
    """JCGM 101, 6.4.9.4: s sqrt(nu/(nu - 2)); 108 signals give 72 degrees of freedom to the reading noise."""
    run = simulate(np.random.default_rng(1), 1e-4)
    estimated = calibrate(run, MODEL, {}, 9.81)
    sizes = Noise(estimated.noise.reading, estimated.noise.setting_rad, np.inf, "given")
    believed = calibrate(run, MODEL, {}, 9.81, noise=sizes)
    assert estimated.noise.dof == 108
    np.testing.assert_allclose(estimated.u, believed.u * np.sqrt(72 / 70), rtol=1e-6)
    closed = [calibrate(run, MODEL, {}, 9.81, "closed-form", noise) for noise in (None, sizes)]
    np.testing.assert_allclose(closed[0].u, closed[1].u * np.sqrt(72 / 70), rtol=1e-6)


def test_setting_errors_without_any_voltmeter_noise():
    readings = simulate(np.random.default_rng(2), 0.0, setting_u_rad=10 * ARCSEC)
    result = calibrate(readings, MODEL, STAND_U, 9.81)
    assert result.noise.reading < 1e-7
    # 36 repeats: four standard errors
    assert result.noise.setting_rad == pytest.approx(10 * ARCSEC, rel=4 / np.sqrt(72))
    assert np.all(np.abs(result.block.vector - TRUTH) < 5 * result.u)


def test_voltmeter_noise_without_any_setting_error():
    readings = simulate(np.random.default_rng(3), 1e-4, setting_u_rad=0.0)
    result = calibrate(readings, MODEL, STAND_U, 9.81)
    assert result.noise.reading == pytest.approx(1e-4, rel=4 / np.sqrt(2 * 72))
    # 36 degrees of freedom along du/dphi: zero lies within the limits of 95 %
    assert result.noise.setting_limits_rad[0] == 0.0
    assert result.noise.setting_rad < 7 * ARCSEC


def hidden_quadratic(noise_v, model=MODEL, seed=5):
    K2 = np.array([100e-6, -100e-6, 100e-6])
    return calibrate(simulate(np.random.default_rng(seed), noise_v, K2=K2), model, STAND_U, 9.81)


@pytest.mark.parametrize(("noise_v", "p"), [(1e-4, 1e-3), (2e-5, 1e-12)])
def test_a_hidden_nonlinearity_shows_as_lack_of_fit(noise_v, p):
    """100 ug/g^2 against 17 ug/g^2 (0.1 mV) and 3.4 ug/g^2 (20 uV) that three passes could tell."""
    assert hidden_quadratic(noise_v).lack_of_fit.p < p


@pytest.mark.parametrize("noise_v", [1e-4, 2e-5])
def test_the_nonlinearity_in_the_model_is_recovered(noise_v):
    """Nothing shrinks it: the size is far beyond the plausible one of the catalogue."""
    result = hidden_quadratic(noise_v, with_effect("quadratic_nonlinearity"))
    assert result.lack_of_fit.p > 0.01
    for axis, truth in zip("xyz", (100, -100, 100), strict=True):
        estimate = result.effects[f"quadratic_nonlinearity.K2[{axis}]"]
        assert estimate.unit == "ug/g^2"
        assert abs(estimate.value - truth) < 4 * estimate.u
        assert estimate.u < (25 if noise_v == 1e-4 else 8)
    assert np.all(np.abs(result.block.vector - TRUTH) < 4 * result.u)
    assert result.model == "quadratic_nonlinearity"


def test_marks_of_the_head_where_no_reading_is_take_no_degrees_of_freedom():
    """Of the eight marks read, seven errors show: a common one is in the zero offset."""
    readings = simulate(np.random.default_rng(12), 5e-5)
    plain = calibrate(readings, MODEL, STAND_U, 9.81, find_shared=False).lack_of_fit
    marks = calibrate(readings, with_effect("head_graduation"), STAND_U, 9.81, find_shared=False).lack_of_fit
    assert marks.dof == plain.dof - 7
    assert marks.p > 0.01


@pytest.mark.slow
def test_uncertainty_of_a_recovered_effect_is_honest():
    """Root mean square of (estimate - truth)/u of three K2 over 60 runs, seed [41, k]: chi-square of 180."""
    model = with_effect("quadratic_nonlinearity")
    truth = np.array([60.0, -40.0, 20.0])
    z = []
    for k in range(60):
        run = calibrate(simulate(np.random.default_rng([41, k]), 2e-5, K2=truth * 1e-6), model, STAND_U, 9.81)
        found = list(run.effects.values())
        z.append([(e.value - t) / e.u for e, t in zip(found, truth, strict=True)])
    low, high = np.sqrt(stats.chi2.ppf([1e-4, 1 - 1e-4], 180) / 180)
    assert 0.93 * low < np.sqrt(np.mean(np.square(z))) < 1.07 * high


def test_eccentricity_in_the_model_is_recovered():
    run = simulate(np.random.default_rng(6), 2e-5, eccentricity_rad=(20 * ARCSEC, -15 * ARCSEC))
    assert calibrate(run, MODEL, STAND_U, 9.81).lack_of_fit.p < 1e-6
    result = calibrate(run, with_effect("head_eccentricity"), STAND_U, 9.81)
    assert result.lack_of_fit.p > 0.01
    for name, truth in (("cosine", 20), ("sine", -15)):
        estimate = result.effects[f"head_eccentricity.{name}"]
        assert estimate.unit == "arcsec"
        assert abs(estimate.value - truth) < 4 * estimate.u
    assert np.all(np.abs(result.block.vector - TRUTH) < 4 * result.u)


def test_a_stated_uncertainty_of_an_effect_is_its_prior():
    """Known from elsewhere to 0.1 ug/g^2, the readings' 17 ug/g^2 add nothing; on channel z alone."""
    known = {"K2": np.array([0.0, 0.0, 100e-6])}
    model = with_effect(
        "quadratic_nonlinearity", known, channels=("z",), u={"K2": np.array([0.0, 0.0, 1e-7])}
    )
    run = simulate(np.random.default_rng(7), 1e-4, K2=np.array([0.0, 0.0, 100e-6]))
    effects = calibrate(run, model, STAND_U, 9.81).effects
    assert list(effects) == ["quadratic_nonlinearity.K2[z]"]
    estimate = effects["quadratic_nonlinearity.K2[z]"]
    assert estimate.u == pytest.approx(0.1, rel=1e-3)
    assert estimate.value == pytest.approx(100, abs=0.1)


def test_the_closed_form_has_the_lack_of_fit_of_the_model():
    """alpha3 = 30 arcsec stays in its residuals, which is no fault of the model."""
    run = simulate(np.random.default_rng(8), 2e-5)
    least_squares = calibrate(run, MODEL, STAND_U, 9.81)
    closed = calibrate(run, MODEL, STAND_U, 9.81, "closed-form")
    assert closed.lack_of_fit.p == pytest.approx(least_squares.lack_of_fit.p, abs=1e-6)
    assert closed.lack_of_fit.rms == pytest.approx(np.sqrt(np.mean(closed.residuals**2)))
    assert closed.lack_of_fit.rms > 2 * least_squares.lack_of_fit.rms


STATED = STAND_U | {"voltmeter_error": 1e-4, "setting_error": SETTING_U_RAD}


def of_stated_noise(readings):
    """The generalised least-squares chi-square of twelve coefficients at the stated sizes, in full, and its dof."""
    at, phi, signal = readings.installation, readings.angle_rad, readings.signal
    n, still = len(phi), np.zeros(len(phi))
    X = np.kron(np.column_stack([specific_force(at, phi), np.ones(n)]), np.eye(3))
    K = np.linalg.lstsq(X, signal.ravel(), rcond=None)[0].reshape(4, 3).T[:, :3]
    errors = [(3, row, STATED["setting_error"]) for row in np.eye(n)]
    sizes = [STATED[name] for name in ("axis_tilt", "zero_offset", "mounting_error")]
    errors += [(k, at == one, size) for one in "12" for k, size in enumerate(sizes)]
    V = STATED["voltmeter_error"] ** 2 * np.eye(3 * n)
    for place, rows, size in errors:
        angles = [still.copy() for _ in range(4)]
        angles[place] = 1e-5 * rows
        slope = ((specific_force(at, phi, *angles) - specific_force(at, phi)) @ K.T).ravel() / 1e-5
        V += size**2 * np.outer(slope, slope)
    lower = np.linalg.cholesky(V)
    rows, left = np.linalg.solve(lower, X), np.linalg.solve(lower, signal.ravel())
    left -= rows @ np.linalg.lstsq(rows, left, rcond=None)[0]
    return float(left @ left), 3 * n - 12


def test_residuals_without_repeats_are_held_against_the_stated_noise():
    """Seed 8: a head with 300 arcsec of eccentricity in one pass; a pass as stated says nothing."""
    for eccentric in (0.0, 300.0):
        readings = simulate(
            np.random.default_rng(8), 1e-4, passes=1, eccentricity_rad=(eccentric * ARCSEC, 0.0)
        )
        found = calibrate(readings, MODEL, STATED, 9.81)
        chi2, dof = of_stated_noise(readings)
        assert found.noise.stated.ratio == pytest.approx(np.sqrt(chi2 / dof), rel=0.01)
        assert found.noise.stated.p == pytest.approx(
            2 * min(stats.chi2.sf(chi2, dof), stats.chi2.cdf(chi2, dof)), rel=0.1, abs=1e-12
        )
        told = [note for note in found.notes if "repeat passes, and check the head or the model" in note]
        assert len(told) == (1 if eccentric else 0)
        assert all(f"the residuals are {np.sqrt(chi2 / dof):.2g} times as large" in note for note in told)
    assert calibrate(simulate(np.random.default_rng(8), 1e-4), MODEL, STATED, 9.81).noise.stated is None
