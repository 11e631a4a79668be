"""Dry runs whose questions a person answers: at the terminal or in the run's folder, the readings are the same."""

import io
import threading
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from bench.run import listening
from bench.run.events import Wish
from bench.run.folder import Run
from bench.run.listening import Asker
from bench.run.person import LeftAnswer, RunControl, WishAuthor, leave_answer, leave_wish
from bench.services.execution import accept_changes
from drivers.interfaces import BenchError
from tests.support.answering import PROCEDURE, Hands, amiss, answer_to, differences, one
from tests.support.campaigns import seeds
from tests.support.commands import printed

POINTS = """\
procedure: points
title: Three settings on one mounting
reading: {samples: 3, nplc: 1, settle: 2 s}
steps:
  - prompt: {text: "Which cable is it?", kind: choose, choices: [long, short]}
  - installation: {label: 1, steps: [turn: {angles: [0 deg, 45 deg, 90 deg]}]}
"""
RUN = ("run", "points.yaml", "--dry-run", "--seed", "3")


@pytest.fixture
def points(bench, monkeypatch):
    """Return what carries out a run answered in its folder, and returns it with the output of the command."""
    Path("points.yaml").write_text(POINTS)
    monkeypatch.setattr(listening, "LISTEN_S", 0.002)

    def answered(name, *arguments, hands=None):
        hands = hands or Hands(Path("runs") / name, None, None, calm=True)
        over = threading.Event()

        def answer():
            while not over.wait(0.002):
                hands.look()

        thread = threading.Thread(target=answer)
        thread.start()
        try:
            said = bench(*arguments)
        finally:
            over.set()
            thread.join()
        return Run(Path("runs") / name), said

    return answered


@pytest.mark.slow
def test_typed_or_left_in_the_folder_the_same_answers_make_the_same_readings(points, bench):
    run, (status, out, err) = points("away", *RUN, "--name", "away", "--answers", "folder")
    assert (status, err) == (0, "")
    assert "answered in the panel by Ann: long" in out
    typed = [event.data["answer"] for event in run.history.events if event.type == "answered"]
    lines = "".join(f"{line}\n" for line in typed)
    assert bench(*RUN, "--name", "here", "--answers", "terminal", stdin=lines)[0] == 0
    here = Run(Path("runs/here"))
    assert differences(here, run) == []
    assert [event.type for event in here.history.events] == [event.type for event in run.history.events]
    assert amiss(run) == amiss(here) == []
    assert {e.data["where"] for e in here.history.events if e.type == "answered"} == {"terminal"}


@pytest.mark.slow
def test_a_typed_angle_is_where_the_simulated_head_stands_and_a_wrong_one_is_refused(points):
    class Careless(Hands):
        def _act(self, prompt):
            if prompt.kind == "angle" and not self.done[prompt.id]:
                self.done[prompt.id] += 1
                self._leave(prompt.id, "12 34 56")
            self._leave(prompt.id, answer_to(prompt) if "1.1.3" not in prompt.id else "90 0 25")

    hands = Careless(Path("runs/one"), None, None)
    run, (status, _, _) = points("one", *RUN, "--name", "one", "--answers", "folder", hands=hands)
    assert status == 0
    refused = [event.data["why"] for event in run.history.events if event.type == "answer_refused"]
    assert len(refused) == 3
    assert "12°34′56″ is" in refused[0]
    readings = run.readings()
    assert readings.angle_rad[2] == pytest.approx(1.5707963 + 25 * 4.848e-6, abs=1e-7)
    exact, _ = points("two", *RUN, "--name", "two", "--answers", "folder")
    moved_v = readings.signal[2] - exact.readings().signal[2]
    assert max(abs(moved_v)) > 20e-6  # of about 2 V/g, by 25″ and as much again as the other was off


@pytest.mark.slow
def test_a_temperature_unlike_a_room_s_is_asked_about_and_the_confirmation_is_on_record(points):
    class Warm(Hands):
        def _act(self, prompt):
            self._leave(prompt.id, "44" if prompt.kind == "number" else answer_to(prompt))

    run, (status, _, _) = points(
        "one", *RUN, "--name", "one", "--answers", "folder", hands=Warm(Path("runs/one"), None, None)
    )
    assert status == 0
    events = run.history.events
    asked = {event.data["id"]: event.data["text"] for event in events if event.type == "asked"}
    answered = [event.data for event in events if event.type == "answered"]
    doubts = [data for data in answered if "Is that right?" in asked[data["id"]]]
    assert [(asked[data["id"]], data["answer"], data["by"]) for data in doubts] == [
        ("44 °C: 21 °C from the 23 °C of a usual room. Is that right?", "yes", "Ann")
    ]
    assert run.readings().temperature_c[0] == 44.0


@pytest.mark.slow
def test_a_run_that_was_stopped_in_the_panel_goes_on_with_a_living_person(points):
    class Stopping(Hands):
        def _act(self, prompt):
            if "1.1.2" in prompt.id:
                leave_wish(
                    self.folder, RunControl(Wish.STOP, "tea", who=WishAuthor("Eve", "viewer", "panel"))
                )
            else:
                super()._act(prompt)

    hands = Stopping(Path("runs/one"), None, None, calm=True)
    run, (status, out, err) = points("one", *RUN, "--name", "one", "--answers", "folder", hands=hands)
    assert status == 2
    assert "stopped in the panel by Eve" in out
    assert "resume with 'bench resume one'" in err
    assert run.history.events.last.data == {"reason": "tea", "by": "Eve", "role": "viewer", "where": "panel"}
    run, (status, _, _) = points("one", "resume", "one", "--answers", "folder")
    assert status == 0
    whole, _ = points("whole", *RUN, "--name", "whole", "--answers", "folder")
    assert differences(run, whole) == []


def test_a_place_that_is_none_is_refused(bench, points):
    assert "--answers mars" in bench(*RUN, "--answers", "mars")[2]
    assert "--follow asks at the terminal" in bench(*RUN, "--answers", "folder", "--follow")[2]


def test_a_run_with_a_panel_prints_the_link_to_its_page_and_is_answered_there(points, monkeypatch):
    monkeypatch.setattr(
        "bench.panel.app.open_panel", lambda runs, after, *_: f"http://127.0.0.1:1/{runs.name}{after}"
    )
    run, (status, out, _) = points("one", *RUN, "--name", "one", "--panel")
    assert status == 0
    assert "panel: http://127.0.0.1:1/runs/runs/one/" in out
    assert {e.data["where"] for e in run.history.events if e.type == "answered"} == {"panel"}


@pytest.mark.parametrize("answer", ["yes", "no"])
def test_files_that_were_changed_before_a_run_goes_on_are_asked_about_in_the_folder_too(tmp_path, answer):
    (tmp_path / "mine.yaml").write_text("new")
    (tmp_path / "procedure.yaml").write_text("old")
    run = SimpleNamespace(
        folder=tmp_path, simulated=False, manifest={"procedure": str(tmp_path / "mine.yaml"), "bench": ""}
    )
    asked = []

    def tell(kind, data):
        if kind == "asked":
            asked.append(data)
            leave_answer(tmp_path, LeftAnswer(data["id"], answer, WishAuthor("Ann", "operator", "panel")))

    asker = Asker(tmp_path, SimpleNamespace(count=41), tell)
    with nullcontext() if answer == "yes" else pytest.raises(BenchError, match="answered no"):
        accept_changes(run, asker, Console(file=io.StringIO()))
    assert asked[0]["id"] == "changed#1@42"
    assert "mine.yaml was changed since the run began. Continue" in asked[0]["text"]


def test_show_and_log_tell_who_answered_what(points, bench):
    points("one", *RUN, "--name", "one", "--answers", "folder")
    printed(bench("show", "one"), "asked: Which cable is it?", "answered in the panel by Ann: long")
    assert "answered in the panel by Ann: long" in Path("runs/one/run.log").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("seed", seeds(5))
def test_answers_from_two_places_and_a_kill_change_nothing(points, tmp_path, seed):
    calm = ("run", PROCEDURE, "--dry-run", "--seed", "7", "--answers", "folder")
    expected, _ = points("calm", *calm, "--name", "calm")
    run, done = one(1, tmp_path, seed=seed, kills=1 + (seed - 5) % 4)
    assert done["killed"] == 1 or seed > 5
    assert differences(run, expected) == []
    assert amiss(expected) == amiss(run) == []
