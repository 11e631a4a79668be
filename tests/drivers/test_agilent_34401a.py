"""The 34401A driver against the manual's text, as pairs of (sent, answered)."""

import re

import pytest

from drivers.instruments.agilent_34401a import Agilent34401A
from drivers.interfaces import BadReading, Identity, InstrumentRefused, VoltmeterSettings
from drivers.wire.visa import SerialSettings
from tests.support.scripted_session import Clock, Pairs, ScriptedSession, swapped, until

NAME = "voltmeter.y"
TEN_VOLTS = VoltmeterSettings(range_v=10.0, nplc=10.0, samples=2)

IDENTIFY: Pairs = [("*IDN?", "HEWLETT-PACKARD,34401A,0,11-5-2"), ("*CLS", None)]
CONFIGURE: Pairs = [
    ("CONF:VOLT:DC 10", None),
    ("FUNC?", '"VOLT"'),
    ("VOLT:DC:RANG?", "+1.000000E+01"),
    ("VOLT:DC:RANG:AUTO?", "0"),
    ("VOLT:DC:NPLC 10", None),
    ("VOLT:DC:NPLC?", "+1.000000E+01"),
    ("ZERO:AUTO ON", None),
    ("ZERO:AUTO?", "1"),
    ("INP:IMP:AUTO ON", None),
    ("INP:IMP:AUTO?", "1"),
    ("TRIG:SOUR IMM", None),
    ("TRIG:SOUR?", "IMM"),
    ("TRIG:COUN 1", None),
    ("TRIG:COUN?", "+1"),
    ("SAMP:COUN 2", None),
    ("SAMP:COUN?", "+2.00000000E+00"),
    ("SYST:ERR?", '+0,"No error"'),
]
PROVEN: Pairs = [
    ("FUNC?", '"VOLT"'), ("VOLT:DC:RANG?", "+1.000000E+01"), ("VOLT:DC:NPLC?", "+1.000000E+01"),
]  # fmt: skip
READ: Pairs = [("INIT", None), ("FETC?", "+1.52345670E+00,-1.00000000E-04"), ("*ESR?", "+0"), *PROVEN]


def meter(script: ScriptedSession, clock: Clock | None = None, interface: str = "lan") -> Agilent34401A:
    return Agilent34401A(NAME, "y", script, clock or Clock(), interface=interface)  # type: ignore[arg-type]


def test_a_whole_reading() -> None:
    script = ScriptedSession(IDENTIFY, CONFIGURE, READ, READ)
    m = meter(script)
    assert m.open() == Identity("HEWLETT-PACKARD", "34401A", "", "11-5-2")
    m.configure(TEN_VOLTS)
    for _ in range(2):
        m.start()
        assert m.fetch() == {"y": (1.5234567, -1e-4)}
    m.close()
    m.close()
    assert script.left == []


# --- settings ---------------------------------------------------------------------------------------


def test_all_settings_that_were_not_taken_are_named_at_once() -> None:
    pairs = swapped(swapped(CONFIGURE, "VOLT:DC:NPLC?", "+1.000000E+02"), "INP:IMP:AUTO?", "0")
    pairs = [*pairs[:-1], ("SYST:ERR?", '-221,"Settings conflict"'), ("SYST:ERR?", '+0,"No error"')]
    script = ScriptedSession(pairs)
    with pytest.raises(InstrumentRefused) as caught:
        meter(script).configure(TEN_VOLTS)
    text = str(caught.value)
    assert "VOLT:DC:NPLC? answers +1.000000E+02, not 10" in text
    assert "INP:IMP:AUTO? answers 0, not 1" in text
    assert '-221,"Settings conflict"' in text
    assert script.left == []


def test_an_error_queue_that_never_empties_is_given_up() -> None:
    script = ScriptedSession([*CONFIGURE[:-1], *[("SYST:ERR?", '-350,"Too many errors"')] * 21])
    with pytest.raises(InstrumentRefused, match="-350"):
        meter(script).configure(TEN_VOLTS)


# --- readings ---------------------------------------------------------------------------------------


def ready(*pairs: Pairs, interface: str = "lan") -> tuple[Agilent34401A, ScriptedSession]:
    script = ScriptedSession(IDENTIFY, CONFIGURE, *pairs)
    m = meter(script)
    m.open()
    m.configure(TEN_VOLTS)
    return m, script


def test_a_trailing_comma_is_let_pass() -> None:
    m, _ = ready(swapped(READ, "FETC?", "+1.00000000E+00,+0.00000000E-05,"))
    m.start()
    assert m.fetch() == {"y": (1.0, 0.0)}


@pytest.mark.parametrize(
    "reply",
    [
        "+1.00000000E+00",
        "+1.00000000E+00,+1.00000000E+00,+1.00000000E+00",
        "+1.00000000E+00,56789E+00",
        "1.0,1.0",
        "+1.00000000E+00,+1.0000000E+00",
        "+1.00000000E+00 +1.00000000E+00",
        "+1.00000000E+00,,+1.00000000E+00",
    ],
)
def test_anything_but_the_15_characters_times_the_samples_is_no_reading(reply: str) -> None:
    m, _ = ready([("INIT", None), ("FETC?", reply)])
    m.start()
    with pytest.raises(BadReading):
        m.fetch()


@pytest.mark.parametrize("value", ["+9.90000000E+37", "-9.90000000E+37"])
def test_overload_names_channel_range_and_remedy(value: str) -> None:
    m, _ = ready(
        [
            ("INIT", None),
            ("FETC?", f"+1.00000000E+00,{value}"),
            ("*ESR?", "+8"),
            ("SYST:ERR?", '+0,"No error"'),
            *PROVEN,
        ]
    )
    m.start()
    with pytest.raises(BadReading, match="channel y overloads the 10 V range; choose a higher range"):
        m.fetch()


def test_timeout_grows_with_samples_and_integration() -> None:
    """Two samples of 10 cycles at 50 Hz, twice for autozero, take 0.8 s and some overhead."""
    m, script = ready(READ)
    assert m.reading_time_s(TEN_VOLTS) == pytest.approx(0.82)
    m.start()
    m.fetch()
    allowed_s = script.timeouts_s["FETC?"]
    assert allowed_s is not None
    assert allowed_s == pytest.approx(ScriptedSession.timeout_s + 1.5 * 0.82)
    assert m.reading_time_s(VoltmeterSettings(10.0, 100.0, 512)) > 512 * 4.0


def test_reading_time_includes_a_slow_line() -> None:
    """512 readings of 16 characters at 11 bits and 9600 baud take 9.4 s to send."""
    settings = VoltmeterSettings(10.0, 0.02, 512)
    m, _ = ready(READ)
    line_s = m.reading_time_s(settings, SerialSettings().character_time_s) - m.reading_time_s(settings)
    assert line_s == pytest.approx(9.39, abs=0.01)


# --- lost and found ---------------------------------------------------------------------------------


def test_a_new_connection_proves_identity_and_settings_before_the_next_reading() -> None:
    m, script = ready([("INIT", None)], IDENTIFY, CONFIGURE, READ)
    m.start()
    script.connection = None
    with pytest.raises(BadReading, match="no reading was started over this connection"):
        m.fetch()
    m.start()
    assert m.fetch() == {"y": (1.5234567, -1e-4)}
    assert script.left == []


def test_errors_that_come_with_a_reading_are_reported() -> None:
    m, _ = ready(
        swapped(until(READ, "*ESR?"), "*ESR?", "+16"),
        [("SYST:ERR?", '-213,"Init ignored"'), ("SYST:ERR?", '+0,"No error"')],
    )
    m.start()
    with pytest.raises(InstrumentRefused, match="Init ignored"):
        m.fetch()


@pytest.mark.parametrize(
    ("question", "reply"),
    [("FUNC?", '"VOLT:AC"'), ("VOLT:DC:RANG?", "+1.000000E+02"), ("VOLT:DC:NPLC?", "+2.000000E-02")],
)
def test_a_reading_with_settings_of_somebody_else_is_refused_and_the_next_one_sets_them(
    question: str, reply: str
) -> None:
    m, script = ready(swapped(READ, question, reply), IDENTIFY, CONFIGURE, READ)
    m.start()
    with pytest.raises(InstrumentRefused, match=re.escape(f"{question} answers {reply}, not")):
        m.fetch()
    m.start()
    assert m.fetch() == {"y": (1.5234567, -1e-4)}
    assert script.left == []


# --- RS-232 -----------------------------------------------------------------------------------------

REMOTE: Pairs = [("SYST:REM", None)]
LOCAL: Pairs = [("SYST:LOC", None)]


def test_rs232_is_made_remote_first_and_local_last() -> None:
    script = ScriptedSession(REMOTE, IDENTIFY, REMOTE, CONFIGURE, READ, LOCAL)
    m = meter(script, interface="rs232")
    m.open()
    m.configure(TEN_VOLTS)
    m.start()
    m.fetch()
    assert script.timeouts_s["FETC?"] == pytest.approx(3.0 + 1.5 * (0.82 + 2 * 16 * 11 / 9600))
    m.close()
    m.close()
    assert script.left == []


def test_rs232_meter_left_alone_is_made_remote_again() -> None:
    clock = Clock()
    script = ScriptedSession(REMOTE, IDENTIFY, REMOTE, CONFIGURE, READ, REMOTE, READ)
    m = meter(script, clock, interface="rs232")
    m.open()
    m.configure(TEN_VOLTS)
    m.start()
    m.fetch()
    clock.sleep(3600.0)
    m.start()
    m.fetch()
    assert script.left == []
