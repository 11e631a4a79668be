"""The table of a budget, and the uncertainty of an acceleration."""

import dataclasses

import numpy as np
import pytest

from bench.calibration import CalibrationError, Noise, calibrate
from bench.calibration.budget.assessment import delta_g, directions, magnitudes, measured, over_directions
from bench.calibration.budget.coefficients import make_budget
from bench.calibration.budget.sources import bench_sources, stand_source
from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.model import CATALOGUE, AppliedEffect, Distribution
from bench.validation.paper_bench import ARCSEC, K, simulate
from tests.support.budget_bench import ONE_SIGMA, paper_setup, stand
from tests.support.honest_runs import MODEL

# µV/g, U0 in µV
BY_SOURCE = {
    "axis_tilt": [0, 0, 0, 0, 0, 0, 0, 0, 0, 0.4, 25.9, 26.0],
    "zero_offset": [0.4, 52.8, 52.8, 25.9, 0.6, 0.6, 26.0, 0.2, 0.2, 0, 0, 0],
    "mounting_error": [6.8, 0, 0, 466.9, 0, 0, 467.8, 0, 0, 0, 0, 0],
    "setting_error": [12.6, 37.3, 37.3, 21.2, 15.0, 0.5, 21.2, 0.1, 15.0, 26.4, 21.2, 21.2],
    "voltmeter_error": [62.1, 106.1, 106.1, 86.6, 81.0, 106.1, 86.6, 106.1, 81.0, 75.0, 68.5, 68.5],
}
COMBINED = {
    "closed-form": [63.8, 124.2, 124.2, 476.0, 82.4, 106.1, 477.0, 106.1, 82.4, 79.5, 76.2, 76.2],
    "least-squares": [62.5, 97.2, 97.2, 471.8, 79.0, 78.1, 472.7, 78.1, 79.0, 42.6, 49.2, 49.3],
    "gls": [62.1, 97.1, 97.1, 103.5, 78.9, 78.0, 103.6, 78.0, 78.9, 42.6, 47.5, 47.5],
}


def close(found_uv, published):
    """To 2 % or half of the last digit."""
    found, told = np.asarray(found_uv), np.asarray(published)
    return np.all(np.abs(found - told) <= np.maximum(0.02 * told, 0.05))


@pytest.mark.parametrize("source", BY_SOURCE)
def test_each_source_in_the_closed_form(source):
    budget = make_budget(paper_setup(), stand(), "closed-form")
    assert close(1e6 * budget.contribution(source).u, BY_SOURCE[source])


@pytest.mark.parametrize(("estimator", "published"), [*COMBINED.items(), ("ols", COMBINED["least-squares"])])
def test_combined_uncertainty(estimator, published):
    """Of a budget, and of a calibration whose noise is given."""
    budget = make_budget(paper_setup(), stand(), estimator)
    assert close(1e6 * budget.combined.u, published)
    sizes = Noise(ONE_SIGMA["voltmeter_error"], ONE_SIGMA["setting_error"], np.inf, "given")
    limits = {name: ONE_SIGMA[name] for name in ("axis_tilt", "zero_offset", "mounting_error")}
    assert close(1e6 * calibrate(simulate(None, 0.0), MODEL, limits, 9.81, estimator, sizes).u, published)


@pytest.mark.parametrize(
    ("estimator", "psi_deg", "low", "high"),
    [
        ("closed-form", 0, 120.6, 123.5), ("closed-form", 45, 108.8, 111.9), ("least-squares", 0, 115.5, 116.7),
        ("least-squares", 45, 102.4, 104.2), ("gls", 0, 40.0, 43.4), ("gls", 45, 40.8, 45.1),
    ],
)  # fmt: skip
def test_delta_g_from_the_coefficients(estimator, psi_deg, low, high):
    points = delta_g(make_budget(paper_setup(psi_deg=psi_deg), stand(), estimator), 3e-4, reading=False)
    u = [1e6 * point.u for point in points]
    assert close([min(u), max(u)], [low, high])


def test_delta_g_with_the_reading_of_the_check():
    found = [
        1e6 * point.u
        for psi_deg in (0, 45)
        for point in delta_g(make_budget(paper_setup(psi_deg=psi_deg), stand(), "closed-form"), 3e-4)
    ]
    assert close([min(found), max(found)], [177.0, 187.0])


def test_delta_g_by_source_at_three_sigma():
    """Worst verification point over both psi: 371 µg in all; by source 31, 18, 327, 49, 171."""
    points = [
        point
        for psi_deg in (0, 45)
        for point in delta_g(
            make_budget(paper_setup(psi_deg=psi_deg), stand(), "closed-form"), 3e-4, reading=False
        )
    ]
    assert close([3e6 * max(point.u for point in points)], [371.0])
    worst = [3e6 * max(point.by_source[name] for point in points) for name in BY_SOURCE]
    np.testing.assert_allclose(worst, [31, 18, 327, 49, 171], atol=0.6)


@pytest.mark.parametrize(
    ("estimator", "size_g", "mean", "largest"),
    [
        ("closed-form", 1, 195, 322), ("gls", 1, 79, 84), ("closed-form", 5, 920, 1580), ("gls", 5, 354, 372),
        ("closed-form", 10, 1835, 3158), ("gls", 10, 704, 742),
    ],
)  # fmt: skip
def test_vector_error_over_directions(estimator, size_g, mean, largest):
    found = over_directions(make_budget(paper_setup(), stand(), estimator), size_g, reading=False)
    assert close([1e6 * found.u_vector_mean, 1e6 * found.u_vector_max], [mean, largest])


@pytest.mark.parametrize(("estimator", "mean", "largest"), [("closed-form", 433, 589), ("gls", 180, 192)])
def test_modulus_at_five_g(estimator, mean, largest):
    found = over_directions(make_budget(paper_setup(), stand(), estimator), 5.0, reading=False)
    assert close([1e6 * found.u_modulus_mean, 1e6 * found.u_modulus_max], [mean, largest])


def worst_three_sigma(estimator, alpha3_arcsec):
    sources = stand({**ONE_SIGMA, "mounting_error": alpha3_arcsec * ARCSEC})
    budgets = [make_budget(paper_setup(psi_deg=psi), sources, estimator) for psi in (0, 45)]
    return 3e6 * max(point.u for budget in budgets for point in delta_g(budget, 3e-4, reading=False))


def test_the_mounting_error_that_a_limit_allows():
    """Closed form: 67 arcsec (1 sigma) for 300 µg at 3 sigma; GLS needs no limit, 135 µg at 2000 arcsec."""
    assert worst_three_sigma("closed-form", 67.0) <= 300.0 < worst_three_sigma("closed-form", 69.0)
    assert close([worst_three_sigma("gls", 2000.0)], [135.0])


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
