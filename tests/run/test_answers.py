"""Answers left in a run's folder, the question that stands, and what is wrong with an answer."""

import json
import math
import re

import pytest

from bench.run.events import Event, EventType
from bench.run.person import (
    ANSWERS,
    AnswersFile,
    LeftAnswer,
    WishAuthor,
    asked_to_json,
    leave_answer,
    problem_with_answer,
    understood_answer,
)
from bench.run.resume import halt_prompt
from drivers.angles import parse_angle
from drivers.instruments.manual import ManualHead
from drivers.person import Prompt, PromptKind
from tests.support.open_prompts import open_prompt

ANN = WishAuthor("Ann", "operator", "panel")
ARCSEC = math.pi / 648000.0


# --- left in the folder -----------------------------------------------------------------------------


def test_answers_come_in_their_order_with_who_and_a_half_written_one_waits(tmp_path):
    answers = AnswersFile(tmp_path)
    assert answers.poll() is None
    leave_answer(tmp_path, LeftAnswer("1#1@7", "45°00′10″\u202e", ANN))
    with (tmp_path / ANSWERS).open("a") as file:
        file.write('{"id": "2", ')
    assert answers.poll() == LeftAnswer("1#1@7", "45°00′10″\u202e", ANN, 1)
    assert answers.poll() is None
    with (tmp_path / ANSWERS).open("a") as file:
        file.write('"answer": "yes"}\n')
    assert answers.poll() == LeftAnswer("2", "yes", WishAuthor(), 2)


@pytest.mark.parametrize(
    "line",
    [b"hello", b"[1]", b"null", b'{"id": 3, "answer": "x"}', b'{"id": "3"}', b"\xff\x00", b"[" * 99_999,
     json.dumps({"id": "3", "answer": "x" * 5000}).encode(), b"{" + b"x" * 100_000],
)  # fmt: skip
def test_a_line_that_is_no_answer_is_told_as_one_and_the_next_is_heard(tmp_path, line):
    (tmp_path / ANSWERS).write_bytes(line + b"\n")
    leave_answer(tmp_path, LeftAnswer("4", "yes"))
    answers = AnswersFile(tmp_path)
    flawed = answers.poll()
    assert flawed.id == ""
    assert flawed.flaw == "line 1 of answers.jsonl is not an answer"
    assert len(flawed.answer) <= 400
    assert answers.poll() == LeftAnswer("4", "yes", line=2)


# --- the question that stands -----------------------------------------------------------------------


def events(*told):
    return [Event(n, "t", 0.0, kind, data) for n, (kind, data) in enumerate(told, 1)]


def head_prompt(target="45 00 00", tolerance="0 00 30", enter=True):
    """Return the prompt of a manual head."""
    seen = []

    class Nobody:
        def ask(self, prompt):
            seen.append(prompt)
            raise EOFError

    head = ManualHead("head", Nobody(), tolerance_rad=parse_angle(tolerance), enter_accepts_target=enter)
    with pytest.raises(EOFError):
        head.move(parse_angle(target), 1, "t1")
    return seen[0]


def test_a_question_stands_until_it_is_answered_or_left():
    prompt = head_prompt()
    asked = (EventType.ASKED, json.loads(json.dumps(asked_to_json(prompt))))
    refused = (EventType.ANSWER_REFUSED, {"id": prompt.id, "answer": "x", "why": "no angle"})
    stands = open_prompt(events(asked, refused))
    assert stands.prompt == prompt
    assert stands.event.number == 1
    for after in (
        (EventType.ANSWERED, {"id": prompt.id, "answer": "45 0 0"}),
        (EventType.REDO, {"first": 1, "last": 1}),
        (EventType.RUN_PAUSED, {"reason": ""}),
        (EventType.RUN_FAILED, {"error": "x"}),
    ):
        assert open_prompt(events(asked, refused, after)) is None
    assert open_prompt(events((EventType.ASKED, asked[1] | {"kind": "essay"}))) is None


# --- what is wrong with an answer -------------------------------------------------------------------


@pytest.mark.parametrize("limit", [1.2345678, -123456.75, 10.0])
def test_a_limit_is_told_with_all_its_digits(limit):
    prompt = Prompt("n", PromptKind.NUMBER, "How much?", None, minimum=limit, maximum=limit)
    for typed, words in ((limit - 1.0, "or more"), (limit + 1.0, "at most")):
        problem = problem_with_answer(prompt, repr(typed))
        assert words in problem
        (told,) = re.findall(r"number of (?:at most )?(\S+?)(?:,| or)", problem)
        assert problem_with_answer(prompt, told) == ""


@pytest.mark.parametrize(
    ("typed", "problem", "understood"),
    [
        ("45 00 10", "", "45° 00′ 10.0″"),
        ("45°00'10.25\"", "", "45° 00′ 10.2″"),
        ("", "", "45° 00′ 00.0″"),
        ("45 61 00", "minutes or seconds of 60 or more", ""),
        ("45 01 00", "45°01′00″ is 0°01′00″ above the target: probably the minute line is one off (1′)", ""),
        ("-45", "probably 360° - x was read instead of x", ""),
        ("44 59 25", "0°00′35″ below the target, outside the 0°00′30″ allowed", ""),
        ("half", "'half' is not an angle: type degrees, minutes, seconds", ""),
    ],
)
def test_a_typed_angle_is_judged_as_the_head_judges_it(typed, problem, understood):
    prompt = head_prompt()
    assert problem in problem_with_answer(prompt, typed)
    assert bool(problem) is bool(problem_with_answer(prompt, typed))
    assert understood_answer(prompt, typed) == understood


def test_where_enter_accepts_nothing_nothing_is_no_answer():
    assert problem_with_answer(head_prompt(enter=False), " ").startswith("Nothing was typed")


@pytest.mark.parametrize(
    ("prompt", "fits", "not_so"),
    [
        (Prompt("1", PromptKind.CONFIRM, "Done"), ["yes", "OK", "no"], ["", "maybe", ":redo"]),
        (Prompt("1", PromptKind.CHOOSE, "Which", choices=("a b", "c")), ["a b", "c"], ["A b", "", "d"]),
        (Prompt("1", PromptKind.NUMBER, "V", unit="V", minimum=10), ["15,5 V", "10"], ["9", "1_5", "nan"]),
        (
            Prompt("1", PromptKind.NUMBER, "T", unit="°C", minimum=-20, maximum=70,
                   action={"do": "read_temperature"}),
            ["23.5", "23,5 °C", "−5 c"], ["2e1", "71", "warm"],
        ),
        (
            Prompt("1", PromptKind.NUMBER, "Bubble", unit="divisions",
                   action={"do": "read_level", "axis": "along", "turned": False, "division_rad": 4 * ARCSEC,
                           "most_divisions": 10.0}),
            ["-1.5", "+2 divisions", "8 arcsec", "40 ″"], ["11", "41 arcsec", "left"],
        ),
        (
            Prompt("1", PromptKind.NUMBER, "Read", unit="V",
                   action={"do": "read_supply", "output": "1", "what": "voltage"}),
            ["15", "15.0 V"], ["on", ""],
        ),
    ],
)  # fmt: skip
def test_answers_of_each_kind(prompt, fits, not_so):
    assert [problem_with_answer(prompt, text) for text in fits] == [""] * len(fits)
    assert all(problem_with_answer(prompt, text) for text in not_so)
    assert all(understood_answer(prompt, text) for text in fits)
    assert not any(understood_answer(prompt, text) for text in not_so)


def test_a_halt_wants_a_reason_in_words_of_one_s_own():
    prompt = halt_prompt(Event(9, "t", 0.0, "early_sign", {"step": 3, "sentence": "x is off"}))
    for text in ("redo point", "Redo  Pass", "go on the lamp was on", "GO ON because"):
        assert problem_with_answer(prompt, text) == ""
    for text in ("go on", "go on REASON", "", "go", "yes"):
        assert problem_with_answer(prompt, text)
