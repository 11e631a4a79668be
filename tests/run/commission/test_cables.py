"""Cables: one prompt for each that there is, a loss that is told or not, and the way back."""

import pytest

from bench.config.bench_file.file import load_bench
from bench.config.shipped import find_bench
from bench.run.commission.course import cables, check_cables
from bench.run.commission.session import State
from bench.run.instruments import Instruments
from drivers.instruments.manual import ManualHead
from tests.support.commission_bench import Head, Says, evening, lost, meters


def tonight(clock, person, name="bench-lan"):
    head = ManualHead("head", person, tolerance_rad=1e-4)
    return evening(person, clock, Instruments(meters(clock), head), load_bench(find_bench(name)))


def test_each_wire_has_a_cable_and_those_behind_an_adapter_share_one(clock):
    own = list(cables(tonight(clock, Says())))
    assert [[one.name for one in cable.instruments] for cable in own] == [
        ["voltmeter.x"],
        ["voltmeter.y"],
        ["voltmeter.z"],
    ]
    (shared,) = cables(tonight(clock, Says(), "bench-prologix"))
    assert len(shared.instruments) == 3
    assert "adapter" in shared.text


def test_a_loss_is_told_and_the_instrument_is_back_after_a_while(clock, person):
    given = tonight(clock, person)
    x = given.instruments.voltmeters[0]

    def pulled(prompt):
        if prompt.action["do"] == "cable" and not prompt.action["plugged"]:
            x.troubles = [lost("voltmeter.x")] * 4  # three more until the port is there again

    person.on_prompt = lambda prompt: pulled(prompt) if "voltmeter.x" in prompt.text else None
    check_cables(given)
    first = given.findings[0]
    assert (first.state, "did not answer" in first.said) == (State.WORKS, True)
    assert first.figures[1].value == pytest.approx(6.0)  # three times two seconds
    assert given.findings[1].check == "cable plugged in again"
    # nobody pulled the other two: they went on answering
    others = [one.state for one in given.findings if one.instrument != "voltmeter.x"]
    assert others == [State.OTHER, State.WORKS] * 2


def test_an_instrument_that_does_not_come_back_is_told(clock, person):
    given = tonight(clock, person)
    x = given.instruments.voltmeters[0]
    person.on_prompt = lambda prompt: x.troubles.extend([lost("voltmeter.x")] * 100)
    check_cables(given)
    assert given.findings[0].state is State.COULD_NOT
    assert "did not respond again" in given.findings[0].said


def test_a_loss_that_is_told_late_is_slow(clock, person):
    given = tonight(clock, person)
    x = given.instruments.voltmeters[0]
    configure, pulled = x.configure, []

    def late(settings):
        if pulled:
            pulled.clear()
            clock.sleep(40.0)  # six times its timeout of 5 s are 30 s
            raise lost("voltmeter.x")
        configure(settings)

    x.configure = late
    person.on_prompt = lambda prompt: (
        pulled.append(1) if prompt.text.startswith("Pull the cable of voltmeter.x") else 0
    )
    check_cables(given)
    assert (given.findings[0].state, given.findings[0].figures[0].value) == (
        State.SLOWER,
        pytest.approx(40.0),
    )


def test_a_driver_that_breaks_on_a_loss_does_not_end_the_evening(clock, person):
    given = tonight(clock, person)
    x = given.instruments.voltmeters[0]
    person.on_prompt = lambda prompt: (
        x.troubles.append(RuntimeError("oh"))
        if prompt.text.startswith("Pull the cable of voltmeter.x")
        else None
    )
    check_cables(given)
    assert "RuntimeError" in given.findings[0].said
    assert len(given.findings) == 6


def test_heads_with_a_wire_are_looked_at_without_a_move(clock, person):
    head = Head("head", clock, (-0.1, 6.4))
    given = evening(person, clock, Instruments(meters(clock), head))
    check_cables(given)
    assert "head" in [one.instrument for one in given.findings]
    assert head.moved == []
