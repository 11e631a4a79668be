"""Held-out readings: prediction and its covariance against dense conditioning of a Gaussian."""

import numpy as np
import pytest

from bench.diagnosis.evidence import KNOWN_SIZE
from bench.diagnosis.gap import folds_of, restrict
from bench.diagnosis.noise_grid import noise_of_repeats
from bench.diagnosis.posterior import NoiseSize, posterior, predicted_error
from bench.diagnosis.where import find_places
from tests.support.diagnosis_bench import NOISE_V, paper_run, set_up
from tests.support.paper_bench import SETTING_U_RAD


@pytest.mark.parametrize("label", ["pass 2", "verification and free positions"])
def test_prediction_is_the_conditional_gaussian(label):
    """The coefficients get a prior of 1e3 V each in the dense computation: as good as none."""
    one = set_up(paper_run(np.random.default_rng(41)))
    linear = one.linear
    held = dict(folds_of(linear))[label]
    variant = next(v for v in one.candidates.variants if v.family == "quadratic_nonlinearity")
    effects = one.candidates.columns[:, list(variant.columns)]
    noise = NoiseSize(NOISE_V, SETTING_U_RAD, 100)
    error, chi2 = predicted_error(linear, effects, noise, posterior(linear, effects, noise, ~held), held)

    same = (linear.setting[:, None] == linear.setting[None, :]) & (linear.setting >= 0)[:, None]
    covariance = NOISE_V**2 * np.eye(len(linear))
    covariance += np.where(same, SETTING_U_RAD**2 * np.outer(linear.slope, linear.slope), 0.0)
    covariance += linear.random @ linear.random.T + KNOWN_SIZE**2 * effects @ effects.T
    inverse = np.linalg.inv(covariance[np.ix_(~held, ~held)])
    x = linear.fixed
    gain = np.linalg.solve(x[~held].T @ inverse @ x[~held], x[~held].T @ inverse)
    weights = covariance[np.ix_(held, ~held)] @ inverse
    predictor = weights + (x[held] - weights @ x[~held]) @ gain
    expected = linear.response[held] - predictor @ linear.response[~held]
    both = np.concatenate([-predictor, np.eye(held.sum())], axis=1)
    order = np.concatenate([np.flatnonzero(~held), np.flatnonzero(held)])
    spread = both @ covariance[np.ix_(order, order)] @ both.T
    np.testing.assert_allclose(error, expected, atol=1e-9)
    assert chi2 == pytest.approx(expected @ np.linalg.solve(spread, expected), rel=1e-4)


@pytest.mark.slow
def test_held_out_chi_square_of_nulls_is_its_floor():
    """30 nulls (seed 42), each pass held out at known noise: mean of 90 reduced chi-squares of 54.

    Its standard error is at most sqrt(2/54/90) = 0.0203; 4 of them.
    """
    rng = np.random.default_rng(42)
    values = []
    for _ in range(30):
        linear = set_up(paper_run(rng, verification=False)).linear
        nothing = np.zeros((len(linear), 0))
        noise = NoiseSize(NOISE_V, SETTING_U_RAD, 100)
        for _, held in folds_of(linear):
            fitted = posterior(linear, nothing, noise, ~held)
            values.append(predicted_error(linear, nothing, noise, fitted, held)[1] / held.sum())
    assert abs(np.mean(values) - 1.0) < 4 * 0.0203


def test_a_part_of_the_rows_numbers_its_settings_anew():
    linear = set_up(paper_run(np.random.default_rng(43))).linear
    held = dict(folds_of(linear))["pass 1"]
    part = restrict(linear, ~held)
    assert len(part) == int((~held).sum())
    assert sorted(set(part.setting.tolist())) == [-1, *range(36)]


def test_noise_of_repeats_is_found_in_spite_of_an_effect():
    """24 settings of freedom, two directions across: sigma within 4 times 1/sqrt(2 * 48) of the truth."""
    for k2 in ((0, 0, 0), (300e-6, -200e-6, 100e-6)):
        linear = set_up(paper_run(np.random.default_rng(44), K2=k2, drift_v_per_h=(0, 50e-6, 0))).linear
        found = noise_of_repeats(linear, 0.0)
        assert found.freedom == 24
        assert abs(found.sigma / NOISE_V - 1) < 4 / np.sqrt(2 * 48)


def test_where_names_channel_installation_and_harmonic():
    """K2 of y in installation 2, where y turns in the plane: its square goes twice a turn."""
    one = set_up(paper_run(np.random.default_rng(45), K2=(0.0, 150e-6, 0.0)))
    repeats = noise_of_repeats(one.linear, 0.0)
    places = find_places(one.linear, one.whitened.grid, 3, repeats.sigma, 3 * repeats.freedom)
    first = places[0]
    assert (first.channel, first.installation, first.pattern) == ("y", "2", "twice per turn")
    assert first.p < 1e-6
    # a_y^2 = 1/2 + cos(2 phi)/2: half of K_yy K2
    assert first.size == pytest.approx(0.5 * 2.14 * 150e-6, rel=0.15)


@pytest.mark.slow
def test_where_is_silent_on_nulls():
    """20 nulls at 1 %, all looks counted: more than 3 have a probability of about 4e-5 (binomial)."""
    rng = np.random.default_rng(46)
    alarms = 0
    for _ in range(20):
        one = set_up(paper_run(rng))
        repeats = noise_of_repeats(one.linear, 0.0)
        alarms += bool(find_places(one.linear, one.whitened.grid, 3, repeats.sigma, 3 * repeats.freedom))
    assert alarms <= 3
