"""The check (9)-(10) at the verification points, against closed forms and Monte Carlo."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from bench.calibration import CalibrationError, calibrate
from bench.calibration.conformity import Population, global_risk
from bench.calibration.verification import verify
from bench.model import Block
from bench.readings.table import make_readings
from bench.results import tables
from bench.results.plots import point_labels
from bench.results.verification import (
    advice,
    global_risk_in_words,
    place_in_words,
    probability_in_words,
    verdict_line,
)
from bench.validation.paper_bench import STAND_U, TRUTH, U0, K, simulate, specific_force
from tests.support.honest_runs import MODEL
from tests.support.results import verification_json

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


def test_points_of_two_mountings_have_different_names():
    twice = replace(turned(), series=np.array([1, 1, 2, 2]), point=np.array([1, 2, 1, 2]))
    result = verify(twice, BLOCK, NONE, 0.0, 3e-4)
    shown = [place_in_words(point) for point in result.points]
    assert shown == ["pass 1 point 1", "pass 1 point 2", "series 2 pass 1 point 1", "series 2 pass 1 point 2"]
    assert [point["series"] for point in verification_json(result)["points"]] == [1, 1, 2, 2]
    assert [row.head for row in tables.verification(result)] == ["1 / 1", "1 / 2", "V/2: 1 / 1", "V/2: 1 / 2"]
    assert point_labels(result.points) == ["45°\nV", "135°\nV", "225°\nV/2", "315°\nV/2"]


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


def test_one_point_beyond_the_limit_is_enough():
    readings = turned()
    readings.signal[2, 0] *= 1.01
    result = verify(readings, BLOCK, NONE, 0.0, 3e-4)
    assert [p.passed for p in result.points] == [True, True, False, True]
    assert not result.passed


@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.arange(1.0, 10.0).reshape(3, 3), K * np.nan])
def test_a_singular_matrix_is_refused(matrix):
    with pytest.raises(CalibrationError, match="singular"):
        verify(turned(), Block(matrix, U0), NONE, 0.0, 3e-4)


def test_a_table_without_verification_points_is_refused():
    with pytest.raises(CalibrationError, match=r"no verification point \(installation V\)"):
        verify(simulate(None, 0.0), BLOCK, NONE, 0.0, 3e-4)


def test_result_as_promised():
    result = verification_json(verify(turned(), BLOCK, NONE, 0.0, 3e-4))
    assert result["limit_g"] == 3e-4
    assert (result["rule"], result["false_acceptance"]) == ("non-binary", 0.05)
    assert result["guard_band"] == pytest.approx(0.8224, abs=1e-4)
    assert result["passed"] is True
    assert set(result["points"][0]) >= {"angle_deg", "g_p", "delta_g", "u", "passed"}


# --- the verdict ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def covariance():
    return calibrate(simulate(np.random.default_rng(3), 1e-4), MODEL, STAND_U, 9.81).covariance


def drawn_errors(covariance, noise, draws=20_000):
    """Δg of coefficients and readings that are off at random, by the modulus itself (seed 8)."""
    rng = np.random.default_rng(8)
    coefficients = rng.multivariate_normal(TRUTH, covariance, draws)
    signal = turned().signal + rng.normal(0, noise, (draws, 4, 3))
    inverse = np.linalg.inv(coefficients[:, :9].reshape(draws, 1, 3, 3))
    return np.linalg.norm((inverse @ (signal - coefficients[:, None, 9:])[..., None])[..., 0], axis=2) - 1


def test_covariance_of_the_points_with_sizes_per_channel_by_monte_carlo(covariance):
    noise = np.array([3e-5, 1e-4, 3e-4])
    result = verify(turned(), BLOCK, covariance, noise, 3e-4)
    found = np.cov(drawn_errors(covariance, noise).T)
    u = np.sqrt(np.diag(found))
    # of 20,000 draws: five standard deviations of a covariance
    np.testing.assert_allclose(
        result.covariance / np.outer(u, u), found / np.outer(u, u), atol=5 / np.sqrt(1e4)
    )
    assert [p.u for p in result.points] == pytest.approx(np.sqrt(np.diag(result.covariance)))


def test_one_size_for_all_channels_is_that_size_in_each(covariance):
    one, three = (verify(turned(), BLOCK, covariance, noise, 3e-4) for noise in (1e-4, np.full(3, 1e-4)))
    np.testing.assert_array_equal(one.covariance, three.covariance)


def test_a_covariance_of_the_points_that_is_known_is_taken_as_it_is():
    joint = {"all": np.full((4, 4), 1e-10)}
    result = verify(turned(), BLOCK, NONE, 1.0, 3e-4, 2.0, joint=joint)
    np.testing.assert_allclose(result.covariance, 4 * joint["all"])
    assert [p.u for p in result.points] == pytest.approx([2e-5] * 4)


def test_u_of_a_point_has_infinite_degrees_of_freedom():
    found = verify(turned(), BLOCK, NONE, 1e-4, 3e-4)
    assert all((one.k, one.dof, one.U) == (2.0, np.inf, 2 * one.u) for one in found.points)
    told = verification_json(found)["points"][0]
    assert (told["dof"], told["k"]) == (None, 2.0)


@pytest.mark.parametrize(
    ("factor", "noise", "rule", "statement", "passed"),
    [
        (1.0, 1e-5, "simple", "pass", True),
        (1.0, 1e-5, "guarded", "pass", True),
        (1.00055, 1e-4, "simple", "conditional pass", True),
        (1.00055, 1e-4, "guarded", "conditional pass", False),
        (1.00065, 1e-4, "simple", "conditional fail", False),
        (1.00065, 1e-4, "non-binary", "conditional fail", False),
        (1.001, 1e-4, "non-binary", "fail", False),
        (1.0, 4e-4, "simple", "inconclusive", False),
        (1.0, 4e-4, "guarded", "inconclusive", False),
        (1.01, 4e-4, "simple", "fail", False),
    ],
)
def test_statement_and_decision(factor, noise, rule, statement, passed):
    result = verify(turned(), altered_z(factor), NONE, noise, 3e-4, rule=rule)
    told = verification_json(result)
    assert (told["statement"], told["passed"]) == (statement, passed)
    decided = "p_false_accept" if passed else "p_false_reject"
    for name in ("p_false_accept", "p_false_reject"):
        assert (told[name] is None) is (statement == "inconclusive" or name != decided), name
    assert told["tur"] == pytest.approx(3e-4 / max(p.U for p in result.points))


def test_a_conditional_pass_of_the_non_binary_rule_is_left_open():
    """Neither accepted nor rejected: the risk is that of the customer who accepts it."""
    result = verify(turned(), altered_z(1.00055), NONE, 1e-4, 3e-4, rule="non-binary")
    told = verification_json(result)
    assert (told["statement"], told["passed"], told["p_false_reject"]) == ("conditional pass", False, None)
    assert told["p_false_accept"] == result.p_outside
    assert all(p["p_false_accept"] is not None and p["p_false_reject"] is None for p in told["points"])
    line = verdict_line("unit", result)
    assert "CONDITIONAL PASS, the customer decides: worst" in line
    assert f"probability of false acceptance if the customer accepts: {result.p_outside:.2g}" in line


def test_what_would_make_it_pass_makes_it_pass():
    """With the limit or the u that it says the same readings pass, with a little less they do not."""
    result = verify(turned(), altered_z(1.00055), NONE, 1e-4, 3e-4)
    assert (result.statement, result.passed) == ("conditional pass", False)
    needed = result.to_pass
    for factor, passed in ((1.001, True), (0.998, False)):
        again = verify(turned(), altered_z(1.00055), NONE, 1e-4, factor * needed.limit_g)
        assert again.passed is passed
        smaller = verify(turned(), altered_z(1.00055), NONE, 1e-4 * needed.u_times / factor, 3e-4)
        assert smaller.passed is passed
    (sentence,) = (one for one in advice(result) if one.startswith("to pass: reduce u(Δg) to"))
    assert "reading at the point" in sentence
    assert f"or agree on a limit of at least {int(np.ceil(1e6 * needed.limit_g))} µg" in sentence
    beyond = verify(turned(), altered_z(1.001), NONE, 1e-4, 3e-4)
    assert beyond.to_pass.u_times is None
    assert any("no reduction of u suffices" in one for one in advice(beyond))
    assert verify(turned(), BLOCK, NONE, 1e-5, 3e-4).to_pass is None


def test_a_population_enters_the_risks_of_the_block(covariance):
    """Its own reading tells of a point as JCGM 106:2012, A.4 has it; of the run all of them do."""
    population = Population(0.0, 1e-4)
    plain = verify(turned(), altered_z(1.0005), covariance, 1e-4, 3e-4)
    result = verify(turned(), altered_z(1.0005), covariance, 1e-4, 3e-4, population=population)
    for before, point in zip(plain.points, result.points, strict=True):
        part = 1e-8 / (1e-8 + point.u**2)
        after = stats.norm(part * point.delta_g, np.sqrt(part) * point.u)
        assert point.p_outside == pytest.approx(after.sf(3e-4) + after.cdf(-3e-4))
        assert point.p_outside < 0.5 * before.p_outside
        assert point.accepted_up_to > before.accepted_up_to
    assert result.p_outside_worst <= result.p_outside < plain.p_outside


def test_a_missing_point_leaves_the_verdict_open_but_not_a_failure():
    open_verdict = verify(replace(turned(), verification_missing=1), BLOCK, NONE, 1e-5, 3e-4)
    assert (open_verdict.statement, open_verdict.passed) == ("not complete", False)
    assert verification_json(open_verdict)["p_false_reject"] is None
    failed = verify(replace(turned(), verification_missing=1), altered_z(1.01), NONE, 1e-5, 3e-4)
    assert failed.statement == "fail"


def test_risks_of_all_points_and_of_the_worst(covariance):
    result = verify(turned(), altered_z(1.0005), covariance, 1e-4, 3e-4)
    single = [p.p_outside for p in result.points]
    assert result.p_outside_worst == max(single)
    assert max(single) < result.p_outside < sum(single)
    told = verification_json(result)
    assert (told["p_false_accept"], told["p_false_accept_worst"]) == (result.p_outside, max(single))
    assert told["global_risk"] is None


def test_a_global_risk_only_of_a_stated_population(covariance):
    population = Population(0.0, 1e-4)
    result = verify(turned(), BLOCK, covariance, 1e-4, 3e-4, rule="guarded", population=population)
    worst = max(result.points, key=lambda p: p.u)
    expected = global_risk(population, worst.u, 3e-4, 3e-4 - worst.U)
    told = verification_json(result)["global_risk"]
    assert (told["false_accept"], told["false_reject"]) == (expected.false_accept, expected.false_reject)
    assert told["false_reject_all"] > told["false_reject"]  # a block is accepted only at all points
    assert told["false_accept_all"] <= told["false_accept"]
    (sentence,) = global_risk_in_words(result)
    assert "standard deviation 100 µg, as stated" in sentence
    assert f"does not accept {probability_in_words(told['false_reject_all'])}" in sentence
