"""The noise is chosen by its evidence: slow, tailed or by channel where it is so, and normal where it is normal."""

from dataclasses import replace

import numpy as np
import pytest

from bench.calibration.budget.meters import HALF_WAVES
from bench.diagnosis.evidence import null_responses
from bench.diagnosis.noise_grid import RATIOS, make_whitener
from bench.diagnosis.noise_kinds import larger_scatter, noise_hypotheses, residuals, slow_noise
from bench.diagnosis.posterior import NoiseSize
from bench.diagnosis.search import SearchTask, find_effects, in_the_noise_of
from bench.validation.paper_bench import SETTING_U_RAD, STAND_U, U0
from tests.support.diagnosis_bench import MODEL, NOISE_V, STAND, OneThreshold, paper_run, set_up

RATIO = 2


@pytest.fixture(scope="module")
def made():
    return set_up(paper_run(np.random.default_rng(1)))


def wandering(rng, n):
    """1/f noise (n, 3) of root mean square 1, from a course eight times as long."""
    frequency = np.fft.rfftfreq(8 * n)
    part = np.append(0.0, frequency[1:] ** -0.5)[:, None]
    phase = np.exp(2j * np.pi * rng.random((len(frequency), 3)))
    course = np.fft.irfft(part * phase * rng.rayleigh(size=phase.shape), 8 * n, axis=0)[:n]
    course -= course.mean(axis=0)
    return course / np.sqrt(np.mean(course**2, axis=0))


def drawn(made, count, seed, size):
    """What is found in so many draws of noise with slow noise of this size in it, in units of a reading's."""
    linear = made.linear
    rng = np.random.default_rng(seed)
    white = null_responses(linear, NOISE_V, np.full(count, RATIOS[RATIO]), rng)
    noise = NoiseSize(NOISE_V, RATIOS[RATIO] / linear.typical_slope * NOISE_V, 150)
    whitener = make_whitener(linear, noise.reading, noise.setting_rad)
    channel = np.minimum(linear.rows.channel, 2)
    for response in white.T:
        slow = size * NOISE_V * wandering(rng, len(linear.readings))
        added = np.where(linear.setting >= 0, slow[linear.rows.reading, channel], 0.0)
        yield slow_noise(replace(linear, response=response + added), whitener, noise)


def test_slow_noise_is_found_at_its_size(made):
    """30 draws of twice the noise of a reading in each channel (seed 3)."""
    found = [one for each in drawn(made, 30, 3, 2.0) for one in each]
    assert sum(len(one.channels) for one in found) >= 30  # of 90
    assert {channel for one in found for channel in one.channels} == {0, 1, 2}
    assert 1.2 < np.median([one.size for one in found]) / NOISE_V < 2.8


@pytest.mark.slow
def test_white_noise_is_seldom_slow(made):
    """60 draws (seed 4), three channels: 200 others gave 4 of 600; at 2 %, 10 of 180 come once in 200 times."""
    assert sum(len(one.channels) for each in drawn(made, 60, 4, 0.0) for one in each) < 10


def test_what_is_random_holds_slow_noise(made):
    (slow, *_) = next(each for each in drawn(made, 20, 5, 3.0) if each)
    own = (made.linear.setting >= 0) & np.isin(made.linear.rows.channel, slow.channels)
    assert not np.any(slow.columns[~own])
    of_channels = slow.columns[own].reshape(np.count_nonzero(own), len(slow.channels), HALF_WAVES + 1)
    waves, mean = of_channels[:, :, :-1], of_channels[:, :, -1]
    np.testing.assert_allclose(np.sqrt(np.mean(np.sum(waves**2, axis=(1, 2)))), slow.size)
    np.testing.assert_allclose(np.sqrt(2.0) * mean.max(), waves.max())


def of_reference(made, count, seed, size, channels):
    """The hypothesis of a noisy reference (None: not offered) in so many draws of noise, with what was added, V.

    The added noise is a fraction of the signal, with the root mean square `size` in units of a reading's noise, and
    one course for each of 1 or 3 `channels`.
    """
    linear, rng = made.linear, np.random.default_rng(seed)
    white = null_responses(linear, NOISE_V, np.full(count, RATIOS[RATIO]), rng)
    noise = NoiseSize(NOISE_V, RATIOS[RATIO] / linear.typical_slope * NOISE_V, 150)
    channel = np.minimum(linear.rows.channel, 2)
    signal = linear.readings.signal[linear.rows.reading, channel]
    for response in white.T:
        course = np.broadcast_to(
            wandering(rng, len(linear.readings))[:, :channels], (len(linear.readings), 3)
        )
        added = size * NOISE_V * course[linear.rows.reading, channel] * signal / np.sqrt(np.mean(signal**2))
        added = np.where(linear.setting >= 0, added, 0.0)
        told = noise_hypotheses(replace(linear, response=response + added), np.zeros((len(linear), 0)), noise)
        yield next((one for one in told if one.what == "reference"), None), added[linear.setting >= 0]


@pytest.mark.parametrize("channels", [1, 3])
def test_noise_of_a_reference_is_offered_at_its_size(made, channels):
    """8 draws of three times the noise of a reading (seed 9); one draw has a spread of a third at most."""
    ratios = []
    for found, added in of_reference(made, 8, 9, 3.0, channels):
        assert found is not None
        system = found.linear
        columns = system.random[system.setting >= 0][:, system.random.shape[1] - system.of_noise :]
        ratios.append(np.sqrt(np.mean(np.sum(columns**2, axis=1)) / np.mean(added**2)))
    assert 0.75 < np.median(ratios) < 1.35


@pytest.mark.slow
def test_white_noise_is_seldom_that_of_a_reference(made):
    """40 draws (seed 10), two hypotheses: at 2 % each, 7 come once in 500 times."""
    assert sum(found is not None for found, _ in of_reference(made, 40, 10, 0.0, 1)) < 7


def test_slow_noise_too_small_in_each_channel_is_found_in_all(made):
    """30 draws of 0.8 of the noise of a reading (seed 6): more often as one size of all than in single channels."""
    found = list(drawn(made, 30, 6, 0.8))
    together = sum(any(len(one.channels) == 3 for one in each) for each in found)
    single = sum(any(len(one.channels) == 1 for one in each) for each in found)
    assert together > single


def places(made, count, seed, times):
    """Where larger noise is found in so many draws; that of y in installation 2 is so many times the rest's."""
    linear = made.linear
    rng = np.random.default_rng(seed)
    here = (linear.readings.installation[linear.rows.reading] == "2") & (linear.rows.channel == 1)
    noise = NoiseSize(NOISE_V, RATIOS[RATIO] / linear.typical_slope * NOISE_V, 150)
    for response in null_responses(linear, NOISE_V, np.full(count, RATIOS[RATIO]), rng).T:
        more = here * np.sqrt(times**2 - 1.0) * NOISE_V * rng.normal(size=len(linear))
        drawn = replace(linear, response=response + more)
        found = larger_scatter(drawn, residuals(drawn, np.zeros((len(linear), 0)), noise))
        yield None if found is None else (found.channel, found.where)


def test_noise_of_a_channel_in_one_installation_is_found_there(made):
    """20 draws of 4 times (seed 7): chance of less than a factor 1.5 from 27 readings is below 1e-9."""
    assert set(places(made, 20, 7, 4.0)) == {("y", "installation 2")}


def test_noise_that_is_alike_has_no_place(made):
    """40 draws (seed 8), each at 0.01 % with all places counted: two come once in 100,000 times."""
    assert sum(found is not None for found in places(made, 40, 8, 1.0)) < 2


# --- the choice, by whole searches --------------------------------------------------------------------


def chosen(readings):
    stated = STAND_U | {"setting_error": SETTING_U_RAD}
    prepared, naming = find_effects(SearchTask(MODEL, stated, 0.0, OneThreshold()), readings)
    kinds = set(prepared.chosen)
    return kinds, naming


def noisy(seed, kind, **hidden):
    """A run with normal noise of one size, or of another kind."""
    rng = np.random.default_rng([77, seed])
    readings = paper_run(rng, noise_v=0.0, **hidden)
    n = len(readings)
    noise = {
        "normal": lambda: rng.normal(size=(n, 3)),
        "tails": lambda: rng.standard_t(3, (n, 3)),
        "slow": lambda: rng.normal(size=(n, 3)) + 3.0 * wandering(rng, n),
        "reference": lambda: rng.normal(size=(n, 3)) + 3.0 * wandering(rng, n)[:, :1] * readings.signal,
        "references": lambda: rng.normal(size=(n, 3)) + 3.0 * wandering(rng, n) * readings.signal,
    }[kind]()
    return replace(readings, signal=readings.signal + NOISE_V * noise)


@pytest.mark.slow
def test_slow_noise_is_chosen_and_nothing_is_named():
    """Two runs: in one of them at least, and in none with an effect of the catalogue alone."""
    found = [chosen(noisy(seed, "slow")) for seed in range(2)]
    assert any("slow" in kinds for kinds, _ in found)
    assert not any(one.variant.named and not one.ties for _, naming in found for one in naming.found)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["reference", "references"])
def test_noise_of_a_reference_is_chosen_and_nothing_is_named(kind):
    kinds, naming = chosen(noisy(0, kind))
    assert "reference" in kinds
    assert not any(one.variant.named and not one.ties for one in naming.found)


@pytest.mark.slow
def test_normal_noise_is_left_normal():
    """Three runs, four kinds of prior odds 0.1: chance gives a Bayes factor of 10 in a tenth of them at most.

    More than 4 of 12 then come in 1 of 100 times at most (binomial).
    """
    assert sum(len(chosen(noisy(seed, "normal"))[0]) for seed in range(3)) <= 4


@pytest.mark.slow
def test_an_effect_stands_against_all_kinds_of_noise_together():
    """Slow noise of the size of the white (seed 51): against white noise alone, the bias settled."""
    rng = np.random.default_rng([79, 51])
    run = paper_run(rng, noise_v=0.0)
    white, slow = rng.normal(size=(len(run), 3)), wandering(rng, len(run))
    kinds, naming = chosen(replace(run, signal=run.signal + NOISE_V * (white + slow)))
    assert kinds == {"slow"}
    assert not naming.found


@pytest.mark.slow
def test_an_effect_is_found_beside_noise_that_is_slow():
    _, naming = chosen(noisy(1, "slow", K2=(0.0, 400e-6, 0.0)))
    families = {name for one in naming.found for name in (one.variant.family, *one.ties)}
    assert "quadratic_nonlinearity" in families


@pytest.mark.slow
def test_tails_replace_single_readings_beside_an_effect():
    """A search with normal noise finds the drift of y and a single reading."""
    kinds, naming = chosen(noisy(14, "tails", drift_v_per_h=(0.0, 100e-6, 0.0)))
    assert "tails" in kinds
    assert [one.variant.family for one in naming.found] == ["bias_drift"]


def test_each_kind_of_noise_is_offered_once(made):
    noise = NoiseSize(NOISE_V, SETTING_U_RAD, 150)
    told = list(noise_hypotheses(made.linear, np.zeros((len(made.linear), 0)), noise))
    assert len({one.what for one in told}) == len(told)
    for one in told:
        assert one.what in {"channels", "tails", "slow", "reference"}
        again = [o.what for o in noise_hypotheses(one.linear, np.zeros((len(made.linear), 0)), noise)]
        assert one.what == "channels" or one.what not in again


@pytest.mark.parametrize("seed", [0, 3])
def test_an_effect_that_changes_between_repeats_leaves_the_noise_right(seed):
    """Repeats at another temperature scatter by more than the noise; with it, a tilt was found in both draws.

    With 150 degrees of freedom, the estimate has a u of 6 %.
    """
    run = paper_run(np.random.default_rng([92, seed]))
    warmth = 3.0 + 1.5 * np.sin(2 * np.pi * run.time_s / 5300.0)
    gain = np.outer(warmth, [0.0, 0.0, 60e-6])
    run = replace(run, signal=run.signal + gain * (run.signal - U0), temperature_c=20.0 + warmth)
    task = SearchTask(MODEL, STAND, 0.0, OneThreshold())
    assert task.repeats(task.linear(run)).sigma > 1.5 * NOISE_V
    prepared, naming = find_effects(task, run)
    assert [one.variant.family for one in naming.found] == ["thermal_scale"]
    assert prepared.whitened.grid.sigma == pytest.approx(NOISE_V, rel=0.2)
    assert prepared.repeats.sigma < 1.5 * NOISE_V


def test_an_outlier_leaves_the_noise_right():
    """One reading is 40 u off (seed 97); nothing named is found, and yet the noise follows the find."""
    run = paper_run(np.random.default_rng([97, 0]))
    signal = run.signal.copy()
    signal[20, 1] += 40 * NOISE_V
    task = SearchTask(MODEL, STAND, 0.0, OneThreshold())
    prepared, naming = find_effects(task, replace(run, signal=signal))
    assert [one.variant.family for one in naming.found] == ["single_reading"]
    assert prepared.whitened.grid.sigma == pytest.approx(NOISE_V, rel=0.2)


def rounded(seed, digit):
    run = paper_run(np.random.default_rng(seed))
    return replace(run, signal=np.round(run.signal / digit) * digit)


def test_a_coarse_digit_is_not_another_kind_of_noise():
    """A digit of four times the noise (seed 400): heavy tails won, as their noise was fixed."""
    prepared, naming = find_effects(SearchTask(MODEL, STAND, 60e-6, OneThreshold()), rounded([400, 9], 60e-6))
    assert not prepared.chosen
    assert not naming.found


def test_rounding_that_repeats_share_counts_once_in_another_model():
    linear = SearchTask(MODEL, STAND, 90e-6, OneThreshold()).linear(rounded(7, 90e-6))
    assert linear.of_noise > 0
    assert np.array_equal(in_the_noise_of(linear, linear).random, linear.random)
