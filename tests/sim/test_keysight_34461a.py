"""The simulated 34461A in its own identity, and its driver on it over a socket."""

import pytest

from sim.keysight_34461a import Keysight34461A
from sim.world.world import World
from tests.support.simulated_stand import a_world, tell


@pytest.fixture
def world() -> World:
    return a_world(seed=5)


@pytest.fixture
def meter(world: World) -> Keysight34461A:
    return Keysight34461A(world.terminals("x"), world.clock, noise=False)


def test_identity_and_the_older_one_on_demand(meter: Keysight34461A) -> None:
    assert (tell(meter, "*IDN?") or "").startswith("Keysight Technologies,34461A,MY")
    tell(meter, "SYST:IDEN HP34401A")
    assert tell(meter, "*IDN?;:SYST:IDEN?") == "HEWLETT-PACKARD,34401A,0,11-5-2;HP34401A"
    tell(meter, "SYST:IDEN DEF")
    assert (tell(meter, "*IDN?") or "").startswith("Keysight Technologies,34461A,MY")


def test_autozero_and_impedance_stand_under_the_function_and_where_they_were(meter: Keysight34461A) -> None:
    tell(meter, "CONF:VOLT:DC 10;:VOLT:DC:ZERO:AUTO OFF;:VOLT:IMP:AUTO ON")
    assert tell(meter, "VOLT:ZERO:AUTO?;:VOLT:IMP:AUTO?;:ZERO:AUTO?;:INP:IMP:AUTO?") == "0;1;0;1"
    assert tell(meter, "SYST:ERR?") == '+0,"No error"'


def test_memory_keeps_the_latest_10_000_readings(meter: Keysight34461A) -> None:
    tell(meter, "CONF:VOLT:DC 10;:VOLT:NPLC 0.02;:SAMP:COUN 10500;:INIT")
    assert tell(meter, "DATA:POIN?") == "+10000"
    assert tell(meter, "SAMP:COUN? MAX") == "+1000000"
    assert tell(meter, "SYST:ERR?") == '+0,"No error"'


def test_readings_of_read_are_kept(meter: Keysight34461A) -> None:
    reply = tell(meter, "CONF:VOLT:DC 10;:READ?")
    assert reply is not None
    assert tell(meter, "FETC?") == reply
