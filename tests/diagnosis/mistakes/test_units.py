"""Signals in another unit, range or decimal point, in all of a run or a part of it; the data sheet is known."""

from dataclasses import replace

import numpy as np
import pytest

from bench.diagnosis import diagnose
from bench.validation.paper_bench import K
from tests.support.diagnosis_bench import MODEL, STAND, OneThreshold
from tests.support.mistaken_runs import EFFECTS, NOISE_V, find, outlier_v, place, run, with_outlier

UNEQUAL = 5.0
"""Standard deviations of the mean square residual beyond which a copy is not put right."""

FACTORS = (1e3, 1e-3, 10.0, 0.1)


def scaled(readings, rows, channels, factor):
    signal = readings.signal.copy()
    signal[np.ix_(np.flatnonzero(rows), channels)] *= factor
    return replace(readings, signal=signal)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scope", "factor"),
    [
        *(("run", factor) for factor in FACTORS[:3]),
        *((part, factor) for part in ("installation", "pass") for factor in (1e3, 0.1)),
    ],
)
def test_a_channel_in_another_unit_is_named_with_its_rows_and_put_right(scope, factor):
    """The odds are e^(6.9 per reading) and more: of 7 kinds none may be missed."""
    seed = FACTORS.index(factor)
    rng = np.random.default_rng([91, seed])
    good = run([92, seed])
    rows, installations, number = place(rng, good, scope)
    channel = int(rng.integers(3))
    found = find(scaled(good, rows, [channel], factor))
    (mistake,) = found.mistakes
    assert (mistake.name, mistake.channels) == ("wrong_unit", ("xyz"[channel],))
    assert (mistake.installations, mistake.pass_number) == (installations, number)
    assert ("mV" in mistake.words) == (factor == 1e3)
    assert ("decimal point" in mistake.words) == (factor not in {1e3, 1e-3})
    assert mistake.p < 1e-6
    # 162 standardised residuals, 12 coefficients fitted: 0.96, and 5 standard deviations of 0.055
    assert mistake.misfit_after < 0.96 + UNEQUAL * 0.055
    np.testing.assert_allclose(found.corrected.signal, good.signal, rtol=1e-12)


@pytest.mark.slow
def test_one_reading_with_another_decimal_point_is_an_outlier():
    good = run(93)
    bad = scaled(good, np.arange(len(good)) == 30, [2], 10.0)
    assert [mistake.name for mistake in find(bad).mistakes] == ["outlier"]


@pytest.mark.slow
def test_a_wrong_unit_is_found_beside_another_mistake_of_the_same_run():
    good = run(94)
    mixed = scaled(good, (good.installation == "2") & (good.pass_number == 3), [1], 1e3)
    mixed = with_outlier(mixed, 4, 0, outlier_v(mixed, 4, 0, 300, NOISE_V))
    assert [mistake.name for mistake in find(mixed).mistakes] == ["wrong_unit", "outlier"]


@pytest.mark.slow
@pytest.mark.parametrize("effect", list(EFFECTS)[::4])
def test_a_perfect_block_with_an_effect_is_in_its_unit(effect):
    """Without biases and cross-axis terms a channel that hardly moves fits any factor: no odds may come of that."""
    good = run(95, **EFFECTS[effect])
    force = (good.signal - good.signal.mean(axis=0)) @ np.linalg.inv(K).T
    assert find(replace(good, signal=force * np.diag(K))).mistakes == ()


@pytest.mark.slow
def test_the_last_digit_of_a_run_in_millivolts_is_that_of_the_copy():
    good = run(96)
    good = replace(good, signal=np.round(good.signal, 7))
    whole = scaled(good, np.ones(len(good), dtype=bool), [0, 1, 2], 1e3)
    found = diagnose(
        replace(whole, signal=np.round(whole.signal, 4)), MODEL, STAND, np.diag(K), OneThreshold()
    )
    (mistake,) = found.mistakes.mistakes
    assert (mistake.name, mistake.channels) == ("wrong_unit", ("x", "y", "z"))
    assert not found.noise_kinds
