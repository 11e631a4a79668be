"""Other people's habits on the served meter: what their scripts send is understood, and leaves no error."""

import socket
from collections.abc import Iterator

import numpy as np
import pytest
import pyvisa

from sim.bench import SimulatedBench
from tests.support.patience import PATIENCE_S
from tests.support.simulated_stand import a_34401a, a_world


@pytest.fixture
def bench() -> Iterator[SimulatedBench]:
    with SimulatedBench(a_world(), {"v": a_34401a("x")}) as served:
        yield served


class Client:
    """A raw socket."""

    def __init__(self, bench: SimulatedBench) -> None:
        self.socket = socket.create_connection(("127.0.0.1", bench.servers["v"].port), timeout=PATIENCE_S)
        self.lines = self.socket.makefile("rb")

    def ask(self, message: bytes) -> bytes:
        self.socket.sendall(message)
        return self.lines.readline().removesuffix(b"\n")

    def close(self) -> None:
        self.lines.close()
        self.socket.close()


@pytest.fixture
def client(bench: SimulatedBench) -> Iterator[Client]:
    made = Client(bench)
    yield made
    made.close()


@pytest.mark.parametrize(
    "message",
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
def test_a_reading_in_other_peoples_words(bench: SimulatedBench, client: Client, message: bytes) -> None:
    reading = client.ask(message)
    assert len(reading) == 15
    assert float(reading) == pytest.approx(bench.world.signal_v("x"), abs=1.5e-3)
    assert client.ask(b"SYST:ERR?\n") == b'+0,"No error"'


@pytest.mark.parametrize(
    ("message", "reply"),
    [
        (b"*IDN?;*OPC?\n", b"HEWLETT-PACKARD,34401A,0,11-5-2;1"),
        (b":SENS:VOLT:DC:RANG?\n", b"+1.000000E+01"),
        (b"SENS:VOLT:RANG 10;RANG?\n", b"+1.000000E+01"),
        (b"VOLT:RANG:AUTO?\n", b"1"),
        (b"sense:voltage:dc:range?\n", b"+1.000000E+01"),
        (b"VOLT:NPLC?;:VOLT:NPLC? MIN;:VOLT:NPLC? MAX\n", b"+1.000000E+01;+2.000000E-02;+1.000000E+02"),
        (b"VOLT:NPLC 5;NPLC?\n", b"+1.000000E+01"),
        (b"CONF?\n", b'"VOLT +1.000000E+01,+1.000000E-05"'),
        (b"CONF:VOLT:DC 10,0.003;:CONF?\n", b'"VOLT +1.000000E+01,+1.000000E-03"'),
        (b"FUNC?\n", b'"VOLT"'),
        (b"TRIG:COUN INF;:TRIG:COUN?\n", b"9.90000000E+37"),
        (b"SAMP:COUN 10;COUN?\n", b"+10"),
        (b"ROUT:TERM?\n", b"FRON"),
        (b"SYST:VERS?\n", b"1994.0"),
        (b"DISP:TEXT 'it''s 12 and more';TEXT?\n", b'"it\'s 12 and "'),
        (b"*ESE 60;*ESE?\n", b"+60"),
        (b"*OPC?\r\n", b"1"),
        (b"\n\r\n  \n*OPC?\n", b"1"),
        (b"DATA:POIN?\n", b"+0"),
    ],
)
def test_replies_in_the_manuals_form(client: Client, message: bytes, reply: bytes) -> None:
    assert client.ask(message) == reply
    assert client.ask(b"SYST:ERR?\n") == b'+0,"No error"'


@pytest.mark.parametrize(
    ("message", "error"),
    [
        (b"VOLTAG:DC:RANG 10\n", b'-113,"Undefined header"'),
        (b"CONF:VOLT:DC DEF,0.1\n", b'-221,"Settings conflict"'),
        (b"CONF:VOLT:DC 10,1E-9\n", b'+532,"Cannot achieve requested resolution"'),
        (b"CONF:VOLT:DC 2000\n", b'-222,"Data out of range"'),
        (b"FETC?\n", b'-230,"Data stale"'),
        (b"ABOR\n", b'-113,"Undefined header"'),
        (b"TRIG:SOUR BUS;:READ?\n", b'-214,"Trigger deadlock"'),
    ],
)
def test_what_the_meter_refuses_others_too(client: Client, message: bytes, error: bytes) -> None:
    client.socket.sendall(message)
    assert client.ask(b"SYST:ERR?\n") == error
    assert client.ask(b"SYST:ERR?\n") == b'+0,"No error"'


def test_a_client_that_polls_for_the_end_with_the_status_byte(client: Client) -> None:
    """The manual's own way to learn of the end: *OPC, *ESE 1, *SRE 32, and the status byte."""
    client.socket.sendall(b"*CLS;*ESE 1;*SRE 32\nSAMP:COUN 5;:INIT;*OPC\n")
    assert client.ask(b"*STB?\n") == b"+96"
    assert client.ask(b"*ESR?\n") == b"+1"
    assert client.ask(b"FETC?\n").count(b",") == 4


def test_a_client_that_closes_its_sending_side_still_gets_its_reply(bench: SimulatedBench) -> None:
    """As `echo 'READ?' | nc host port` does."""
    with socket.create_connection(("127.0.0.1", bench.servers["v"].port), timeout=PATIENCE_S) as client:
        client.sendall(b"READ?\n")
        client.shutdown(socket.SHUT_WR)
        with client.makefile("rb") as lines:
            assert len(lines.read()) == 16


def test_pyvisa_scripts(bench: SimulatedBench) -> None:
    visa = pyvisa.ResourceManager("@py").open_resource(bench.resources["v"])
    assert isinstance(visa, pyvisa.resources.MessageBasedResource)
    visa.read_termination = "\n"
    visa.timeout = int(1000 * PATIENCE_S)
    assert visa.query("*IDN?").split(",")[1] == "34401A"
    visa.write("*RST")
    visa.write("CONF:VOLT:DC 10,0.003")
    visa.write("TRIG:COUN 3;:SAMP:COUN 2")
    assert len(visa.query_ascii_values("READ?")) == 6
    assert len(visa.query_ascii_values("READ?", container=np.array)) == 6
    visa.write("VOLT:DC:NPLC 0.02;")
    assert float(visa.query("VOLT:NPLC?")) == 0.02
    visa.clear()
    assert visa.query("SYST:ERR?") == '+0,"No error"'
    visa.close()
