"""`bench run --until`: ends when it is good enough, tells why, and chooses the same when it was killed."""

import json
import shutil
from pathlib import Path

import pytest

from bench.cli.app import main as command_line

PROCEDURE = """procedure: few
reading: {samples: 2, nplc: 1, settle: 10 s}
operator_time: {turn: 2 min, mount: 20 min}
steps:
  - installation:
      label: 1
      steps:
        - repeat:
            directions: [rising, rising, rising]
            steps: [{turn: {angles: {from: 0 deg, step: 60 deg, count: 6}}}]
  - installation:
      label: 2
      steps:
        - repeat:
            directions: [rising, rising, rising]
            steps: [{turn: {angles: {from: 0 deg, step: 60 deg, count: 6}}}]
  - installation:
      label: V
      steps: [{turn: {angles: [45 deg, 135 deg]}}]
"""
GOAL = "vector=8e-5"


def main(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as end:
        command_line(arguments)
    return int(end.value.code)


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """The folder of a run that came to its end, what it said, and its exit status."""
    folder = tmp_path_factory.mktemp("until")
    (folder / "few.yaml").write_text(PROCEDURE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.delenv("BENCH_FILE", raising=False)
        status = main(["run", "few.yaml", "--dry-run", "--name", "whole", "--until", GOAL])
    return folder, status


def lines(run: Path) -> list[dict]:
    return [json.loads(line) for line in (run / "events.jsonl").read_text().splitlines()]


def chosen(run: Path) -> list[dict]:
    told = ("visit", "left_out", "taken_up", "next", "in_all", "now", "settings", "repeats", "stop")
    return [{k: e[k] for k in told if k in e} for e in lines(run) if e["type"] == "chosen"]


def readings(run: Path) -> dict[str, list[float]]:
    return {e["key"]: e["reading"]["mean"] for e in lines(run) if e["type"] == "step_done" and "reading" in e}


@pytest.mark.slow
def test_a_run_ends_when_it_is_good_enough_and_its_calibration_states_that(ended):
    folder, status = ended
    assert status == 0
    run = folder / "runs" / "whole"
    found = chosen(run)
    assert found[-1]["stop"] == "reached"
    assert found[-1]["now"]["u"] <= 8e-5
    taken = [key for key in readings(run) if key.split("/")[-1][0] in "12"]
    assert len(taken) == found[-1]["settings"] < 36
    assert sum("/V." in key for key in readings(run)) == 2  # the verification points stay
    assert json.loads((run / "run.json").read_text())["until"] == [GOAL]
    notes = json.loads((run / "calibrate.json").read_text())["notes"]
    assert any("measured until vector=8e-5" in note for note in notes)


@pytest.mark.slow
@pytest.mark.parametrize("part", [0.0, 0.55])
def test_killed_and_resumed_it_chooses_and_reads_the_same(ended, part, monkeypatch):
    folder, _ = ended
    monkeypatch.chdir(folder)
    whole, killed = folder / "runs" / "whole", folder / "runs" / f"killed{part:g}"
    shutil.copytree(whole, killed)
    every = (killed / "events.jsonl").read_text().splitlines(keepends=True)
    first_chosen = next(i for i, e in enumerate(lines(whole)) if e["type"] == "chosen")
    kept = first_chosen + int(part * (len(every) - first_chosen))  # 0: the first choice is not on the disk
    (killed / "events.jsonl").write_text("".join(every[:kept]))
    assert main(["resume", killed.name]) == 0
    assert chosen(killed) == chosen(whole)
    assert readings(killed) == readings(whole)


@pytest.mark.slow
def test_show_says_what_was_chosen_and_why_it_ended(ended, capsys, monkeypatch):
    monkeypatch.chdir(ended[0])
    assert main(["show", "whole"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "enough: u of rms error vector at 1 g" in out
    assert "are not needed" in out


@pytest.mark.slow
def test_a_goal_below_the_floor_is_refused_before_there_is_a_run(ended, capsys, monkeypatch):
    monkeypatch.chdir(ended[0])
    assert main(["run", "few.yaml", "--dry-run", "--name", "never", "--until", "all=1e-5"]) == 2
    assert "main contributions: zero offset" in " ".join(capsys.readouterr().err.split())
    assert not Path("runs/never").exists()


def test_all_goals_that_cannot_be_understood_are_told_at_once(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("few.yaml").write_text(PROCEDURE)
    assert main(["run", "few.yaml", "--dry-run", "--until", "foo,al=5e-5", "--until", "Kxx=-1"]) == 2
    said = capsys.readouterr().err
    assert [line.count("until") for line in said.splitlines()] == [1, 1, 1]
    assert "--until foo: give a name" in said
    assert "no coefficient 'al'" in said
    assert "not -1" in said
