"""The score of the blind trial."""

import pytest

from benchmarks.blind_trial.cases import Row, make_case
from benchmarks.blind_trial.score import NOT_SHRUNK, can_tell, judge, nearest_rival
from benchmarks.campaign import Share
from tests.support.blind_cases import SEED, mistaken, said, single


@pytest.mark.parametrize(
    ("successes", "of", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_interval_is_the_published_one(successes, of, low, high):
    """Newcombe, Statistics in Medicine 17 (1998) 857-872, table I, method 3 (Wilson)."""
    assert Share(successes, of).interval == pytest.approx((low, high), abs=5e-5)


@pytest.mark.slow
def test_nonlinearities_tie_and_twelve_angles_break_them():
    for name in ("cubic_nonlinearity", "odd_quadratic_nonlinearity"):
        answer = single(name)[1]
        assert nearest_rival(answer) > 0.999
        assert not can_tell(answer)
        assert nearest_rival(single(name, "turn-12")[1]) < 0.999
    for name in ("head_eccentricity", "thermal_scale"):
        assert can_tell(single(name)[1])


def test_single_effects_are_judged_by_name_and_by_set():
    case, answer = single("thermal_scale")
    right = judge(case, answer, said("named", ("thermal_scale", [])))
    assert right == {
        "detected": True,
        "mistake alleged": False,
        "in the set": True,
        "first name right": True,
        "alone given": True,
        "alone right": True,
        NOT_SHRUNK: False,
    }
    tied = judge(case, answer, said("confounded", ("scale_drift", ["thermal_scale"])))
    assert (tied["in the set"], tied["first name right"], tied["alone given"]) == (True, False, False)
    assert "alone right" not in tied
    wrong = judge(case, answer, said("named", ("thermal_scale", []), ("outlier", [])))
    assert not wrong["alone right"]
    assert judge(case, answer, said("agrees"))["detected"] is False
    unknown = judge(case, answer, said("unknown"))
    assert unknown["detected"]
    assert "in the set" not in unknown


@pytest.mark.parametrize(
    "gap",
    [
        {"before": 0.97, "after": 1.02, "before_rms": 4e-5, "after_rms": 3e-5},
        {"before": 3.95, "after": 1.2, "before_rms": 42e-6, "after_rms": 80e-6},
        dict.fromkeys(("before", "after", "before_rms", "after_rms")),
    ],
)
def test_a_name_without_a_smaller_gap_is_counted(gap):
    case, answer = single("thermal_scale")
    assert judge(case, answer, said("named", ("thermal_scale", [])) | {"gap": gap})[NOT_SHRUNK]
    assert NOT_SHRUNK not in judge(case, answer, said("confounded", ("thermal_scale", [])) | {"gap": gap})


def test_other_kinds_are_judged():
    case, answer = make_case(SEED, Row("pair", rho=10), 0)
    a, b = answer.names
    both = judge(case, answer, said("confounded", (a, []), ("outlier", [b])))
    assert (both["both in the sets"], both["a set without either"]) == (True, False)
    one = judge(case, answer, said("named", (a, []), ("outlier", [])))
    assert (one["both in the sets"], one["a set without either"]) == (False, True)

    case, answer = make_case(SEED, Row("outside", rho=20), 0)
    assert judge(case, answer, said("named", ("warm_up", [])))["given a single name"]
    alike = judge(case, answer, said("unknown"), likeness=lambda _: 0.97)
    assert alike["flagged unknown (like a member)"]

    _, _, answer = mistaken("reversed_rotation", "")
    assert judge(case, answer, said("mistake", ("reversed_polarity", [])))["first name right"]
    missed = judge(case, answer, said("named", ("reversed_rotation", [])))
    assert not missed["mistake found"]
    assert not missed["first name right"]

    case, answer = make_case(SEED, Row("hidden"), 0)
    listed = judge(case, answer, said("agrees", hidden=answer.names))
    assert listed == {"agrees": True, "hidden listed": True}
    assert not judge(case, answer, said("agrees"))["hidden listed"]
