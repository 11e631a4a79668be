"""New readings of the tests' own geometry against a model: the effect is there, is another one, or is gone."""

from dataclasses import replace

import numpy as np
import pytest

from bench.calibration import CalibrationError
from bench.diagnosis.confirm import confirm
from bench.model import CATALOGUE, AppliedEffect
from tests.diagnosis.test_naming import Ready
from tests.support.diagnosis_bench import MODEL, STAND, paper_run

NOMINAL = np.array([-2.18, -2.14, -2.14])
FOUND = AppliedEffect(
    CATALOGUE["quadratic_nonlinearity"],
    {"K2": np.array([0.0, 100e-6, 0.0])},
    ("y",),
    {"K2": np.array([0.0, 4e-6, 0.0])},
)


def held_against(found, seed, **hidden):
    model = replace(MODEL, effects=(found,))
    return confirm(paper_run(np.random.default_rng(seed), **hidden), model, STAND, NOMINAL, Ready(None))


@pytest.mark.slow
def test_an_effect_that_is_there_again_is_confirmed_and_closes_the_gap():
    told = held_against(FOUND, 61, K2=(0.0, 100e-6, 0.0))
    assert told.verdict == "confirmed"
    before, after = told.before.reduced, told.after.reduced
    assert told.closed == pytest.approx((before - after) / (before - 1.0))
    # 148 numbers beyond the coefficients and their noise: the chi-square is within 4 deviations of its floor
    assert abs(after - 1.0) < 4 * np.sqrt(2 / 148 + 2 / 148)
    assert before > 2.0
    assert told.before.rms_g > told.after.rms_g
    assert told.after.rms_g == pytest.approx(told.after.expected_rms_g, rel=0.2)
    ((was,), (now,)) = told.effects[0].found, told.effects[0].now
    assert (was.value, was.u, was.unit) == (pytest.approx(100.0), pytest.approx(4.0), "ug/g^2")
    assert abs(now.value - 100.0) < 4 * now.u


@pytest.mark.slow
@pytest.mark.parametrize(("k2", "verdict"), [(170e-6, "changed"), (-100e-6, "changed"), (0.0, "gone")])
def test_another_size_is_a_change_and_none_is_gone(k2, verdict):
    told = held_against(FOUND, 62, K2=(0.0, k2, 0.0))
    assert told.verdict == verdict
    assert told.effects[0].p_same < 0.01
    if verdict == "gone":
        assert told.after.reduced > told.before.reduced
        assert told.after.rms_g > told.before.rms_g


@pytest.mark.slow
def test_the_same_effect_beside_a_new_one_does_not_close_the_gap():
    told = held_against(FOUND, 63, K2=(0.0, 100e-6, 0.0), drift_v_per_h=(3e-4, 0.0, 0.0))
    assert told.effects[0].verdict == "confirmed"
    assert told.closed is not None
    assert told.closed < 0.5
    assert told.verdict == "changed"
    assert told.diagnosis.verdict in {"named", "confounded", "unknown"}


@pytest.mark.slow
def test_readings_that_could_not_show_it_confirm_nothing():
    small = replace(FOUND, values={"K2": np.array([0.0, 5e-6, 0.0])})
    with pytest.raises(CalibrationError, match=r"could not show what the model has.*more passes"):
        held_against(small, 64)
