"""An encoder that answers in the person's place: who answered, what is recorded, how many keys a run takes."""

import io
import math
import os
from dataclasses import replace
from types import SimpleNamespace

import pytest
from rich.console import Console

from bench.config.devices.registry import devices
from bench.panel.run_state import prompt_of
from bench.run.assembly.served import LivingOperator
from bench.run.commission.session import CommissioningPerson
from bench.run.events import Event, EventType
from bench.run.listening import Asker
from bench.run.person import AskedPrompt
from bench.run.sentences import said
from bench.run.terminal import TerminalPerson
from drivers.person import Answer, AnsweredByInstrument, Prompt, PromptKind, watching
from sim.world.operator import ScriptedOperator
from tests.support.instrument_stand import standing
from tests.support.scripted_session import Clock

TURN = Prompt("1/turn#1", PromptKind.CONFIRM, "Turn.", default="yes")


class Record:
    def __init__(self):
        self.events = []

    @property
    def count(self):
        return len(self.events)

    def tell(self, kind, data):
        self.events.append(Event(self.count + 1, "2026-11-21T10:00:00+00:00", 0.0, kind, dict(data)))


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def record():
    return Record()


@pytest.fixture
def away(tmp_path, record, clock):
    return Asker(tmp_path, record, record.tell, clock=clock)


def put(asker, clock, look, every_s=0.2, prompt=TURN):
    with pytest.raises(AnsweredByInstrument) as seen, watching(asker, look, every_s, clock):
        asker.ask(prompt)
    return seen.value


def arrives_at(time_s, clock, problem=""):
    def look():
        if clock.now_s() >= time_s:
            raise AnsweredByInstrument("encoder", "45°00′01.0″", problem)

    return look


def test_the_record_says_that_the_encoder_answered(away, record, clock):
    put(away, clock, arrives_at(3.0, clock))
    asked, answered = record.events
    assert (asked.type, answered.type) == (EventType.ASKED, EventType.ANSWERED)
    assert answered.data == {
        "id": asked.data["id"], "answer": "45°00′01.0″", "by": "encoder", "role": "", "where": "instrument",
    }  # fmt: skip
    assert said(answered) == "answered by the encoder: 45°00′01.0″"
    assert away.answered_by.by == "encoder"


def test_what_is_no_answer_yet_is_refused_and_it_stays_one_question(away, record, clock):
    why = "The head did not approach from below."
    assert put(away, clock, arrives_at(1.0, clock, why)).problem == why
    put(
        away, clock, arrives_at(2.0, clock), prompt=Prompt("1/turn#2", PromptKind.CONFIRM, why, default="yes")
    )
    assert [event.type for event in record.events] == [
        EventType.ASKED, EventType.ANSWER_REFUSED, EventType.ANSWERED,
    ]  # fmt: skip
    assert said(record.events[1]) == f"an answer by the encoder is not accepted: {why}"


def test_it_is_looked_at_as_often_as_is_told_and_the_rest_as_before(away, clock):
    rails, looks = [], []
    away.meanwhile = lambda: rails.append(clock.now_s())
    arrives = arrives_at(10.0, clock)

    def look():
        looks.append(clock.now_s())
        arrives()

    put(away, clock, look)
    assert 30 <= len(looks) <= 60
    assert 9 <= len(rails) <= 12
    assert away.slice_s == 1.0
    assert away.meanwhile is not None


class Turning:
    """A hand that turns a simulated head leg by leg, `legs` of which are begun at each event of a type."""

    def __init__(self, stand, legs):
        self.world, self.legs, self.begun = stand.world, legs, []
        self.sleep, stand.world.clock.sleep = stand.world.clock.sleep, self.later

    def later(self, duration_s):
        self.sleep(duration_s)
        if self.begun and self.world.head_rate_rad_s == 0.0:
            self.world.move_head(math.radians(self.begun.pop(0)), math.radians(10.0))

    def __call__(self, event):
        self.begun += self.legs.get(event.type, [])


@pytest.mark.parametrize("name", ["heidenhain-nd28x", "encoder-line"])
def test_a_hand_and_an_encoder_alone_carry_out_a_turn_and_the_record_says_so(tmp_path, record, name):
    legs = {EventType.ASKED: [47.0, 45.001], EventType.ANSWER_REFUSED: [43.5, 44.999]}
    with standing(devices().get(name), tmp_path, hands_free="yes") as stand:
        hand = Turning(stand, legs)

        def tell(kind, data):
            record.tell(kind, data)
            if data.get("action", {}).get("do") == "turn" or kind == EventType.ANSWER_REFUSED:
                hand(record.events[-1])

        stand.driver._person = Asker(tmp_path, record, tell, clock=stand.world.clock)
        stand.driver.open()
        stand.driver._trusted = True  # of the line a person was asked
        position = stand.driver.move(math.radians(45.0), 1, "1/turn")
    assert math.degrees(position.angle_rad) == pytest.approx(44.999, abs=1e-4)
    assert [event.type for event in record.events] == [
        EventType.ASKED, EventType.ANSWER_REFUSED, EventType.ANSWERED,
    ]  # fmt: skip
    assert "did not approach from below" in record.events[1].data["why"]
    assert record.events[2].data["answer"] == "44°59′56.4″"
    assert {event.data["by"] for event in record.events[1:]} == {"encoder"}


def test_the_terminal_rings_once_the_encoder_has_answered(clock):
    shown = io.StringIO()
    keys, _ = os.pipe()
    with os.fdopen(keys, encoding="utf-8") as answers:
        person = TerminalPerson(answers, Console(file=shown, force_terminal=True))
        put(person, clock, arrives_at(0.0, clock), every_s=0.01)
    assert shown.getvalue().endswith("\a")


def test_on_a_page_a_turn_that_an_encoder_reads_is_confirmed_and_not_typed():
    action = {"do": "turn", "target_rad": 1.0, "direction": 1, "read_by": "encoder"}
    event = Event(1, "2026-11-21T10:00:00+00:00", 0.0, "asked", {})
    told = prompt_of(
        AskedPrompt(event, replace(TURN, action=action)), SimpleNamespace(turned=None, mounted=None), {}
    )
    assert told["target"] == "57°17′45″"
    assert told["buttons"][0] == {"text": "", "label": "Yes"}


@pytest.mark.parametrize(("typed", "answer"), [(False, "yes"), (True, "45 00 02")])
def test_at_a_simulated_bench_a_living_person_says_that_the_simulated_hand_turns(tmp_path, typed, answer):
    device = devices().get("heidenhain-nd28x")
    with standing(device, tmp_path, typed="yes" if typed else "no") as stand:

        class Living:
            meanwhile = None

            def ask(self, prompt):
                assert stand.world.scale_angle_rad == 0.0
                return Answer(prompt.id, answer)

        stand.driver._person = LivingOperator(Living(), stand.driver._person)
        stand.driver.open()
        position = stand.driver.move(math.radians(45.0), 1, "1/turn")
        assert position.angle_rad == pytest.approx(math.radians(45.0), abs=1e-4)
        assert stand.world.direction == 1


@pytest.mark.slow
def test_an_evening_with_an_encoder_finds_that_all_works(bench):
    status, out, err = bench(
        "instruments", "--commission", "--dry-run", "--bench", "bench-encoder", "--out", "evening"
    )
    assert (status, err) == (0, ""), out
    assert "was turned to" in out


def test_an_evening_watches_with_the_person_where_that_is_possible():
    class Nobody:
        def ask(self, prompt):
            raise AssertionError(prompt)

    looks = []
    watched, alone = CommissioningPerson(ScriptedOperator(None)), CommissioningPerson(Nobody())
    for person in (watched, alone):
        person.meanwhile = looks.append
    assert watched.meanwhile is not None
    assert alone.meanwhile is None
