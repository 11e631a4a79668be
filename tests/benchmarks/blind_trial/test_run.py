"""The blind trial as a program: enough cases, failures counted, cases sealed."""

import json
from dataclasses import replace

import pytest

from bench.diagnosis import levels, visibility
from benchmarks.blind_trial.cases import make_case, seal
from benchmarks.blind_trial.mistakes import MISTAKES
from benchmarks.blind_trial.perturb import changed, constants
from benchmarks.blind_trial.run import FULL, SHORT, kept_in, main
from benchmarks.blind_trial.signals import signals
from benchmarks.blind_trial.stand import make_run
from tests.support.blind_cases import SEED, said


@pytest.mark.slow
def test_the_whole_trial_has_cases_enough():
    for rows in (FULL, SHORT):
        assert len({row.key for row in rows}) == len(rows)
        for row in rows:
            make_case(SEED, row, 0)
    assert sum(row.count for row in FULL if row.kind == "null") >= 2000
    assert min(row.count for row in FULL if row.runs == 1) >= 100
    assert {row.kind for row in FULL} >= {f"mistake:{name}" for name in MISTAKES}


def agrees_or_fails(case) -> dict:
    if case.readings.signal[0, 0] > signals(make_run(case.design))[0, 0]:
        raise ArithmeticError("no convergence")
    return said("agrees")


@pytest.mark.slow
def test_the_trial_counts_failures_and_seals_its_cases(tmp_path, capsys):
    arguments = ["--short", "--only", "null", "--rows", "20", "--workers", "1", "--json", str(tmp_path / "s")]
    ledger = tmp_path / "ledger.jsonl"
    status = main([*arguments, "--ledger", str(ledger)], diagnose=agrees_or_fails)
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


@pytest.mark.slow
def test_a_trial_that_was_interrupted_goes_on_where_it_stopped(tmp_path, capsys):
    kept, made = tmp_path / "kept", []

    def counted(case):
        made.append(case.id)
        return said("agrees")

    def score(seed=1):
        made.clear()
        arguments = ["--short", "--only", "null", "--rows", "6", "--workers", "1", "--seed", str(seed)]
        main([*arguments, "--keep", str(kept), "--json", str(tmp_path / "s")], diagnose=counted)
        return json.loads((tmp_path / "s").read_text())

    whole = score()
    assert len(made) == len(whole["cases"])
    assert score() == whole
    assert made == []
    # a kill in the middle of a line
    lines = kept.read_bytes().splitlines(keepends=True)
    kept.write_bytes(b"".join(lines[:-3]) + lines[-3][:40])
    assert score() == whole
    assert made == [case["id"] for case in whole["cases"]][-3:]
    with pytest.raises(SystemExit, match="of another seed"):
        score(seed=2)
    own_lines = kept.read_bytes().splitlines(keepends=True)
    other = tmp_path / "other"
    kept_in(other, 1, code="another program")
    kept.write_bytes(b"".join([*other.read_bytes().splitlines(keepends=True), *own_lines[1:]]))
    with pytest.raises(SystemExit, match="of another program"):
        score()
    kept.write_text('{\n "score": 1\n}')
    with pytest.raises(SystemExit, match="holds no results of a campaign"):
        score()
    assert kept.read_text() == '{\n "score": 1\n}'
    capsys.readouterr()


def test_a_diagnosis_that_failed_is_tried_again(tmp_path, capsys):
    made = []

    def counted(case):
        made.append(case.id)
        return agrees_or_fails(case)

    arguments = ["--short", "--only", "null", "--rows", "6", "--workers", "1"]
    arguments += ["--keep", str(tmp_path / "kept")]
    assert main(arguments, diagnose=counted) == 1
    first = made.copy()
    made.clear()
    assert main(arguments, diagnose=counted) == 1
    failed = capsys.readouterr().out.count("failed")
    assert 0 < len(made) < len(first)
    assert failed > 0


def test_a_kind_that_does_not_exist_is_refused(capsys):
    with pytest.raises(SystemExit, match="no kind of case called sorcery"):
        main(["--only", "sorcery"], diagnose=agrees_or_fails)


def test_a_perturbed_constant_reaches_every_module_also_in_a_worker():
    """A worker receives a copy of the value, not the object that the modules share."""
    (far,) = (replace(one, value=one.value + 0.0) for one in constants() if one.name == "FAR")
    with changed(far, 1.3):
        assert levels.FAR == visibility.FAR == pytest.approx(1.3 * far.value)
    assert levels.FAR == visibility.FAR == far.value
