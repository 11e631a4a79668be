"""`bench run --until` where somebody refuses or mounts again, under a time, and where the model does not fit."""

import json
from pathlib import Path

import pytest

from bench.config.shipped import find_bench
from bench.run.events import Wish
from bench.run.person import ControlFile, RunControl
from tests.cli.test_until import PROCEDURE, chosen, lines, readings

EFFECT = """
effects:
  - name: head_eccentricity
    parameters: {sine: 120 arcsec}
"""
pytestmark = pytest.mark.slow


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


def test_a_time_is_kept_verification_points_and_all(bench, monkeypatch):
    status, run = run_with(bench, monkeypatch, goals=("time=2h",))
    assert status == 0
    found = chosen(run)[-1]
    assert found["stop"] == "time"
    assert found["settings"] < 36
    assert sum("/V." in key for key in readings(run)) == 2
    assert 6600.0 < lines(run)[-1]["bench_s"] <= 7200.0  # no point of two minutes more had fitted in


def test_mounted_again_the_points_count_in_their_own_mounting(bench, monkeypatch):
    status, run = run_with(bench, monkeypatch, RunControl(Wish.MOUNT_AGAIN, "it slipped"))
    assert status == 0
    found = chosen(run)
    assert found[-1]["stop"] == "reached"
    stand = json.loads((run / "calibrate.json").read_text())["stand"]
    assert {name.partition("[")[2] for name in stand} == {"1]", "1/2]", "2]"}


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
