"""The simulated Keithley 2000: what it is switched on with, its buffer, its waiting."""

import pytest

from sim.keithley_2000 import Keithley2000
from sim.world.world import World
from tests.support.simulated_stand import a_world, tell


@pytest.fixture
def world() -> World:
    return a_world(seed=5)


@pytest.fixture
def meter(world: World) -> Keithley2000:
    return Keithley2000(world.terminals("x"), world.clock, noise=False)


def test_switched_on_it_measures_by_itself_with_its_filter(meter: Keithley2000) -> None:
    assert tell(meter, ":INIT:CONT?;:VOLT:DC:AVER:STAT?") == "1;1"
    tell(meter, ":INIT")
    assert tell(meter, ":SYST:ERR?;ERR?") == '-213,"Init ignored";0,"No error"'
    tell(meter, "*RST")
    assert tell(meter, ":INIT:CONT?;:VOLT:DC:AVER:STAT?;:VOLT:DC:NPLC?") == "0;0;1.00"


def test_the_buffer_is_filled_once_and_whoever_does_not_wait_gets_nothing(
    meter: Keithley2000, world: World
) -> None:
    tell(meter, "*RST;:VOLT:RANG 10;NPLC 10;:SAMP:COUN 3;:TRAC:POIN 3;FEED:CONT NEXT;:INIT")
    began_s = world.clock.now_s()
    assert tell(meter, ":TRAC:DATA?") is None
    assert tell(meter, ":SYST:ERR?") == '-230,"Data corrupt or stale"'
    reply = tell(meter, "*WAI;:TRAC:DATA?") or ""
    assert [float(text) for text in reply.split(",")] == pytest.approx([world.signal_v("x")] * 3, abs=1e-8)
    assert world.clock.now_s() - began_s == pytest.approx(3 * 2 * 10 / 50.0, abs=0.01)
    world.turn(1.0, 1)
    tell(meter, ":INIT")
    assert tell(meter, "*WAI;:TRAC:DATA?") == reply


@pytest.mark.parametrize(
    ("message", "error"),
    [
        (":TRAC:POIN 1", -222),
        (":TRAC:POIN 1025", -222),
        (":SAMP:COUN 0", -222),
        (":VOLT:DC:NPLC 100", -222),
        (":VOLT:DC:RANG 2000", -222),
        (":TRAC:FEED:CONT NEXT;:TRAC:POIN 5", -221),
        (":FUNC 'RES'", -224),
        (":CONF:VOLT:DC 10", -113),
        (":READ?", -113),
    ],
)
def test_what_it_refuses(meter: Keithley2000, message: str, error: int) -> None:
    tell(meter, message)
    assert (tell(meter, "SYST:ERR?") or "").startswith(f"{error},")


@pytest.mark.parametrize(("stated", "taken"), [("0.05", 0.1), ("2.5", 10.0), ("10", 10.0), ("1010", 1000.0)])
def test_the_range_is_that_which_holds_the_signal(meter: Keithley2000, stated: str, taken: float) -> None:
    assert float(tell(meter, f":VOLT:DC:RANG {stated};RANG?") or "") == taken
    assert tell(meter, ":VOLT:DC:RANG:AUTO?") == "0"


def test_an_overflow_is_printed_short(meter: Keithley2000, world: World) -> None:
    tell(meter, "*RST;:VOLT:RANG 0.1;:SAMP:COUN 2;:TRAC:POIN 2;FEED:CONT NEXT;:INIT")
    assert abs(world.signal_v("x")) < 0.12
    assert "9.9E37" not in (tell(meter, "*WAI;:TRAC:DATA?") or "9.9E37")
    meter.overloaded = True
    tell(meter, ":TRAC:CLE;FEED:CONT NEXT;:INIT")
    assert tell(meter, "*WAI;:TRAC:DATA?") == "+9.9E37,+9.9E37"


@pytest.mark.parametrize("line_end", ["\n", "\r", "\r\n", "\n\r"])
def test_over_rs232_lines_end_as_it_is_set(world: World, line_end: str) -> None:
    meter = Keithley2000(world.terminals("x"), world.clock, interface="rs232", line_end=line_end)
    assert meter.line_ends.reply == line_end.encode()
    assert line_end.encode() in meter.line_ends.messages
    assert tell(meter, ":SYST:REM;:SYST:LOC;:SYST:ERR?") == '0,"No error"'
