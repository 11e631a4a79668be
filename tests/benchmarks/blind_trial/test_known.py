"""The rows on what is known of a bench: what they hide is what they say."""

import numpy as np

from benchmarks.blind_trial.cases import Row, make_case
from benchmarks.blind_trial.outside import judge_known

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
    found = {"verdict": "mistake", "effects": [{"name": "outlier"}, {"name": "warm_up"}]}
    assert judge_known("repaired", ("warm_up",), found) == {
        "mistake found": True,
        "the effect in the set": True,
    }
    assert not judge_known("repaired", ("bias_drift",), found)["the effect in the set"]
