"""New readings of the tests' own geometry against a model: the effect is there, is another one, or is gone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import special

from bench.calibration import CalibrationError
from bench.calibration.design import EffectUnknown
from bench.config.model_file import load_model, write_model_file
from bench.diagnosis.confirm import EstimatedEffects, confirm, judged
from bench.model import CATALOGUE, AppliedEffect
from bench.results.confirm import effect_now_in_words, either_in_words
from tests.diagnosis.test_next_measurement import FIXED
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
    return confirm(paper_run(np.random.default_rng(seed), **hidden), model, STAND, NOMINAL, FIXED)


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
@pytest.mark.parametrize(("k2", "verdict"), [(170e-6, "changed"), (0.0, "gone")])
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
    with pytest.raises(CalibrationError, match=r"cannot confirm the model.*more passes"):
        held_against(small, 64)


GAINS = tuple(
    AppliedEffect(
        CATALOGUE["meters_exchanged"], {"xy_gain": np.asarray(size)}, installations=(mount,), either_of=names
    )
    for names in [("meters_exchanged", "voltmeter_gain")]
    for mount, size in (("1", 150e-6), ("2", -150e-6))
)
COMMON, APART = 380.0, 0.5
"""Variances of the sum and the difference of two values, over the root of 2, in plausible sizes squared."""


@pytest.mark.parametrize(
    ("change", "verdict"), [((1.0, -1.0), "confirmed"), ((-5.0, 5.0), "gone"), ((9.0, 9.0), "confirmed")]
)
def test_what_is_known_in_the_difference_of_two_mountings_is_judged_in_it(change, verdict):
    """Neither value is known to 10 plausible sizes, their difference is: 10 in the model, of variance 2 * 0.5."""
    unknowns = [EffectUnknown(i, "xy_gain", None, 0.0, 1.0, stated=True) for i in range(2)]
    turned = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2.0)
    covariance = turned @ np.diag([COMMON, APART]) @ turned.T
    found = np.array([5.0, -5.0])
    estimated = EstimatedEffects(np.full(2, 30e-6), found, np.full(2, 4.0), np.array(change), covariance)
    model = replace(MODEL, effects=GAINS)
    for now in judged(model, unknowns, estimated):
        assert now.verdict == verdict
        difference = change[0] - change[1]
        # the model's u of it is taken to be that of these readings, not that of the two values
        assert now.p_same == pytest.approx(special.chdtrc(1, difference**2 / (4 * APART)))
        assert now.p_none == pytest.approx(special.chdtrc(1, (10.0 + difference) ** 2 / (2 * APART)))
        assert either_in_words(now) == "either of meters_exchanged or voltmeter_gain"
        assert next(effect_now_in_words(now)).startswith(f"{either_in_words(now)}: {verdict}")


def test_a_tie_keeps_its_names_in_a_model_file(tmp_path):
    write_model_file(tmp_path / "tied.yaml", "tied", [*GAINS, FOUND])
    effects = load_model(tmp_path / "tied.yaml").applied_effects()
    names = ("meters_exchanged", "voltmeter_gain")
    assert [one.either_of for one in effects] == [names, names, ()]
