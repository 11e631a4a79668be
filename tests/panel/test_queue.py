"""The queue of the day: order, two people at once, damage; nothing begins but by a person, and nothing twice."""

import datetime
import json
import re
import shutil
from pathlib import Path

import pytest

from bench.panel.access import STATE, Access, Refusal, Role
from bench.panel.launching import TrialResult, start_run
from bench.panel.pages.queue import bench_today, next_unit
from bench.panel.queue import ITEMS, MOST_ITEMS, DayQueue, new_item
from bench.run.events import RecordError
from drivers.clock import utc_now
from tests.support.panel_client import Browser

RECORDS = Path(__file__).parent.parent / "data" / "records"
VALUES = "{range: 10 V, gain: {correction: -12 ppm, U: 6 ppm, k: 2, drift: 8 ppm/year}}"
UNITS = {"procedure": "quick", "bench": "paper-stand", "do": "add"}


@pytest.fixture
def checks(monkeypatch):
    """The checks that were started instead of processes."""
    calls = []
    monkeypatch.setattr("bench.panel.pages.start.start", lambda *given, **more: calls.append(given))
    return calls


def queue_of(browser):
    return browser.client.app.state.panel.queue


def added(anna, *units, **sent):
    assert anna.post("/queue", **{**UNITS, **sent}, units="\n".join(units)).status_code == 303
    return queue_of(anna).items()


def act(anna, item, do):
    return anna.post(f"/queue/{item.id}", do=do)


def units(browser):
    return [one.unit for one in queue_of(browser).items()]


def found_possible(anna, reply):
    """Say that a check found no obstacle; return the check."""
    wish = anna.client.app.state.panel.wishes.of(reply.headers["location"].rpartition("/")[2])
    assert 'href="/queue">Back to the queue' in anna.get(reply.headers["location"]).text
    wish.tell(TrialResult("done", check={"problems": [], "dry_run_refuses": []}, tried=0))
    return wish


def test_the_queue_begins_with_the_bench_of_the_working_folder(runs, anna):
    Path("mine.yaml").write_text("name: mine\ninstruments:\n")
    assert "<option selected>mine.yaml</option>" in anna.get("/queue").text
    added(anna, "17-042")
    assert "<option selected>paper-stand</option>" in anna.get("/queue").text  # as the unit before


def test_units_stand_in_order_are_moved_and_removed_and_survive_a_restart(runs, anna):
    items = added(anna, "17-042", "", " 17-043 ", "17-044")
    assert units(anna) == ["17-042", "17-043", "17-044"]
    for item, do, order in [
        (items[2], "up", ["17-042", "17-044", "17-043"]),
        (items[0], "up", ["17-042", "17-044", "17-043"]),
        (items[1], "down", ["17-042", "17-044", "17-043"]),
        (items[0], "down", ["17-044", "17-042", "17-043"]),
        (items[1], "remove", ["17-044", "17-042"]),
    ]:
        assert act(anna, item, do).status_code == 303
        assert units(anna) == order
    bert = Browser(runs, "bert")  # another panel over the same folder, as after a restart
    assert units(bert) == ["17-044", "17-042"]
    assert (queue_of(bert).item(items[0].id).added_by, act(bert, items[1], "up").status_code) == ("anna", 409)


def test_two_people_who_add_at_once_lose_nothing(runs):
    queues = [DayQueue(runs) for _ in range(2)]
    for number in range(6):
        queues[number % 2].add([new_item(str(number), "quick", "paper-stand", "a", dry_run=False)])
    assert [one.unit for one in queues[0].items()] == list("012345")
    with pytest.raises(Refusal, match="at most"):
        queues[0].add([new_item("", "quick", "b", "a", dry_run=False)] * MOST_ITEMS)
    assert len(queues[1].items()) == 6


@pytest.mark.parametrize(
    "sent",
    [{"procedure": "../x"}, {"bench": ""}, {"units": "a\x1b[2J"}, {"units": "x" * 101}, {"do": "else"}],
)
def test_what_cannot_be_queued_is_refused(anna, sent):
    assert anna.post("/queue", **{**UNITS, "units": "1", **sent}).status_code == 400
    assert units(anna) == []


def test_a_viewer_sees_the_queue_and_changes_nothing(runs):
    (item,) = added(Browser(runs, "anna"), "17-042")
    eve = Browser(runs, "eve", Role.VIEWER)
    page = eve.get("/queue").text
    assert "17-042" in page
    assert 'name="do"' not in page.partition("<main")[2]
    assert (eve.post("/queue", do="duty").status_code, act(eve, item, "begin").status_code) == (403, 403)


def test_a_person_begins_each_unit_and_nobody_begins_it_twice(runs, checks, monkeypatch):
    anna, bert = Browser(runs, "anna"), Browser(runs, "bert")
    (item, later) = added(anna, "17-042", "17-043")
    wish = found_possible(anna, act(anna, item, "begin"))
    assert wish.wanted().request.unit == "17-042"
    assert act(bert, item, "begin").headers["location"] == f"/start/{wish.id}"  # the check is shared
    assert len(checks) == 1
    begun = []

    def start(wish, name, folder):
        begun.append(name)
        shutil.copytree(RECORDS / "interrupted", folder.path / name)
        return start_run.__globals__["Run"](folder.path / name)

    monkeypatch.setattr("bench.panel.pages.start.start_run", start)
    replies = [one.post(f"/start/{wish.id}/go") for one in (anna, bert)]
    assert [reply.status_code for reply in replies] == [303, 409]
    assert len(begun) == 1
    assert queue_of(bert).item(item.id).run == begun[0]
    assert act(bert, item, "begin").status_code == 409
    assert next_unit(bert.client.app.state.panel).id == later.id
    # it is interrupted: the page says so and offers to resume, and nothing has started since
    page = bert.get("/queue").text
    assert f'href="/runs/{begun[0]}/">Resume or end it' in page
    assert (len(checks), len(begun)) == (1, 1)
    assert act(anna, item, "put back").status_code == 303
    assert queue_of(anna).item(item.id).run == ""


def test_a_start_that_fails_leaves_the_unit_to_be_begun(anna, checks, monkeypatch):
    (item,) = added(anna, "17-042")
    wish = found_possible(anna, act(anna, item, "begin"))

    def start(*given):
        raise Refusal(409, "it did not begin")

    monkeypatch.setattr("bench.panel.pages.start.start_run", start)
    assert anna.post(f"/start/{wish.id}/go").status_code == 409
    assert queue_of(anna).item(item.id).run == ""
    assert act(anna, item, "begin").headers["location"] == f"/start/{wish.id}"


def test_a_finished_unit_is_done_and_the_verdict_offers_the_next(runs, anna, dry_run_of_paper):
    shutil.copytree(dry_run_of_paper, runs / "one")
    (item, later) = added(anna, "17-042", "17-043")
    queue_of(anna).change(item.id, run="one")
    assert act(anna, item, "put back").status_code == 409
    card = anna.get("/runs/one/outcome").text
    assert f'action="/queue/{later.id}"' in card
    assert "Next unit: 17-043: quick on paper-stand" in card
    assert "1 of 2 done" in anna.get("/queue").text
    anna.post("/queue", do="remove done")
    assert units(anna) == ["17-043"]


@pytest.mark.parametrize(
    "text", ["{", "[1]", '[{"id": "x"}]', '[{"unit": 7}]', '{"a": 1}', '["\\ud800"]', "\x00\xff"]
)
def test_a_damaged_file_says_what_to_do_and_is_put_aside_not_lost(runs, anna, text):
    added(anna, "17-042")
    file = runs / STATE / ITEMS
    file.write_bytes(text.encode("latin-1"))
    page = anna.get("/queue")
    assert page.status_code == 200
    assert "put the file aside" in page.text
    assert anna.post("/queue", **UNITS, units="2").status_code == 409
    assert anna.get("/").status_code == 200
    anna.post("/queue", do="put aside")
    assert units(anna) == []
    (aside,) = (runs / STATE).glob(f"{ITEMS}.damaged-*")
    assert aside.read_bytes() == text.encode("latin-1")
    added(anna, "17-043")
    anna.post("/queue", do="put aside")  # nothing is damaged now
    assert units(anna) == ["17-043"]


def test_who_is_on_duty_and_since_when_a_bench_is_on(runs):
    anna, bert = Browser(runs, "anna"), Browser(runs, "bert")
    added(anna, "17-041", dry_run="yes")
    assert "Switched on now" not in anna.get("/queue").text  # practice needs no bench
    added(anna, "17-042")
    assert "On duty: nobody" in anna.get("/queue").text
    anna.post("/queue", do="duty")
    anna.post("/queue", do="on", bench="paper-stand")
    assert re.search(r'On duty: <b class="name">anna</b> since \d', bert.get("/queue").text)
    assert "on for 0 s; warm in 1 h" in bert.get("/queue").text
    bert.post("/queue", do="duty")
    assert queue_of(anna).on_duty().who == "bert"
    anna.post("/queue", do="off duty")
    assert queue_of(bert).on_duty() is None
    assert anna.post("/queue", do="on", bench="none").status_code == 400


def test_expired_and_due_certificates_are_in_view(runs, tmp_path):
    from bench.config.shipped import find_bench

    text = find_bench("bench-lan").read_text("utf-8")
    text = text.replace('SOCKET", range: 10 V}', 'SOCKET", range: 10 V, CERTIFICATE}')
    today = utc_now().date()
    old, soon = today - datetime.timedelta(2), today + datetime.timedelta(9)

    for number, until in (("A1", old), ("B2", soon), ("C3", "2999-12-31")):
        stated = (
            f"number: {number}, laboratory: Acme, date: 2020-01-01, valid_until: {until}, values: [{VALUES}]"
        )
        text = text.replace("CERTIFICATE", f"certificate: {{{stated}}}", 1)
    Path("config").mkdir()
    Path("config/mine.yaml").write_text(text)
    told = bench_today("mine", [], None)
    assert [one[0] for one in told.certificates] == ["✗", "!"]
    assert f"A1 expired on {old}" in told.certificates[0]
    assert "9 more days" in told.certificates[1]
    Path("config/mine.yaml").write_text("name: [")
    assert "✗" in bench_today("mine", [], None).notes[0]
    assert "no longer exists" in bench_today("gone", [], None).notes[0]


def test_a_stranger_is_sent_to_sign_in(runs, anna):
    Access(runs / STATE).revoke("anna")
    assert anna.get("/queue").headers["location"].startswith("/sign-in")


def test_rows_of_an_unknown_form_are_no_items(runs):
    (runs / ITEMS).write_text(json.dumps([{"id": "0" * 12, "more": 1}]))
    with pytest.raises(RecordError, match=rf"{ITEMS}, row 1: .*missing: unit, .*more.*put the file aside"):
        DayQueue(runs).items()
