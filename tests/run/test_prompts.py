"""Prompts answered by a person: asked until the answer fits, a stale one ignored."""

import io

import pytest
from rich.console import Console

from bench.run.control import ControlFile, OperatorWish, RunControl, leave_wish
from bench.run.prompts import ask, confirm
from bench.run.states import Wish
from bench.run.terminal import TerminalPerson
from drivers.interfaces import Answer, BenchError, NoAnswer, Prompt, PromptKind


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
    assert person.seen[1].text.startswith("A number in V is wanted, not 'many'. Supply")
    assert "below the least, 10 V" in person.seen[2].text
    assert "above the most, 30 V" in person.seen[3].text


def test_a_stale_answer_is_ignored():
    assert ask(Script("12", "13", stale=1), NUMBER) == "13"


def test_empty_means_the_default():
    assert ask(Script(""), Prompt("1", PromptKind.CONFIRM, "Mounted", default="yes")) == "yes"
    assert ask(Script("", "b"), Prompt("1", PromptKind.CHOOSE, "Which", choices=("a", "b"))) == "b"


def test_it_ends_after_many_answers_that_do_not_fit():
    with pytest.raises(BenchError, match="no usable answer"):
        ask(Script(*["x"] * 30), NUMBER)


def test_no_stops_the_run():
    with pytest.raises(BenchError, match="answered no to: Mount"):
        confirm(Script("no"), Prompt("1", PromptKind.CONFIRM, "Mount the block"))


def test_the_terminal_says_when_the_answers_end():
    shown = io.StringIO()
    person = TerminalPerson(io.StringIO("yes\n"), Console(file=shown))
    prompt = Prompt("1#1", PromptKind.CONFIRM, "Mount the [block]", default="yes")
    assert person.ask(prompt) == Answer("1#1", "yes")
    with pytest.raises(NoAnswer, match=r"the answers ended at the question: Mount the \[block\]"):
        person.ask(prompt)
    assert "Mount the [block]" in shown.getvalue()
    assert "Enter = yes" in shown.getvalue()


def test_a_wish_typed_at_a_prompt_is_heard_and_a_misspelt_one_explained():
    shown = io.StringIO()
    person = TerminalPerson(io.StringIO(":rdo\n:skip\n:skip the cable came loose\n"), Console(file=shown))
    with pytest.raises(OperatorWish) as heard:
        person.ask(Prompt("1#1", PromptKind.ANGLE, "Turn"))
    assert heard.value.control == RunControl(Wish.SKIP, "the cable came loose", by_person=True)
    assert ":rdo is no wish; there are :pause, :continue, :redo" in shown.getvalue()
    assert "say why" in shown.getvalue()


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
    heard = [controls.poll() for _ in range(5)]
    assert heard == [RunControl(Wish.PAUSE), None, RunControl(Wish.SKIP, "wrong angle"), None, None]
