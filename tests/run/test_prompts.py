"""Prompts answered by a person: asked until the answer fits, a stale one ignored."""

import io
from dataclasses import replace

import pytest
from rich.console import Console

from bench.base.languages import speaking
from bench.config.procedure.plan import Mount
from bench.run.events import Wish
from bench.run.instruments import same_serials
from bench.run.person import (
    ControlFile,
    OperatorWish,
    RunControl,
    agree,
    ask,
    confirm,
    leave_wish,
    mount_prompt,
    untouched_prompt,
)
from bench.run.terminal import TerminalPerson, heard_at, typing_help
from drivers.interfaces import BenchError, Identity, NoAnswer
from drivers.person import ATTEMPTS, Answer, Prompt, PromptKind


class Script:
    """Answers in order; keeps the prompts it saw."""

    def __init__(self, *texts, stale=0):
        self.texts = list(texts)
        self.stale = stale
        self.seen = []

    def ask(self, prompt):
        self.seen.append(prompt)
        if self.stale:
            self.stale -= 1
            return Answer("0000/other#1", self.texts.pop(0))
        return Answer(prompt.id, self.texts.pop(0))


NUMBER = Prompt("0007/ask", PromptKind.NUMBER, "Supply voltage", unit="V", minimum=10, maximum=30)


def test_a_number_is_asked_until_it_fits():
    person = Script("many", "9", "31", "15,5")
    assert ask(person, NUMBER) == "15,5"
    assert [p.id for p in person.seen] == [f"0007/ask#{n}" for n in (1, 2, 3, 4)]
    assert person.seen[1].text.startswith("Type a number in V, not 'many'. Supply")
    assert "ype a number of 10 or more, not 9 V" in person.seen[2].text
    assert "ype a number of at most 30, not 31 V" in person.seen[3].text


def test_a_stale_answer_is_ignored():
    assert ask(Script("12", "13", stale=1), NUMBER) == "13"


def test_empty_means_the_default():
    assert ask(Script(""), Prompt("1", PromptKind.CONFIRM, "Mounted", default="yes")) == "yes"
    assert ask(Script("", "b"), Prompt("1", PromptKind.CHOOSE, "Which", choices=("a", "b"))) == "b"


def test_it_ends_after_many_answers_that_do_not_fit():
    with pytest.raises(BenchError, match="no valid answer"):
        ask(Script(*["x"] * ATTEMPTS), NUMBER)


def test_no_waits_until_a_task_is_done():
    person = Script("no", "n", "NO", "yes")
    confirm(person, Prompt("1", PromptKind.CONFIRM, "Mount the block"))
    assert len({p.id for p in person.seen}) == 4
    assert person.seen[-1].text == "There is no hurry: answer yes when it is done. Mount the block"


def test_no_to_a_question_stops():
    with pytest.raises(BenchError, match="answered no to: Go on"):
        agree(Script("no"), Prompt("1", PromptKind.CONFIRM, "Go on"))


@pytest.mark.parametrize("chamber", [True, False])
def test_a_mounting_is_confirmed_in_words_and_speaks_of_a_chamber_only_where_there_is_one(chamber):
    prompt = mount_prompt(Mount("m", "1", 1), chamber=chamber)
    assert ("chamber" in prompt.text) is chamber
    with pytest.raises(BenchError, match="no valid answer"):
        confirm(Script(*[""] * ATTEMPTS), prompt)


def test_the_answers_in_brackets_are_in_the_language_of_the_question():
    prompt = untouched_prompt(Mount("m", "1", 1))
    shown = io.StringIO()
    with speaking("uk"):
        TerminalPerson(io.StringIO("не чіпали\n"), Console(file=shown, width=200)).ask(prompt)
    assert "[не чіпали, закріплено знову; ? = довідка]" in shown.getvalue()


def test_help_names_the_answers_and_the_wishes_of_the_prompt():
    shown = io.StringIO()
    person = TerminalPerson(io.StringIO("?\n?\n12\n"), Console(file=shown, width=100))
    assert person.ask(NUMBER).text == "12"
    said = shown.getvalue()
    assert "a number in V, 10 at least, 30 at most" in said
    assert ":skip REASON: leave this point out" in said
    assert ":continue" not in said
    assert said.count("? = help") == 3
    paused = Prompt("p", PromptKind.CONFIRM, "Paused", default="yes", action={"do": "wait"})
    assert Wish.CONTINUE in heard_at(paused)
    assert Wish.PAUSE not in heard_at(paused)


def test_where_no_wish_is_heard_it_is_said():
    shown = io.StringIO()
    person = TerminalPerson(io.StringIO(":pause\nyes\n"), Console(file=shown), wishes=())
    assert person.ask(Prompt("1", PromptKind.CONFIRM, "Go on")).text == "yes"
    assert "this question accepts no command" in shown.getvalue()


@pytest.mark.parametrize("width", [30, 41, 57, 80])
def test_no_word_is_broken_at_the_end_of_a_line(width):
    shown = io.StringIO()
    console = Console(file=shown, width=width, soft_wrap=True, force_terminal=True, color_system=None)
    prompt = mount_prompt(Mount("m", "1", 2), chamber=True)
    with pytest.raises(NoAnswer):
        TerminalPerson(io.StringIO("?\n"), console).ask(replace(prompt, picture=""))
    lines = shown.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    words = f"» {prompt.text} {typing_help(prompt, heard_at(prompt))}".split()
    assert set(words) <= set(shown.getvalue().split())


def test_instruments_with_one_serial_number_are_told():
    def meter(serial):
        return Identity("K", "34461A", serial)

    told = same_serials({"x": meter("MY1"), "y": meter("MY1"), "z": meter("MY1"), "head": meter("")})
    assert told == [
        "x, y and z state one serial number, MY1 (34461A): if they are one instrument, correct the "
        "addresses in the bench file"
    ]
    assert same_serials({"x": meter("0"), "y": meter("0"), "z": meter("MY1")}) == []  # a 34401A states 0


def test_the_terminal_says_when_the_answers_end():
    shown = io.StringIO()
    person = TerminalPerson(io.StringIO("yes\n"), Console(file=shown))
    prompt = Prompt("1#1", PromptKind.CONFIRM, "Mount the [block]", default="yes")
    assert person.ask(prompt) == Answer("1#1", "yes")
    with pytest.raises(NoAnswer, match=r"the input ended before an answer to: Mount the \[block\]"):
        person.ask(prompt)
    assert "Mount the [block]" in shown.getvalue()
    assert "Enter = yes" in shown.getvalue()


def test_a_wish_typed_at_a_prompt_is_heard_and_a_misspelt_one_explained():
    shown = io.StringIO()
    person = TerminalPerson(io.StringIO(":rdo\n:skip\n:skip the cable came loose\n"), Console(file=shown))
    with pytest.raises(OperatorWish) as heard:
        person.ask(Prompt("1#1", PromptKind.ANGLE, "Turn"))
    assert heard.value.control == RunControl(Wish.SKIP, "the cable came loose", by_person=True)
    assert "there is no command :rdo; type one of :pause, :continue, :redo" in shown.getvalue()
    assert "a skip needs a reason" in shown.getvalue()


def test_wishes_left_in_the_folder_are_heard_once_and_in_order(tmp_path):
    leave_wish(tmp_path, RunControl(Wish.ABORT))
    controls = ControlFile(tmp_path)
    assert controls.poll() is None  # what was there before was for another program
    leave_wish(tmp_path, RunControl(Wish.PAUSE))
    with (tmp_path / "control.jsonl").open("a") as file:
        file.write("nonsense\n")
    leave_wish(tmp_path, RunControl(Wish.SKIP, "wrong angle"))
    with (tmp_path / "control.jsonl").open("a") as file:
        file.write('{"wish": "redo"')
    heard = [controls.poll() for _ in range(4)]
    assert heard == [RunControl(Wish.PAUSE), RunControl(Wish.SKIP, "wrong angle"), None, None]


def test_the_help_on_a_number_is_wholly_ukrainian():
    prompt = Prompt("t", PromptKind.NUMBER, "T?", unit="°C", minimum=-80.0, maximum=120.5)
    with speaking("uk"):
        assert typing_help(prompt, ()).splitlines()[1] == "  число в °C, щонайменше -80, щонайбільше 120,5"
    assert typing_help(prompt, ()).splitlines()[1] == "  a number in °C, -80 at least, 120.5 at most"
