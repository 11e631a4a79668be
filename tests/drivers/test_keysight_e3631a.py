"""The E3631A as its manual says: remote first over RS-232, APPLy, one switch, its conditions."""

import pytest

from drivers.facts import keysight_e3631a as facts
from drivers.instruments.keysight_e3631a import KeysightE3631A
from drivers.interfaces import InstrumentRefused, OutputSettings, SupplyLimits
from tests.support.scripted_session import ScriptedSession

IDENTITY = ("*IDN?", "HEWLETT-PACKARD,E3631A,0,1.4-5.0-1.0")
OPENED = [IDENTITY, ("*CLS", None)]
NO_ERROR = ("SYST:ERR?", '+0,"No error"')


def asked(*outputs, on="0"):
    """Return the exchange that reads everything; of each output settings, volts, amperes, condition."""
    exchanges = [("OUTP?", on)]
    for number, (name, reply) in enumerate(zip(("P6V", "P25V", "N25V"), outputs, strict=True), start=1):
        question = f"APPL? {name};:MEAS:VOLT? {name};:MEAS:CURR? {name};:STAT:QUES:INST:ISUM{number}:COND?"
        exchanges.append((question, reply))
    return exchanges


OFF = ('"0.000000,5.000000";+0.00000000E+00;+0.00000000E+00;+0',) * 3
P25V_SET = (OFF[0], '"15.000000,0.200000";+1.20000000E-03;+0.00000000E+00;+0', OFF[2])
P25V_ON = (OFF[0], '"15.000000,0.200000";+1.50003000E+01;+6.12000000E-02;+2', OFF[2])
P25V_LIMITS = (OFF[0], '"15.000000,0.200000";+9.10000000E+00;+2.00000000E-01;+1', OFF[2])


def made(exchanges, **options):
    session = ScriptedSession(exchanges)
    limits = SupplyLimits.of(facts)
    return KeysightE3631A("power_supply", session, session.clock, limits=limits, **options), session


def test_it_is_set_up_and_switched_on():
    wanted = {"P25V": OutputSettings(15.0, 0.2)}
    supply, session = made(
        [
            *OPENED,
            *asked(*OFF),
            ("OUTP:TRAC?", "0"),
            ("APPL P25V,15.0000,0.2000", None),
            NO_ERROR,
            *asked(*P25V_SET),
            *asked(*P25V_SET),
            ("OUTP ON", None),
            *asked(*P25V_ON, on="1"),
            NO_ERROR,
            *asked(*P25V_LIMITS, on="1"),
        ]
    )
    assert supply.open().model == "E3631A"
    supply.set_up(wanted, "1/supply")
    supply.switch("P25V", True, "2/on")
    state = supply.state("3")["P25V"]
    assert (state.voltage_v, state.current_a, state.limiting, state.tripped) == (9.1, 0.2, True, False)
    assert session.left == []


def test_over_rs232_it_is_told_to_be_remote_first_and_let_go_at_the_end():
    supply, session = made([("SYST:REM", None), *OPENED, ("SYST:LOC", None)], interface="rs232")
    supply.open()
    supply.close()
    assert session.left == []


DEMAND = [("OUTP:TRAC?", "0"), ("APPL P25V,15.0000,0.2000", None)]
LEFT = ('"3.300000,1.000000";+0.00000000E+00;+0.00000000E+00;+0', OFF[1], OFF[2])


@pytest.mark.parametrize(
    ("exchanges", "told"),
    [
        (asked(*LEFT), r"P6V to 3\.3 V"),  # what nobody named is not switched on with the rest
        ([*asked(*OFF), ("OUTP:TRAC?", "1")], "track"),
        (
            [*asked(*OFF), *DEMAND, ("SYST:ERR?", '-222,"Data out of range"'), NO_ERROR, *asked(*OFF)],
            r"-222.*the voltage is 0 V, not 15 V.*current limit is 5 A",
        ),
    ],
)
def test_what_keeps_it_from_being_set_up_is_told(exchanges, told):
    supply, _ = made([*OPENED, *exchanges])
    supply.open()
    with pytest.raises(InstrumentRefused, match=told):
        supply.set_up({"P25V": OutputSettings(15.0, 0.2)}, "1/supply")


def test_failed_hardware_is_told():
    failed = (OFF[0], OFF[1].removesuffix("0") + "3", OFF[2])
    supply, _ = made([*OPENED, *asked(*failed)])
    supply.open()
    with pytest.raises(InstrumentRefused, match="failed"):
        supply.state("1")
