"""`bench run --until`: ends when it is good enough, tells why, chooses the same when killed; wishes on the way."""

import json
import shutil
from functools import partial
from pathlib import Path

import pytest

from bench.cli.app import main as command_line
from bench.config.shipped import find_bench
from bench.planning.choice import time_outlook
from bench.run.events import Wish
from bench.run.person import ControlFile, RunControl

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


@pytest.fixture(autouse=True, scope="module")
def short_outlook():
    """What a run is expected to take is told from few simulated ones: `tests/planning/test_until.py` tests it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("bench.services.until.time_outlook", partial(time_outlook, draws=4))
        yield


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
    assert " from zero offset, " in " ".join(capsys.readouterr().err.split())
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


EFFECT = """
effects:
  - name: head_eccentricity
    parameters: {sine: 120 arcsec}
"""


class WishedOnce:
    """Leaves a wish as soon as so many readings of the calibration are recorded."""

    def __init__(self, run: Path, after: int, wish: RunControl) -> None:
        self.events, self.after, self.wish, self.seen = run / "events.jsonl", after, wish, -1

    def poll(self) -> RunControl | None:
        if self.wish is None or not self.events.exists():
            return None
        if self.events.stat().st_size == self.seen:
            return None
        self.seen = self.events.stat().st_size
        if self.events.read_text().count('"reading"') < self.after:
            return None
        wish, self.wish = self.wish, None
        return wish


def run_with(command, monkeypatch, wish=None, after=7, goals=("vector=8e-5",), own=""):
    """Return the exit status of a dry run named `one`, and its folder."""
    monkeypatch.delenv("BENCH_FILE", raising=False)
    Path("few.yaml").write_text(PROCEDURE)
    run = Path("runs") / "one"
    wished = WishedOnce(run, after, wish)
    monkeypatch.setattr(ControlFile, "poll", wished.poll)
    options = [word for goal in goals for word in ("--until", goal)]
    if own:
        Path("own.yaml").write_text(own)
        options += ["--bench", "own.yaml"]
    status, _, _ = command("run", "few.yaml", "--dry-run", "--name", "one", *options)
    return status, run


def proposed(choice) -> set[str]:
    """The points of a choice as installation.pass.point."""
    told = choice.get("next", {"points": []})
    return {f"{told['installation']}.{number}.{point}" for number, point in told["points"]}


@pytest.mark.slow
def test_a_point_that_is_skipped_is_not_proposed_again_in_any_pass(bench, monkeypatch):
    status, run = run_with(bench, monkeypatch, RunControl(Wish.SKIP, "the cable is in the way"))
    assert status == 0
    told = lines(run)
    number = next(i for i, e in enumerate(told) if e["type"] == "skipped" and e.get("reason"))
    last = next(e for e in reversed(told[:number]) if e["type"] == "chosen")
    measured = {key.split("/")[-1] for key in readings(run)}
    (skipped,) = proposed(last) - measured
    installation, _, point = skipped.split(".")
    later = [e for e in told[number:] if e["type"] == "chosen"]
    assert len(later) > 1
    assert not {f"{installation}.{n}.{point}" for n in (1, 2, 3)} & set().union(*map(proposed, later))
    assert later[-1]["stop"] == "reached"


@pytest.mark.slow
def test_a_time_is_kept_verification_points_and_all(bench, monkeypatch):
    status, run = run_with(bench, monkeypatch, goals=("time=2h",))
    assert status == 0
    found = chosen(run)[-1]
    assert found["stop"] == "time"
    assert found["settings"] < 36
    assert sum("/V." in key for key in readings(run)) == 2
    assert 6600.0 < lines(run)[-1]["bench_s"] <= 7200.0  # no point of two minutes more had fitted in


@pytest.mark.slow
def test_mounted_again_the_points_count_in_their_own_mounting(bench, monkeypatch):
    status, run = run_with(bench, monkeypatch, RunControl(Wish.MOUNT_AGAIN, "it slipped"))
    assert status == 0
    found = chosen(run)
    assert found[-1]["stop"] == "reached"
    stand = json.loads((run / "calibrate.json").read_text())["stand"]
    assert {name.partition("[")[2] for name in stand} == {"1]", "1/2]", "2]"}


@pytest.mark.slow
def test_where_the_model_does_not_fit_it_goes_to_what_tells_more(bench, monkeypatch):
    own = find_bench("paper-stand").read_text() + EFFECT
    status, run = run_with(bench, monkeypatch, own=own, goals=("vector=4e-4",))
    assert status == 1
    asked = [e["next"] for e in chosen(run) if "next" in e]
    first = next(i for i, told in enumerate(asked) if told["tells_apart"])
    seen = {(told["installation"], point) for told in asked[:first] for _, point in told["points"]}
    new = {(asked[first]["installation"], point) for _, point in asked[first]["points"]}
    assert new
    assert not new & seen
