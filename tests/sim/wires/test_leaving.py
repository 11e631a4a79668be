"""A client that asks a meter for hours of samples and leaves does not hold up the others."""

import socket
import threading

import pytest

from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1
from sim import voltmeters as line
from sim.bench import SimulatedBench, SimulatedMeter
from sim.keithley_2000 import Keithley2000
from sim.world.clock import ScaledClock
from sim.world.world import World, WorldSettings
from tests.sim.wires.test_server import BLOCK, IDENTITY, Client
from tests.support.patience import PATIENCE_S
from tests.support.simulated_stand import a_34401a

HOURS = b"CONF:VOLT:DC 10\nVOLT:DC:NPLC 100\nTRIG:DEL 60\nSAMP:COUN 500\n*IDN?\n"
"""As many as the memory takes. Answered, so that what another client sets next comes after it."""


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch):
    """The ports of meters on real time, which are told at once of a client that has left."""
    monkeypatch.setattr("sim.wires.session.LEAVING_S", 0.0)
    model = ForwardModel({"1": INSTALLATION_1})
    world = World(WorldSettings(BLOCK, model, {}, 5), ScaledClock())
    meters = {"34401A": a_34401a("x", noise=False), "2000": SimulatedMeter(Keithley2000, "x")}
    with SimulatedBench(world, meters) as bench:
        yield {model: server.port for model, server in bench.servers.items()}


@pytest.fixture
def port(ports):
    return ports["34401A"]


@pytest.fixture
def waited_for(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Is set as soon as a message waits for a measurement."""
    waits, wait_until = threading.Event(), line.wait_until

    def seen(*given):
        waits.set()
        return wait_until(*given)

    monkeypatch.setattr(line, "wait_until", seen)
    return waits


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Is set as soon as a measurement is under way."""
    begins, measures_until = threading.Event(), line.MeasuringCycle._measures_until

    def seen(*given):
        measures_until(*given)
        begins.set()

    monkeypatch.setattr(line.MeasuringCycle, "_measures_until", seen)
    return begins


@pytest.mark.parametrize("command", [b"READ?\n", b"INIT\n", b"INIT\nFETC?\n", b"READ?\nREAD?\nREAD?\n"])
def test_the_next_client_is_served_when_one_that_wanted_hours_has_left(port, command):
    with Client(port) as impatient:
        assert impatient.ask(HOURS) == IDENTITY
        impatient.write(command)
    with Client(port) as other:
        assert other.ask(b"*IDN?\n") == IDENTITY
        other.write(b"*CLS\nCONF:VOLT:DC 10\nVOLT:DC:NPLC 0.02\n")
        assert len(other.ask(b"READ?\n")) > 10


@pytest.mark.parametrize("last_words", [b"", b"FETC?\n", b"*CLS\nREAD?\n"])
def test_one_that_waits_already_is_served_when_who_wanted_hours_leaves(port, begun, waited_for, last_words):
    with Client(port) as impatient, Client(port) as other:
        assert impatient.ask(HOURS) == IDENTITY
        impatient.write(b"INIT\n")
        assert begun.wait(PATIENCE_S)
        other.write(b"*IDN?\n")
        assert waited_for.wait(PATIENCE_S)
        impatient.write(last_words)
        impatient.file.close()
        impatient.socket.close()
        assert other.file.readline() == IDENTITY


def test_one_that_waits_for_a_2000_is_served_as_well(ports, begun, waited_for):
    with Client(ports["2000"]) as impatient, Client(ports["2000"]) as other:
        impatient.write(b":INIT:CONT OFF\n:VOLT:DC:NPLC 10\n:SAMP:COUN 1024\n:TRIG:COUN 20\n:INIT\n")
        assert begun.wait(PATIENCE_S)
        other.write(b"*OPC?\n")
        assert waited_for.wait(PATIENCE_S)
        impatient.file.close()
        impatient.socket.close()
        assert other.file.readline() == b"1\n"


def test_one_that_has_left_does_not_take_what_another_began_after_it(port, waited_for):
    with Client(port) as impatient, Client(port) as other:
        assert impatient.ask(b"CONF:VOLT:DC 10\nVOLT:DC:NPLC 0.02\n*IDN?\n") == IDENTITY
        impatient.write(b"INIT\n")
        assert impatient.ask(b"*IDN?\n") == IDENTITY
        waited_for.clear()
        other.write(b"VOLT:DC:NPLC 10\nREAD?\n")
        assert waited_for.wait(PATIENCE_S)
        impatient.file.close()
        impatient.socket.close()
        assert len(other.file.readline()) > 10


def test_one_that_has_left_long_ago_leaves_another_s_measurement_alone(port):
    with Client(port) as first, Client(port) as second:
        assert second.ask(b"*IDN?\n") == IDENTITY
        first.write(b"CONF:VOLT:DC 10\nVOLT:DC:NPLC 10\n")
        assert first.ask(b"*IDN?\n") == IDENTITY
        first.write(b"INIT\n")
        second.file.close()
        second.socket.close()
        assert float(first.ask(b"FETC?\n")) != 0.0


def test_one_that_only_sends_no_more_still_has_its_reply(port, monkeypatch):
    monkeypatch.setattr("sim.wires.session.LEAVING_S", 60.0)
    with Client(port) as client:
        client.write(b"CONF:VOLT:DC 10\nVOLT:DC:NPLC 1\nREAD?\n")
        client.socket.shutdown(socket.SHUT_WR)
        assert len(client.file.readline()) > 10
