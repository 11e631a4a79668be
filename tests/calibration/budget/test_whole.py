"""The combined uncertainty: against closed forms, against the budget of the plan, against drawn truth."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from bench.calibration import calibrate
from bench.calibration.budget.coefficients import Setup, make_budget
from bench.calibration.budget.sources import assumed_stand, bench_sources
from bench.calibration.budget.whole import delta_g_contributions, delta_g_elsewhere, sign
from bench.calibration.result import Noise
from bench.config.bench_file.file import load_bench
from bench.config.bench_file.stand import RatioError, TemperatureError, VoltageError, ZeroRepeats
from bench.model import Block, ForwardModel
from bench.model.geometry import COEFFICIENTS
from bench.readings.table import VERIFICATION, make_readings
from bench.validation.paper_bench import ARCSEC, U0, K, simulate, specific_force
from tests.support.results import calibration_json
from tests.support.whole_truth import CASES, simulate_whole

BENCH = load_bench(Path(__file__).parents[3] / "config" / "paper-stand.yaml")
MODEL = ForwardModel(BENCH.installation_models())
STAND_U = {name: d.u for name, d in BENCH.stand_distributions().items()}
ASSUMED = {name: d.u for name, d in assumed_stand(BENCH).items()}


def signed(readings, noise=None, **options):
    found = calibrate(readings, MODEL, STAND_U, 9.81, noise=noise, assumed_u=ASSUMED, **options)
    return sign(found, readings, BENCH, MODEL)


@pytest.fixture(scope="module")
def run():
    return simulate_whole(np.random.default_rng([3, 1]), "stand").readings


def delta_g_covariance(*asked):
    """The covariance of |a| at the verification rows."""
    return sum(delta_g_contributions(*asked).values())


def source(found, name):
    return next(s for s in found.sources if s.name == name)


def test_gain_and_offset_in_closed_form(run):
    """Each meter's gain scales its own row of K and its bias; an offset is in its bias alone."""
    found = signed(run)
    u_gain, u_offset = 20e-6 / np.sqrt(3), 50e-6 / np.sqrt(3)
    gain = source(found, "voltmeter_gain").covariance
    rows = np.kron(np.eye(3), np.ones((3, 3)))
    own = np.outer(found.block.vector, found.block.vector) * u_gain**2
    # noise and the stand's angles make the readings deviate from U = K a + U0 by less than a thousandth
    np.testing.assert_allclose(gain[:9, :9], own[:9, :9] * rows, atol=2e-3 * u_gain**2 * 4.6)
    offset = source(found, "voltmeter_offset").covariance
    np.testing.assert_allclose(offset[9:, 9:], np.eye(3) * u_offset**2, rtol=1e-3, atol=1e-3 * u_offset**2)


def test_the_roll_is_as_large_as_the_mounting_error(run):
    """1 arcsec is 10.4 uV/g of Kyz and Kzy (metrology: 934 uV/g for 90 arcsec): in u, not in u_readings."""
    found = signed(run)
    roll = np.sqrt(np.diag(source(found, "mounting_roll").covariance))
    for name in ("Kyz", "Kzy"):
        j = COEFFICIENTS.index(name)
        assert roll[j] == pytest.approx(30 * 10.38e-6, rel=0.01)
        assert found.u_readings[j] < 0.2 * found.u[j]


def test_the_readings_part_is_that_of_a_fit_without_the_roll(run):
    alone = calibrate(run, MODEL, STAND_U, 9.81)
    np.testing.assert_allclose(signed(run).u_readings, alone.u, rtol=2e-3)


def test_it_is_the_budget_of_the_plan_where_the_noise_is_the_same(run):
    """Promised to 1 %. The plan's readings are those taken, at a stand without errors."""
    noise = Noise(1e-4, STAND_U["setting_error"], np.inf, "given")
    found = signed(run, noise)
    setup = Setup(MODEL, run.conditions(), Block.from_vector(found.block.vector))
    budget = make_budget(setup, bench_sources(BENCH, setup))
    np.testing.assert_allclose(found.u, budget.per_local_g.u, rtol=0.01)
    for name in ("voltmeter_gain", "voltmeter_offset", "voltmeter_linearity", "temperature", "K2", "K3"):
        u = np.sqrt(np.diag(source(found, name).covariance))
        np.testing.assert_allclose(u, budget.contribution(name).u, rtol=0.02, atol=1e-6)


def test_equal_voltages_have_equal_errors_of_linearity(run):
    """Installation 2 at 270° has the voltages of installation 1 at 90°: budget and calibrate count them once."""
    found = signed(run, Noise(1e-4, STAND_U["setting_error"], np.inf, "given"))
    setup = Setup(MODEL, run.conditions(), Block.from_vector(found.block.vector))
    budget = make_budget(setup, bench_sources(BENCH, setup))
    u = np.sqrt(np.diag(source(found, "voltmeter_linearity").covariance))
    np.testing.assert_allclose(u, budget.contribution("voltmeter_linearity").u, rtol=0.02)


def test_passes_at_half_degrees_share_their_error_of_linearity():
    """Seed 4: as read, 22.5° is on either side of the half degree."""
    angle = np.tile(np.arange(16) * np.pi / 8, 6)
    labels, passes = np.repeat(["1", "2"], 48), np.tile(np.repeat([1, 2, 3], 16), 2)
    read = angle + np.random.default_rng(4).normal(0.0, 2 * ARCSEC, len(angle))
    zero = np.zeros(len(angle))
    signal = specific_force(labels, angle, zero, zero, zero, zero, zero) @ K.T + U0
    exact, as_read = (
        signed(
            make_readings(labels.tolist(), passes.tolist(), np.tile(np.arange(1, 17), 6).tolist(), at, signal,
                          source="half degrees"),
            Noise(1e-4, STAND_U["setting_error"], np.inf, "given"),
        )
        for at in (angle, read)
    )  # fmt: skip
    u, u_read = (np.diag(source(one, "voltmeter_linearity").covariance) ** 0.5 for one in (exact, as_read))
    np.testing.assert_allclose(u_read, u, rtol=0.01)


def test_points_verified_at_another_temperature_leave_u_of_the_coefficients(run):
    """The coefficients are those of the readings in the fit, at 23 °C, wherever they are verified."""
    at_c = np.full(len(run), 23.0)
    warm = np.where(run.installation == VERIFICATION, 33.0, 23.0)
    alike, apart = (signed(dataclasses.replace(run, temperature_c=one)) for one in (at_c, warm))
    np.testing.assert_allclose(apart.u, alike.u, rtol=1e-9)


def test_what_cancels_cancels(run):
    """The same meters at calibration and check: their gain and offset add nothing to delta g."""
    found = signed(run)
    whole = np.sqrt(np.diag(delta_g_covariance(found, run, BENCH, MODEL)))
    both = found.covariance_same_meters
    noise = found.noise.by_channel
    same = delta_g_elsewhere(found.block, both, noise, run, BENCH, MODEL, same_meters=True)
    other = delta_g_elsewhere(found.block, found.covariance, noise, run, BENCH, MODEL, same_meters=False)
    assert np.all(np.diag(other) > np.diag(same))
    # by the same table K2 and K3 cancel in part, too: never more than coefficients of another day
    assert np.all(whole <= np.sqrt(np.diag(same)) * 1.001)
    without = sign(
        calibrate(run, MODEL, STAND_U, 9.81, assumed_u=ASSUMED), run, _with_meters("1 ppm", "1 uV"), MODEL
    )
    small = np.sqrt(np.diag(delta_g_covariance(without, run, _with_meters("1 ppm", "1 uV"), MODEL)))
    np.testing.assert_allclose(whole, small, rtol=1e-3)


def test_what_k2_and_k3_did_to_the_coefficients_they_do_at_the_points(run):
    """Coefficients of the same table, its K2 and K3 known to be those of the check: no more than cancels there."""
    found = signed(run)
    both, noise = found.covariance_same_meters, found.noise.by_channel
    apart, known = (
        delta_g_elsewhere(found.block, both, noise, run, BENCH, MODEL, same_meters=True, block_terms=terms)
        for terms in (None, found.block_terms)
    )
    whole = delta_g_covariance(found, run, BENCH, MODEL)
    assert np.all(np.diag(known) < np.diag(apart))
    # what is left beside the whole is the temperature, an offset that one table shares and another day has anew:
    # of calibration and check, n^2 of a bias and n^4 of a scale factor for each channel
    n = found.block.specific_force(run.signal[run.installation == VERIFICATION])
    temperature = (0.5**2 / 3) * (n**2 * (30e-6**2 / 3) + n**4 * (180e-6**2 / 3)).sum(axis=1)
    np.testing.assert_allclose(np.diag(known), np.diag(whole) + 2 * temperature, rtol=0.1)


def _with(**sizes):
    stated = {name: form(limit=limit, distribution="rectangular") for name, (limit, form) in sizes.items()}
    return BENCH.model_copy(update={"uncertainty": BENCH.uncertainty.model_copy(update=stated)})


def _with_meters(gain, offset):
    return _with(voltmeter_gain=(gain, RatioError), voltmeter_offset=(offset, VoltageError))


@pytest.mark.parametrize("seed", [None, 1])
def test_noise_adds_to_u(seed):
    """Computed readings, with and without stand errors, have no larger u than readings with 1 µV of noise.

    If the fit takes the noise as nearly zero, u of the cross-axis terms is a hundred times as large.
    """
    exact = simulate(np.random.default_rng(seed) if seed else None, 0.0, setting_u_rad=0.0)
    noise = np.random.default_rng(2).normal(0.0, 1e-6, exact.signal.shape)
    noisy = dataclasses.replace(exact, signal=exact.signal + noise)
    assert np.all(signed(exact).u < 1.02 * signed(noisy).u)


def test_an_offset_of_the_temperature_moves_what_its_u_says(run):
    """Off by one u with coefficients of one u: the same throughout the run, so no pass averages it."""
    found = signed(run)
    off_k, per_k = 0.5 / np.sqrt(3), 180e-6 / np.sqrt(3)
    warm = dataclasses.replace(run, signal=run.signal + off_k * per_k * (run.signal - found.block.U0))
    moved = signed(warm).block.vector - found.block.vector
    u = np.sqrt(np.diag(source(found, "temperature").covariance))
    for name in ("Kxx", "Kyy", "Kzz", "Kzx"):
        j = COEFFICIENTS.index(name)
        assert abs(moved[j]) == pytest.approx(u[j], rel=0.01)
    # calibration and check of one table share it
    without = delta_g_covariance(found, run, _with(temperature=("1 mK", TemperatureError)), MODEL)
    np.testing.assert_allclose(delta_g_covariance(found, run, BENCH, MODEL), without, rtol=1e-2, atol=1e-14)


def test_gravity_is_in_si_alone(run):
    found = signed(run)
    written = calibration_json(found)
    u_g = 5e-4 / BENCH.gravity_m_s2
    own = written["coefficients_per_ms2"]["Kxx"]
    expected = np.hypot(found.u[0], found.block.vector[0] * u_g) / 9.81
    assert own["u"] == pytest.approx(expected, rel=1e-9)
    assert written["coefficients"]["Kxx"]["u"] == pytest.approx(found.u[0])
    assert written["coefficients"]["Kxx"]["U"] == pytest.approx(2 * found.u[0])


RUNS = 12


@pytest.mark.slow
@pytest.mark.parametrize("case", ["roll", "meters", "all"])
def test_errors_are_as_large_as_u_says(case):
    """So many runs a case, seeds [5, case, k]; bounds fail a true 1.1 with probability 1e-5 each.

    Thousands of runs, and the other cases, are `benchmarks/signed_uncertainty.py`.
    """
    z = []
    for k in range(RUNS):
        drawn = simulate_whole(np.random.default_rng([5, CASES.index(case), k]), case)
        found = signed(drawn.readings)
        z.append((found.block.vector - drawn.truth) / found.u)
    high = np.sqrt(stats.chi2.ppf(1 - 1e-5, RUNS) / RUNS)
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert np.all(rms < 1.1 * high), rms.round(2)
    if case == "all":
        low = np.sqrt(stats.chi2.ppf(1e-5, RUNS) / RUNS)
        assert np.all(rms > 0.9 * low), rms.round(2)


def test_the_size_that_stands_in_is_told(run):
    told = {s.name: s for s in signed(run).sources}
    assert told["mounting_roll"].origin == "not stated: as mounting_error"
    assert told["mounting_roll"].size == "30 arcsec"
    assert all(s.prior for s in told.values())
    assert ASSUMED["mounting_roll"] == pytest.approx(30 * ARCSEC)


@pytest.mark.parametrize("unit", ["V", "counts"])
@pytest.mark.parametrize("stated", [{"restart": ("1 mg", "2 mg", "3 mg")}, {"scale": (5.0, 0.0, 25.0)}])
def test_zeros_hold_their_scatter_from_repeat_to_repeat(run, stated, unit):
    """In any unit of the signals: the scatter is the block's, and not of the meters."""
    readings = dataclasses.replace(run, unit=unit)
    repeats = BENCH.uncertainty.model_copy(update={"zero_repeats": ZeroRepeats.model_validate(stated)})
    bench = BENCH.model_copy(update={"uncertainty": repeats})
    found = calibrate(readings, MODEL, STAND_U, 9.81, assumed_u=ASSUMED)
    plain, wide = (sign(found, readings, one, MODEL) for one in (BENCH, bench))
    added = np.sqrt(np.diag(wide.covariance - plain.covariance))
    if "restart" in stated:
        expected = np.abs(np.diag(found.block.K)) * [1e-3, 2e-3, 3e-3]
    else:
        expected = found.u_readings[9:] * [5.0, 0.0, 25.0]
    assert added[9:] == pytest.approx(expected, rel=0.01, abs=1e-12)
    assert np.all(added[:9] == 0.0)


def test_readings_in_g_lack_only_the_errors_of_the_voltmeters(run):
    """The same readings in another unit: temperature, K2, K3 and the roll are errors of block and stand."""
    in_volts, in_g = (
        sign(calibrate(one, MODEL, STAND_U, 9.81, assumed_u=ASSUMED), one, BENCH, MODEL)
        for one in (run, dataclasses.replace(run, unit="g", signal=run.signal / 2.0))
    )
    assert {s.name for s in in_volts.sources} - {s.name for s in in_g.sources} == {
        "voltmeter_gain", "voltmeter_offset", "voltmeter_linearity", "reference_noise",
    }  # fmt: skip
    for one in in_g.sources:
        np.testing.assert_allclose(
            4.0 * one.covariance, source(in_volts, one.name).covariance, rtol=1e-3, atol=1e-15
        )
    # ±0.5 K and ±180 ppm/K, both rectangular
    u_temperature = np.sqrt(np.diag(source(in_g, "temperature").covariance))
    assert u_temperature[0] / abs(in_g.block.K[0, 0]) == pytest.approx(0.5 * 180e-6 / 3.0, rel=1e-3)
    assert np.all(np.isfinite(in_g.dof))
    assert in_g.gravity_u == in_volts.gravity_u > 0.0
    readings = dataclasses.replace(run, unit="g", signal=run.signal / 2.0)
    volts, g = (delta_g_contributions(a, b, BENCH, MODEL) for a, b in ((in_volts, run), (in_g, readings)))
    for name in ("temperature", "K2", "K3"):
        np.testing.assert_allclose(g[name], volts[name], rtol=1e-3, atol=1e-15)


def test_one_kind_of_scatter_is_stated():
    with pytest.raises(ValueError, match=r"2 of .* are stated \('restart', 'scale'\)"):
        ZeroRepeats.model_validate({"restart": ["1 mg"] * 3, "scale": [1, 1, 1]})


def _with_a_shared_error(seed, kind):
    """Three passes in installations 1, 2 and V on a perfect bench; repeats share an error of the signals."""
    rng = np.random.default_rng([seed, 7])
    rows = [(i, p, n, 45.0 * n) for i in "12" for p in (1, 2, 3) for n in range(9)]
    rows += [("V", p, n, 45.0 + 90.0 * n) for p in (1, 2, 3) for n in range(4)]
    installation, passes, point, angle = (np.array(column) for column in zip(*rows, strict=True))
    psi = np.where(installation == VERIFICATION, np.radians(45.0), 0.0)
    output = specific_force(installation, np.radians(angle), psi=psi) @ K.T
    alike = (installation, passes if kind == "gain" else point)
    groups = np.unique([f"{i} {n}" for i, n in zip(*alike, strict=True)], return_inverse=True)[1]
    error = rng.normal(0.0, {"gain": 1e-4, "setting": 15e-5}[kind], (groups.max() + 1, 3))[groups]
    signal = U0 + output + error * (output if kind == "gain" else 1.0) + rng.normal(0.0, 50e-6, output.shape)
    return make_readings(installation, passes, point + 1, np.radians(angle), signal)


@pytest.mark.parametrize("kind", ["gain", "setting"])
def test_errors_that_repeats_share_are_in_u_at_the_points_too(kind):
    """A pass of verification points has a gain of its own, and a point an error that each of its repeats has.

    Six runs with nine or twelve shared errors each: the mean chi-square scatters by 0.2.
    """
    exact = {name: 1e-6 * u for name, u in STAND_U.items()}
    chi2 = []
    for seed in range(6):
        run = _with_a_shared_error(seed, kind)
        at = run.installation == VERIFICATION
        found = sign(calibrate(run, MODEL, exact, 9.81), run, BENCH, MODEL)
        delta_g = np.linalg.norm(found.block.specific_force(run.signal[at]), axis=1) - 1.0
        parts = delta_g_contributions(found, run, BENCH, MODEL)
        own = sum(parts[n] for n in ("noise_and_stand", "reading_at_the_point", "errors_that_readings_share"))
        shared, noise = found.shared, found.noise.widened().by_channel
        later = delta_g_elsewhere(
            found.block, found.covariance_readings, noise, run, BENCH, MODEL, same_meters=True, shared=shared
        )
        assert np.all(np.diag(later) > np.diag(own))  # which has the errors of the block besides
        chi2.append(delta_g @ np.linalg.solve(own, delta_g) / len(delta_g))
    assert 0.5 < np.mean(chi2) < 1.5  # without the shared errors: 4 and more


def test_the_wander_of_the_biases_does_not_cancel_between_days(run):
    found = signed(run)
    apart, wandered = (
        delta_g_elsewhere(
            found.block, found.covariance, np.zeros(3), run, BENCH, MODEL, same_meters=True, wander=wander
        )
        for wander in (None, np.full(3, 1e-4))
    )
    u = np.sqrt(np.diag(wandered - apart))
    np.testing.assert_allclose(u, np.sqrt(2.0) * 1e-4 / 2.17, rtol=0.02)


@pytest.mark.parametrize(("samples_sd", "u_v"), [(3e-4, 1e-4), (9e-4, 3.2e-4)])
def test_noisier_samples_at_the_points_are_in_u(samples_sd, u_v):
    """Samples at the points scatter like those of the calibration, or three times as much."""
    run = simulate_whole(np.random.default_rng(5), "noise").readings
    at = run.installation == VERIFICATION
    noise = Noise(1e-4, 0.0, np.inf, "given")
    sd = np.where(at[:, None], samples_sd, 3e-4) * np.ones(3)
    run = dataclasses.replace(run, signal_sd=sd, samples=np.full(len(run), 10))
    found = signed(run, noise)
    part = delta_g_contributions(found, run, BENCH, MODEL)["reading_at_the_point"]
    np.testing.assert_allclose(np.sqrt(np.diag(part)), u_v / 2.17, rtol=0.15)
    elsewhere = delta_g_elsewhere(
        found.block, 0.0 * found.covariance, np.full(3, 1e-4), run, _with_meters("1 ppm", "1 uV"), MODEL,
        same_meters=True,
    )  # fmt: skip
    assert np.all(np.sqrt(np.diag(elsewhere)) > 0.85 * u_v / 2.17)
