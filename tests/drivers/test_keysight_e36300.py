"""The E36300 series as its manual says: channel lists, protections first, a switch for each output."""

import pytest

from drivers.facts import keysight_e36300 as facts
from drivers.instruments.keysight_e36300 import KeysightE36300
from drivers.interfaces import InstrumentRefused, OutputSettings, SupplyLimits
from tests.support.scripted_session import ScriptedSession

OPENED = [("*IDN?", "Keysight Technologies,E36312A,MY61001234,2.1.1-1.0.4-1.12"), ("*CLS", None)]
NO_ERROR = ("SYST:ERR?", '+0,"No error"')
QUESTION = (
    "OUTP? (@1,2,3);:VOLT:PROT:TRIP? (@1,2,3);:CURR:PROT:TRIP? (@1,2,3);:VOLT? (@1,2,3);:CURR? (@1,2,3);"
    ":VOLT:PROT? (@1,2,3);:MEAS:VOLT? (@1,2,3);:MEAS:CURR? (@1,2,3);:STAT:QUES:INST:ISUM1:COND?;"
    ":STAT:QUES:INST:ISUM2:COND?;:STAT:QUES:INST:ISUM3:COND?"
)
WANTED = {"2": OutputSettings(15.0, 0.2, 17.0)}


def asked(on="0", volts="0", limit="1", protection="27.5", given="+0.0E+00", tripped="0", condition="0"):
    """Return the exchange that reads everything; outputs 1 and 3 are off."""
    reply = (
        f"0,{on},0;0,{tripped},0;0,0,0;+0,{volts},+0;+5,{limit},+1;+6.6,{protection},+27.5;+0,{given},+0;"
        f"+0,+6.1E-02,+0;0;{condition};0"
    )
    return (QUESTION, reply)


def made(exchanges):
    session = ScriptedSession(exchanges)
    limits = SupplyLimits.of(facts, "E36312A")
    supply = KeysightE36300("power_supply", session, session.clock, limits=limits, model="E36312A")
    return supply, session


SET = asked(volts="+1.5E+01", limit="+2.0E-01", protection="+1.7E+01")
ON = asked("1", "+1.5E+01", "+2.0E-01", "+1.7E+01", "+1.49998E+01", condition="2")
LIMITS = asked("1", "+1.5E+01", "+2.0E-01", "+1.7E+01", "+9.0E+00", condition="1")
TRIPPED = asked("0", "+1.5E+01", "+2.0E-01", "+1.7E+01", tripped="1", condition="512")
SETTING_UP = [
    asked(), ("VOLT:PROT 17.000,(@2)", None), ("CURR 0.2000,(@2)", None), ("VOLT 15.0000,(@2)", None), NO_ERROR,
    SET,
]  # fmt: skip


def test_it_is_set_up_protections_first_and_switched_on():
    supply, session = made([*OPENED, *SETTING_UP, SET, ("OUTP ON,(@2)", None), ON, NO_ERROR, LIMITS])
    assert supply.open().serial == "MY61001234"
    supply.set_up(WANTED, "1/supply")
    supply.switch("2", True, "2/on")
    state = supply.state("3")["2"]
    assert (state.on, state.limiting, state.voltage_v, state.current_a) == (True, True, 9.0, 0.061)
    assert session.left == []


@pytest.mark.parametrize(
    ("after", "told"),
    [
        ([TRIPPED], "a protection has switched its output 2 off"),
        ([(QUESTION, ON[1].replace("0,1,0;", "0,1,1;", 1)), NO_ERROR], "switched its output 3, too"),
    ],
)
def test_a_trip_at_switching_on_and_an_output_that_goes_with_another_are_told(after, told):
    supply, _ = made([*OPENED, *SETTING_UP, SET, ("OUTP ON,(@2)", None), *after])
    supply.open()
    supply.set_up(WANTED, "1/supply")
    with pytest.raises(InstrumentRefused, match=told):
        supply.switch("2", True, "2/on")


def test_another_model_is_refused():
    supply, _ = made([("*IDN?", "Keysight Technologies,E36313A,MY61001234,2.1.1-1.0.4-1.12")])
    with pytest.raises(InstrumentRefused, match="E36313A"):
        supply.open()


def test_all_are_switched_off_at_once():
    supply, session = made([*OPENED, ("OUTP OFF,(@1,2,3)", None), asked()])
    supply.open()
    assert supply.switch_all_off() == ""
    assert session.left == []


def test_one_that_stays_on_is_told():
    supply, _ = made([*OPENED, ("OUTP OFF,(@1,2,3)", None), ON])
    supply.open()
    with pytest.raises(InstrumentRefused, match="output 2 stays on"):
        supply.switch_all_off()
