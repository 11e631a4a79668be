"""The blind trial's score: intervals, what can be told, what counts as right, and the trial as a whole."""

from __future__ import annotations

import json

import pytest

from benchmarks.blind_trial.cases import Row, make_case, seal
from benchmarks.blind_trial.designs import make_run
from benchmarks.blind_trial.effects import CATALOGUE
from benchmarks.blind_trial.mistakes import MISTAKES
from benchmarks.blind_trial.run import FULL, SHORT, main
from benchmarks.blind_trial.score import Share, judge
from benchmarks.blind_trial.signals import signals
from benchmarks.blind_trial.ties import can_tell_by_signature, can_tell_by_table, nearest_rival

SEED = 20261122


@pytest.mark.parametrize(
    ("successes", "of", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_interval_is_the_published_one(successes, of, low, high):
    """Newcombe, Statistics in Medicine 17 (1998) 857-872, table I, method 3 (Wilson)."""
    assert Share(successes, of).interval == pytest.approx((low, high), abs=5e-5)


def _single(name: str, design: str = "paper") -> tuple[object, object]:
    turn = list(CATALOGUE).index(name)
    for index in range(turn, 20 * len(CATALOGUE), len(CATALOGUE)):
        case, answer = make_case(SEED, Row("single", design, 10), index)
        if answer.names == (name,) and len(answer.effects[0].channels) <= 1:
            return case, answer
    raise AssertionError(f"no {name}")


def test_ties_are_those_of_the_table_and_twelve_angles_break_them():
    for name in ("cubic_nonlinearity", "odd_quadratic_nonlinearity"):
        case, answer = _single(name)
        assert nearest_rival(answer) > 0.999
        assert not can_tell_by_signature(case, answer)
        assert not can_tell_by_table(case, answer)
        assert nearest_rival(_single(name, "turn-12")[1]) < 0.999
    for name in ("head_eccentricity", "thermal_scale"):
        assert can_tell_by_table(*_single(name))
        assert can_tell_by_signature(*_single(name))


def _said(verdict: str, *effects: tuple[str, list[str]], hidden: tuple[str, ...] = ()) -> dict:
    found = [{"name": name, "cannot_tell_from": others} for name, others in effects]
    return {"verdict": verdict, "effects": found, "hidden": list(hidden)}


def test_single_effects_are_judged_by_name_and_by_set():
    case, answer = _single("thermal_scale")
    right = judge(case, answer, _said("named", ("thermal_scale", [])))
    assert right == {
        "detected": True,
        "mistake alleged": False,
        "in the set": True,
        "first name right": True,
        "alone given": True,
        "alone right": True,
    }
    tied = judge(case, answer, _said("confounded", ("scale_drift", ["thermal_scale"])))
    assert (tied["in the set"], tied["first name right"], tied["alone given"]) == (True, False, False)
    assert "alone right" not in tied
    wrong = judge(case, answer, _said("named", ("thermal_scale", []), ("outlier", [])))
    assert not wrong["alone right"]
    assert judge(case, answer, _said("agrees"))["detected"] is False
    unknown = judge(case, answer, _said("unknown"))
    assert unknown["detected"]
    assert "in the set" not in unknown


def test_other_kinds_are_judged():
    case, answer = make_case(SEED, Row("pair", rho=10), 0)
    a, b = answer.names
    both = judge(case, answer, _said("confounded", (a, []), ("outlier", [b])))
    assert (both["both in the sets"], both["a set without either"]) == (True, False)
    one = judge(case, answer, _said("named", (a, []), ("outlier", [])))
    assert (one["both in the sets"], one["a set without either"]) == (False, True)

    case, answer = make_case(SEED, Row("outside", rho=20), 0)
    assert judge(case, answer, _said("named", ("warm_up", [])))["given a single name"]
    alike = judge(case, answer, _said("unknown"), likeness=lambda _: 0.97)
    assert alike["flagged unknown (like a member)"]

    _, answer = make_case(SEED, Row("mistake:reversed_rotation"), 0)
    assert judge(case, answer, _said("mistake", ("reversed_polarity", [])))["first name right"]
    missed = judge(case, answer, _said("named", ("reversed_rotation", [])))
    assert not missed["mistake found"]
    assert not missed["first name right"]

    case, answer = make_case(SEED, Row("hidden"), 0)
    listed = judge(case, answer, _said("agrees", hidden=answer.names))
    assert listed == {"agrees": True, "hidden listed": True}
    assert not judge(case, answer, _said("agrees"))["hidden listed"]


def test_the_whole_trial_has_cases_enough():
    for rows in (FULL, SHORT):
        assert len({row.key for row in rows}) == len(rows)
        for row in rows:
            make_case(SEED, row, 0)
    assert sum(row.count for row in FULL if row.kind == "null") >= 2000
    assert min(row.count for row in FULL) >= 100
    assert {row.kind for row in FULL} >= {f"mistake:{name}" for name in MISTAKES}


def _agrees_or_fails(case) -> dict:
    if case.readings.signal[0, 0] > signals(make_run(case.design))[0, 0]:
        raise ArithmeticError("no convergence")
    return _said("agrees")


def test_the_trial_counts_failures_and_seals_its_cases(tmp_path, capsys):
    arguments = ["--short", "--only", "null", "--rows", "20", "--workers", "1", "--json", str(tmp_path / "s")]
    ledger = tmp_path / "ledger.jsonl"
    status = main([*arguments, "--ledger", str(ledger)], diagnose=_agrees_or_fails)
    out, err = capsys.readouterr()
    assert status == 1
    assert "no convergence" in err
    score = json.loads((tmp_path / "s").read_text())
    row = score["score"]["null paper 15 uV"]
    assert row["agrees"]["successes"] == row["agrees"]["of"]
    assert row["agrees"]["of"] + row["failed"]["of"] == 20
    assert min(row["agrees"]["of"], row["failed"]["of"]) > 0
    assert f"1.000 ({row['agrees']['of']}/{row['agrees']['of']}" in out
    sealed = [json.loads(line) for line in ledger.read_text().splitlines()]
    assert [line["id"] for line in sealed] == [case["id"] for case in score["cases"]]
    case, answer = make_case(1, SHORT[0], 0)
    assert seal(case, answer) == sealed[0]


def test_a_kind_that_does_not_exist_is_refused(capsys):
    with pytest.raises(SystemExit, match="no kind of case called sorcery"):
        main(["--only", "sorcery"], diagnose=_agrees_or_fails)
