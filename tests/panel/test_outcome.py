"""The end of a run on its page: the verdict, the change since the last calibration, what is offered next."""

import json
import re
import shutil
from collections import deque
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from bench.base.languages import catalogue
from bench.base.numbers import rounded
from bench.panel.access import Role
from bench.panel.folder import RunsFolder
from bench.panel.results import (
    EDGE,
    LABELS,
    LONGEST_RESULTS_S,
    WIDTH,
    outcome_of,
    picture_of,
    previous_calibration,
    results_of,
)
from bench.panel.run_events import RunView
from bench.panel.run_state import alarm_of
from bench.panel.stream import DISK_NEEDED, Follower
from bench.run.events import EVENTS, MANIFEST, Event, RunState
from bench.run.folder import RESULTS, Run
from bench.run.person import AskedPrompt, mount_prompt
from bench.run.record import locked
from tests.support.pages import ROOT
from tests.support.panel_client import Browser

RECORDS = ROOT / "tests" / "data" / "records"


def change(file, **told):
    file.write_text(json.dumps({**json.loads(file.read_text("utf-8")), **told}), "utf-8")


def serial(folder, number, created):
    change(folder / MANIFEST, unit_under_test={"type": "block", "serial": number}, created=created)


def outcome(folder, **told):
    return outcome_of(
        Run(folder), RunsFolder(folder.parent), **{"alive": False, "finished": True, "age_s": 1.0, **told}
    )


def test_the_page_of_a_finished_run_ends_with_verdict_picture_and_next_steps(runs, judged):
    worst = max(
        json.loads((judged / "verify.json").read_text())["points"], key=lambda one: abs(one["delta_g"])
    )
    page = Browser(runs, "anna").get("/runs/run/").text
    assert f"worst |Δg| = {rounded(abs(worst['delta_g']) * 1e6, worst['U'] * 1e6)} ±" in page
    assert page.count('class="whisker ') == 4
    assert 'href="/runs/run/view/report">Report</a>' in page
    assert 'href="/start?like=run">Next unit</a>' in page
    assert ">Diagnose</button>" not in page  # it passed and fits
    viewer = Browser(runs, "vera", Role.VIEWER).get("/runs/run/outcome").text
    assert "worst |Δg|" in viewer
    assert "Next unit" not in viewer


def test_the_picture_has_each_point_with_its_u_at_its_place(judged):
    points = json.loads((judged / "verify.json").read_text())
    picture = picture_of(results_of(Run(judged)).verdict)
    scale = (picture.right - picture.left) / (2 * points["limit_g"])
    for whisker, point in zip(picture.whiskers, points["points"], strict=True):
        assert whisker.x - picture.zero == pytest.approx(scale * point["delta_g"], abs=0.2)
        assert whisker.high - whisker.low == pytest.approx(2 * scale * point["U"], abs=0.2)
        assert LABELS <= whisker.low < whisker.high <= WIDTH - EDGE


@pytest.mark.parametrize(
    ("file", "told", "words"),
    [
        ("verify.json", {"passed": False, "statement": "fail"}, "The block did not pass"),
        ("calibrate.json", {"residual": {"p": 1e-5}, "fits": False}, "The model does not fit the readings"),
        ("calibrate.json", {"residual": {"p": 1e-3}}, "A lack of fit is shown at 1 %"),
        ("verify.json", {"warnings": ["continued in spite of it"]}, "yet: continued in spite of it."),
    ],
)
def test_a_run_that_failed_or_misfits_offers_the_diagnosis(runs, judged, file, told, words):
    change(judged / file, **told)
    page = Browser(runs, "anna").get("/runs/run/").text
    assert words in page
    assert '<button class="primary">Diagnose</button>' in page


@pytest.mark.parametrize("diagnosable", [True, False])
def test_a_run_without_calibration_says_why_and_offers_the_diagnosis_if_it_may_help(
    runs, judged, anna, diagnosable
):
    for name in ("calibrate.json", "verify.json"):
        (judged / name).unlink()
    change(judged / RESULTS, made=[], no_calibration="the fit did not converge", diagnosable=diagnosable)
    for page in (anna.get("/runs/run/").text, anna.get("/runs/run/verdict").text):
        assert "the fit did not converge" in page
        assert ('action="/runs/run/diagnose"' in page) == diagnosable


def test_a_run_that_was_given_up_leads_to_the_next_one(runs, anna):
    shutil.copytree(RECORDS / "interrupted", runs / "one")
    assert "like=one" not in anna.get("/runs/one/").text
    assert anna.post("/runs/one/give-up").status_code == 303
    page = anna.get("/runs/one/").text
    assert '<p class="todo">The run is aborted' in page
    assert '<a class="button" href="/start?like=one">Next unit</a>' in page


def test_a_conditional_pass_offers_no_diagnosis(judged):
    change(judged / "verify.json", passed=False, statement="conditional pass")
    assert outcome(judged).misfit == ""


def test_a_damaged_verdict_is_named_with_the_command_that_makes_it_again(runs, judged):
    change(judged / "verify.json", statement="splendid")
    page = Browser(runs, "anna").get("/runs/run/").text
    assert "verify.json: cannot be read; &#39;bench verify run&#39; makes it again" in page
    assert "has no verification points" not in page


def test_results_that_are_being_computed_are_waited_for(judged):
    assert outcome(judged).state == "ready"
    assert outcome(judged, alive=True).state == "waiting"
    for name in ("calibrate.json", "verify.json"):
        (judged / name).unlink()
    assert outcome(judged).state == "waiting"
    assert outcome(judged, finished=False).state == "none"
    assert outcome(judged, age_s=LONGEST_RESULTS_S).state == "none"  # their program was stopped
    with locked(judged / RESULTS):
        assert outcome(judged, age_s=1e4).state == "waiting"
    assert outcome(judged, age_s=LONGEST_RESULTS_S).state == "none"


def test_an_old_snapshot_does_not_keep_a_page_waiting_for_results(judged, anna, monkeypatch):
    (judged / "calibrate.json").unlink()
    ended = datetime.fromisoformat(Run(judged).history.events.last.time)
    monkeypatch.setattr("bench.panel.stream.utc_now", lambda: ended + timedelta(seconds=1))
    monkeypatch.setattr("bench.panel.pages.run.utc_now", lambda: ended + timedelta(hours=1), raising=False)
    assert 'data-outcome="none"' in anna.get("/runs/run/outcome").text


@pytest.mark.slow
def test_a_run_killed_while_it_computes_does_not_promise_its_results(bench, monkeypatch):
    """From the last reading to the results, the list of results is locked; a program that ends releases it."""
    seen = []

    def stopped(run):
        seen.append(outcome(run.folder, age_s=1e4).state)
        raise KeyboardInterrupt

    monkeypatch.setattr("bench.services.conclusion.conclude", stopped)
    assert bench("run", "quick", "--dry-run", "--name", "one")[0] == 2
    assert bench("resume", "one")[0] == 2
    assert seen == ["waiting", "waiting"]
    assert outcome(Path("runs/one"), age_s=LONGEST_RESULTS_S).state == "none"


def test_a_run_says_whether_its_results_are_missing_or_not_due(runs, judged, anna, monkeypatch):
    monkeypatch.setattr("bench.panel.results.LONGEST_RESULTS_S", 0.0)
    for name in ("calibrate.json", "verify.json"):
        (judged / name).unlink()
    page = anna.get("/runs/run/").text
    assert "its results are missing" in page
    assert "Make the results" in anna.get("/runs/run/verdict").text
    change(judged / RESULTS, made=[])  # as after a procedure that alone gives no calibration
    page = anna.get("/runs/run/").text
    assert "This run alone gives no calibration" in page
    assert "Make the results" not in page
    assert 'href="/start?like=run">Next unit</a>' in page
    assert "The run alone gives no calibration" in anna.get("/runs/run/verdict").text


def test_the_previous_calibration_is_the_last_one_before_of_the_same_unit(runs, judged):
    for name, number, day in [("old", "7", 1), ("last", "7", 2), ("other", "8", 3), ("later", "7", 5)]:
        shutil.copytree(judged, runs / name)
        serial(runs / name, number, f"2026-11-0{day}T00:00:00+00:00")
    serial(judged, "7", "2026-11-04T00:00:00+00:00")
    found = previous_calibration(Run(judged), RunsFolder(runs))
    assert found.name == "last"
    assert outcome(runs / "old").change is None
    assert outcome(runs / "other").change is None


def test_what_changed_since_then_is_said_with_its_u(runs, judged):
    shutil.copytree(judged, runs / "last")
    serial(runs / "last", "7", "2026-11-01T00:00:00+00:00")
    serial(judged, "7", "2026-11-04T00:00:00+00:00")
    same = outcome(judged).change
    assert same.previous == "last"
    assert "Nothing changed" in same.sentence
    told = json.loads((judged / "calibrate.json").read_text())
    told["coefficients"]["Kxx"]["value"] *= 1.01
    change(judged / "calibrate.json", coefficients=told["coefficients"])
    moved = outcome(judged).change
    assert moved.changed
    assert moved.rows[0].startswith("Sx: ")
    assert "Changed beyond the uncertainty: 4 of the nine" in moved.sentence


@pytest.mark.parametrize("what", ["report", "diagnosis", "else"])
def test_report_and_diagnosis_are_shown_below_the_header_of_the_panel(runs, judged, what):
    browser = Browser(runs, "anna")
    there = browser.get(f"/runs/run/view/{what}")
    if what != "report":  # it was not diagnosed
        assert there.status_code == 404
        return
    assert '<iframe class="framed" src="/runs/run/report"' in there.text
    framed = browser.get("/runs/run/report")
    assert framed.headers["x-frame-options"] == "SAMEORIGIN"
    assert "sandbox; frame-ancestors 'self'" in framed.headers["content-security-policy"]
    assert there.headers["x-frame-options"] == "DENY"


# --- before the end -----------------------------------------------------------------------------------


@pytest.fixture
def growing(tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(RECORDS / "finished", folder)
    return folder


def state_after(folder, lines):
    whole = (RECORDS / "finished" / EVENTS).read_bytes().splitlines(keepends=True)
    (folder / EVENTS).write_bytes(b"".join(whole[:lines]))
    follower = Follower(folder)
    follower.look()
    return follower.state()


def test_time_left_is_known_at_every_event_of_a_run_and_falls(growing):
    whole = (RECORDS / "finished" / EVENTS).read_bytes().splitlines()
    left = [state_after(growing, lines)["where"]["left_s"] for lines in range(1, len(whole), 7)]
    assert None not in left
    assert left[0] > left[len(left) // 2] > left[-1] >= 0.0
    assert state_after(growing, len(whole))["where"]["left"] is None


def test_redo_names_the_point_that_it_repeats(growing):
    assert state_after(growing, 3)["redo"] == ""
    assert state_after(growing, 40)["redo"] == "point 6, 225°00′00″, pass 1"


def test_a_run_that_a_full_disk_ended_says_to_free_it(growing, monkeypatch):
    full = shutil.disk_usage(growing)._replace(free=DISK_NEEDED - 1)
    monkeypatch.setattr("bench.panel.stream.shutil.disk_usage", lambda _: full)
    alarm = state_after(growing, 40)["alarm"]
    assert (alarm["cause"], alarm["do"]) == ("The program of this run ended: the disk is full.", "resume")
    assert alarm["action"].startswith("Free disk space")


def test_a_run_whose_program_is_gone_is_an_alarm_and_a_finished_one_is_none(growing):
    alarm = state_after(growing, 40)["alarm"]
    assert alarm["do"] == "resume"
    assert "ended unexpectedly" in alarm["cause"]
    assert state_after(growing, 10_000)["alarm"] is None


# --- in Ukrainian -------------------------------------------------------------------------------------

LOST = "voltmeter.y: ADDRESS did not answer READ? within 5 s; check its power, its interface setting and the cable"
TURNED = "the head was turned to the next point: it stood at 90°00′00″"
SIGN = {
    "step": 3,
    "sentence": "the reading of installation 1, pass 1, point 2 at 45°00′00″ differs from the prediction: x +99 mV "
    f"(u = 0.45 mV, 220 σ); probable cause: {TURNED}",
    "causes": [TURNED],
    "confident": True,
    "channels": ["x"],
}


@pytest.mark.parametrize(
    ("state", "why", "warnings", "disk_full"),
    [
        (RunState.FAILED, LOST, (), False),
        (RunState.FAILED, "", (), False),
        (RunState.RUNNING, "", (), False),
        (RunState.RUNNING, "", (), True),
        (RunState.RUNNING, "", (Event(9, "t", 0.0, "early_sign", SIGN),), False),
    ],
)
def test_an_alarm_can_be_read_in_ukrainian(growing, state, why, warnings, disk_full):
    plan = Run(growing).plan
    view = RunView(plan, state=state, why=why, warnings=deque(warnings))
    asked = AskedPrompt(Event(10, "t", 0.0, "asked", {}), mount_prompt(plan.steps[1], chamber=False))
    alarm = alarm_of(view, asked, alive=bool(warnings), disk_full=disk_full)
    for text in filter(None, (alarm["cause"], alarm["action"], alarm["details"])):
        assert not re.findall("[a-z]{3,}", catalogue("uk").translate(text)), text
