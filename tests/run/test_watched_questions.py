"""The rails of the block's supply are watched while a question waits, and no answer is lost."""

import io
import math
import os
import pty
import signal
from unittest.mock import Mock

import pytest
from rich.console import Console

from bench.readings.table import Reading
from bench.run import terminal as terminal_module
from bench.run.events import EventType, RunState, Wish
from bench.run.interrupts import Interrupts
from bench.run.person import RunControl
from bench.run.power import RailFault
from bench.run.terminal import LineReader, ProgressBar, TerminalPerson
from drivers.angles import parse_angle
from drivers.interfaces import NoAnswer
from drivers.person import Answer, Prompt, PromptKind
from sim.world.clock import VirtualClock
from tests.support.fed_runs import Supply, fed_runner
from tests.support.runner_bench import PLAN, Bench, new_record, recorded

QUESTION = Prompt("1#1", PromptKind.CONFIRM, "Mount the block")


class Passing(VirtualClock):
    """Time passes while somebody looks at it: as much as between two slices of a question."""

    def now_s(self) -> float:
        self.sleep(terminal_module.SLICE_S)
        return super().now_s()


@pytest.fixture
def terminal(monkeypatch):
    """A terminal of the system: where keys are hit, and the stream that a program reads."""
    monkeypatch.setattr("bench.run.terminal.select.select", _at_once(terminal_module.select.select))
    keys, screen = pty.openpty()
    with os.fdopen(screen, encoding="utf-8") as answers, os.fdopen(keys, "wb", buffering=0) as keyboard:
        yield keyboard, answers


def _at_once(select):
    """Wait no longer than it takes the system to say what is there."""
    return lambda read, write, failed, _wait_s: select(read, write, failed, 0.005)


# --- what is typed ----------------------------------------------------------------------------------


def test_an_answer_that_is_typed_while_a_look_is_under_way_counts(terminal):
    keyboard, answers = terminal
    person = TerminalPerson(answers, Console(file=io.StringIO()))
    looks = []

    def look():
        looks.append(1)
        if len(looks) == 3:
            keyboard.write(b"yes\n")

    person.meanwhile = look
    assert person.ask(QUESTION) == Answer("1#1", "yes")
    assert len(looks) >= 3


def test_an_answer_half_typed_at_a_look_is_whole_after_it_and_can_be_mended(terminal):
    keyboard, answers = terminal
    person = TerminalPerson(answers, Console(file=io.StringIO()))
    keys = iter([b"45 00 1", b"", b"\x7f0", b"5\n"])  # a key too many is taken back, as at every terminal
    person.meanwhile = lambda: keyboard.write(next(keys, b""))
    assert person.ask(QUESTION).text == "45 00 05"


def test_lines_of_a_pipe_are_read_one_by_one_and_its_end_is_nobody(monkeypatch):
    """A stream that had read ahead would let the system say that nothing is there."""
    monkeypatch.setattr("bench.run.terminal.select.select", _at_once(terminal_module.select.select))
    out, into = os.pipe()
    looks = []
    with os.fdopen(out, encoding="utf-8") as answers:
        os.write(into, "yes\n45°00′\nhalf".encode())
        person = TerminalPerson(answers, Console(file=io.StringIO()))
        person.meanwhile = lambda: looks.append(1) or os.close(into)
        assert [person.ask(QUESTION).text for _ in range(2)] == ["yes", "45°00′"]
        assert looks == []
        assert LineReader(answers).read(person.meanwhile) == "half"
        assert looks == [1]
        with pytest.raises(NoAnswer):
            person.ask(QUESTION)


def test_a_reading_is_shown_with_its_angle_as_it_was_understood():
    shown = io.StringIO()
    bar = ProgressBar(PLAN, Console(file=shown, width=200, force_terminal=True), [1.0] * len(PLAN.steps))
    angle_deg = math.degrees(parse_angle("45.0010"))
    reading = Reading(
        installation="1", series=1, pass_number=1, point=2, angle_deg=angle_deg, mean=(-1.5, 0.0, -1.5)
    )
    bar(Mock(type=EventType.STEP_DONE, step=0, reading=reading))
    assert "installation 1, pass 1, point 2, 45°00′03.6″: x -1.500000" in shown.getvalue()


# --- runs -------------------------------------------------------------------------------------------


@pytest.fixture
def asked_run(tmp_path, terminal):
    """Carry out a run whose person never answers at a terminal; return history, what stopped it, what was shown."""
    _, answers = terminal

    def carry_out(supply, **options):
        record, shown = new_record(tmp_path), io.StringIO()
        console = Console(file=shown, width=200)
        bar = ProgressBar(PLAN, console, [1.0] * len(PLAN.steps))
        person = TerminalPerson(answers, console, bar.pause, bar.go_on)
        stopped = None
        with Interrupts() as signals:
            runner = fed_runner(
                Bench(), record, supply, person=person, observers=(bar,), hold_signals=signals.hold, **options
            )
            try:
                runner.run()
            except (RailFault, KeyboardInterrupt) as error:
                stopped = error
        record.close()
        return recorded(tmp_path / "run")[0], stopped, shown.getvalue()

    return carry_out


class LookedInOn(Supply):
    """Something happens to it at the second look while a question stands."""

    def __init__(self, what):
        super().__init__(Passing())
        self.what, self.looks_asked = what, 0

    def state(self, key):
        self.looks_asked += key == "asked"
        if self.looks_asked == 2:
            self.what(self)
        return super().state(key)


@pytest.mark.parametrize("unsafe", ["off", "stay-on"])
def test_a_rail_that_goes_while_a_question_stands_stops_the_run_and_is_told_at_once(asked_run, unsafe):
    supply = LookedInOn(lambda s: s.befall("P25V", voltage_v=12.0))
    history, stopped, shown = asked_run(supply, feed={"when_unsafe": unsafe})
    assert isinstance(stopped, RailFault)
    assert "rail p15 has 12 V, not 14.8 to 15.2 V" in str(stopped)
    assert history.state is RunState.FAILED
    assert supply.is_on is (unsafe == "stay-on")
    lines = shown.splitlines()
    said = lines.index("stopped: rail p15 has 12 V, not 14.8 to 15.2 V")
    assert lines[said - 1].endswith("? = help] ")


def test_ctrl_c_at_a_question_amid_a_look_goes_the_way_out(asked_run):
    supply = LookedInOn(lambda s: os.kill(os.getpid(), signal.SIGINT))
    history, stopped, _ = asked_run(supply)
    assert isinstance(stopped, KeyboardInterrupt)
    assert history.state is RunState.INTERRUPTED
    assert not supply.is_on
    assert [e.data["power"] for e in history.events if e.type == "power"] == ["on", "off"]


class Wishes(list):
    """What was wished, each heard once."""

    stopped = None

    def poll(self):
        return self.pop() if self else None


def test_a_rail_that_goes_while_the_run_is_paused_stops_it(asked_run):
    wishes = Wishes()

    def look(supply):
        if paused:
            supply.befall("N25V", on=False)
        elif supply.clock.now_s() > 3000.0:  # the block is warm, the first step goes on
            wishes.append(RunControl(Wish.PAUSE))
            paused.append(True)

    paused = []
    supply = Supply(Passing(), at=dict.fromkeys(range(1, 2000), look))
    history, stopped, _ = asked_run(supply, controls=wishes, patience=VirtualClock())
    assert "rail n15 is off" in str(stopped)
    assert [e.type for e in history.events if e.type.startswith("run_")][-2:] == ["run_paused", "run_failed"]


def test_a_supply_that_a_person_works_is_not_watched_at_questions():
    person = TerminalPerson(io.StringIO(), Console(file=io.StringIO()))
    supply = Supply(VirtualClock())
    supply.asks_person = True
    fed_runner(Bench(), None, supply, person=person)
    assert person.meanwhile is None
    supply.asks_person = False
    fed_runner(Bench(), None, supply, decider=person)
    assert person.meanwhile is not None
