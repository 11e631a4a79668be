"""A client that asks a meter for hours of samples and leaves does not hold up the others."""

import socket

import pytest

from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1
from sim.bench import SimulatedBench
from sim.world.clock import ScaledClock
from sim.world.world import World, WorldSettings
from tests.sim.wires.test_server import BLOCK, IDENTITY, Client
from tests.support.simulated_stand import a_34401a

HOURS = b"CONF:VOLT:DC 10\nVOLT:DC:NPLC 100\nTRIG:COUN 1\nSAMP:COUN 5000\n"


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch):
    """The port of a meter on real time, of which a client that has left is told at once."""
    monkeypatch.setattr("sim.wires.session.LEAVING_S", 0.0)
    model = ForwardModel({"1": INSTALLATION_1})
    world = World(WorldSettings(BLOCK, model, {}, 5), ScaledClock())
    with SimulatedBench(world, {"voltmeter.x": a_34401a("x", noise=False)}) as bench:
        yield bench.servers["voltmeter.x"].port


@pytest.mark.parametrize("command", [b"READ?\n", b"INIT\n", b"INIT\nFETC?\n", b"READ?\nREAD?\nREAD?\n"])
def test_the_next_client_is_served_when_one_that_wanted_hours_has_left(port, command):
    with Client(port) as impatient:
        assert impatient.ask(b"*IDN?\n") == IDENTITY
        impatient.write(HOURS + command)
    with Client(port) as other:
        assert other.ask(b"*IDN?\n") == IDENTITY
        other.write(b"*CLS\nCONF:VOLT:DC 10\nVOLT:DC:NPLC 0.02\n")
        assert len(other.ask(b"READ?\n")) > 10


def test_one_that_has_left_long_ago_leaves_another_s_measurement_alone(port):
    with Client(port) as first, Client(port) as second:
        assert second.ask(b"*IDN?\n") == IDENTITY
        first.write(b"CONF:VOLT:DC 10\nVOLT:DC:NPLC 10\n")
        assert first.ask(b"*IDN?\n") == IDENTITY
        first.write(b"INIT\n")
        second.socket.close()
        assert float(first.ask(b"FETC?\n")) != 0.0


def test_one_that_only_sends_no_more_still_has_its_reply(port, monkeypatch):
    monkeypatch.setattr("sim.wires.session.LEAVING_S", 60.0)
    with Client(port) as client:
        client.write(b"CONF:VOLT:DC 10\nVOLT:DC:NPLC 1\nREAD?\n")
        client.socket.shutdown(socket.SHUT_WR)
        assert len(client.file.readline()) > 10
