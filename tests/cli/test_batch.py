"""bench batch: what it prints, writes and returns; what it refuses."""

import csv
import json
import shutil
from pathlib import Path

import pytest

from bench.batch.work import worked
from tests.support.commands import printed, refused
from tests.support.many_runs import edited, runs_in
from tests.support.schemas import keeps_to


@pytest.fixture
def here(monkeypatch):
    """Runs are computed in this process."""
    monkeypatch.setattr(
        "bench.batch.processes.by_processes", lambda job, runs, count: (worked(job, run) for run in runs)
    )


@pytest.fixture
def runs(empty_folder, here):
    return runs_in(Path("runs"), 3)


def calibrate(bench, *more):
    return bench("batch", "calibrate", "--over", "runs/*", "--out", "out", *more)


@pytest.mark.slow
def test_nothing_changes_where_nothing_is_other_and_the_table_has_each_run_once(bench, runs):
    import duckdb

    status, out, err = calibrate(bench, "--json", "result.json")
    assert (status, err) == (0, "")
    assert out.splitlines()[-1] == "NO VERDICT WOULD BE DIFFERENT"
    assert "computed with: what each run recorded" in out
    told = json.loads(Path("result.json").read_text())
    keeps_to("batch", told)
    assert told["verdicts"] == {"different": 0, "same": 3, "unknown": 0, "changes": []}
    assert told["runs"]["simulated"] == 3
    assert json.loads(Path("out/summary.json").read_text()) == told
    calibrate(bench)
    rows = list(csv.DictReader(Path("out/changes.csv").read_text().splitlines()))
    assert [row["run"] for row in rows] == [str(run.resolve()) for run in runs]
    found = duckdb.sql("SELECT run, len(covariance) FROM 'out/changes.parquet' ORDER BY run").fetchall()
    assert found == [(row["run"], 144) for row in rows]


@pytest.mark.slow
def test_verdicts_that_would_be_different_are_told_counted_and_listed_and_shown_again(bench, runs):
    shutil.rmtree(runs[2])
    (runs[1] / "verify.json").unlink()
    out = printed(
        calibrate(bench, "--limit", "1e-6"),
        "verdicts: 0 the same, 1 different, 1 with nothing to compare (1 without a stored one)",
        "computed with: limit g 1e-06",
        status=1,
    )
    assert out.splitlines()[-1] == "1 VERDICT WOULD BE DIFFERENT"
    (row,) = csv.DictReader(Path("out/verdicts.csv").read_text().splitlines())
    assert (Path(row["run"]).name, row["verdict_stored"]) == ("run-1", "passed (conditional pass)")
    assert row["verdict"].startswith("failed")
    assert bench("batch", "show", "out", "--json", "told.json") == (1, out, "")
    keeps_to("batch", json.loads(Path("told.json").read_text()))
    refusal = "bench: nothing: the folder has no batch (no batch.json in it); name the folder of a batch\n"
    assert bench("batch", "show", "nothing")[2] == refusal
    err = refused(calibrate(bench, "--limit", "1e-6", "--estimator", "robust"))
    assert err.startswith(
        "bench: out: its batch was started with other options: --estimator was gls; use the same options"
    )
    refused(bench("batch", "diagnose", "--over", "runs/*", "--out", "out"), "the command was calibrate")


@pytest.mark.slow
def test_a_bad_run_is_listed_and_does_not_stop_the_others(bench, runs):
    (runs[1] / "events.jsonl").write_text("{}\n")
    out = printed(calibrate(bench), status=1)
    assert out.splitlines()[-1] == "NO VERDICT WOULD BE DIFFERENT; 1 RUN FAILED"
    assert "failed: runs/run-2: " in out
    assert "verdicts: 2 the same" in out
    keeps_to("batch", json.loads(Path("out/summary.json").read_text()))


@pytest.mark.slow
def test_strict_takes_a_fit_that_is_judged_otherwise(bench, runs):
    edited(runs[0] / "calibrate.json", lambda told: told["residual"].update(p=1e-5))
    assert calibrate(bench)[0] == 0
    printed(calibrate(bench, "--strict"), "lack of fit: 2 judged the same, 1 otherwise", status=1)


@pytest.mark.slow
def test_ctrl_c_says_what_is_done_and_the_same_command_goes_on(bench, runs, monkeypatch):
    def stopped(job, runs, count):
        yield worked(job, next(runs))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("bench.batch.processes.by_processes", stopped)
        status, out, err = calibrate(bench)
    assert (status, out) == (2, "")
    assert err == "bench: stopped by Ctrl-C; 1 of 3 runs are done; repeat the command to continue\n"
    status, out, err = calibrate(bench)
    assert (status, err) == (0, "note: 1 runs are done, 2 are left\n")
    assert "3 runs (3 simulated)" in out


@pytest.mark.slow
def test_what_no_run_could_be_asked_is_refused_at_once(bench, runs):
    for options, told in {
        ("--estimator", "best"): "best",
        ("--model", "no.yaml"): "--model no.yaml: no such file; check the name",
        ("--g", "1"): "--g 1: give local gravity",
        ("--limit", "-1"): "give a positive limit",
        ("--bench", "nowhere"): "nowhere: there is no such file",
        ("--json", "no/where.json"): "no/where.json",
    }.items():
        refused(calibrate(bench, *options), told)
    assert not Path("out").exists()


@pytest.mark.slow
def test_pages_go_into_the_folder_of_the_batch(bench, runs, monkeypatch):
    status, _, _ = bench("batch", "report", "--over", "runs/*", "--out", "out", "--rule", "guarded")
    assert status in {0, 1}
    pages = sorted(Path("out/pages").rglob("*.html"))
    assert [page.name for page in pages] == ["run-1.html", "run-2.html", "run-3.html"]
    rows = list(csv.DictReader(Path("out/changes.csv").read_text().splitlines()))
    assert [row["page"] for row in rows] == [str(page.resolve()) for page in pages]
    assert {row["rule"] for row in rows} == {"guarded"}
    assert not any((run / "report.html").exists() for run in runs)


def test_a_batch_of_diagnoses(bench, runs, monkeypatch):
    told = {"verdict": "named", "effects": [{"name": "cable_torque"}], "gap": {"before": 4.0, "after": 1.1}}
    monkeypatch.setattr("bench.batch.work._diagnosis", lambda source: told)
    (runs[0] / "diagnose.json").write_text(json.dumps(told | {"effects": []}))
    (runs[1] / "diagnose.json").write_text(json.dumps(told | {"verdict": "agrees", "effects": []}))
    arguments = ("batch", "diagnose", "--over", "runs/*", "--out", "out")
    printed(
        bench(*arguments),
        "names of effects: 0 judged the same, 2 otherwise",
        "1 VERDICT WOULD BE DIFFERENT",
        status=1,
    )
    keeps_to("batch", json.loads(Path("out/summary.json").read_text()))
