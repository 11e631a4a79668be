"""Other people's habits at the meter: what their scripts send is understood, and leaves no error."""

import socket

import pytest

from sim.bench import SimulatedBench
from sim.wires.session import Framer
from tests.support.patience import PATIENCE_S
from tests.support.simulated_stand import a_34401a, a_world, ask


@pytest.mark.parametrize(
    "lines",
    [
        b"MEAS:VOLT:DC?\n",
        b":MEAS:VOLT:DC?\n",
        b"MEASURE:VOLTAGE:DC?\n",
        b"measure:voltage?\r\n",
        b"  MEAS:VOLT:DC?  \n",
        b"MEAS:VOLT:DC? 10\n",
        b"MEAS:VOLT:DC? 10,0.003\n",
        b"MEAS:VOLT:DC? 10, 0.003\n",
        b"MEAS:VOLT:DC? DEF,DEF\n",
        b"MEAS:VOLT? DEF\n",
        b"meas:volt:dc? max,min\n",
        b"CONF:VOLT:DC 10,0.003\nREAD?\n",
        b"CONF:VOLT:DC 10, 0.003;:READ?\n",
        b"conf:volt:dc 10;:read?\n",
        b"CONF:VOLT:DC\nREAD?;\n",
        b"*RST\n*CLS\nREAD?\n",
        b"*RST;*CLS;:READ?\n",
        b"INIT\nFETC?\n",
        b"INIT;*OPC\nFETCH?\n",
        b"INIT:IMM\nfetc?\n",
        b"TRIG:SOUR BUS\nINIT\n*TRG\nFETC?\n",
        b"TRIG:SOUR BUS;:INIT;*TRG;:FETC?\n",
        b"SENS:FUNC 'VOLT:DC'\nREAD?\n",
        b'FUNC "VOLT"\nREAD?\n',
        b':SENSE:FUNCTION "VOLTAGE:DC"\nREAD?\n',
        b"VOLT:DC:NPLC MAX\nREAD?\n",
        b"VOLT:RANG:AUTO ON\nREAD?\n",
        b"DISP OFF\nREAD?\n",
        b"ZERO:AUTO ONCE\nREAD?\n",
        b"TRIG:DEL 10 MS\nREAD?\n",
        b"INP:IMP:AUTO ON;:READ?\n",
        b'DATA:FEED RDG_STORE,"CALC"\nINIT\nFETC?\n',
        b"CALC:FUNC AVER;STAT ON;:READ?\n",
    ],
)
def test_a_reading_in_other_peoples_words(lines: bytes) -> None:
    world = a_world()
    meter, framer = a_34401a("x").on(world), Framer()
    framer.feed(lines)
    (reading,) = filter(None, [meter.handle(message) for message in iter(framer.take, None)])
    assert len(reading) == 15
    assert float(reading) == pytest.approx(world.signal_v("x"), abs=1.5e-3)
    assert ask(meter, "SYST:ERR?") == '+0,"No error"'


def test_a_client_that_polls_for_the_end_with_the_status_byte() -> None:
    """The manual's own way to learn of the end: *OPC, *ESE 1, *SRE 32, and the status byte."""
    with (
        SimulatedBench(a_world(), {"v": a_34401a("x")}) as bench,
        socket.create_connection(("127.0.0.1", bench.servers["v"].port), timeout=PATIENCE_S) as client,
        client.makefile("rb") as lines,
    ):
        client.sendall(b"*CLS;*ESE 1;*SRE 32\nSAMP:COUN 5;:INIT;*OPC\n*STB?\n*ESR?\nFETC?\n")
        assert [lines.readline() for _ in range(2)] == [b"+96\n", b"+1\n"]
        assert lines.readline().count(b",") == 4
