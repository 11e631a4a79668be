"""Noise of unequal channels, with tails, with a coarse last digit: told, and not taken for an effect."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis import diagnose
from bench.diagnosis.gap import restrict
from bench.diagnosis.noise_grid import digit_of, is_coarse, make_noise_grid, repeated
from bench.diagnosis.noise_kinds import sizes_by_channel
from bench.diagnosis.posterior import NoiseSize, whiten_rows
from bench.validation.paper_bench import SETTING_U_RAD, K
from tests.support.diagnosis_bench import MODEL, NOISE_V, STAND, OneThreshold, paper_run, set_up

SIZES = np.array([0.5, 0.8, 1.5])


def diagnosed(readings):
    return diagnose(readings, MODEL, STAND, np.diag(K), OneThreshold())


def test_unequal_channels_are_whitened_as_their_covariance_says():
    linear = replace(set_up(paper_run(np.random.default_rng(3))).linear, by_channel=SIZES)
    noise = NoiseSize(NOISE_V, SETTING_U_RAD, 100)
    rows = linear.setting >= 0
    white = whiten_rows(restrict(linear, rows), noise, np.eye(rows.sum()))
    same = linear.setting[rows][:, None] == linear.setting[rows]
    covariance = np.diag((NOISE_V * SIZES[linear.rows.channel[rows]]) ** 2)
    covariance += np.where(same, SETTING_U_RAD**2 * np.outer(linear.slope[rows], linear.slope[rows]), 0.0)
    np.testing.assert_allclose(white @ covariance @ white.T, np.eye(rows.sum()), atol=1e-9)


def test_the_grid_and_a_dense_covariance_give_the_same_misfit():
    """Restricted: coefficients projected out of the dense covariance of noise, setting and stand."""
    linear = replace(set_up(paper_run(np.random.default_rng(4))).linear, by_channel=SIZES)
    ratio = 2.6
    white = make_noise_grid(linear, NOISE_V, SETTING_U_RAD, [ratio]).white[0] @ linear.response
    slope = ratio / linear.typical_slope * np.where(linear.setting >= 0, linear.slope, 0.0)
    same = linear.setting[:, None] == linear.setting
    covariance = np.diag(linear.relative**2) + np.where(same, np.outer(slope, slope), 0.0)
    covariance += linear.random @ linear.random.T / NOISE_V**2
    inverse = np.linalg.inv(covariance)
    x, y = linear.fixed, linear.response
    left = y - x @ np.linalg.solve(x.T @ inverse @ x, x.T @ inverse @ y)
    assert white @ white == pytest.approx(left @ inverse @ left, rel=1e-6)


def test_sizes_of_channels_are_found():
    """600 settings without slope: each size within 4 times 1/sqrt(2 * 600) of the truth."""
    rng = np.random.default_rng(5)
    n = 600
    white, none, cells = rng.normal(size=(n, 3)), np.zeros((n, 3)), np.arange(n) % 18
    sizes = SIZES / np.sqrt(np.mean(SIZES**2))
    found = sizes_by_channel(white * SIZES * 1e-5, np.ones(n), none, cells, 1e-12)
    np.testing.assert_allclose(found, sizes, rtol=4 / np.sqrt(2 * n))


@pytest.mark.slow
def test_unequal_noise_is_told_and_nothing_is_found():
    rng = np.random.default_rng(6)
    readings = paper_run(rng, noise_v=0.0)
    signal = readings.signal + rng.normal(size=(len(readings), 3)) * [9e-6, 15e-6, 33e-6]
    found = diagnosed(replace(readings, signal=signal))
    assert found.verdict == "agrees"
    assert [kind.what for kind in found.noise_kinds] == ["channels"]
    np.testing.assert_allclose(found.noise_by_channel, [9e-6, 15e-6, 33e-6], rtol=0.45)


@pytest.mark.slow
def test_readings_in_tails_are_weighed_down():
    rng = np.random.default_rng(8)
    readings = paper_run(rng, noise_v=0.0)
    signal = readings.signal + rng.standard_t(3, (len(readings), 3)) * 10e-6
    found = diagnosed(replace(readings, signal=signal))
    assert found.verdict == "agrees"
    assert "tails" in [kind.what for kind in found.noise_kinds]


# --- a coarse last digit ----------------------------------------------------------------------------


def test_the_last_digit_may_be_any_step():
    readings = paper_run(np.random.default_rng(9))
    for step in (1e-5, 3e-5, 2e-4):
        rounded = replace(readings, signal=np.round(np.round(readings.signal / step) * step, 9))
        assert digit_of(rounded) == pytest.approx(step)
    assert is_coarse(2e-4, NOISE_V)
    assert not is_coarse(1e-5, NOISE_V)


def test_the_part_of_rounding_that_repeats_is_what_simulation_says():
    """20,000 points read twice (seed 10): covariance of two roundings within 4 standard errors of 1/12/sqrt(n)."""
    rng = np.random.default_rng(10)
    n = 20_000
    for dither in (0.0, 0.15, 0.3):
        value = rng.uniform(0, 1000, n)
        twice = value + rng.normal(0, dither, (2, n))
        error = np.round(twice) - twice
        covariance = float(np.mean(error[0] * error[1]))
        total = np.sqrt(dither**2 + 1 / 12)
        assert repeated(1.0, total) ** 2 == pytest.approx(covariance, abs=4 / 12 / np.sqrt(n))
    assert repeated(1.0, 1.0) < 1e-6


@pytest.mark.slow
def test_rounding_to_20_times_the_noise_is_told_and_no_effect():
    readings = paper_run(np.random.default_rng(11))
    step = 20 * NOISE_V
    found = diagnosed(replace(readings, signal=np.round(np.round(readings.signal / step) * step, 9)))
    assert found.verdict == "agrees"
    assert [kind.what for kind in found.noise_kinds] == ["resolution"]
