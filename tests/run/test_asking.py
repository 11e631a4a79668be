"""Questions answered at the terminal or in the run's folder: the first answer that fits counts, no other does."""

import io
import os
import pty

import pytest
from rich.console import Console

from bench.run import listening
from bench.run import person as person_module
from bench.run import terminal as terminal_module
from bench.run.events import Event, Wish
from bench.run.listening import READ_S, Asker, WishListener
from bench.run.person import (
    ANSWERS,
    CONTROL,
    ControlFile,
    LeftAnswer,
    OperatorWish,
    RunControl,
    Stopped,
    WishAuthor,
    ask,
    confirm,
    leave_answer,
    leave_wish,
)
from bench.run.power import RailFault
from bench.run.sentences import sentence
from bench.run.terminal import TerminalPerson
from drivers.angles import parse_angle
from drivers.instruments.manual import ManualHead
from drivers.interfaces import NoAnswer
from drivers.person import Prompt, PromptKind
from sim.world.clock import VirtualClock
from tests.support.open_prompts import open_prompt

ANN = WishAuthor("Ann", "operator", "panel")
BOB = WishAuthor("bob", "supervisor", "terminal")
MOUNT = Prompt("2/mount#1", PromptKind.CONFIRM, "Mount the block")
PAUSED = Prompt("pause@1", PromptKind.CONFIRM, "Paused", default="yes", action={"do": "wait"})


class Folder(VirtualClock):
    """A run's folder and record in memory, and a clock at whose looks something happens."""

    def __init__(self, folder):
        super().__init__()
        self.folder, self.events, self.plan = folder, [], []

    @property
    def count(self):
        return len(self.events)

    def tell(self, kind, data):
        self.events.append(Event(self.count + 1, "t", 0.0, kind, data))

    def sleep(self, duration_s):
        super().sleep(duration_s)
        self.happen()

    def happen(self):
        assert self.plan, "the question waits for ever"
        self.plan.pop(0)()

    def answer(self, text, prompt_id=None, who=ANN):
        """Return what leaves an answer, to the question that stands."""
        return lambda: leave_answer(
            self.folder, LeftAnswer(prompt_id or open_prompt(self.events).prompt.id, text, who)
        )

    def told(self, kind):
        return [event.data for event in self.events if event.type == kind]


@pytest.fixture
def run(tmp_path):
    return Folder(tmp_path)


@pytest.fixture
def away(run):
    """A person away from any terminal."""
    return Asker(run.folder, run, run.tell, clock=run)


@pytest.fixture
def keyboard_and_person(run, monkeypatch):
    """A terminal of the system: where keys are hit, the person at it, and what is shown."""
    real = terminal_module.select.select

    def at_once(read, write, failed, _wait_s):
        if not (found := real(read, write, failed, 0.005))[0] and run.plan:
            run.happen()
        return found

    monkeypatch.setattr("bench.run.terminal.select.select", at_once)
    keys, screen = pty.openpty()
    with os.fdopen(screen, encoding="utf-8") as answers, os.fdopen(keys, "wb", buffering=0) as keyboard:
        shown = io.StringIO()
        terminal = TerminalPerson(answers, Console(file=shown, width=200), who=BOB)
        yield keyboard, Asker(run.folder, run, run.tell, terminal=terminal, clock=run), shown


# --- away from a terminal ---------------------------------------------------------------------------


def test_a_question_is_on_record_with_all_that_it_says_and_its_answer_with_who_gave_it(run, away):
    prompt = Prompt("3/ask#1", PromptKind.CHOOSE, "Which?", choices=("a", "b"), picture="|_")
    run.plan = [run.answer(" b ")]
    answer = away.ask(prompt)
    assert (answer.prompt_id, answer.text) == ("3/ask#1", "b")
    (asked,) = run.told("asked")
    assert asked["id"] == "3/ask#1@1"
    assert asked["choices"] == ("a", "b")
    assert run.told("answered") == [
        {"id": "3/ask#1@1", "answer": "b", "by": "Ann", "role": "operator", "where": "panel", "line": 1}
    ]


def test_what_is_stale_double_ill_fitting_or_garbage_is_refused_on_record_and_the_question_stands(run, away):
    def garbage():
        with (run.folder / ANSWERS).open("a") as file:
            file.write("yes\n")

    run.plan = [
        run.answer("yes", "1/old@1"),
        run.answer("perhaps"),
        garbage,
        run.answer(""),
        run.answer("yes"),
    ]
    confirm(away, MOUNT)
    first = run.told("answered")[0]["id"]
    run.plan = [run.answer("yes", first), run.answer("yes")]
    confirm(away, MOUNT)
    assert [refused["why"] for refused in run.told("answer_refused")] == [
        "it answers another question than the open one",
        "answer yes or no, not 'perhaps'",
        "line 3 of answers.jsonl is not an answer",
        "nothing was typed: answer yes or no",
        "the question was answered already by Ann",
    ]
    assert [answered["line"] for answered in run.told("answered")] == [5, 7]
    assert len({asked["id"] for asked in run.told("asked")}) == len(run.told("asked")) == 2


def test_an_answer_left_while_nothing_is_asked_answers_nothing(run, away):
    run.answer("yes", "9/next#1@1")()
    away.drain()
    assert run.told("answer_refused")[0]["why"] == "no question is open"


def test_a_program_that_takes_the_run_up_passes_over_the_answers_that_were_heard(run, away):
    run.plan = [run.answer("maybe"), run.answer("yes")]
    confirm(away, MOUNT)
    run.answer("yes", run.told("asked")[0]["id"])()  # heard by nobody: the program died
    again = Asker(run.folder, run, run.tell, answers_read=2, clock=run)
    run.plan = [run.answer("yes")]
    confirm(again, MOUNT)
    assert [refused["line"] for refused in run.told("answer_refused")] == [1, 3]


def test_an_empty_answer_is_the_default_and_none_where_there_is_none(run, away):
    run.plan = [run.answer("")]
    assert ask(away, Prompt("4/ask", PromptKind.CONFIRM, "Short the inputs", default="yes")) == "yes"
    assert run.told("answered")[0]["answer"] == "yes"
    run.plan = [run.answer(""), run.answer("yes")]
    confirm(away, MOUNT)
    assert run.told("answer_refused")[0]["answer"] == ""


def test_what_is_watched_meanwhile_is_watched_away_from_a_terminal_too(run, away):
    def look():
        raise RailFault("power_supply", "rail p15 is off", "look")

    away.meanwhile = look
    run.plan = [lambda: None] * 20
    with pytest.raises(RailFault):
        away.ask(MOUNT)


# --- at a terminal as well --------------------------------------------------------------------------


def test_the_first_answer_counts_and_the_other_place_says_so(run, keyboard_and_person):
    keyboard, person, _ = keyboard_and_person
    run.plan = [run.answer("yes")]
    assert person.ask(MOUNT).text == "yes"
    (answered,) = [event for event in run.events if event.type == "answered"]
    assert sentence(answered) == "answered in the panel by Ann: yes"
    run.sleep = lambda duration_s: None
    run.plan = [lambda: VirtualClock.sleep(run, READ_S), lambda: keyboard.write(b"yes\n")]
    assert person.ask(MOUNT).text == "yes"
    assert run.told("answered")[1] == {"id": "2/mount#1@3", "answer": "yes", **BOB.to_json()}
    run.plan = [run.answer("no", "2/mount#1@3"), run.answer("no")]
    person.ask(MOUNT)
    assert run.told("answer_refused")[0]["why"] == "the question was answered already by bob"


def test_a_line_typed_for_a_question_that_somebody_else_has_answered_does_not_answer_the_next(
    run, keyboard_and_person
):
    keyboard, person, _ = keyboard_and_person
    run.plan = [run.answer("yes")]
    person.ask(MOUNT)
    run.plan = [
        lambda: keyboard.write(b"yes\n"),
        lambda: VirtualClock.sleep(run, READ_S),
        lambda: keyboard.write(b"no\n"),
    ]
    assert person.ask(MOUNT).text == "no"
    assert (
        run.told("answer_refused")[0]["why"]
        == "the answer was typed before this question appeared; answer again"
    )


def test_an_answer_that_does_not_fit_is_refused_at_the_terminal_and_the_question_is_the_same_one(
    run, keyboard_and_person
):
    keyboard, person, shown = keyboard_and_person
    head = ManualHead("head", person, tolerance_rad=parse_angle("0 0 30"))
    run.plan = [lambda: keyboard.write(b"46 0 0\n"), run.answer("45 60 0"), run.answer("45 0 2")]
    assert head.move(parse_angle("45"), 1, "5/turn").angle_rad == pytest.approx(parse_angle("45 0 2"))
    assert len(run.told("asked")) == 1
    assert [refused["where"] for refused in run.told("answer_refused")] == ["terminal", "panel"]
    assert "probably the degree line is one off" in shown.getvalue()


def test_the_rest_of_a_line_that_was_begun_for_an_answered_question_is_dropped(run, monkeypatch):
    out, into = os.pipe()
    run.plan = []
    with os.fdopen(out, encoding="utf-8") as answers:
        terminal = TerminalPerson(answers, Console(file=io.StringIO()))
        person = Asker(run.folder, run, run.tell, terminal=terminal)
        monkeypatch.setattr(listening, "LISTEN_S", 0.01)
        terminal.slice_s = 0.01
        os.write(into, b"45 0")
        leave_answer(run.folder, LeftAnswer("2/mount#1@1", "yes", ANN))
        assert person.ask(MOUNT).text == "yes"
        os.write(into, b"0 10\nno\n")
        assert person.ask(MOUNT).text == "no"
        os.close(into)
        with pytest.raises(NoAnswer):
            person.ask(MOUNT)


def test_a_run_paused_at_a_terminal_that_has_ended_goes_on_by_the_folder(run):
    terminal = TerminalPerson(io.StringIO(""), Console(file=io.StringIO()))
    person = Asker(run.folder, run, run.tell, terminal=terminal, clock=run)
    run.plan = [run.answer("yes")]
    assert person.ask(PAUSED).text == "yes"
    with pytest.raises(NoAnswer):
        person.ask(MOUNT)


# --- wishes at a question ---------------------------------------------------------------------------


def test_wishes_left_in_the_folder_are_heard_at_a_question_where_they_would_be_typed(run, away):
    controls = WishListener(ControlFile(run.folder))

    def wish(what):
        return lambda: leave_wish(run.folder, RunControl(what, "why", who=ANN))

    away.attach(run.tell, controls)
    run.plan = [wish(Wish.CONTINUE), wish(Wish.REPEAT_POINT)]
    with pytest.raises(OperatorWish) as heard:
        away.ask(MOUNT)
    assert heard.value.control == RunControl(Wish.REPEAT_POINT, "why", who=ANN)
    (refused,) = run.told("wish_refused")
    assert refused == {"wish": "continue", "why": "this question does not accept it", **ANN.to_json()}
    run.plan = [wish(Wish.CONTINUE)]
    with pytest.raises(OperatorWish) as heard:
        away.ask(PAUSED)
    assert heard.value.control.wish is Wish.CONTINUE


class Short(io.RawIOBase):
    """A file that accepts a few bytes at once, as one on a disk that is nearly full."""

    def __init__(self, file):
        self.file = file

    def write(self, data):
        return self.file.write(data[:7])

    def close(self):
        self.file.close()


@pytest.mark.parametrize("torn", [b"", b'{"wish": "pau', bytes(30)], ids=["short", "torn", "zeros"])
def test_what_a_full_disk_or_a_power_cut_tore_swallows_no_later_request(run, away, monkeypatch, torn):
    opened = person_module.open_regular
    monkeypatch.setattr(
        person_module,
        "open_regular",
        lambda f, mode="rb": Short(o) if mode == "ab" and (o := opened(f, mode)) else opened(f),
    )
    controls = ControlFile(run.folder)
    (run.folder / CONTROL).write_bytes(torn)
    leave_wish(run.folder, RunControl(Wish.STOP, "smoke", who=ANN))
    assert controls.poll() == RunControl(Wish.STOP, "smoke", who=ANN)
    (run.folder / ANSWERS).write_bytes(torn)
    run.plan = [
        lambda: leave_answer(run.folder, LeftAnswer(open_prompt(run.events).event.data["id"], "yes", ANN))
    ]
    assert away.ask(MOUNT).text == "yes"


@pytest.mark.skipif(
    not person_module.HOLDS_FOLDERS, reason="an open folder cannot be followed on this system"
)
def test_requests_and_answers_are_heard_after_the_folder_was_renamed(run, away):
    """'stop was sent; it takes effect at once', said the command, and nobody heard it."""
    controls = ControlFile(run.folder)
    assert controls.poll() is None
    away.drain()
    run.folder = run.folder.rename(run.folder.with_name("renamed"))
    leave_wish(run.folder, RunControl(Wish.STOP, "smoke", who=ANN))
    assert controls.poll() == RunControl(Wish.STOP, "smoke", who=ANN)
    told = run.events
    run.plan = [lambda: leave_answer(run.folder, LeftAnswer(open_prompt(told).event.data["id"], "yes", ANN))]
    assert away.ask(MOUNT).text == "yes"


def test_a_wish_to_stop_leaves_a_question_as_ctrl_c_does(run, away, keyboard_and_person):
    away.attach(run.tell, WishListener(ControlFile(run.folder)))
    run.plan = [lambda: leave_wish(run.folder, RunControl(Wish.STOP, "smoke", who=ANN))]
    with pytest.raises(Stopped) as stopped:
        away.ask(MOUNT)
    assert stopped.value.control.who == ANN
    keyboard, person, _ = keyboard_and_person
    run.plan = [lambda: keyboard.write(b":stop\n")]
    with pytest.raises(KeyboardInterrupt):
        person.ask(MOUNT)
