"""The 34970A driver against the manual's text, as pairs of (sent, answered)."""

import re

import pytest

from drivers.instruments.keysight_34970a import Keysight34970A
from drivers.interfaces import BadReading, InstrumentRefused, LimitExceeded, Voltmeter, VoltmeterSettings
from tests.support.scripted_session import Pairs, ScriptedSession, swapped

TEN_VOLTS = VoltmeterSettings(range_v=10.0, nplc=10.0, samples=2)
LIST = "(@101,102,103)"

IDENTIFY: Pairs = [
    ("*IDN?", "HEWLETT-PACKARD,34970A,0,13-2-2"),
    ("*CLS", None),
    ("SYST:CTYP? 100", "HEWLETT-PACKARD,34901A,0,2.3"),
]
CONFIGURE: Pairs = [
    (f"CONF:VOLT:DC 10,DEF,{LIST}", None),
    (f"FUNC? {LIST}", '"VOLT","VOLT","VOLT"'),
    (f"VOLT:DC:RANG? {LIST}", "+1.00000000E+01,+1.00000000E+01,+1.00000000E+01"),
    (f"VOLT:DC:RANG:AUTO? {LIST}", "0,0,0"),
    (f"VOLT:DC:NPLC 10,{LIST}", None),
    (f"VOLT:DC:NPLC? {LIST}", "+1.00000000E+01,+1.00000000E+01,+1.00000000E+01"),
    (f"ZERO:AUTO ON,{LIST}", None),
    (f"ZERO:AUTO? {LIST}", "1,1,1"),
    (f"INP:IMP:AUTO ON,{LIST}", None),
    (f"INP:IMP:AUTO? {LIST}", "1,1,1"),
    (f"ROUT:CHAN:DEL 0.1,{LIST}", None),
    (f"ROUT:CHAN:DEL? {LIST}", "+1.00000000E-01,+1.00000000E-01,+1.00000000E-01"),
    (f"ROUT:SCAN {LIST}", None),
    ("ROUT:SCAN?", "#214(@101,102,103)"),
    ("FORM:READ:ALAR OFF", None),
    ("FORM:READ:ALAR?", "0"),
    ("FORM:READ:CHAN OFF", None),
    ("FORM:READ:CHAN?", "0"),
    ("FORM:READ:TIME OFF", None),
    ("FORM:READ:TIME?", "0"),
    ("FORM:READ:UNIT OFF", None),
    ("FORM:READ:UNIT?", "0"),
    ("TRIG:SOUR IMM", None),
    ("TRIG:SOUR?", "IMM"),
    ("TRIG:COUN 2", None),
    ("TRIG:COUN?", "+2.00000000E+00"),
    ("SYST:ERR?", '+0,"No error"'),
]
SIX = "+1.00000000E+00,+2.00000000E+00,+3.00000000E+00,+1.10000000E+00,+2.10000000E+00,-3.10000000E+00"
READ: Pairs = [
    ("INIT", None),
    ("FETC?", SIX),
    ("*ESR?", "+0"),
    *(
        (question, reply)
        for question, reply in CONFIGURE
        if question.startswith(("FUNC?", "VOLT:DC:RANG?", "VOLT:DC:NPLC?"))
    ),
]


XYZ = {"x": 101, "y": 102, "z": 103}


def meter(script: ScriptedSession, channels: object = XYZ, **options: object) -> Keysight34970A:
    return Keysight34970A("voltmeter", channels, script, script.clock, **options)  # type: ignore[arg-type]


def ready(*pairs: Pairs) -> tuple[Keysight34970A, ScriptedSession]:
    script = ScriptedSession(IDENTIFY, CONFIGURE, *pairs)
    m = meter(script)
    m.open()
    m.configure(TEN_VOLTS)
    return m, script


def test_a_whole_reading() -> None:
    m, script = ready(READ, READ)
    assert isinstance(m, Voltmeter)
    for _ in range(2):
        m.start()
        assert m.fetch() == {"x": (1.0, 1.1), "y": (2.0, 2.1), "z": (3.0, -3.1)}
    m.close()
    assert script.left == []


def test_signals_stand_in_the_order_of_the_channel_numbers_in_which_the_meter_scans() -> None:
    m = meter(ScriptedSession(), channels=[("x", 103), ("y", 101), ("z", 102)])
    assert m.channels == ("y", "z", "x")
    readings = "+1.00000000E+00,+2.00000000E+00,+3.00000000E+00"
    script = ScriptedSession(
        IDENTIFY,
        swapped(
            [(s.replace("TRIG:COUN 2", "TRIG:COUN 1"), a) for s, a in CONFIGURE],
            "TRIG:COUN?",
            "+1.00000000E+00",
        ),
        swapped(READ, "FETC?", readings),
    )
    m = meter(script, channels=[("x", 103), ("y", 101), ("z", 102)])
    m.open()
    m.configure(VoltmeterSettings(10.0, 10.0, 1))
    m.start()
    assert m.fetch() == {"y": (1.0,), "z": (2.0,), "x": (3.0,)}


@pytest.mark.parametrize(
    ("reply", "named"),
    [
        ("HEWLETT-PACKARD,0,0,0", "slot 100 of TCPIP::192.0.2.5::9888::SOCKET is empty, not a 34901A"),
        ("HEWLETT-PACKARD,34908A,0,2.3", "holds 'HEWLETT-PACKARD,34908A,0,2.3', not a 34901A"),
    ],
)
def test_the_card_in_the_slot_is_proved(reply: str, named: str) -> None:
    with pytest.raises(InstrumentRefused, match=re.escape(named)):
        meter(ScriptedSession(swapped(IDENTIFY, "SYST:CTYP? 100", reply))).open()


def test_every_slot_that_is_used_is_proved() -> None:
    script = ScriptedSession(IDENTIFY, [("SYST:CTYP? 300", "HEWLETT-PACKARD,34901A,0,2.3")])
    meter(script, channels={"x": 101, "y": 120, "z": 301}).open()
    assert script.left == []


@pytest.mark.parametrize(
    ("channels", "named"),
    [
        ({"x": 121, "y": 102, "z": 103}, "x on channel 121 (a 34901A has 101 to 120"),
        ({"x": 100}, "x on channel 100"),
        ({"x": 401}, "x on channel 401"),
        ({"x": 101, "y": 101}, "two signals on channel 101"),
        ([("x", 101), ("x", 102)], "x on two channels"),
        ({}, "a scan of no channel"),
    ],
)
def test_channels_are_validated(channels: object, named: str) -> None:
    with pytest.raises(LimitExceeded, match=re.escape(named)):
        meter(ScriptedSession(), channels=channels)


@pytest.mark.parametrize(("delay_s", "named"), [(60.5, "0 to 60 s"), (-1.0, "0 to 60 s"), (0.0005, "1 ms")])
def test_channel_delay_is_validated(delay_s: float, named: str) -> None:
    with pytest.raises(LimitExceeded, match=named):
        meter(ScriptedSession(), channel_delay_s=delay_s)


@pytest.mark.parametrize(
    ("command", "reply", "named"),
    [
        ("ROUT:SCAN?", "#210(@101,102)", "ROUT:SCAN? answers #210(@101,102), not #214(@101,102,103)"),
        (f"VOLT:DC:NPLC? {LIST}", "+1.00000000E+01,+1.00000000E+00,+1.00000000E+01", "not 10, 10, 10"),
        (f"INP:IMP:AUTO? {LIST}", "1,0,1", "not 1, 1, 1"),
        ("FORM:READ:TIME?", "1", "FORM:READ:TIME? answers 1, not 0"),
        ("TRIG:SOUR?", "TIM", "TRIG:SOUR? answers TIM, not IMM"),
    ],
)
def test_a_setting_that_was_not_taken_is_named(command: str, reply: str, named: str) -> None:
    script = ScriptedSession(swapped(CONFIGURE, command, reply))
    with pytest.raises(InstrumentRefused, match=re.escape(named)):
        meter(script).configure(TEN_VOLTS)
    assert script.left == []


@pytest.mark.parametrize(
    "reply",
    [
        "+1.00000000E+00,+2.00000000E+00,+3.00000000E+00",
        SIX + ",+1.00000000E+00",
        SIX.replace("+1.10000000E+00", "+1.10000000E+00 VDC"),
        SIX.replace("+1.10000000E+00", "+1.1E+00"),
    ],
)
def test_anything_but_all_readings_of_all_channels_is_no_reading(reply: str) -> None:
    m, _ = ready([("INIT", None), ("FETC?", reply)])
    m.start()
    with pytest.raises(BadReading):
        m.fetch()


def test_timeout_grows_with_the_scan() -> None:
    """Two scans of three channels: 0.1 s of delay, 10 cycles twice at 50 Hz, 30 ms around each."""
    m, script = ready(READ)
    m.start()
    m.fetch()
    assert script.timeouts_s["FETC?"] == pytest.approx(3.0 + 1.5 * 6 * (0.1 + 0.4 + 0.03))
