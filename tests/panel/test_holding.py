"""Who is in control of a run: one person or nobody, by their word alone, known again from the journal."""

import itertools
import json
from datetime import UTC, datetime, timedelta

import pytest

from bench.panel.access import Person, Refusal, Role
from bench.panel.holding import JOURNAL, WORDS, change, read_holding, require_holder

ANNA = Person("anna", Role.OPERATOR)
BEN = Person("ben", Role.OPERATOR)
EVE = Person("eve", Role.VIEWER)
SUE = Person("sue", Role.SUPERVISOR)


def refusal(folder, *what):
    with pytest.raises(Refusal) as refused:
        change(folder, *what)
    return refused.value.status, refused.value.text


def test_nobody_is_in_control_until_somebody_takes_it(tmp_path):
    assert read_holding(tmp_path).holder == ""
    with pytest.raises(Refusal, match="nobody is in control; take it first"):
        require_holder(tmp_path, ANNA)
    change(tmp_path, "take", ANNA)
    require_holder(tmp_path, ANNA)
    with pytest.raises(Refusal, match="anna is in control; ask for it first"):
        require_holder(tmp_path, BEN)


def test_taking_over_asks_who_holds(tmp_path):
    change(tmp_path, "take", ANNA)
    assert refusal(tmp_path, "take", BEN) == (409, "anna is in control; ask for it")
    change(tmp_path, "ask", BEN)
    assert read_holding(tmp_path).asking == ("ben",)
    assert refusal(tmp_path, "grant", BEN)[0] == 403
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
