"""The simulated 34461A in its own identity, and its driver on it over a socket."""

import numpy as np
import pytest

from bench.model import Block, ForwardModel
from bench.model.geometry import INSTALLATION_1
from drivers.instruments.keysight_34461a import Keysight34461A as Driver
from drivers.interfaces import VoltmeterSettings
from drivers.wire.visa import MessageSession
from sim.bench import SimulatedBench
from sim.keysight_34461a import Keysight34461A
from sim.world.clock import VirtualClock
from sim.world.world import World, WorldSettings


@pytest.fixture
def world() -> World:
    block = Block(np.diag([-2.1, -2.2, -2.3]), np.array([0.1, 0.2, 0.3]))
    return World(WorldSettings(block, ForwardModel({"1": INSTALLATION_1}), {}, seed=5), VirtualClock())


@pytest.fixture
def meter(world: World) -> Keysight34461A:
    return Keysight34461A(world.terminals("x"), world.clock, noise=False)


def say(meter: Keysight34461A, message: str) -> str | None:
    reply = meter.handle(message.encode())
    return None if reply is None else reply.decode()


def test_identity_and_the_older_one_on_demand(meter: Keysight34461A) -> None:
    assert (say(meter, "*IDN?") or "").startswith("Keysight Technologies,34461A,MY")
    say(meter, "SYST:IDEN HP34401A")
    assert say(meter, "*IDN?;:SYST:IDEN?") == "HEWLETT-PACKARD,34401A,0,11-5-2;HP34401A"
    say(meter, "SYST:IDEN DEF")
    assert (say(meter, "*IDN?") or "").startswith("Keysight Technologies,34461A,MY")


def test_autozero_and_impedance_stand_under_the_function_and_where_they_were(meter: Keysight34461A) -> None:
    say(meter, "CONF:VOLT:DC 10;:VOLT:DC:ZERO:AUTO OFF;:VOLT:IMP:AUTO ON")
    assert say(meter, "VOLT:ZERO:AUTO?;:VOLT:IMP:AUTO?;:ZERO:AUTO?;:INP:IMP:AUTO?") == "0;1;0;1"
    assert say(meter, "SYST:ERR?") == '+0,"No error"'


def test_memory_keeps_the_latest_10_000_readings(meter: Keysight34461A) -> None:
    say(meter, "CONF:VOLT:DC 10;:VOLT:NPLC 0.02;:SAMP:COUN 10500;:INIT")
    assert say(meter, "DATA:POIN?") == "+10000"
    assert say(meter, "SAMP:COUN? MAX") == "+1000000"
    assert say(meter, "SYST:ERR?") == '+0,"No error"'


def test_readings_of_read_are_kept(meter: Keysight34461A) -> None:
    reply = say(meter, "CONF:VOLT:DC 10;:READ?")
    assert reply is not None
    assert say(meter, "FETC?") == reply


@pytest.mark.parametrize("identity", ["DEF", "HP34401A"])
def test_the_driver_reads_it_in_either_identity(world: World, meter: Keysight34461A, identity: str) -> None:
    say(meter, f"SYST:IDEN {identity}")
    with SimulatedBench(world, {"voltmeter.x": meter}) as bench:
        session = MessageSession("voltmeter.x", bench.resources["voltmeter.x"], timeout_s=5.0)
        driver = Driver("voltmeter.x", "x", session, world.clock)
        try:
            driver.open()
            driver.configure(VoltmeterSettings(10.0, 10.0, 3))
            driver.start()
            assert driver.fetch() == {"x": pytest.approx([world.signal_v("x")] * 3, abs=1e-8)}
        finally:
            driver.close()
    assert (meter.configuration.autozero, meter.configuration.high_impedance) == (True, True)
