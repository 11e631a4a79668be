"""Starting a run: only what may be chosen, check and dry run before, and what is started is what was checked."""

import json
import os
import re
import runpy
from dataclasses import replace
from html import unescape
from pathlib import Path

import pytest

from bench.panel import launching as trying
from bench.panel.access import Refusal, Role, Settings
from bench.panel.launching import (
    MOST_KEPT,
    TrialResult,
    WantedRun,
    Wishes,
    WishFolder,
    arguments_of,
    start,
    wait_until,
)
from bench.panel.own_files import choices, chosen_bench
from bench.panel.pages.start import FORM, form_field, printable
from bench.panel.shared import Panel
from bench.run.events import MANIFEST
from tests.support.commands import without_figures
from tests.support.panel_client import Browser

CHOSEN = {"procedure": "quick", "bench": "paper-stand"}


@pytest.fixture
def started(monkeypatch):
    """What was started instead of processes."""
    calls = []
    monkeypatch.setattr("bench.panel.pages.start.start", lambda *given, **more: calls.append((given, more)))
    return calls


def test_the_form_begins_with_the_bench_of_the_latest_run(runs, judged, anna):
    Path("mine.yaml").write_text("name: mine\ninstruments:\n")
    assert "<option selected>paper-stand</option>" in anna.get("/start").text
    (judged / MANIFEST).write_text("damaged")
    assert "<option selected>mine.yaml</option>" in anna.get("/start").text


def begun(anna, **sent):
    reply = anna.post("/start", **{**CHOSEN, **sent})
    assert reply.status_code == 303, reply.text
    return anna.client.app.state.panel.wishes.of(reply.headers["location"].rpartition("/")[2])


def test_only_shipped_files_and_those_of_the_working_folder_are_chosen(runs, tmp_path, monkeypatch):
    Path("mine.yaml").write_text("name: mine\ninstruments:\n")
    Path("other.yaml").write_text("procedure: other\n")
    Path("notes.yaml").write_text("text: 1\n")
    assert {"mine.yaml", "paper-stand"} <= choices("config").keys()
    assert {"other.yaml", "calibration"} <= choices("procedures").keys()
    assert "notes.yaml" not in choices("config") | choices("procedures")
    panel = Panel(Settings(runs))
    for name in ("/etc/passwd", "../mine.yaml", "notes.yaml", "", "next:..", "next:none", "\0"):
        with pytest.raises(Refusal):
            chosen_bench(name, panel.runs)


@pytest.mark.parametrize(
    "sent",
    [
        {"procedure": "/etc/passwd"},
        {"bench": "../x.yaml"},
        {"name": "../x"},
        {"name": "-x"},
        {"name": "done"},
        {"unit": "17\x1b[2J"},
        {"operator": "x" * 101},
        {"operator": "a\nb"},
    ],
)
def test_what_cannot_be_wished_is_refused_and_nothing_started(runs, started, sent):
    (runs / "done").mkdir()
    reply = Browser(runs, "anna").post("/start", **{**CHOSEN, **sent})
    assert reply.status_code in {400, 409}
    assert started == []


def test_the_form_asks_for_fields_of_the_request_and_the_same_request_is_run(anna, started):
    page = anna.get("/start").text
    assert '<input type="radio" name="procedure" value="paper" required>' in page
    for field in map(form_field, FORM[1:]):
        assert f'<label for="{field.name}">{field.label}</label>' in page
        assert field.help in unescape(page)
    wanted = begun(anna, unit="17-042", dry_run="yes").wanted()
    assert (wanted.request.unit, wanted.request.operator, wanted.request.dry_run) == ("17-042", "anna", True)
    arguments = list(arguments_of(replace(wanted.request, name="one", until=["all=1e-4", "time=4h"])))
    assert arguments[0] == wanted.request.procedure
    assert {"--unit=17-042", "--operator=anna", "--dry-run", "--until=all=1e-4", "--until=time=4h"} < {
        *arguments
    }
    assert not any(word.startswith(("--seed", "--model", "--panel")) for word in arguments)


def test_a_viewer_starts_nothing(runs, started):
    eve = Browser(runs, "eve", Role.VIEWER)
    assert (eve.get("/start").status_code, eve.post("/start", **CHOSEN).status_code) == (403, 403)
    assert started == []


def test_what_check_finds_stands_on_the_page(anna, started):
    wish = begun(anna, unit="17-042")
    page = anna.get(f"/start/{wish.id}").text
    assert "data-waiting" in page
    assert "Start on the bench" not in page
    found = trying.checked(wish.wanted(), wish.path)
    assert found.stage == "trying"
    wish.tell(found)
    assert "Being tried" in anna.get(f"/start/{wish.id}").text
    wish.tell(TrialResult("done", check=found.check, tried=0, said="verdict <b>"))
    page = anna.get(f"/start/{wish.id}").text
    assert "22 readings" not in page
    assert "verdict &lt;b&gt;" in page
    assert "Start on the bench" in page


@pytest.mark.parametrize(("stage", "what"), [("checking", "check"), ("trying", "dry run")])
def test_a_check_or_dry_run_whose_process_is_gone_is_told_and_the_choice_kept(
    anna, started, monkeypatch, stage, what
):
    wish = begun(anna, unit="17-042")
    if stage == "trying":
        wish.tell(trying.checked(wish.wanted(), wish.path))
    monkeypatch.setattr("bench.panel.pages.start._just_begun", lambda _: False)
    page = anna.get(f"/start/{wish.id}").text
    again = re.search(rf'The {what} was stopped. <a href="([^"]*)">Start again</a>', page)
    assert "unit=17-042" in again[1]
    assert "Start on the bench" not in page


def test_files_with_mistakes_are_told_with_all_of_them(anna, started):
    Path("bad.yaml").write_text("name: bad\ninstruments: {}\n")
    wish = begun(anna, bench="bad.yaml")
    wish.tell(trying.checked(wish.wanted(), wish.path))
    page = anna.get(f"/start/{wish.id}").text
    assert "bad.yaml" in page
    assert page.count("bad.yaml:") > 2
    assert anna.post(f"/start/{wish.id}/go").status_code == 409


@pytest.mark.parametrize("tried", [2, None, -9])
def test_what_failed_in_the_dry_run_is_not_started(anna, started, tried):
    wish = begun(anna)
    check = {"problems": [], "dry_run_refuses": [], "hints": [], "procedure": "q", "bench": "b", "steps": 1,
             "operator_actions": 1, "expected_s": 1.0, "longest_s": 1.0}  # fmt: skip
    wish.tell(TrialResult("done", check=check, tried=tried))
    assert "Start on the bench" not in anna.get(f"/start/{wish.id}").text
    assert anna.post(f"/start/{wish.id}/go").status_code == 409


def test_what_was_changed_since_it_was_checked_is_not_started(anna, started):
    Path("procedures").mkdir()
    quick = Path("procedures/quick.yaml")
    quick.write_bytes(choices("procedures")["quick"].read_bytes())
    wish = begun(anna)
    wish.tell(trying.checked(wish.wanted(), wish.path))
    found = wish.found()
    wish.tell(TrialResult("done", check=found.check, tried=0))
    quick.write_text(quick.read_text() + "\n# another\n")
    reply = anna.post(f"/start/{wish.id}/go")
    assert reply.status_code == 409
    assert "changed after the check" in reply.text


def test_a_wish_is_started_once(tmp_path):
    wish = Wishes(tmp_path).new(WantedRun({"procedure": "p", "bench": "b"}))
    wish.mark_started("one")
    with pytest.raises(Refusal, match="already started"):
        wish.mark_started("two")


def test_the_trial_says_its_own_verdict_and_the_choice_is_kept_for_another(anna, started, judged):
    wish = begun(anna, unit="17-042", operator="Ann B.", dry_run="yes")
    verdict = json.loads((judged / "verify.json").read_text())
    check = {"problems": [], "hints": [], "dry_run_refuses": [], "steps": 1, "operator_actions": 1,
             "procedure": "quick", "bench": "b", "expected_s": 60.0, "longest_s": 60.0}  # fmt: skip
    doubtful = verdict | {"passed": False, "statement": "conditional pass"}
    for verification, says in (
        (verdict, "✓ passed, worst"),
        (doubtful, "conditional pass, worst"),
        (None, "not accepted: see the output"),
    ):
        wish.tell(TrialResult("done", check=check, tried=1, result={"verification": verification}))
        page = unescape(anna.get(f"/start/{wish.id}").text)
        assert says in page
        assert "does not pass" not in page
    form = anna.get(re.search(r'href="([^"]*)">Change the choice', page)[1]).text
    for kept in ('value="quick" required checked', "<option selected>paper-stand<", 'value="17-042"',
                 'value="Ann B."', 'name="dry_run" type="checkbox" value="yes" checked'):  # fmt: skip
        assert kept in form


def test_old_wishes_are_forgotten(tmp_path):
    wishes = Wishes(tmp_path)
    made = [wishes.new(WantedRun({"procedure": "p", "bench": "b"})).id for _ in range(MOST_KEPT + 5)]
    kept = {folder.name for folder in tmp_path.iterdir()}
    assert len(kept) == MOST_KEPT
    assert made[-1] in kept
    with pytest.raises(Refusal):
        wishes.of("../" + made[-1])


def test_no_more_than_two_are_tried_at_once(tmp_path):
    wishes = Wishes(tmp_path)
    one, two = (
        wishes.new(WantedRun({"procedure": "p", "bench": "b"})),
        wishes.new(WantedRun({"procedure": "p", "bench": "b"})),
    )
    with one.lock(), two.lock(), pytest.raises(Refusal, match="two runs are being tried already"):
        wishes.new(WantedRun({"procedure": "p", "bench": "b"}))
    wishes.new(WantedRun({"procedure": "p", "bench": "b"}))


@pytest.mark.slow
def test_a_wish_is_checked_and_tried_by_a_run_of_its_own(runs, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(runs.parent), prepend=os.pathsep)
    without_figures(runs.parent)
    wish = Wishes(runs.parent / "wishes").new(
        WantedRun(
            {
                "procedure": str(choices("procedures")["quick"]),
                "bench": str(choices("config")["paper-stand"]),
                "unit": "17-042",
            }
        ).hashed()
    )
    monkeypatch.setattr("sys.argv", ["launching", str(wish.path)])
    runpy.run_path(trying.__file__, run_name="__main__")  # as python -m does; the run is a process
    found = wish.found()
    assert (found.stage, found.tried, found.startable) == ("done", 0, True)
    assert found.result["verification"]["passed"]
    manifest = json.loads((wish.path / "runs" / "trial" / "run.json").read_text())
    assert manifest["unit_under_test"]["serial"] == "17-042"


def test_a_process_that_ends_before_it_begins_says_why(tmp_path):
    started = start([], tmp_path / "log", program=("-c", "print('no \\x1b[2J bench'); raise SystemExit(2)"))
    with pytest.raises(Refusal, match=r"exit status 2\); .*: no \\x1b\[2J bench"):
        wait_until(lambda: False, started)


def test_a_damaged_wish_is_one_to_begin_again(anna, started):
    wish = begun(anna)
    (wish.path / "found.json").write_text("[]")
    assert anna.get(f"/start/{wish.id}").status_code == 404
    assert WishFolder(wish.path).at_work() is False


@pytest.mark.parametrize(
    ("text", "words"), [("x" * 101, "unit: .* more than 100"), ("a\x1b", "unit: .* printed")]
)
def test_a_text_of_a_field_is_refused_for_its_own_reason(text, words):
    assert printable(f" {'x' * 100} ", "unit") == "x" * 100
    with pytest.raises(Refusal, match=words):
        printable(text, "unit")


def test_a_process_that_ends_without_a_word_is_told(tmp_path):
    started = start([], tmp_path / "log", program=("-c", "raise SystemExit(2)"))
    with pytest.raises(Refusal, match=r"exit status 2\) and stated no cause"):
        wait_until(lambda: False, started)
