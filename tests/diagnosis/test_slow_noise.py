"""Slow noise: found by its likelihood, at its size, and seldom where there is none; effects must hold beside it."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis import Threshold, ThresholdCache
from bench.diagnosis.evidence import Search, null_responses, total_evidence
from bench.diagnosis.noise_grid import RATIOS, digit_of
from bench.diagnosis.noise_kinds import beside_all_sizes, noise_kinds, slow_noise, with_slow_noise
from bench.diagnosis.posterior import NoiseSize
from bench.diagnosis.single_run_search import search_run
from benchmarks.blind_trial.cases import Row, make_case
from tests.support.diagnosis_bench import MODEL, NOISE_V, paper_run, set_up
from tests.support.paper_bench import SETTING_U_RAD, STAND_U

RATIO = 2
LIMIT = 1.1
"""About the threshold of the paper's design."""


def wandering(rng, n):
    """1/f noise (n, 3) of root mean square 1, from a course eight times as long."""
    frequency = np.fft.rfftfreq(8 * n)
    part = np.append(0.0, frequency[1:] ** -0.5)[:, None]
    phase = np.exp(2j * np.pi * rng.random((len(frequency), 3)))
    course = np.fft.irfft(part * phase * rng.rayleigh(size=phase.shape), 8 * n, axis=0)[:n]
    course -= course.mean(axis=0)
    return course / np.sqrt(np.mean(course**2, axis=0))


def responses(linear, count, seed, size):
    """Draw noise (N, count) with slow noise of this size, in units of a reading's, in it."""
    rng = np.random.default_rng(seed)
    white = null_responses(linear, NOISE_V, np.full(count, RATIOS[RATIO]), rng)
    rows = linear.setting >= 0
    for response in white.T:
        slow = size * NOISE_V * wandering(rng, len(linear.readings))
        yield response + np.where(rows, slow[linear.rows.reading, np.minimum(linear.rows.channel, 2)], 0.0)


def drawn(count, seed, size):
    """What is found in so many draws."""
    made = set_up(paper_run(np.random.default_rng(1)))
    for response in responses(made.linear, count, seed, size):
        yield slow_noise(replace(made.linear, response=response), made.whitened, RATIO)


def test_slow_noise_is_found_at_its_size():
    """40 draws of twice the noise of a reading in each channel (seed 3)."""
    found = [one for each in drawn(40, 3, 2.0) for one in each]
    assert len(found) >= 24  # of 120, a third of them as a rule, less 3 sd
    assert {one.channel for one in found} == {0, 1, 2}
    assert 1.5 < np.median([one.size for one in found]) / NOISE_V < 2.5


def test_white_noise_is_not_slow():
    """150 draws (seed 4), three channels, each by chance in 1 of 1,000: more than 4 in 1 of 1,000 times."""
    assert sum(len(each) for each in drawn(150, 4, 0.0)) <= 4


def test_what_is_random_holds_slow_noise():
    (slow, *_) = next(each for each in drawn(40, 5, 3.0) if each)
    linear = set_up(paper_run(np.random.default_rng(1))).linear
    added = with_slow_noise(linear, [slow]).random[:, linear.random.shape[1] :]
    own = (linear.setting >= 0) & (linear.rows.channel == slow.channel)
    assert not np.any(added[~own])
    np.testing.assert_allclose(np.sqrt(np.mean(np.sum(added[own] ** 2, axis=1))), slow.size)


# --- what was found, beside slow noise that does not show by itself ---------------------------------


class Fixed(ThresholdCache):
    """A threshold that nobody simulated, about that of the paper's design."""

    def threshold(self, linear, whitened, setting_rad):
        return Threshold(LIMIT, 0.006, 0.0, 0.05, 0.8, 2000)


def odds_of(made, response):
    """Return ln odds that anything is missing (sets,) in responses (N, sets)."""
    return total_evidence(
        Search.beside(made.whitened, ()).score(made.whitened.reduce(response)), made.whitened
    )


def odds_beside(made, response, plausible):
    """Return the same of one response (N,) beside slow noise of all sizes."""
    linear = replace(made.linear, response=response)
    return beside_all_sizes(linear, made.whitened, NOISE_V, plausible)


def test_what_a_wander_alone_gives_seldom_holds_beside_one():
    """200 draws of slow noise as large as a reading's (seed 6): it gives 14 % of them odds above the threshold."""
    made = set_up(paper_run(np.random.default_rng(1)))
    alarms = [
        response
        for response in responses(made.linear, 200, 6, 1.0)
        if odds_of(made, response[:, None])[0] >= LIMIT
    ]
    assert len(alarms) >= 14  # of 28 as a rule, 2.9 sd fewer
    held = [odds_beside(made, response, 1.0).total >= LIMIT for response in alarms]
    assert np.sum(held) <= len(alarms) // 3


def test_an_effect_that_goes_with_the_angle_holds_beside_a_wander_and_a_drift_loses_most():
    """A square and a drift, each at 7 times its standard deviation in white noise (seed 7, ten draws)."""
    made = set_up(paper_run(np.random.default_rng(1)))
    white = np.column_stack(list(responses(made.linear, 10, 7, 0.0)))
    fallen = {}
    for family in ("quadratic_nonlinearity", "bias_drift"):
        variant = next(v for v in made.candidates.variants if v.family == family and len(v.columns) == 1)
        column = made.candidates.columns[:, variant.columns[0]]
        size = 7.0 / np.sqrt(made.whitened.square[RATIO, variant.columns[0]])
        response = white + size * column[:, None]
        alone = odds_of(made, response)
        beside = np.array([odds_beside(made, one, 1.0).total for one in response.T])
        fallen[family] = float(np.median(alone - beside))
    assert fallen["quadratic_nonlinearity"] < 1.0
    assert fallen["bias_drift"] > 4.0


def test_what_is_plausible_beforehand_counts():
    """The odds beside no slow noise are those without; they fall the more, the more plausible it is."""
    made = set_up(paper_run(np.random.default_rng(1)))
    response = np.column_stack(list(responses(made.linear, 20, 8, 1.0)))
    one = response[:, int(np.argmax(odds_of(made, response)))]
    never, seldom, often = (odds_beside(made, one, plausible).total for plausible in (1e-15, 0.1, 1.0))
    assert never == pytest.approx(odds_of(made, one[:, None])[0], abs=1e-6)
    assert never > seldom > often


@pytest.mark.parametrize("index", [34, 137, 387])
def test_a_wander_that_was_an_alarm_is_slow_noise(index):
    """Cases of the blind trial in which nothing is missing, half a sigma of 1/f in the noise of each channel."""
    case, _ = make_case(919, Row("null", noise="1/f"), index)
    looked, naming = search_run(
        case.readings, MODEL, STAND_U, SETTING_U_RAD, Fixed(None), digit_of(case.readings)
    )
    assert not naming.found
    assert looked.slow


def test_the_size_that_explains_readings_as_well_as_an_effect_is_said_with_that():
    made = set_up(paper_run(np.random.default_rng(1)))
    (response,) = responses(made.linear, 1, 9, 1.0)
    slow = odds_beside(made, response, 1.0).slow
    assert [one.channel for one in slow] == [0, 1, 2]
    assert len({one.size for one in slow}) == 1
    (kind,) = noise_kinds(made.linear, NoiseSize(NOISE_V, SETTING_U_RAD, 100), None, 1e-9, slow)
    assert kind.what == "slow"
    assert "explains the readings as well as an effect does" in kind.words
