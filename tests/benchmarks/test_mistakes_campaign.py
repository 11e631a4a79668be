"""Operators' mistakes, a short version of the campaign: stopped in time, named rightly, mended by a redo."""

import json
from functools import partial
from unittest import mock

import pytest

from bench.cli.app import main
from bench.config.shipped import find_bench
from bench.run.folder import Run
from benchmarks.mistaken_operator import KINDS, MistakenOperator, draw
from benchmarks.mistakes_campaign import CLEAN, LARGE, Outcome, setting, table, watched, whole
from drivers.interfaces import NoAnswer
from drivers.person import Answer
from tests.support.check_runs import dry_run
from tests.support.schemas import keeps_to

QUICK = {"procedure": "quick", "bench_name": "paper-stand"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_mistake_that_is_large_stops_the_run_in_two_readings_for_the_right_reason(kind):
    """Seed 11, two places each; 1′ is never large on this bench, whose readings scatter by 10″."""
    for number in (0, 1):
        outcome = watched(kind, number, 11, **QUICK)
        if outcome.size is None or outcome.size < LARGE:
            continue
        assert outcome.stopped
        assert outcome.late in (0, 1)
        assert outcome.right, outcome


@pytest.mark.slow
def test_a_run_without_a_mistake_is_not_stopped():
    assert not any(watched(CLEAN, number, 12, **QUICK).stopped for number in range(5))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["not remounted", "cables swapped", "wrong direction"])
def test_what_is_taken_again_agrees_with_an_undisturbed_run(kind, tmp_path):
    outcome = whole(kind, 1, 13, folder=tmp_path, **QUICK)
    assert outcome.stopped
    assert outcome.right
    assert outcome.agrees, outcome
    assert not outcome.trouble


class Stubborn(MistakenOperator):
    def ask(self, prompt):
        if prompt.id.startswith("halt@"):
            return Answer(prompt.id, "go on it is late")
        return super().ask(prompt)


def gone_on(kind, runs, number=0):
    """A finished run of whose mistake the operator was told, and went on."""
    plan, bench = setting("quick", "paper-stand")
    mistake = draw(kind, number, plan, bench.installation_models(), 5)
    make = partial(Stubborn, plan=plan, mistake=mistake)
    with mock.patch("bench.run.assembly.served.ScriptedOperator", make):
        return dry_run("quick", "paper-stand", runs, "run", 5)


def diagnosed(capsys, runs, *more):
    with pytest.raises(SystemExit) as ended:
        main(["diagnose", "run", "--runs", str(runs), "--no-report", "--json", str(runs / "d.json"), *more])
    capsys.readouterr()
    result = json.loads((runs / "d.json").read_text())
    keeps_to("diagnose", result)
    return ended.value.code, result


@pytest.mark.slow
def test_a_run_in_a_wrong_installation_is_put_right_by_diagnose_and_not_refused(tmp_path, capsys):
    run = gone_on("not remounted", tmp_path)
    events = [event.type for event in run.history.events]
    assert events.count("went_on") == 1  # a mistake that lasts is asked about once
    assert events.count("early_sign") > 5
    status, result = diagnosed(capsys, tmp_path)
    assert status == 0
    assert result["verdict"] == "mistake"
    assert result["effects"][0]["name"] == "swapped_installations"
    assert "the block sat in installation 1, not in 2" in result["effects"][0]["words"]
    assert "do not determine" in result["notes"][0]
    assert diagnosed(capsys, tmp_path, "--strict")[0] == 1


@pytest.mark.slow
def test_a_large_effect_of_a_recorded_run_is_named_and_taken_for_no_mistake(tmp_path, capsys):
    bench_file = tmp_path / "bench.yaml"
    large = '  effects:\n    - {name: scale_asymmetry, parameters: {Kabs: "1 mg/g"}}\n'
    bench_file.write_text(find_bench("paper-stand").read_text(encoding="utf-8") + large, encoding="utf-8")
    assert dry_run("paper", str(bench_file), tmp_path, "run", 5).history.progress.signs > 10
    result = diagnosed(capsys, tmp_path)[1]
    assert result["verdict"] == "named"
    assert [effect["name"] for effect in result["effects"]] == ["scale_asymmetry"]


@pytest.mark.slow
def test_a_head_that_was_not_turned_is_left_out_by_diagnose(tmp_path, capsys):
    gone_on("not turned", tmp_path, 2)
    status, result = diagnosed(capsys, tmp_path)
    assert status == 0
    assert result["verdict"] == "mistake"
    assert [effect["name"] for effect in result["effects"]] == ["wrong_setting"]
    assert "the head was not turned" in result["effects"][0]["words"]
    assert any("the head was not turned" in row for row in result["skipped_rows"])
    with pytest.raises(SystemExit):
        main(["report", "run", "--runs", str(tmp_path)])
    assert Run(tmp_path / "run").history.problems == ()


@pytest.mark.slow
def test_a_dry_run_that_stops_ends_with_status_2_and_asks_again_when_resumed(tmp_path, capsys, monkeypatch):
    """The scripted operator forgets the head once and has no answer to how to go on."""
    plan, bench = setting("quick", "paper-stand")
    mistake = draw("not turned", 0, plan, bench.installation_models(), 5)

    class Silent(MistakenOperator):
        def ask(self, prompt):
            if prompt.id.startswith("halt@"):
                raise NoAnswer("operator", "nobody", "be there")
            return super().ask(prompt)

    monkeypatch.chdir(tmp_path)
    make = partial(Silent, plan=plan, mistake=mistake)
    with mock.patch("bench.run.assembly.served.ScriptedOperator", make), pytest.raises(SystemExit) as ended:
        main(["run", "quick", "--bench", "paper-stand", "--dry-run", "--name", "run"])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert "the head was not turned" in said
    assert "bench resume run" in said
    (tmp_path / "answers").write_text("redo point\n", encoding="utf-8")
    with (tmp_path / "answers").open() as answers, monkeypatch.context() as patch:
        patch.setattr("sys.stdin", answers)
        with pytest.raises(SystemExit) as ended:
            main(["resume", "run"])
    assert ended.value.code == 0
    assert "probable cause: the head was not turned" in " ".join(capsys.readouterr().out.split())
    assert Run(tmp_path / "runs" / "run").history.state == "finished"


def test_the_table_says_which_bar_is_missed():
    good = [Outcome("not turned", "1.1", k, 50.0, True, 0, ("was not turned",), True) for k in range(100)]
    late = [Outcome("not turned", "1.1", k, 50.0, True, 2, ("was not turned",), True) for k in range(2)]
    small = [Outcome("not turned", "1.1", k, 5.0) for k in range(50)]
    assert table([*good, *small])[1]
    assert not table([*good, *late])[1]
    assert not table([*good, Outcome(CLEAN, "", 1, stopped=True)])[1]
