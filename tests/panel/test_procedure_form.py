"""Procedures in a table: comments kept, mistakes at their fields, the check beside it."""

import re
from html import unescape
from pathlib import Path

import pytest

from bench.base.yaml_files import read_yaml
from bench.config.procedure.load import load_procedure
from bench.config.shipped import PROCEDURES
from bench.panel.access import Refusal, Role
from bench.panel.own_files import shipped_files
from bench.panel.pages.procedure import (
    AS_LIST,
    AS_STEPS,
    rows_of,
    sections_of,
    table_text,
    values_in,
    with_copy,
    without_step,
)
from tests.support.panel_client import Browser

SHIPPED = shipped_files(PROCEDURES)
TURN = "steps[2].installation.steps[2].repeat.steps[1].turn"


def table(text):
    data = read_yaml(text).data
    groups = [*sections_of(data), *(row.group for row in rows_of(data))]
    fields = [one for group in groups for one in group.fields]
    return fields, values_in(data, fields)


def edited(text, **typed):
    fields, values = table(text)
    values |= typed
    return table_text(text, values, fields)


def comments(text):
    return sorted(line.strip() for line in text.splitlines() if line.lstrip().startswith("#"))


def shown(page):
    """The fields of the table as a browser sends them, and the names that they have in the form."""
    sent = {
        name: unescape(value)
        for name, value in re.findall(r'<input[^>]* name="([^"]+)"[^>]*? value="([^"]*)"', page)
    }
    sent |= {
        name: unescape((re.search(r'<option value="([^"]*)" selected', body) or re.search("()", ""))[1])
        for name, body in re.findall(r'<select[^>]* name="(f\d+)"[^>]*>(.*?)</select>', page, re.DOTALL)
    }
    sent["typed"] = unescape(re.search(r"<textarea[^>]*>\n(.*?)</textarea>", page, re.DOTALL)[1])
    names = dict(re.findall(r'<(?:input|select)[^>]* id="([^"]+)" name="(f\d+)"', page))
    sent.pop("csrf"), sent.pop("name", None)
    return sent, names


_OPENED = {}


def opened(anna, query):
    """The table as a browser sends it; that of a shipped procedure is read from its page once."""
    if query not in _OPENED or not query.startswith("start="):
        _OPENED[query] = shown(anna.get(f"/procedures/form?{query}").text)
    sent, names = _OPENED[query]
    return sent.copy(), names


def send(anna, sent, **more):
    return anna.post("/procedures/form", **{**sent, "do": "show", **more})


# --- the text ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(SHIPPED))
def test_a_table_in_which_nothing_is_changed_leaves_the_text_as_it_is(name):
    text = SHIPPED[name].read_text("utf-8")
    assert edited(text) == text


def test_angles_passes_and_dwell_are_changed_and_comments_stay():
    before = SHIPPED["calibration"].read_text("utf-8")
    after = edited(
        before,
        **{
            "reading.settle": "20 s",
            "steps[1].wait.for": "5 min",
            "steps[2].installation.steps[2].repeat.directions": "rising, falling",
            f"{TURN}.angles.count": "5",
            f"{TURN}.angles.step": "90 deg",
            "steps[4].installation.steps[2].turn.angles": "45 deg, 225 deg",
        },
    )
    assert comments(after) == comments(before)
    data = read_yaml(after).data
    first = data["steps"][1]["installation"]["steps"]
    assert data["reading"]["settle"] == "20 s"
    assert first[1]["repeat"]["directions"] == ["rising", "falling"]
    assert first[1]["repeat"]["steps"][0]["turn"]["angles"] == {
        "from": "0 deg",
        "step": "90 deg",
        "count": "5",
    }
    plan = load_procedure(Path("x.yaml"), after.encode()).plan
    assert plan.counts()["read"] == 2 * 5 + 27 + 2


def test_angles_become_a_list_and_steps_again():
    text = SHIPPED["calibration"].read_text("utf-8")
    as_list = edited(text, **{f"form:{TURN}.angles": AS_LIST})
    assert "turn: {angles: [0 deg, 45 deg, 90 deg," in as_list
    again = edited(as_list, **{f"form:{TURN}.angles": AS_STEPS})
    assert read_yaml(again).data == read_yaml(text).data


@pytest.mark.parametrize("name", ["calibration", "temperature", "turn-on", "quick"])
def test_every_step_that_has_lines_of_its_own_can_be_copied_and_removed(name):
    text = SHIPPED[name].read_text("utf-8")
    changed = 0
    for row in rows_of(read_yaml(text).data):
        place = row.group.at[:-1]
        try:
            twice = with_copy(text, place)
        except Refusal:
            continue
        changed += 1
        assert len(rows_of(read_yaml(twice).data)) > len(rows_of(read_yaml(text).data))
        assert read_yaml(without_step(twice, place)).data == read_yaml(text).data
    assert changed >= 4


# --- the page ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_procedure_is_picked_changed_checked_and_saved_under_a_new_name(anna):
    page = anna.get("/procedures").text
    assert 'href="/procedures/form?start=calibration"' in page
    assert "4 h 40 min · 58 readings · 3 mountings" in page
    sent, names = opened(anna, "start=calibration&bench=paper-stand")
    sent[names["reading.settle"]] = "1 min"
    page = send(anna, sent).text
    assert "181 steps, 64 operator actions, 58 readings." in page
    assert "turn the head to 45°" in page
    assert "settle: 1 min" in unescape(page)
    reply = send(anna, sent, new_name="mine", do="write")
    assert reply.status_code == 303
    written = Path("procedures/mine.yaml").read_text("utf-8")
    assert written.startswith("# changed in the panel by anna on ")
    assert load_procedure(Path("procedures/mine.yaml")).name == "mine"
    assert set(comments(SHIPPED["calibration"].read_text("utf-8"))) < set(comments(written))
    assert "procedures/mine.yaml is written" in anna.get(reply.headers["location"]).text
    assert "mine" in anna.get("/start").text


@pytest.mark.parametrize(
    ("field", "typed", "told"),
    [
        ("reading.samples", "many", "whole number"),
        ("steps[1].wait.for", "10 volts", "a duration"),
        (f"{TURN}.angles.count", "99", "±360°"),
        ("steps[4].installation.steps[2].turn.angles", "45 deg, x", "an angle"),
        ("steps[2].installation.label", "S", "without orientation"),
        ("steps[2].installation.steps[2].repeat.directions", "up", "rising"),
    ],
)
def test_a_mistake_stands_at_its_field_and_is_not_written(anna, field, typed, told):
    sent, names = opened(anna, "start=calibration")
    sent[names[field]] = typed
    page = send(anna, sent, new_name="mine", do="write").text
    assert "Not written" in page
    place = page.index(f'id="{field}"')
    stated = re.search(r'class="mistake" id="[^"]+">✗ ([^<]+)', page[place - 3000 :])
    assert any(told in unescape(one) for one in re.findall(r'class="mistake" id="[^"]+">✗ ([^<]+)', page)), (
        stated
    )
    assert f'value="{typed}"' in page
    assert not Path("procedures").exists()


def test_what_the_bench_cannot_do_stands_beside_the_table(anna):
    page = anna.get("/procedures/form?start=temperature&bench=bench-lan").text
    assert "the bench file has no chamber" in page


def test_a_text_written_by_hand_is_taken_and_a_double_change_is_asked_about(anna):
    sent, names = opened(anna, "start=quick")
    by_hand = "# seven\n" + sent["typed"].replace("samples: 5", "samples: 7")
    page = send(anna, {**sent, "typed": by_hand}, do="text").text
    assert 'value="7"' in page
    both = {**sent, "typed": by_hand, names["reading.nplc"]: "1"}
    page = send(anna, both, new_name="mine", do="write").text
    assert "Table and text were both changed" in page
    assert "# seven" in page
    assert not Path("procedures").exists()
    assert 'role="alert"' in send(anna, {**sent, "typed": "a: [b"}, do="text").text


@pytest.mark.slow
def test_steps_are_copied_and_removed_by_buttons(anna):
    sent, _ = opened(anna, "start=calibration")
    page = send(anna, sent, do="remove:steps[3].installation").text
    assert page.count("Mount the block</legend>") == 2
    page = send(anna, sent, do=f"copy:{TURN}").text
    assert page.count("Turn</legend>") == 4
    assert send(anna, sent, do="copy:steps[99].x").status_code == 200


@pytest.mark.parametrize("include", ["/etc/passwd", "../x.yaml", "a/b.yaml", ".hidden.yaml"])
def test_no_file_of_another_folder_is_included(anna, include):
    text = f"procedure: x\nsteps:\n  - include: {include}\n"
    sent, _ = opened(anna, "start=quick")
    page = send(anna, {**sent, "typed": text, "new_name": "mine"}, do="text").text
    assert "includes files of the same folder only" in page
    assert send(anna, {**sent, "text": text, "typed": text}, new_name="mine", do="write").status_code == 200
    assert not Path("procedures").exists()


@pytest.mark.parametrize(
    "text", ["", "5", "[1]", "steps: 3", "steps: [[1], x, {}]", "[" * 3000, "\ta: b", "a: *b"]
)
def test_no_text_breaks_the_table(anna, text):
    sent, _ = opened(anna, "start=quick")
    reply = send(anna, {**sent, "typed": text}, do="text")
    assert reply.status_code == 200
    assert send(anna, {**sent, "text": text, "typed": text}, new_name="mine", do="write").status_code in {
        200,
        409,
    }
    assert not Path("procedures").exists()


@pytest.mark.slow
def test_nobody_writes_over_the_change_of_another(anna, runs):
    sent, _ = opened(anna, "start=quick")
    send(anna, sent, new_name="mine", do="write")
    bert = Browser(runs, "bert")
    (first, names), (second, _) = (opened(one, "file=mine") for one in (anna, bert))
    assert send(anna, {**first, names["reading.nplc"]: "1"}, do="write").status_code == 303
    page = send(bert, {**second, names["reading.nplc"]: "2"}, do="write").text
    assert "Not written: the file was changed" in page
    assert "nplc: 1" in Path("procedures/mine.yaml").read_text()


@pytest.mark.slow
def test_only_operators_and_only_files_of_the_list(anna, runs):
    assert Browser(runs, "eve", Role.VIEWER).get("/procedures").status_code == 403
    for query in ("start=../x", "file=calibration", "file=", "start=none"):
        assert anna.get(f"/procedures/form?{query}").status_code == 404
    sent, _ = opened(anna, "start=quick")
    for name in ("../x", "quick", "", "a b"):
        assert "Not written" not in (page := send(anna, sent, new_name=name, do="write").text)
        assert 'id="m-new_name-1"' in page
    assert not Path("procedures").exists()
