"""Runs with noise of different sizes: each weighs by its own, chosen by evidence."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis import diagnose
from bench.diagnosis.linear import RunSizes
from bench.diagnosis.multi_run_system import make_system
from bench.diagnosis.noise_kinds import noise_findings, noise_hypotheses
from bench.diagnosis.posterior import NoiseSize, posterior
from bench.diagnosis.search import in_the_noise_of
from bench.readings.table import JoinedPart, together
from tests.support.diagnosis_bench import MODEL, NOISE_V, STAND, STAND_U, K, OneThreshold, paper_run

SEED = 301


def runs(*sizes, seed=SEED, blocks=False, **what):
    """Runs whose readings have so many times the noise."""
    rng = np.random.default_rng(seed)
    tables = [paper_run(rng, noise_v=size * NOISE_V, **what) for size in sizes]
    return together([JoinedPart(table, block=i if blocks else 0) for i, table in enumerate(tables)])


def offered(system, effects=None):
    """The hypothesis of runs with noise of their own, where it is offered."""
    noise = NoiseSize(NOISE_V * np.sqrt(5.0), STAND["setting_error"], 300)
    every = noise_hypotheses(system, np.zeros((len(system), 0)) if effects is None else effects, noise)
    return [one for one in every if one.what == "runs"]


@pytest.mark.parametrize("blocks", [False, True])
def test_sizes_of_runs_are_found_from_their_residuals(blocks):
    (one,) = offered(make_system(runs(1, 3, blocks=blocks), MODEL, STAND_U))
    system, found = one.linear, one.linear.by_run
    assert np.all(found.freedom > 100)
    u = np.sqrt(np.sum(0.5 / found.freedom))
    assert abs(np.log(found.sizes[1] / found.sizes[0] / 3.0)) < 3.5 * u
    rows = system.readings.run[system.rows.reading]
    np.testing.assert_allclose(system.relative, found.sizes[rows])
    assert np.mean(system.relative**2) == pytest.approx(1.0)
    assert offered(system) == []


def test_a_run_that_the_fit_meets_exactly_has_the_noise_of_the_others():
    """Four verification points, and as many free parameters, leave no degrees of freedom and show no noise."""
    rng = np.random.default_rng(SEED)
    loud, quiet, points = (paper_run(rng, noise_v=size * NOISE_V) for size in (3, 1, 1))
    few = points.select(points.installation == "V")
    system = make_system(
        together([JoinedPart(table, block=0) for table in (loud, quiet, few)]), MODEL, STAND_U
    )
    (one,) = offered(system, NOISE_V * np.eye(len(system))[:, -4:])
    sizes = one.linear.by_run.sizes
    assert sizes[1] < sizes[2] < sizes[0]
    assert sizes[0] / sizes[1] == pytest.approx(3.0, rel=0.3)


def test_a_single_run_has_no_runs_that_differ():
    assert offered(make_system(paper_run(np.random.default_rng(SEED)), MODEL, STAND_U)) == []


def test_a_channel_of_several_blocks_weighs_at_their_moduli_as_each_block_shows_it():
    system = make_system(runs(1, 1, blocks=True), MODEL, STAND_U)
    sizes = np.array([0.5, 1.0, 1.32])
    own = np.concatenate([replace(part, by_channel=sizes).relative for part in system.parts])
    np.testing.assert_allclose(replace(system, by_channel=sizes).relative, own, rtol=1e-6)


def test_the_estimate_is_that_of_least_squares_weighted_by_the_noise_of_each_run():
    """With the whole covariance written down, and the stand's limits as observations of their own."""
    system = replace(
        make_system(runs(1, 3), MODEL, STAND_U),
        by_run=RunSizes(np.array([1.0, 3.0]) / np.sqrt(5.0), np.array([40.0, 40.0])),
    )
    noise = NoiseSize(NOISE_V * np.sqrt(5.0), STAND["setting_error"], 300)
    run = system.readings.run[system.rows.reading]
    same = (system.setting[:, None] == system.setting) & (system.setting >= 0)
    whole = np.diag((np.array([1.0, 3.0]) * NOISE_V)[run] ** 2)
    whole += np.where(same, np.outer(system.slope, system.slope) * STAND["setting_error"] ** 2, 0.0)
    whole += system.random @ system.random.T
    inverse = np.linalg.inv(whole)
    covariance = np.linalg.inv(system.fixed.T @ inverse @ system.fixed)
    fitted = posterior(system, np.zeros((len(system), 0)), noise)
    np.testing.assert_allclose(fitted.covariance[:12, :12], covariance, rtol=1e-6, atol=1e-18)
    value = covariance @ (system.fixed.T @ inverse @ system.response)
    np.testing.assert_allclose(fitted.mean[:12], value, rtol=1e-6)


@pytest.mark.slow
def test_two_runs_in_which_nothing_is_missing_agree():
    found = diagnose(runs(1, 3), MODEL, STAND, np.diag(K), OneThreshold())
    assert found.verdict == "agrees"
    (kind,) = found.noise_kinds
    assert kind.what == "runs"
    assert "in series 1" in kind.words


@pytest.mark.slow
def test_what_both_have_is_found_as_well_as_the_better_run_shows_it():
    """Backlash of 20 arcsec, its u less than that of two runs with three times the noise."""
    arcsec = np.radians(1 / 3600)
    tables = runs(1, 3, backlash_rad=20 * arcsec, directions=(1, -1, 1))
    found = diagnose(tables, MODEL, STAND, np.diag(K), OneThreshold())
    assert [effect.name for effect in found.effects] == ["backlash"]
    (value,) = found.effects[0].parameters
    assert abs(value.value - 20.0) < 4 * value.u
    as_noisy = runs(3, 3, backlash_rad=20 * arcsec, directions=(1, -1, 1))
    noisier = diagnose(as_noisy, MODEL, STAND, np.diag(K), OneThreshold())
    assert value.u < 0.85 * noisier.effects[0].parameters[0].u


@pytest.mark.slow
def test_runs_that_are_rounded_share_the_error_of_rounding_as_one_run_does():
    """To 90 uV, six times the noise: readings of a setting are rounded alike, and what they share is no effect."""
    tables = runs(1, 1)
    rounded = replace(tables, signal=np.round(tables.signal / 90e-6) * 90e-6)
    found = diagnose(rounded, MODEL, STAND, np.diag(K), OneThreshold())
    assert found.verdict == "agrees"
    assert found.whitened.grid.known
    assert found.linear.of_noise == 2 * (
        2 * 9 * 3 + 4
    )  # runs, installations, angles, channels; verification points
    assert found.noise.reading >= 90e-6 / np.sqrt(12.0)


def test_a_model_is_held_against_readings_in_the_noise_that_was_found_in_them():
    system = make_system(replace(runs(1, 3), block=None), MODEL, STAND_U)
    shared = np.zeros((len(system), 2))
    shared[::2, 0] = shared[1::2, 1] = NOISE_V
    sizes = RunSizes(np.array([1.0, 3.0]) / np.sqrt(5.0), np.array([40.0, 40.0]))
    tails = np.where(np.arange(len(system)) == 7, 5.0, 1.0)
    looked = replace(
        system.with_noise(shared), by_channel=np.array([0.5, 1.0, 1.32]), by_run=sizes, by_row=tails
    )
    taken = in_the_noise_of(looked, system)
    np.testing.assert_allclose(taken.relative, looked.relative)
    np.testing.assert_allclose(taken.random[:, -2:], shared)
    np.testing.assert_array_equal(taken.response, system.response)
    assert np.array_equal(in_the_noise_of(system, system).random, system.random)


def test_noise_that_is_larger_than_stated_is_a_finding_of_its_run():
    """Both files say 15 uV; the second run has three times as much, the root mean square of both 2.2 times."""
    tables = runs(1, 3)
    noise = NoiseSize(NOISE_V * np.sqrt(5.0), 0.0, 300)
    sizes = RunSizes(np.array([1.0, 3.0]) / np.sqrt(5.0), np.array([40.0, 40.0]))
    (found,) = noise_findings(noise, tables, {"voltmeter_error": NOISE_V}, 2.2, by_run=sizes)
    assert found.found == pytest.approx(3 * NOISE_V)
    assert found.series == (2,)
    assert "of series 2" in found.words
    assert noise_findings(noise, tables, {"voltmeter_error": 2 * NOISE_V}, 2.2, by_run=sizes) == ()
