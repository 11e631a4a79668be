"""Measured accelerations and delta g: closed forms, Monte Carlo, and what must cancel."""

import dataclasses

import numpy as np
import pytest

from bench.calibration import CalibrationError
from bench.calibration.budget.assessment import delta_g, directions, magnitudes, measured, over_directions
from bench.calibration.budget.coefficients import make_budget
from bench.calibration.budget.sources import bench_sources, stand_source
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.model import CATALOGUE, AppliedEffect, Distribution
from tests.support.budget_bench import ONE_SIGMA, paper_setup, stand
from tests.support.paper_bench import ARCSEC, K

SHIPPED = load_bench(find_bench("paper-stand"))
SETUP = paper_setup()
SOURCES = {s.name: s for s in bench_sources(SHIPPED, SETUP)}


def alone(*names, estimator="closed-form", setup=SETUP):
    return make_budget(setup, [SOURCES[name] for name in names], estimator, stated=ONE_SIGMA)


@pytest.mark.parametrize("name", ["gravity", "voltmeter_gain", "voltmeter_offset"])
def test_gain_gravity_and_offset_cancel_in_delta_g(name):
    points = delta_g(alone(name, setup=paper_setup(meters=(0, 0, 0))), 3e-4)
    assert max(p.u for p in points) < 1e-15
    with_coefficients_alone = delta_g(alone(name), 3e-4, reading=False)
    assert max(p.u for p in with_coefficients_alone) > 1e-6


def test_gravity_is_the_whole_relative_error_of_a_measured_modulus():
    found = measured(alone("gravity"), np.array([[3.0, 0.0, 4.0], [0.0, 0.1, 0.0]]))
    np.testing.assert_allclose(found.u_modulus, SOURCES["gravity"].u * np.array([5.0, 0.1]), rtol=1e-9)


def test_the_same_voltmeters_cancel_their_gain():
    force = np.array([[5.0, -2.0, 1.0]])
    budget = alone("voltmeter_gain", "voltmeter_offset")
    assert measured(budget, force, same_voltmeters=True).u_modulus[0] < 1e-15
    assert measured(budget, force).u_modulus[0] > 5 * SOURCES["voltmeter_gain"].u


def test_one_reading_adds_its_noise():
    """Without errors of the coefficients the vector's variance is u^2 times the squared length of N."""
    source = stand_source("voltmeter_error", Distribution(3e-4))
    budget = make_budget(SETUP, [source])
    without = measured(budget, np.array([[0.0, 0.0, 1.0]]), reading=False).covariance[0]
    whole = measured(budget, np.array([[0.0, 0.0, 1.0]])).covariance[0]
    inverse = np.linalg.inv(K)
    np.testing.assert_allclose(whole - without, 9e-8 * inverse @ inverse.T, rtol=1e-9)


def test_cubic_term_keeps_its_correlation():
    """At 1 g along x the closed form has taken up 0.7071 K3 into Kxx: 0.2929 K3 is left; at 5 g 125 - 3.54."""
    found = measured(alone("K3"), np.array([[1.0, 0.0, 0.0], [5.0, 0.0, 0.0]]))
    left = SOURCES["K3"].u * np.array([1 - np.sqrt(0.5), 125 - 5 * np.sqrt(0.5)])
    np.testing.assert_allclose(found.u_modulus, left, rtol=2e-4)


def test_an_effect_of_the_model_acts_in_use_like_the_prior():
    effect = AppliedEffect(
        CATALOGUE["quadratic_nonlinearity"], {"K2": np.zeros(3)}, ("x", "y", "z"), {"K2": np.full(3, 30e-6)}
    )
    setup = paper_setup(effects=[effect])
    named = [s for s in bench_sources(SHIPPED, setup) if s.effect is not None]
    force = 4.0 * directions(20)
    ours = measured(make_budget(setup, named, "closed-form"), force)
    prior = measured(alone("K2"), force)
    np.testing.assert_allclose(ours.covariance, prior.covariance, rtol=1e-6, atol=1e-16)


def test_nonlinearity_dominates_at_five_g():
    budget = make_budget(SETUP, list(SOURCES.values()))
    at_one, at_five = over_directions(budget, 1.0), over_directions(budget, 5.0)
    assert at_one.share["K2"] + at_one.share["K3"] < 0.1
    assert at_five.share["K2"] + at_five.share["K3"] > 0.9
    assert sum(at_five.share.values()) == pytest.approx(1.0)
    assert at_five.U_modulus_max == pytest.approx(2 * at_five.u_modulus_max, rel=1e-4)


def test_delta_g_by_monte_carlo():
    """Coefficients drawn from the budget's covariance, 40 000 times, and a check reading of its own noise."""
    budget = make_budget(SETUP, stand(), "closed-form")
    rng, n = np.random.default_rng(1), 40_000
    draws = SETUP.block.vector + rng.multivariate_normal(np.zeros(12), budget.combined.covariance, n)
    for row, point in zip(np.flatnonzero(SETUP.verification), delta_g(budget, 3e-4), strict=True):
        signal = SETUP.signal[row] + rng.normal(0.0, ONE_SIGMA["voltmeter_error"], (n, 3))
        a = np.linalg.solve(draws[:, :9].reshape(-1, 3, 3), (signal - draws[:, 9:])[:, :, None])[:, :, 0]
        spread = np.std(np.linalg.norm(a, axis=1))
        assert point.u == pytest.approx(spread, rel=4 / np.sqrt(2 * n))


def test_the_third_mounting_angle_shows_at_the_check():
    """90 arcsec in one installation at psi = 45 degrees about z: half of 309 µg for the two; nothing at psi = 0."""
    roll = stand_source("mounting_roll", Distribution(90 * ARCSEC))
    at_45 = delta_g(make_budget(SETUP, [*stand(), roll], "closed-form"), 3e-4)
    at_0 = delta_g(make_budget(paper_setup(psi_deg=0.0), [*stand(), roll], "closed-form"), 3e-4)
    # two independent draws: 309 µg is for both alike, so each gives half
    largest = max(p.by_source["mounting_roll"] for p in at_45)
    assert 1e6 * largest == pytest.approx(309 / np.sqrt(2), rel=0.02)
    assert 1e6 * max(p.by_source["mounting_roll"] for p in at_0) < 5


def test_decision_simple_and_guarded():
    budget = make_budget(SETUP, stand(), "gls")
    simple, guarded = (delta_g(budget, 3e-4, rule)[0] for rule in ("simple acceptance", "guarded"))
    assert simple.accepted_up_to == 3e-4
    assert guarded.accepted_up_to == pytest.approx(3e-4 - guarded.U)
    assert guarded.passes < simple.passes
    # u = 146 µg: U = 292 µg is within 300 µg, but not within 300 - 292
    assert simple.capable
    assert not guarded.capable
    assert delta_g(budget, 1e-4, "guarded")[0].passes == 0.0
    with pytest.raises(CalibrationError, match="no decision rule 'lenient'"):
        delta_g(budget, 3e-4, "lenient")


def test_probability_to_pass():
    """erf: a normal error of u is within 2.575829 u in 99 % of cases; with U beyond the limit nothing passes."""
    budget = make_budget(SETUP, stand(), "gls")
    u = delta_g(budget, 1.0)[0].u
    assert delta_g(budget, 2.575829 * u)[0].passes == pytest.approx(0.99, abs=1e-6)
    assert delta_g(budget, 1.959964 * u)[0].passes == 0.0


def test_without_verification_points_there_is_no_decision():
    setup = dataclasses.replace(SETUP, conditions=dataclasses.replace(
        SETUP.conditions, **{name: getattr(SETUP.conditions, name)[:54] for name in (
            "mount", "pass_number", "point", "angle_rad", "direction", "time_s", "temperature_c", "scan_order"
        )}
    ))  # fmt: skip
    assert delta_g(make_budget(setup, stand()), 3e-4) == ()


def test_directions_are_even_and_magnitudes_reach_the_range():
    even = directions(1000)[:1000]
    np.testing.assert_allclose(np.linalg.norm(even, axis=1), 1.0)
    np.testing.assert_allclose(even.T @ even / 1000, np.eye(3) / 3, atol=2e-3)
    assert magnitudes(10.0) == (1.0, 2.0, 5.0, 10.0)
    assert magnitudes(3.0) == (1.0, 2.0, 3.0)
    assert magnitudes(0.5) == (0.5,)


def test_no_direction_is_refused():
    with pytest.raises(CalibrationError, match="no direction"):
        measured(make_budget(SETUP, stand()), np.zeros((1, 3)))
