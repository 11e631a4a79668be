"""The SCPI base with the words of another make: trigger, readings, errors, identity are the make's to state."""

from __future__ import annotations

import pytest

from drivers.interfaces import BadReading, InstrumentRefused, VoltmeterLimits, VoltmeterSettings
from drivers.scpi_voltmeter import ProvenSetting, ScpiVoltmeter
from tests.support.scripted_session import ScriptedSession

SETTINGS = VoltmeterSettings(10.0, 1.0, 2)


class OtherMake(ScpiVoltmeter):
    """A made-up meter: seven digits, blanks in its identity, a trace buffer, a status queue."""

    makers = r"VOLTWERKE GMBH"
    models = ("MODEL 7",)
    called = "a Model 7"
    start_command = ":TRAC:FEED:CONT NEXT;:INIT"
    fetch_query = ":TRAC:DATA?"
    reading = r"[+-]\d\.\d{6}E[+-]\d\d"
    reading_example = "+1.234567E+00"
    reading_characters = 14
    overload_v = 9e36
    error_query = ":STAT:QUE?"
    remote_command = ""
    local_command = ""
    limits = VoltmeterLimits((10.0,), (1.0,), 1024, 2)  # type: ignore[assignment]

    def _setup(self, settings: VoltmeterSettings) -> list[ProvenSetting]:
        return [ProvenSetting(f":TRAC:POIN {settings.samples}", ":TRAC:POIN?", float(settings.samples))]


OPEN = [("*IDN?", "VOLTWERKE GMBH,MODEL 7,0815,A01"), ("*CLS", None)]
SET = [(":TRAC:POIN 2", None), (":TRAC:POIN?", "2"), (":STAT:QUE?", '0,"No error"')]
START = [(":TRAC:FEED:CONT NEXT;:INIT", None)]


def meter(session, interface="rs232"):
    return OtherMake("voltmeter.x", ("x",), session, session.clock, interface=interface, line_hz=50.0)


def test_it_speaks_in_its_own_words():
    session = ScriptedSession(
        OPEN, SET, START, [(":TRAC:DATA?", "+1.234567E+00,-1.234567E+00"), ("*ESR?", "0")]
    )
    other = meter(session)
    assert other.open().model == "MODEL 7"
    other.configure(SETTINGS)
    other.start()
    assert other.fetch() == {"x": (1.234567, -1.234567)}
    other.close()
    assert session.left == []


@pytest.mark.parametrize(
    ("reply", "cause"),
    [
        ("+1.23456780E+00,+1.23456780E+00", r"2 readings such as \+1\.234567E\+00"),
        ("+1.234567E+00", "2 readings"),
        ("+9.900000E+36,+1.234567E+00", "overloads"),
    ],
)
def test_readings_of_another_form_are_none(reply, cause):
    session = ScriptedSession(OPEN, SET, START, [(":TRAC:DATA?", reply), ("*ESR?", "0")])
    other = meter(session)
    other.open()
    other.configure(SETTINGS)
    other.start()
    with pytest.raises(BadReading, match=cause):
        other.fetch()


def test_its_error_queue_and_its_identity_are_asked_in_its_words():
    session = ScriptedSession(
        OPEN, [*SET[:2], (":STAT:QUE?", '-113,"Undefined header"'), (":STAT:QUE?", '0,""')]
    )
    other = meter(session)
    other.open()
    with pytest.raises(InstrumentRefused, match="error -113"):
        other.configure(SETTINGS)
    with pytest.raises(InstrumentRefused, match=r"not a Model 7; check the address in the bench file$"):
        meter(ScriptedSession([("*IDN?", "HEWLETT-PACKARD,34401A,0,11-5-2")])).open()
