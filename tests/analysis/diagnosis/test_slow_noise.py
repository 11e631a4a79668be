"""Slow noise: found by its likelihood, at its size, and seldom where there is none."""

from dataclasses import replace

import numpy as np

from bench.analysis.diagnosis.noise_grid import RATIOS
from bench.analysis.diagnosis.slow_noise import slow_noise, with_slow_noise
from bench.analysis.diagnosis.threshold import null_responses
from tests.support.diagnosis_bench import NOISE_V, paper_run, set_up

RATIO = 2


def wandering(rng, n):
    """1/f noise (n, 3) of root mean square 1, from a course eight times as long."""
    frequency = np.fft.rfftfreq(8 * n)
    part = np.append(0.0, frequency[1:] ** -0.5)[:, None]
    phase = np.exp(2j * np.pi * rng.random((len(frequency), 3)))
    course = np.fft.irfft(part * phase * rng.rayleigh(size=phase.shape), 8 * n, axis=0)[:n]
    course -= course.mean(axis=0)
    return course / np.sqrt(np.mean(course**2, axis=0))


def drawn(count, seed, size):
    """What is found in so many draws of noise with slow noise of this size, in units of a reading's, in it."""
    rng = np.random.default_rng(seed)
    made = set_up(paper_run(np.random.default_rng(1)))
    linear = made.linear
    white = null_responses(linear, NOISE_V, np.full(count, RATIOS[RATIO]), rng)
    rows = linear.setting >= 0
    for response in white.T:
        slow = size * NOISE_V * wandering(rng, len(linear.readings))
        added = np.where(rows, slow[linear.rows.reading, np.minimum(linear.rows.channel, 2)], 0.0)
        yield slow_noise(replace(linear, response=response + added), made.whitened, RATIO)


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
