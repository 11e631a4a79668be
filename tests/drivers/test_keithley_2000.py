"""The Keithley 2000's driver against the manual's text, as pairs of (sent, answered)."""

import pytest

from drivers.instruments.keithley_2000 import Keithley2000
from drivers.interfaces import BadReading, Identity, InstrumentRefused, Voltmeter, VoltmeterSettings
from tests.support.scripted_session import Pairs, ScriptedSession

OPENING: Pairs = [("*IDN?", "KEITHLEY INSTRUMENTS INC.,MODEL 2000,1308393,A20  /A02"), ("*CLS", None)]
SETTINGS = VoltmeterSettings(range_v=10.0, nplc=0.1, samples=2)
SETUP: Pairs = [
    ("INIT:CONT OFF;:ABOR", None), ("INIT:CONT?", "0"),
    ("FUNC 'VOLT:DC'", None), ("FUNC?", '"VOLT:DC"'),
    ("VOLT:DC:RANG 10", None), ("VOLT:DC:RANG?", "10"), ("VOLT:DC:RANG:AUTO?", "0"),
    ("VOLT:DC:NPLC 0.1", None), ("VOLT:DC:NPLC?", "0.10"),
    ("VOLT:DC:AVER:STAT OFF", None), ("VOLT:DC:AVER:STAT?", "0"),
    ("VOLT:DC:REF:STAT OFF", None), ("VOLT:DC:REF:STAT?", "0"),
    ("SYST:AZER:STAT ON", None), ("SYST:AZER:STAT?", "1"),
    ("FORM:DATA ASC", None), ("FORM:DATA?", "ASC"),
    ("FORM:ELEM READ", None), ("FORM:ELEM?", "READ"),
    ("TRIG:SOUR IMM", None), ("TRIG:SOUR?", "IMM"),
    ("TRIG:DEL:AUTO ON", None), ("TRIG:DEL:AUTO?", "1"),
    ("TRIG:COUN 1", None), ("TRIG:COUN?", "1"),
    ("SAMP:COUN 2", None), ("SAMP:COUN?", "2"),
    ("TRAC:FEED:CONT NEV;:TRAC:FEED SENS;:TRAC:POIN 2", None), ("TRAC:POIN?", "2"),
    ("SYST:ERR?", '0,"No error"'),
]  # fmt: skip
START: Pairs = [("TRAC:CLE;:TRAC:FEED:CONT NEXT;:INIT", None)]


def fetched(*replies: tuple[str, str | None]) -> dict[str, tuple[float, ...]]:
    session = ScriptedSession(OPENING, SETUP, START, replies)
    meter = Keithley2000("voltmeter.x", "x", session, session.clock)  # type: ignore[arg-type]
    assert isinstance(meter, Voltmeter)
    assert meter.open() == Identity("KEITHLEY INSTRUMENTS INC.", "MODEL 2000", "1308393", "A20  /A02")
    meter.configure(SETTINGS)
    meter.start()
    values = meter.fetch()
    assert session.left == []
    return dict(values)


def test_a_reading_comes_out_of_the_buffer_when_it_is_full() -> None:
    reply = "+1.23456789E-03,-1.23456700E-03"
    proven = [one for one in SETUP if one[0] in {"FUNC?", "VOLT:DC:RANG?", "VOLT:DC:NPLC?"}]
    assert fetched(("*WAI;:TRAC:DATA?", reply), ("*ESR?", "0"), *proven) == {
        "x": (1.23456789e-3, -1.234567e-3)
    }


@pytest.mark.parametrize(
    "reply",
    [
        "+1.23456789E-03",
        "+1.23456789E-03,-1.23456700E-0",
        "+1.23456789E-03,-1.23456700",
        "+1.23456789E-03VDC,+0.123SECS",
        "+1.23456789E-03,+9.9E3",
        "+1.23456789E-03,-1.23456700E-03,-1.23456700E-03",
    ],
)
def test_what_is_not_two_whole_readings_is_none(reply: str) -> None:
    with pytest.raises(BadReading):
        fetched(("*WAI;:TRAC:DATA?", reply))


def test_a_digit_that_was_lost_on_the_wire_is_noticed() -> None:
    proven = [one for one in SETUP if one[0] in {"FUNC?", "VOLT:DC:RANG?", "VOLT:DC:NPLC?"}]
    with pytest.raises(BadReading, match=r"the reading 1\.3456700E-03 is shorter than 1\.23456789E-03"):
        fetched(("*WAI;:TRAC:DATA?", "+1.23456789E-03,-1.3456700E-03"), ("*ESR?", "0"), *proven)


def test_a_filter_that_stays_on_is_noticed() -> None:
    answered = [
        (sent, "1") if sent == "VOLT:DC:AVER:STAT?" else (sent, reply) for sent, reply in (*OPENING, *SETUP)
    ]
    session = ScriptedSession(answered)
    meter = Keithley2000("voltmeter.x", "x", session, session.clock)  # type: ignore[arg-type]
    meter.open()
    with pytest.raises(InstrumentRefused, match=r"VOLT:DC:AVER:STAT\? answers 1, not 0"):
        meter.configure(SETTINGS)
