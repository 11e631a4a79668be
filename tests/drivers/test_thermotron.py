"""The Thermotron driver against the manual's text."""

import pytest

from drivers.chambers import ChamberLimits
from drivers.instruments.thermotron import ThermotronChamber
from drivers.interfaces import BadReading, Identity, InstrumentRefused, ThermalChamber
from tests.support.scripted_session import Clock, Pairs, ScriptedSession

LIMITS = ChamberLimits(-40.0, 85.0, band_c=2.0)
OPEN: Pairs = [("IDEN?", "8800 V3.12")]
SET: Pairs = [("MODE?", "2"), ("SETP1,25.0", None), ("SETP1?", "25.000"), ("RUNM", None), ("MODE?", "16")]
READ: Pairs = [("MODE?", "16"), ("SETP1?", "25.000"), ("PVAR1?", "25.400")]


def chamber(session: object, clock: object | None = None) -> ThermotronChamber:
    return ThermotronChamber("chamber", session, clock or Clock(), LIMITS)  # type: ignore[arg-type]


def test_set_and_read_with_a_second_after_each_command() -> None:
    clock = Clock()
    script = ScriptedSession(OPEN, SET, READ, [("STOP", None), ("MODE?", "2")], clock=clock)
    c = chamber(script, clock)
    assert isinstance(c, ThermalChamber)
    assert c.open() == Identity("Thermotron", "8800", "", "V3.12")
    c.set_temperature(25.0, "1/temperature")
    assert c.temperature("2/read") == 25.4
    c.make_safe()
    c.close()
    assert script.left == []
    sent = script.sent_at_s
    for (command, at_s), (_, next_s) in zip(sent, [*sent[1:], ("", 1e9)], strict=True):
        assert command.endswith("?") or next_s - at_s >= 1.0


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        ([("MODE?", "0")], "its mode is 0, not stopped or manual"),
        ([*SET[:2], ("SETP1?", "23.000")], "set point is 23 °C"),
        ([*SET[:4], ("MODE?", "2")], "its mode is 2, not manual"),
    ],
)
def test_a_demand_that_is_not_taken(pairs: Pairs, words: str) -> None:
    c = chamber(ScriptedSession(OPEN, pairs))
    c.open()
    with pytest.raises(InstrumentRefused, match=words):
        c.set_temperature(25.0, "1/temperature")


def test_a_controller_set_to_fahrenheit_is_noticed_when_it_cannot_be_celsius() -> None:
    c = chamber(ScriptedSession(OPEN, SET, [*READ[:2], ("PVAR1?", "140.000")]))
    c.open()
    c.set_temperature(25.0, "1/temperature")
    with pytest.raises(BadReading, match=r"140 °C, which is not plausible.*its unit"):
        c.temperature("2/read")
