"""Who is in control of a run, and what a person asks of it: answers, wishes, everybody's stop."""

import errno
import itertools
import json
import shutil
from datetime import UTC, datetime, timedelta

import pytest

from bench.panel.access import Person, Refusal, Role
from bench.panel.holding import JOURNAL, WORDS, change, read_holding
from bench.run.folder import Run
from bench.run.person import ANSWERS, CONTROL, asked_to_json
from bench.run.record import Record
from drivers.clock import utc_now
from drivers.person import Prompt, PromptKind
from tests.support.pages import ROOT
from tests.support.panel_client import Browser, stranger

RECORDS = ROOT / "tests" / "data" / "records"
QUESTION = Prompt(
    id="step-1@9", kind=PromptKind.CONFIRM, text="Mounted?", default="yes", action={"do": "mount"}
)


@pytest.fixture
def runs(tmp_path):
    (tmp_path / "runs").mkdir()
    shutil.copytree(RECORDS / "interrupted", tmp_path / "runs" / "one")
    return tmp_path / "runs"


@pytest.fixture
def one(runs):
    return runs / "one"


@pytest.fixture
def alive(one):
    """The record of the run, which somebody carries out, and who has asked something."""
    record, history = Record.reopen(one, utc_now)
    record.append("run_resumed", history.events.last_s, step=1, instruments={})
    record.append("asked", history.events.last_s, **asked_to_json(QUESTION))
    yield record
    record.close()


def lines(file):
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def test_the_holder_answers_the_question_that_stands(anna, one, alive):
    answer = {"id": QUESTION.id, "text": "yes"}
    status, told = anna.ask("/runs/one/answer", **answer)
    assert (status, told["problem"]) == (403, "nobody is in control; take control first")
    assert anna.ask("/runs/one/control", do="take")[0] == 200
    assert anna.ask("/runs/one/answer", **answer) == (200, {"done": "answered"})
    who = {"by": "anna", "role": "operator", "where": "panel"}
    assert lines(one / ANSWERS) == [{"id": QUESTION.id, "answer": "yes", **who}]


def test_an_answer_that_is_stale_or_does_not_fit_is_refused_and_not_left(anna, one, alive):
    anna.ask("/runs/one/control", do="take")
    assert anna.ask("/runs/one/answer", id="step-0@3", text="yes")[0] == 409
    status, told = anna.ask("/runs/one/answer", id=QUESTION.id, text="perhaps")
    assert (status, told["problem"]) == (422, "answer yes or no, not 'perhaps'")
    assert anna.ask("/runs/one/answer", id=QUESTION.id, text="y" * 5000)[0] == 413
    assert lines(one / ANSWERS) == []


def test_a_question_that_was_answered_takes_no_second_answer(anna, runs, one, alive):
    anna.ask("/runs/one/control", do="take")
    alive.append("answered", 0.0, id=QUESTION.id, answer="yes", by="x", role="supervisor", where="terminal")
    again = Browser(runs, "sue", Role.SUPERVISOR)  # another panel, as after a restart
    again.ask("/runs/one/control", do="force")
    status, told = again.ask("/runs/one/answer", id=QUESTION.id, text="yes")
    assert status == 409
    assert "was answered" in told["problem"]
    assert lines(one / ANSWERS) == []


def test_a_panel_begun_anew_knows_who_is_signed_in_who_is_in_control_and_what_is_asked(
    anna, runs, one, alive
):
    anna.ask("/runs/one/control", do="take")
    for _ in range(3):
        cookies = dict(anna.client.cookies)
        anna.client = stranger(runs)  # the one before leaves nothing but its files
        anna.client.cookies.update(cookies)
        told = anna.get("/runs/one/state").json()
        assert (told["alive"], told["control"]["holder"], told["prompt"]["id"]) == (True, "anna", QUESTION.id)
    assert anna.ask("/runs/one/answer", id=QUESTION.id, text="")[0] == 200
    alive.append("answered", 0.0, id=QUESTION.id, answer="yes", by="anna", role="operator", where="panel")
    anna.client = stranger(runs)
    anna.client.cookies.update(cookies)
    assert anna.ask("/runs/one/answer", id=QUESTION.id, text="yes")[0] == 409
    assert [line["answer"] for line in lines(one / ANSWERS)] == [""]


def test_stop_is_everybodys_and_all_else_the_holders(runs, one, alive):
    eve = Browser(runs, "eve", Role.VIEWER)
    for word in ("pause", "redo", "skip", "abort"):
        assert eve.ask("/runs/one/wish", wish=word, reason="x")[0] == 403
    ben = Browser(runs, "ben")
    assert ben.ask("/runs/one/wish", wish="pause")[0] == 403
    assert lines(one / CONTROL) == []
    ben.ask("/runs/one/control", do="take")
    assert ben.ask("/runs/one/wish", wish="skip")[0] == 400
    assert ben.ask("/runs/one/wish", wish="skip", reason="the cable\ncame loose") == (
        200,
        {"done": "skip was sent"},
    )
    who = {"by": "ben", "role": "operator", "where": "panel"}
    assert lines(one / CONTROL)[-1] == {"wish": "skip", "reason": "the cable came loose", **who}
    assert eve.ask("/runs/one/wish", wish="fly", reason="x")[0] == 403
    assert eve.ask("/runs/one/control", do="take")[0] == 403


def test_a_wish_that_the_run_refused_is_told_until_the_next_answer(anna, alive):
    who = {"by": "anna", "role": "operator", "where": "panel"}
    alive.append("wish_refused", 0.0, wish="redo", why="no point was measured", **who)
    told = anna.get("/runs/one/state").json()["unmet"]
    assert told == "redo in the panel by anna is not possible: no point was measured"
    alive.append("answered", 0.0, id=QUESTION.id, answer="yes", **who)
    later = (anna.get("/runs/one/state").json()["unmet"] for _ in range(200))
    assert "" in later


def test_nobody_hears_a_wish_for_a_run_that_nobody_carries_out(anna, one):
    anna.ask("/runs/one/control", do="take")
    status, told = anna.ask("/runs/one/wish", wish="pause")
    assert (status, told["problem"]) == (409, "no program is carrying out this run; load the page again")
    assert not (one / CONTROL).exists()


def test_a_run_is_given_up_for_good_by_who_is_in_control(anna, runs, one):
    ben = Browser(runs, "ben")
    ben.ask("/runs/one/control", do="take")
    assert anna.ask("/runs/one/give-up")[0] == 403
    assert anna.ask("/runs/one/wish", wish="abort")[0] == 403
    assert Run(one).history.state == "interrupted"
    assert ben.ask("/runs/one/wish", wish="abort")[0] == 200
    history = Run(one).history
    assert (history.state, history.problems) == ("aborted", ())
    assert history.events.last.data == {"by": "ben", "role": "operator", "where": "panel"}
    assert ben.ask("/runs/one/give-up")[0] == 409


def test_resuming_takes_control_where_nobody_has_it(anna, runs, one, monkeypatch):
    started = []
    monkeypatch.setattr(
        "bench.panel.pages.run.resume_run", lambda run, by: started.append((run.name, by.name))
    )
    ben = Browser(runs, "ben")
    assert anna.post("/runs/one/resume").headers["location"] == "/runs/one/"
    assert read_holding(one).holder == "anna"
    assert ben.ask("/runs/one/resume")[0] == 403
    assert Browser(runs, "eve", Role.VIEWER).ask("/runs/one/resume")[0] == 403
    assert started == [("one", "anna")]


def test_a_file_that_cannot_be_written_is_refused_with_its_remedy(anna, one, alive, monkeypatch):
    anna.ask("/runs/one/control", do="take")
    for number, remedy in (
        (errno.ENOSPC, "free disk space"),
        (errno.EROFS, "make it writable"),
    ):

        def fails(*_, number=number):
            raise OSError(number, "why")

        monkeypatch.setattr("bench.panel.pages.run.leave_answer", fails)
        status, told = anna.ask("/runs/one/answer", id=QUESTION.id, text="yes")
        assert (status, told["problem"]) == (409, f"the run's folder cannot be written (why); {remedy}")


def test_taking_over_asks_and_is_answered(anna, runs, one):
    ben = Browser(runs, "ben")
    assert anna.ask("/runs/one/control", do="take")[1]["control"]["holder"] == "anna"
    assert ben.ask("/runs/one/control", do="ask")[1]["control"]["asking"] == ["ben"]
    assert ben.ask("/runs/one/control", do="force")[0] == 403
    assert anna.ask("/runs/one/control", do="grant", to="ben")[1]["control"]["holder"] == "ben"
    assert [line["did"] for line in lines(one / JOURNAL)] == ["taken", "asked", "granted"]


def test_a_stream_ends_when_who_looks_is_signed_out_for_good(anna, runs, monkeypatch):
    from bench.panel.access import STATE, Access

    async def events():
        yield b"event: state\ndata: {}\n\n"
        Access(runs / STATE).revoke("anna")
        yield b"event: state\ndata: secret\n\n"

    followers = type(anna.client.app.state.panel.followers)
    monkeypatch.setattr(followers, "stream", lambda self, folder: events())
    assert anna.get("/runs/one/stream").text == "event: state\ndata: {}\n\n"


ANNA = Person("anna", Role.OPERATOR)
BEN = Person("ben", Role.OPERATOR)
EVE = Person("eve", Role.VIEWER)
SUE = Person("sue", Role.SUPERVISOR)


def refusal(folder, *what):
    with pytest.raises(Refusal) as refused:
        change(folder, *what)
    return refused.value.status, refused.value.text


def test_taking_over_asks_who_holds(tmp_path):
    change(tmp_path, "take", ANNA)
    assert refusal(tmp_path, "take", BEN) == (409, "anna is in control; ask for control")
    change(tmp_path, "ask", BEN)
    assert read_holding(tmp_path).asking == ("ben",)
    status, text = refusal(tmp_path, "grant", BEN)
    assert (status, text.endswith("(anna) may grant, deny or give up control; ask anna for control")) == (
        403,
        True,
    )
    change(tmp_path, "deny", ANNA)
    assert (read_holding(tmp_path).holder, read_holding(tmp_path).denied) == ("anna", ("ben",))
    change(tmp_path, "ask", BEN)
    after = change(tmp_path, "grant", ANNA, "ben")
    assert after == read_holding(tmp_path)
    assert (after.holder, after.how, after.asking, after.denied) == ("ben", "granted", (), ())
    change(tmp_path, "release", BEN)
    change(tmp_path, "take", ANNA)
    assert read_holding(tmp_path).holder == "anna"


def test_force_is_a_supervisors(tmp_path):
    change(tmp_path, "take", ANNA)
    assert refusal(tmp_path, "force", BEN)[0] == 403
    assert change(tmp_path, "force", SUE).holder == "sue"
    lines = [json.loads(line) for line in (tmp_path / JOURNAL).read_text().splitlines()]
    assert [(line["did"], line["who"], line["role"]) for line in lines] == [
        ("taken", "anna", "operator"),
        ("forced", "sue", "supervisor"),
    ]


@pytest.mark.parametrize("word", [*WORDS, "steal", ""])
def test_a_viewer_changes_nothing(tmp_path, word):
    change(tmp_path, "take", ANNA)
    change(tmp_path, "ask", BEN)
    before = (tmp_path / JOURNAL).read_bytes()
    assert refusal(tmp_path, word, EVE)[0] in {400, 403}
    assert (tmp_path / JOURNAL).read_bytes() == before


def test_no_time_runs_out_on_anybody(tmp_path):
    begun = datetime(2026, 1, 1, tzinfo=UTC)
    change(tmp_path, "take", ANNA, now=lambda: begun)
    years = itertools.count(1)
    for _ in range(5):
        with pytest.raises(Refusal):
            change(tmp_path, "take", BEN, now=lambda: begun + timedelta(days=365 * next(years)))
    assert read_holding(tmp_path).holder == "anna"


def test_a_line_that_was_written_in_part_is_none_and_the_next_begins_anew(tmp_path):
    change(tmp_path, "take", ANNA)
    with (tmp_path / JOURNAL).open("ab") as file:
        file.write(b'{"did": "forced", "who": "ev')
    assert read_holding(tmp_path).holder == "anna"
    change(tmp_path, "release", ANNA)
    change(tmp_path, "take", BEN)
    assert read_holding(tmp_path).holder == "ben"
    assert all(json.loads(line) for line in (tmp_path / JOURNAL).read_text().splitlines())


def test_what_is_no_line_of_ours_tells_nothing(tmp_path):
    rubbish = [
        b"\xff\n",
        b"[]\n",
        b'{"did": "eaten", "who": "x", "at": ""}\n',
        b"null\n",
        b"[" * 9999 + b"\n",
    ]
    (tmp_path / JOURNAL).write_bytes(b"".join(rubbish))
    assert read_holding(tmp_path).holder == ""


def test_a_journal_that_is_a_link_is_neither_read_nor_written(tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_text('{"did": "taken", "who": "eve", "role": "operator", "at": ""}\n')
    (tmp_path / JOURNAL).symlink_to(elsewhere)
    before = elsewhere.read_bytes()
    assert read_holding(tmp_path).holder == ""
    with pytest.raises(OSError, match="symbolic"):
        change(tmp_path, "take", ANNA)
    assert elsewhere.read_bytes() == before
