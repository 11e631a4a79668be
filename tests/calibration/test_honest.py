"""Are the stated uncertainties true? 40 simulated runs at each of two noise levels.

Simulation by bench.validation: the paper's stand with its limits as three sigma, noise sizes unknown to
the fit; run k has the seed [2024, k] at 0.1 mV and [2025, k] at 20 uV. Thousands of runs of such a stand are
`benchmarks/signed_uncertainty.py --cases stand`.
"""

import numpy as np
import pytest
from scipy import stats

from bench.calibration import CalibrationError, calibrate, gls
from bench.calibration.calibrate import first_guess
from bench.calibration.design import make_problem
from bench.calibration.noise import KnownNoise, KnownStand
from bench.validation.paper_bench import SETTING_U_RAD, STAND_U, simulate
from tests.support.honest_runs import FEW, MODEL, STATED, run, run_few, simulate_few
from tests.support.results import calibration_json

pytestmark = pytest.mark.slow

RUNS = 40
SEEDS = {1e-4: 2024, 2e-5: 2025}
# each bound fails a true 1 with probability 2e-5: 24 of them, 1 in 2000 for all together
LOW, HIGH = np.sqrt(stats.chi2.ppf([1e-5, 1 - 1e-5], RUNS) / RUNS)


@pytest.fixture(scope="module", params=list(SEEDS), ids=["0.1 mV", "20 uV"])
def level(request):
    return request.param, run(SEEDS[request.param], range(RUNS), request.param)


def test_errors_are_as_large_as_their_stated_uncertainty(level):
    """Promised: 0.95 to 1.05 for every coefficient, here widened by what 40 runs can tell (chi-square)."""
    _, runs = level
    assert np.all(runs.z > 0.95 * LOW), runs.z.round(3)
    assert np.all(runs.z < 1.05 * HIGH), runs.z.round(3)
    # all twelve together are worth more runs, correlated in pairs at most: four standard errors beside the promise
    told = 4 / np.sqrt(2 * RUNS * 6)
    assert 0.95 - told < np.sqrt(np.mean(runs.z**2)) < 1.05 + told


def test_the_closed_forms_uncertainty_is_honest_too(level):
    _, runs = level
    assert np.all(runs.z_closed > 0.95 * LOW), runs.z_closed.round(3)
    assert np.all(runs.z_closed < 1.05 * HIGH), runs.z_closed.round(3)


def test_kyx_and_kzx_are_four_times_better_than_with_8(level):
    """Expected from the covariances: 4.6 times at 0.1 mV, 8 times at 20 uV."""
    _, runs = level
    assert np.all(runs.gain[[3, 6]] > 4.0), runs.gain.round(2)


def test_no_coefficient_is_worse_than_with_8(level):
    """Paired over the runs; three standard errors."""
    _, runs = level
    assert np.all(runs.paired_t > -3.0), runs.paired_t.round(1)


def test_noise_sizes_are_estimated_without_bias(level):
    """Variance of a run from 72 degrees of freedom, its mean over the runs to four standard errors.

    In every sixth run chance alone makes a component of the readings, which takes a quarter of the noise with it.
    """
    noise_v, runs = level
    assert np.mean(runs.reading**2) / noise_v**2 == pytest.approx(1, abs=0.04 + 4 * np.sqrt(2 / 72 / RUNS))
    if noise_v == 2e-5:
        # 36 degrees of freedom along dU/dphi; at 0.1 mV the estimate is often cut off at zero
        spread = np.std(runs.setting_rad**2) / np.sqrt(RUNS) / SETTING_U_RAD**2
        assert np.mean(runs.setting_rad**2) / SETTING_U_RAD**2 == pytest.approx(1, abs=4 * spread)


def test_p_of_lack_of_fit_is_uniform_when_the_model_is_true(level):
    """Binomial bounds with probability 1e-4 on each side, for five fractions."""
    _, runs = level
    for fraction in (0.01, 0.05, 0.25, 0.5, 0.9):
        low, high = stats.binom.ppf([1e-4, 1 - 1e-4], RUNS, fraction)
        assert low <= np.sum(runs.p < fraction) <= high, fraction


def test_one_pass_is_honest():
    """No repeats: few residuals tell the sizes of the noise, and u has to be wide enough for that.

    20 runs, seed [2026, k].
    """
    runs = run(2026, range(20), 1e-4, passes=1)
    low, high = np.sqrt(stats.chi2.ppf([1e-5, 1 - 1e-5], 20) / 20)
    assert np.all(runs.z > 0.95 * low), runs.z.round(3)
    assert np.all(runs.z < 1.05 * high), runs.z.round(3)


# --- few readings ---------------------------------------------------------------------------------


def few(design, seed, times=1.0, stated=STATED, known=None):
    readings = simulate_few(np.random.default_rng(seed), design, times * 1e-4, times * SETTING_U_RAD)
    return calibrate(readings, MODEL, stated, 9.81, known=known)


def test_saturated_readings_have_the_noise_that_the_bench_file_states():
    """Four readings, twelve signals: without the statement the noise was 0.3 uV, and u(Kxx) 2 uV/g for 70."""
    found = few("2+2", 1)
    assert found.noise.reading == pytest.approx(1e-4)
    assert found.noise.setting_rad == pytest.approx(SETTING_U_RAD, rel=1e-3)
    assert found.noise.reading_dof == 4.0
    # 100 uV in the half difference of two readings, widened for four degrees of freedom
    assert found.u_readings[0] == pytest.approx(np.sqrt(2) * 70e-6, rel=0.05)
    assert any(
        "u rests on the sizes of the noise that the bench file states (reading 100 µV" in n
        for n in found.notes
    )
    prior = calibration_json(found)["noise"]["prior"]
    assert (prior["reading_v"], prior["dof"], prior["p"], prior["from"]) == (
        pytest.approx(1e-4), 4.0, None, "bench file"
    )  # fmt: skip


@pytest.mark.parametrize("design", FEW)
def test_few_readings_are_refused_where_nobody_states_the_noise(design):
    with pytest.raises(CalibrationError, match="state voltmeter_error in the bench file"):
        few(design, 1, stated=STAND_U)


@pytest.mark.slow
@pytest.mark.parametrize("design", ["2+2", "3+2"])
def test_intervals_of_few_readings_hold_the_truth(design):
    """Seed 50, 40 runs, noise drawn from the stated prior: 0.95, to three errors of 40 independent intervals."""
    runs = run_few(50, range(40), design)
    assert not runs.refused
    assert runs.rests.all()
    assert runs.covered.mean() > 0.95 - 3 * np.sqrt(0.05 * 0.95 / 40)


def test_readings_that_disagree_with_the_statement_say_so():
    """3 + 3 readings leave six degrees of freedom: noise of five times the stated one cannot hide in them."""
    found = few("3+3", 4, times=5.0)
    prior = found.noise.prior
    assert prior.ratio > 2
    assert prior.p < 0.05
    assert found.noise.reading > 2e-4
    assert any("the readings disagree: they scatter" in note for note in found.notes)


def test_what_other_runs_told_stands_in_place_of_the_statement():
    """Each channel in its ratio, also where four readings leave nothing over."""
    sizes = np.array([0.5e-4, 1e-4, 2e-4])
    noise = KnownNoise(sizes, np.full(3, 20.0), SETTING_U_RAD, 20.0)
    tilt = STAND_U["axis_tilt"]
    stand = KnownStand((("axis_tilt", ""),), np.zeros(1), np.array([[tilt**2]]), {"axis_tilt": tilt}, noise)
    found = few("2+2", 1, known=stand)
    np.testing.assert_allclose(found.noise.by_channel, sizes, rtol=1e-3)
    assert found.noise.reading_dof == pytest.approx(20.0)
    assert any("other runs gave" in note for note in found.notes)


@pytest.mark.parametrize("passes", [1, 3])
def test_a_statement_counts_nothing_beside_readings_that_tell_the_noise(passes):
    """18 and 54 readings at a fifth of the stated noise: to the last digit what they are without a statement."""
    readings = simulate(np.random.default_rng(5), 2e-5, passes=passes)
    with_it, without = (calibrate(readings, MODEL, sizes, 9.81) for sizes in (STATED, STAND_U))
    assert with_it.noise.prior is None
    np.testing.assert_array_equal(with_it.covariance, without.covariance)


@pytest.mark.parametrize("seed", [287, 399])
def test_a_good_file_converges_whose_noise_has_two_maxima_of_likelihood(seed):
    """3 + 3 readings without a statement: their sizes went to and fro with the point, and the file was refused."""
    readings = simulate_few(np.random.default_rng([1, seed]), "3+3", 1e-4, SETTING_U_RAD)
    problem = make_problem(MODEL, readings.conditions(), STAND_U)
    fit = gls.fit(problem, readings.signal, first_guess(problem, readings.signal))
    assert np.all(np.isfinite(fit.covariance))


def test_a_fit_that_does_not_converge_says_what_still_moves(monkeypatch):
    monkeypatch.setattr(gls, "MOST_ITERATIONS", 1)
    with pytest.raises(
        CalibrationError, match=r"the fit did not converge: after 1 steps \S+ still moves by .* of its"
    ):
        few("3+3", 1)
