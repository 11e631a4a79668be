"""The SCPI base: which identities each model takes, and the words of another make."""

from functools import partial
from typing import Any

import pytest

from drivers.instruments.agilent_34401a import Agilent34401A
from drivers.instruments.keithley_2000 import Keithley2000
from drivers.instruments.keysight_34461a import Keysight34461A
from drivers.instruments.keysight_34970a import Keysight34970A
from drivers.interfaces import BadReading, Identity, InstrumentRefused, VoltmeterLimits, VoltmeterSettings
from drivers.scpi_voltmeter import ProvenSetting, ScpiVoltmeter
from tests.support.scripted_session import Pairs, ScriptedSession

MODELS: dict[str, tuple[Any, Any, str]] = {
    "34401A": (Agilent34401A, "x", "not as 34401A; check the address"),
    "2000": (Keithley2000, "x", "not as Keithley 2000"),
    "34461A": (Keysight34461A, "x", "not as 34460A, 34461A, 34465A or 34470A"),
    "34970A": (Keysight34970A, {"x": 101}, "not as 34970A or 34972A; check the address"),
}
CARD: Pairs = [("SYST:CTYP? 100", "HEWLETT-PACKARD,34901A,0,2.3")]


def of_model(model: str, session: ScriptedSession, **options: Any) -> Any:
    kind, channels, _ = MODELS[model]
    return kind("voltmeter", channels, session, session.clock, **options)


@pytest.mark.parametrize(
    ("model", "reply", "card"),
    [
        ("34401A", "HEWLETT-PACKARD,34401A,0,3-1-1", []),
        ("34401A", "HEWLETT-PACKARD,34401A,MY53000001,01.05-11-5-2", []),
        ("34401A", "Agilent Technologies,34401A,0,11-5-2", []),
        ("34401A", "Keysight Technologies,34401A,0,11-5-2", []),
        ("34970A", "HEWLETT-PACKARD,34970A,0,13-2-2", CARD),
        ("34970A", "Agilent Technologies,34972A,MY49000001,1.16-1.12-02-02", CARD),
        ("34970A", "Keysight Technologies,34972A,MY59000001,1.17", CARD),
    ],
)
def test_identity_by_pattern(model: str, reply: str, card: Pairs) -> None:
    maker, name, serial, firmware = reply.split(",")
    session = ScriptedSession([("*IDN?", reply), ("*CLS", None)], card)
    assert of_model(model, session).open() == Identity(maker, name, serial.removeprefix("0"), firmware)


@pytest.mark.parametrize(
    ("model", "reply"),
    [
        ("34401A", "KEITHLEY INSTRUMENTS INC.,MODEL 2000,0,B02"),
        ("34401A", "Keysight Technologies,34461A,MY1,A.02"),
        ("34401A", "X,34401A,0,1"),
        ("2000", "KEITHLEY INSTRUMENTS INC.,MODEL 2700,1,B09  /A02"),
        ("2000", "HEWLETT-PACKARD,34401A,0,11-5-2"),
        ("34461A", "Agilent Technologies,34410A,MY1,2.35"),
        ("34461A", "Rigol Technologies,34461A,DM1,1"),
        ("34461A", "A,B,C,D"),
        ("34970A", "HEWLETT-PACKARD,34401A,0,11-5-2"),
        ("34970A", "RIGOL TECHNOLOGIES,34970A,0,1"),
    ],
)
def test_another_instrument_is_refused(model: str, reply: str) -> None:
    with pytest.raises(InstrumentRefused, match=MODELS[model][2]) as caught:
        of_model(model, ScriptedSession([("*IDN?", reply)])).open()
    assert reply in str(caught.value)


# --- another make -----------------------------------------------------------------------------------

SETTINGS = VoltmeterSettings(10.0, 1.0, 2)


class OtherMake(ScpiVoltmeter):
    """A made-up meter: seven digits, blanks in its identity, a trace buffer, a status queue, always remote."""

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


OPEN: Pairs = [("*IDN?", "VOLTWERKE GMBH,MODEL 7,0815,A01"), ("*CLS", None)]
SET: Pairs = [(":TRAC:POIN 2", None), (":TRAC:POIN?", "2")]
other_make = partial(OtherMake, "voltmeter.x", ("x",), interface="rs232", line_hz=50.0)


def fetched(reply: str) -> Any:
    start: Pairs = [(":STAT:QUE?", '0,"No error"'), (":TRAC:FEED:CONT NEXT;:INIT", None)]
    session = ScriptedSession(OPEN, SET, start, [(":TRAC:DATA?", reply), ("*ESR?", "0")])
    meter = other_make(session, session.clock)  # type: ignore[arg-type]
    assert meter.open().model == "MODEL 7"
    meter.configure(SETTINGS)
    meter.start()
    values = meter.fetch()
    meter.close()
    assert session.left == []
    return values


def test_it_speaks_in_its_own_words() -> None:
    assert fetched("+1.234567E+00,-1.234567E+00") == {"x": (1.234567, -1.234567)}
    with pytest.raises(BadReading, match=r"2 readings such as \+1\.234567E\+00"):
        fetched("+1.23456780E+00,+1.23456780E+00")
    with pytest.raises(BadReading, match="overloads"):
        fetched("+9.900000E+36,+1.234567E+00")
    queue: Pairs = [(":STAT:QUE?", '-113,"Undefined header"'), (":STAT:QUE?", '0,""')]
    session = ScriptedSession(OPEN, SET, queue)
    meter = other_make(session, session.clock)  # type: ignore[arg-type]
    meter.open()
    with pytest.raises(InstrumentRefused, match="error -113"):
        meter.configure(SETTINGS)


def test_a_meter_may_leave_out_zeros_and_signs(monkeypatch) -> None:
    monkeypatch.setattr(OtherMake, "reading", r"-?\d\.\d+E-?\d+")
    assert fetched("1.25E0,-1.234567E-3") == {"x": (1.25, -1.234567e-3)}


def test_an_error_that_fills_the_queue_is_told_once() -> None:
    queue: Pairs = [(":STAT:QUE?", '-410,"Query INTERRUPTED"')] * (1 + OtherMake.errors_kept)
    session = ScriptedSession(OPEN, SET, queue)
    meter = other_make(session, session.clock)  # type: ignore[arg-type]
    meter.open()
    with pytest.raises(InstrumentRefused) as refusal:
        meter.configure(SETTINGS)
    assert str(refusal.value).count("-410") == 1


def test_the_number_of_an_error_is_the_first_group_of_its_pattern(monkeypatch) -> None:
    monkeypatch.setattr(OtherMake, "error_reply", r"NO (\d+)/[A-Z ]+")
    session = ScriptedSession(OPEN, SET, [(":STAT:QUE?", "NO 7/BAD POINTS"), (":STAT:QUE?", "NO 0/NONE")])
    meter = other_make(session, session.clock)  # type: ignore[arg-type]
    meter.open()
    with pytest.raises(InstrumentRefused, match="error NO 7/BAD POINTS"):
        meter.configure(SETTINGS)


def test_another_meter_of_the_same_model_is_refused_over_a_new_connection() -> None:
    other: Pairs = [("*IDN?", "VOLTWERKE GMBH,MODEL 7,4711,A01")]
    quiet: Pairs = [(":STAT:QUE?", '0,"No error"')]
    session = ScriptedSession(
        OPEN, SET, quiet, other, OPEN, SET, quiet, [(":TRAC:FEED:CONT NEXT;:INIT", None)]
    )
    meter = other_make(session, session.clock)  # type: ignore[arg-type]
    meter.open()
    meter.configure(SETTINGS)
    session.connection = None
    with pytest.raises(
        InstrumentRefused, match=r"was VOLTWERKE GMBH MODEL 7 0815 A01 and is now .* 4711 A01; conn"
    ):
        meter.start()
    meter.start()  # the first one is connected again
    assert session.left == []
