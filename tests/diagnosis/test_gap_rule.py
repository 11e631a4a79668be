"""The rule by which a gap shrinks, on folds made up: what it takes for a name alone."""

import numpy as np
import pytest

from bench.diagnosis.gap import BLIND, NOT_THERE, OWN_VALUE, Fold, Gap, HeldOut
from bench.diagnosis.posterior import NoiseSize
from bench.results.diagnosis_parts import gap_part

ROWS = 50
NOISE = NoiseSize(15e-6, 1.6e-5, 150)


def held_out(reduced, rms=20e-6):
    error = np.full(ROWS, rms)
    return HeldOut(error, error / 2.0, np.full(ROWS, 9e-6), reduced * ROWS)


def fold(label, before, after, rms=(30e-6, 20e-6), blind="", name="bias_drift"):
    gains = {name: ROWS * (before - after)} if name else {}
    return Fold(label, gains, held_out(before, rms[0]), held_out(after, rms[1]), blind)


def gap(*folds, named=("bias_drift",), undetermined=()):
    return Gap(folds, NOISE, "V", NOISE.freedom, named, undetermined)


def test_a_gap_that_closes_shrinks_and_says_how_far():
    one = gap(fold("pass 1", 3.0, 1.0), fold("pass 2", 5.0, 1.2))
    assert one.shrinks is True
    assert one.reason == ""
    assert (one.before, one.after) == (pytest.approx(4.0), pytest.approx(1.1))
    assert one.closed == pytest.approx(2.9 / 3.0)
    told = gap_part(one).to_dict()
    assert told["before_rms_ug"] == pytest.approx(15.0)
    assert told["after_rms_ug"] == pytest.approx(10.0)
    assert told["expected_rms_ug"] == pytest.approx(9.0)
    assert told["reason"] is None


@pytest.mark.parametrize(
    "folds",
    [
        (fold("pass 1", 0.97, 1.02), fold("pass 2", 0.97, 1.02)),  # it grows
        (fold("pass 1", 1.10, 1.03),),  # by 3.5 in chi-square: chance does that
        (fold("pass 1", 3.95, 1.20, rms=(42e-6, 80e-6)),),  # the root mean square rises
        (fold("pass 1", 5.0, 4.0),),  # a quarter of what is far above the noise
        (fold("pass 1", 3.0, 1.0, name="warm_up"), fold("pass 2", 3.0, 1.0, name="")),  # another name does it
    ],
)
def test_what_does_not_shrink_is_not_confirmed_and_says_so(folds):
    one = gap(*folds)
    assert one.shrinks is False
    assert one.unconfirmed == ("bias_drift",) or one.before_rms_g != one.after_rms_g
    assert f"{one.before:.2f} before, {one.after:.2f} after" in one.reason


def test_of_two_names_the_one_that_gains_nothing_is_told():
    both = {"bias_drift": 100.0, "backlash": 1.0}
    one = gap(Fold("pass 1", both, held_out(3.0, 30e-6), held_out(1.0), ""), named=("bias_drift", "backlash"))
    assert one.shrinks is False
    assert one.unconfirmed == ("backlash",)
    assert "do not confirm backlash (" in one.reason


def test_a_small_gap_need_only_fall_by_more_than_chance():
    """1.25 over 50 rows, 150 of freedom: chance reaches it in 15 %, and no half of it can be asked for."""
    assert gap(fold("pass 1", 1.25, 1.15)).shrinks is True


def test_a_fold_that_cannot_confirm_is_left_out_with_its_number_and_why():
    one = gap(
        fold("pass 1", 3.0, 1.0),
        fold("pass 2", 1.0, 1.0, blind=NOT_THERE),
        fold("verification and free positions", 9.0, 9.0, blind=BLIND),
    )
    assert [f.label for f in one.opened] == ["pass 1"]
    assert one.before == pytest.approx(3.0)
    told = {f["what"]: f for f in gap_part(one).to_dict()["held_out"]}
    assert told["verification and free positions"]["left_out"] == BLIND
    assert told["verification and free positions"]["before"] == pytest.approx(9.0)
    assert told["pass 2"]["left_out"] == NOT_THERE
    assert told["pass 1"]["left_out"] is None


def test_a_fold_that_is_made_worse_counts_whether_or_not_it_could_confirm():
    """Passes close, and the verification points go from 9 to 103: no name alone."""
    worse = fold("verification and free positions", 8.9, 103.0, blind=BLIND)
    one = gap(fold("pass 1", 3.95, 1.2), worse)
    assert worse in one.opened
    assert one.shrinks is False
    # where what was found has a value of its own, nothing was predicted
    other = fold("verification and free positions", 8.9, 103.0, blind=OWN_VALUE)
    assert gap(fold("pass 1", 3.95, 1.2), other).shrinks is True


def test_where_no_fold_measures_it_the_gap_is_none_and_says_why():
    one = gap(fold("pass 1", 1.2, 1.2, blind=BLIND), fold("pass 2", 1.2, 1.2, blind=BLIND))
    told = gap_part(one).to_dict()
    assert one.shrinks is None
    assert (told["before"], told["after"], told["closed"], told["before_rms_ug"]) == (None,) * 4
    assert told["reason"] == f"nothing held out can measure the gap (pass 1, pass 2: {BLIND})"
    assert gap().reason == "nothing can be held out: one pass, and no verification or free position"
    alone = gap_part(gap(undetermined=("pass 1",))).to_dict()
    assert "without pass 1 the rest does not determine the coefficients" in alone["reason"]
    assert alone["held_out"][0]["before"] is None


def test_with_nothing_found_there_is_nothing_to_confirm():
    one = gap(fold("pass 1", 1.0, 1.0, name=""), named=())
    assert (one.shrinks, one.reason) == (None, "")
    assert one.closed is None
