"""The head: limits refused without a wire, small moves confirmed, a stop that is obeyed or not."""

import math

import pytest

from bench.run.commission.devices import check_limits, check_moves
from bench.run.commission.session import CommissioningSession, State
from bench.run.events import Wish
from bench.run.instruments import Instruments
from bench.run.person import OperatorWish, RunControl
from drivers.instruments.manual import ManualHead
from drivers.interfaces import InstrumentLost, InstrumentRefused
from tests.support.commission_bench import Head, Says, evening, meters, motorised

LIMITS = (math.radians(-5.0), math.radians(365.0))
SKIP = OperatorWish(RunControl(Wish.SKIP, "the cables are short"))


def tonight(clock, person, **head) -> CommissioningSession:
    return evening(person, clock, Instruments(meters(clock), Head("head", clock, LIMITS, **head)))


def test_limits_are_tried_without_a_wire_and_without_a_move(clock, person):
    given = tonight(clock, person)
    check_limits(given)
    assert [one.state for one in given.findings] == [State.WORKS]
    assert given.instruments.head.moved == []
    assert given.identities == {}  # nothing was opened
    assert person.asked == []


def test_a_head_that_does_not_refuse_is_told(clock, person):
    given = tonight(clock, person, obeys=False)
    check_limits(given)
    (found,) = given.findings
    assert (found.state, "-6°" in found.said) == (State.OTHER, True)
    assert "do not use it" in found.remedy


def test_a_head_whose_wire_alone_refuses_is_told(clock, person, monkeypatch):
    given = tonight(clock, person)

    def move(*_):
        raise InstrumentLost("head", "is not open, nothing was sent", "open it first")

    monkeypatch.setattr(given.instruments.head, "move", move)
    check_limits(given)
    assert "was refused only after it was sent" in given.findings[0].said


def test_it_goes_both_ways_stops_between_and_ends_where_it_began(clock, person):
    given = tonight(clock, person, angle_rad=1.0)
    check_moves(given)
    head = given.instruments.head
    assert [one.state for one in given.findings] == [State.WORKS] * 4
    assert [one.check for one in given.findings] == ["position", "small move", "stop", "small move"]
    assert head.moved == [(pytest.approx(1.0 + math.radians(2.0)), 1), (1.0, -1)]
    assert head.stops == 1
    assert len(person.asked) == 3
    assert all(p.default is None and p.action["do"] == "stand_clear" for p in person.asked)


def test_near_its_upper_limit_it_goes_down_first(clock, person):
    given = tonight(clock, person, angle_rad=LIMITS[1])
    check_moves(given)
    assert [direction for _, direction in given.instruments.head.moved] == [-1, 1]
    assert all(LIMITS[0] <= target <= LIMITS[1] for target, _ in given.instruments.head.moved)


def test_a_head_outside_its_limits_is_not_moved(clock, person):
    given = tonight(clock, person, angle_rad=math.radians(-20.0))
    check_moves(given)
    assert [one.state for one in given.findings] == [State.OTHER]
    assert given.instruments.head.moved == []
    assert person.asked == []


def test_a_stop_that_is_not_obeyed_is_told_and_repeated(clock, person):
    given = tonight(clock, person, angle_rad=1.0, obeys=False)
    check_moves(given)
    stop = next(one for one in given.findings if one.check == "stop")
    assert stop.state is State.OTHER
    assert "emergency stop" in stop.remedy


def test_a_stop_that_fails_twice_is_told_with_the_emergency_stop(clock, person, monkeypatch):
    given = tonight(clock, person, angle_rad=1.0)

    def refused():
        raise InstrumentRefused("head", "it refuses ST", "see its display")

    monkeypatch.setattr(given.instruments.head, "stop", refused, raising=False)
    check_moves(given)
    stop = next(one for one in given.findings if one.check == "stop")
    assert (stop.state, stop.said) == (State.OTHER, "it refuses ST")
    assert "press its emergency stop. Cause: it refuses ST" in stop.remedy


def test_whatever_ends_the_stop_the_head_was_told_to_stop(clock, person, monkeypatch):
    given = tonight(clock, person, angle_rad=1.0)

    def interrupted(_):
        raise KeyboardInterrupt

    person.on_prompt = lambda prompt: (
        monkeypatch.setattr(clock, "sleep", interrupted) if "half way" in prompt.text else None
    )
    with pytest.raises(KeyboardInterrupt):
        check_moves(given)
    assert given.instruments.head.stops == 1


def test_a_move_that_is_skipped_is_not_made(clock, person):
    person.answers = [SKIP]
    given = tonight(clock, person, angle_rad=1.0)
    check_moves(given)
    assert given.instruments.head.moved == []
    assert (given.findings[-1].state, given.findings[-1].said) == (State.SKIPPED, "the cables are short")


def test_a_slow_move_is_told(clock, person, monkeypatch):
    given = tonight(clock, person, angle_rad=1.0)
    move = given.instruments.head.move

    def slow(*arguments):
        clock.sleep(30.0)
        return move(*arguments)

    monkeypatch.setattr(given.instruments.head, "move", slow)
    check_moves(given)
    assert [one.state for one in given.findings if one.check == "small move"] == [State.SLOWER] * 2


def test_a_head_without_a_motor_is_turned_by_the_person(clock):
    from bench.config.bench_file.file import load_bench
    from bench.config.shipped import find_bench

    person = Says(["10 0 1", "5 0 0"])
    head = ManualHead("head", person, tolerance_rad=1e-4)
    given = evening(person, clock, Instruments(meters(clock), head), load_bench(find_bench("bench-lan")))
    check_limits(given)
    check_moves(given)
    assert [one.state for one in given.findings] == [State.WORKS] * 2
    assert given.findings[0].figures[0].value == pytest.approx(1.0, abs=1e-6)
    assert motorised().instruments.head.by_hand is False
