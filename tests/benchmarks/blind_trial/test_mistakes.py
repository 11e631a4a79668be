"""Rows of the blind trial hide what they say: mistakes of procedure and wiring, and what is known of a bench."""

import numpy as np
import pytest

from benchmarks.blind_trial.cases import Row, make_case
from benchmarks.blind_trial.score import judge
from benchmarks.blind_trial.signals import SETTING_SIGMA, signals
from benchmarks.blind_trial.stand import make_run
from tests.support.blind_cases import NOISE_V, mistaken, said

SMALL_V = 2e-3
"""Above what stand errors (5 σ of α3 are 1.6 mV) and noise do to a reading, below what a mistake does."""


def test_swapped_channels():
    signal, _, _ = mistaken("swapped_channels", "x and z mounting 2")
    run = make_run("paper")
    plain = signals(run)
    second = run.mount == 1
    np.testing.assert_allclose(signal[second][:, [2, 1, 0]], plain[second], atol=SMALL_V)
    np.testing.assert_allclose(signal[~second], plain[~second], atol=SMALL_V)


def test_reversed_polarity_of_x_everywhere_may_be_called_reversed_rotation():
    signal, _, answer = mistaken("reversed_polarity", "x everywhere")
    np.testing.assert_allclose(signal * [-1, 1, 1], signals(make_run("paper")), atol=SMALL_V)
    assert answer.accepted == ("reversed_polarity", "reversed_rotation")
    _, _, answer = mistaken("reversed_polarity", "y everywhere")
    assert answer.accepted == ("reversed_polarity",)


def test_reversed_rotation():
    signal, case, _ = mistaken("reversed_rotation", "")
    run = make_run("paper")
    np.testing.assert_allclose(signal, signals(run, true_angle=-run.angle), atol=SMALL_V)
    np.testing.assert_array_equal(case.readings.angle_rad, run.angle)


def test_swapped_installations():
    signal, case, _ = mistaken("swapped_installations", "")
    run = make_run("paper")
    np.testing.assert_allclose(signal, signals(run), atol=SMALL_V)
    assert case.readings.installation.tolist() == ["2"] * 27 + ["1"] * 27 + ["V"] * 4


def test_shifted_points():
    signal, _, _ = mistaken("shifted_points", "mounting 2")
    plain = signals(make_run("paper"))
    np.testing.assert_allclose(signal[28:54], plain[27:53], atol=SMALL_V)
    np.testing.assert_allclose(signal[:27], plain[:27], atol=SMALL_V)


@pytest.mark.parametrize(
    ("kind", "turned_deg"), [("1 deg", 1.0), ("10 arcmin", 1 / 6), ("1 arcmin", 1 / 60), ("reflected", None)]
)
def test_wrong_setting(kind, turned_deg):
    run = make_run("paper")
    _, case, answer = mistaken("wrong_setting", kind)
    row = int(answer.place.split()[1].rstrip(",")) - 1
    signal = case.readings.signal
    others = np.arange(len(signal)) != row
    np.testing.assert_allclose(signal[others], signals(run)[others], atol=SMALL_V)
    assert run.fitted[row]
    turned = [
        -2 * run.angle[row] if turned_deg is None else sign * np.radians(turned_deg) for sign in (1, -1)
    ]
    # the same stop of the other passes has the same stand errors: what differs is the setting
    alike = others & (run.mount == run.mount[row]) & (run.point == run.point[row])
    off = signal[row] - signal[alike].mean(axis=0)
    # a reflected angle turns the sign of what α3 does, too
    bound = 2 * SMALL_V if turned_deg is None else 4 * np.sqrt(1.5) * np.hypot(NOISE_V, 2.2 * SETTING_SIGMA)
    errors = [np.max(np.abs(off - (signals(run, setting=t) - signals(run))[row])) for t in turned]
    assert min(errors) < bound


def test_outlier():
    signal, _, answer = mistaken("outlier", "")
    off = np.abs(signal - signals(make_run("paper")))
    row, channel, size = answer.place.removesuffix(" V").split(", ")
    here = int(row.removeprefix("row ")) - 1, "xyz".index(channel)
    assert off[here] == pytest.approx(abs(float(size)), abs=SMALL_V)
    off[here] = 0
    assert off.max() < SMALL_V


SEED = 6


def test_the_bench_file_of_another_psi_is_wrong_by_ten_degrees_or_more():
    psi = [make_case(SEED, Row("other_psi"), i)[0].stated_psi_deg for i in range(20)]
    assert all(10 <= abs(stated - 45) <= 40 for stated in psi)
    assert make_case(SEED, Row("null"), 0)[0].stated_psi_deg is None


def test_what_is_hidden_in_common_volts_is_the_same_in_all_channels():
    _, answer = make_case(SEED, Row("common_volts", rho=12), 0)
    (effect,) = answer.effects
    np.testing.assert_allclose(effect.change, effect.change[:, :1] * np.ones(3))
    assert abs(effect.rho - 12) < 1e-6


def test_hand_set_positions_are_off_by_tenths_of_degrees_each_by_its_own():
    case, answer = make_case(SEED, Row("hand_set", "six"), 0)
    off_v = answer.effects[0].change
    assert len(case.readings) == 18
    # half a degree is 9 mg in each of the two directions across
    assert 0.005 < np.sqrt(np.mean(off_v**2)) / 2.15 < 0.02


def test_marks_say_what_came_after_a_mistake():
    case, answer = make_case(SEED, Row("repaired", rho=20), 0)
    marks = judge(case, answer, said("mistake", ("outlier", []), (answer.names[0], [])))
    assert marks == {"mistake found": True, "the effect in the set": True}
    assert not judge(case, answer, said("mistake", ("outlier", [])))["the effect in the set"]
