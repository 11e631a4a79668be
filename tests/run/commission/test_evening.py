"""An evening of checks: the session, its findings and its wires."""

import pytest

from bench.run.commission.session import (
    ONLY_THESE,
    CommissioningSession,
    Figure,
    Finding,
    SessionEnded,
    Skipped,
    State,
    WireWatch,
    status_of,
)
from bench.run.events import Wish
from bench.run.instruments import Instruments
from bench.run.person import OperatorWish, RunControl
from drivers.interfaces import BadReading, InstrumentLost, InstrumentRefused, NoAnswer
from sim.world.clock import VirtualClock
from tests.support.commission_bench import Head, Says, evening, lost, meters


@pytest.fixture
def tonight(clock: VirtualClock, person: Says) -> CommissioningSession:
    return evening(person, clock, Instruments(meters(clock), Head("head", clock, (-0.1, 6.0))))


def works(tonight: CommissioningSession) -> Finding:
    return Finding("check", tonight.instruments.head.name, State.WORKS, "fine")


def raising(error):
    def look():
        raise error

    return look


@pytest.mark.parametrize(
    ("error", "state", "said"),
    [
        (InstrumentLost("head", "is gone", "look"), State.COULD_NOT, "is gone"),
        (InstrumentRefused("head", "says no", "look"), State.OTHER, "says no"),
        (BadReading("head", "is garbled", "look"), State.OTHER, "is garbled"),
        (InstrumentLost("adapter", "is gone", "look"), State.COULD_NOT, "adapter: is gone"),
        (ZeroDivisionError("x"), State.OTHER, "the driver failed with ZeroDivisionError (x)"),
        (Skipped("no time"), State.SKIPPED, "no time"),
    ],
)
def test_whatever_a_check_raises_becomes_its_finding(tonight, error, state, said):
    found = tonight.carry_out("check", tonight.instruments.head, raising(error))
    assert (found.instrument, found.state, found.said) == ("head", state, said)
    assert tonight.findings == [found]
    assert found.remedy or state is State.SKIPPED


def test_what_refuses_to_be_opened_could_not_be_done(tonight, monkeypatch):
    refusal = InstrumentRefused("head", "is held by another program", "end that")
    monkeypatch.setattr(tonight.instruments.head, "open", raising(refusal))
    for _ in range(3):
        found = tonight.carry_out("check", tonight.instruments.head, lambda: works(tonight))
        assert found.state is State.COULD_NOT
    assert found.said == "not tried: the instrument was lost before"


def test_an_error_of_another_that_takes_part_is_told_of_that_one(tonight):
    x, y, _ = tonight.instruments.voltmeters
    found = tonight.carry_out("together", x, raising(lost("voltmeter.y")), also=[y])
    assert found.instrument == "voltmeter.y"


def test_what_was_lost_twice_is_not_tried_again(tonight):
    x = tonight.instruments.voltmeters[0]
    tried = []

    def look():
        tried.append(1)
        raise lost("voltmeter.x")

    for _ in range(4):
        found = tonight.carry_out("check", x, look)
    assert len(tried) == 2
    assert (found.state, found.said) == (State.COULD_NOT, "not tried: the instrument was lost before")


def test_an_answer_that_takes_most_of_its_timeout_is_slow(tonight, clock):
    head = tonight.instruments.head  # its timeout is 3 s

    def look(took_s):
        tonight.watch("head", ">", "get pos")
        clock.sleep(took_s)
        tonight.watch("head", "<", "0")
        return works(tonight)

    assert tonight.carry_out("check", head, lambda: look(1.4)).state is State.WORKS
    found = tonight.carry_out("check", head, lambda: look(1.6))
    assert found.state is State.SLOWER
    assert "get pos took 1.6 s" in found.said
    assert "3.2 s" in found.remedy
    assert tonight.carry_out("check", head, lambda: look(1.6), by_answers=False).state is State.WORKS


def test_a_failure_that_the_driver_mended_is_told(tonight):
    def look():
        tonight.watch("head", "!", "connecting: InstrumentLost: refused; look")
        return works(tonight)

    found = tonight.carry_out("check", tonight.instruments.head, look)
    assert (found.state, "refused" in found.said) == (State.OTHER, True)


def test_a_connection_made_anew_is_told(clock, person):
    numbers = iter([1, 1, 1, 2])
    tonight = evening(person, clock, Instruments(meters(clock), Head("head", clock, (-0.1, 6.0))))
    tonight.connections = {"head": lambda: next(numbers)}
    head = tonight.instruments.head
    assert tonight.carry_out("check", head, lambda: works(tonight)).state is State.WORKS
    found = tonight.carry_out("check", head, lambda: works(tonight))
    assert (found.state, "requested again" in found.said) == (State.OTHER, True)


def test_skip_and_abort_are_heard_and_no_other_wish(tonight, person):
    person.answers = [OperatorWish(RunControl(Wish.REPEAT_POINT)), "yes"]
    tonight.confirm("Go on?")
    assert person.asked[1].text == f"{ONLY_THESE}Go on?"
    person.answers = [OperatorWish(RunControl(Wish.SKIP, "no shorts here"))]
    with pytest.raises(Skipped, match="no shorts here"):
        tonight.confirm("Go on?")
    person.answers = [OperatorWish(RunControl(Wish.ABORT))]
    with pytest.raises(SessionEnded):
        tonight.confirm("Go on?")
    person.answers = [NoAnswer("operator", "no answer is left", "answer")]
    with pytest.raises(SessionEnded, match="no answer is left"):
        tonight.confirm("Go on?")


def found(*states: State) -> list[Finding]:
    return [Finding("check", "head", state, "said") for state in states]


@pytest.mark.parametrize(
    ("states", "status"),
    [
        ([State.WORKS], 0),
        ([State.WORKS, State.SKIPPED], 0),
        ([State.WORKS, State.SLOWER], 1),
        ([State.OTHER, State.WORKS], 1),
        ([State.OTHER, State.COULD_NOT], 2),
        ([], 2),
    ],
)
def test_the_worst_decides_the_status(states, status):
    assert status_of(found(*states), whole=True) == status


def test_an_evening_that_was_not_gone_through_is_not_done():
    assert status_of(found(State.WORKS), whole=False) == 2


def test_a_figure_is_told_with_its_unit_and_what_it_was_held_against():
    assert Figure("took", 4.123456, "s", "4.1 s expected").text == "took 4.123 s (4.1 s expected)"
    assert Figure("mean", 1.0, "µV").text == "mean 1 µV"


def test_a_finding_is_one_sentence_with_what_to_do():
    finding = Finding("stop", "head", State.OTHER, "went on", remedy="do not use it")
    assert finding.sentence == "head: stop: went on; do not use it"


def test_the_time_of_an_answer_is_from_its_command_on_and_of_its_instrument():
    clock, logged = VirtualClock(), []
    watch = WireWatch(lambda *message: logged.append(message), clock.now_s)
    watch("x", ">", "*IDN?")
    clock.sleep(0.1)
    watch("y", ">", "TEMP?")
    mark = watch.mark()
    clock.sleep(0.2)
    watch("x", "<", "M1")
    watch("y", "!", "after sending: InstrumentLost: gone; look")
    watch("y", "<", "too late")
    (exchange,) = watch.exchanges(mark, "x")
    assert (exchange.command, round(exchange.took_s, 9)) == ("*IDN?", 0.3)
    assert watch.exchanges(mark, "y") == []
    assert watch.failures(mark, "y") == ["after sending: InstrumentLost: gone; look"]
    assert watch.failures(mark, "x") == watch.failures(watch.mark(), "y") == []
    assert [direction for _, direction, _ in logged] == [">", ">", "<", "!", "<"]
