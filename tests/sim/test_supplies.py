"""The simulated supplies in other people's words: replies in their manuals' form, what they refuse, their power."""

import numpy as np
import pytest

from bench.model import Block, ForwardModel
from bench.model.geometry import INSTALLATION_1
from sim.aim_tti import AimTti
from sim.supply import KeysightE3631A, KeysightE36300
from sim.world.clock import VirtualClock
from sim.world.power import Disturbance, PowerSettings, Rail
from sim.world.world import World, WorldSettings

BLOCK = Block(np.diag([-2.2, -2.1, -2.15]), np.zeros(3))


def world(output: str = "2") -> World:
    rail = Rail("p15", output, 15.0, (12.0, 18.0), (-0.5, 18.0), 0.06, 0.2)
    settings = WorldSettings(
        BLOCK, ForwardModel({"1": INSTALLATION_1}), {}, 5, power=PowerSettings((rail,), in_rush=1.0)
    )
    return World(settings, VirtualClock())


def tell(supply, *messages: str) -> list[str | None]:
    replies = [supply.handle(message.encode(), lambda: False) for message in messages]
    return [None if reply is None else reply.decode() for reply in replies]


@pytest.mark.parametrize(
    ("messages", "reply"),
    [
        (("*IDN?",), "HEWLETT-PACKARD,E3631A,0,1.4-5.0-1.0"),
        (("APPL?",), '"0.000000,5.000000"'),
        (("APPL P25V, 15.0, 0.2", "APPL? P25V"), '"15.000000,0.200000"'),
        (("INST:NSEL 2;:VOLT 15;:VOLT?",), "+1.50000000E+01"),
        (("INST:NSEL 3;:VOLT -12;:VOLT?",), "-1.20000000E+01"),
        (("APPL N25V,MAX,DEF", "APPL? N25V"), '"-25.750000,1.000000"'),
        (("VOLT? MAX;:CURR? MAX",), "+6.18000000E+00;+5.15000000E+00"),
        (("OUTP:TRAC ON;:APPL P25V,10", "APPL? N25V"), '"-10.000000,1.000000"'),
        (("OUTP?;:OUTP:STATE ON;:OUTP?",), "0;1"),
        (("STAT:QUES:INST:ISUM2:COND?",), "+0"),
    ],
)
def test_an_e3631a_in_its_manuals_words(messages, reply):
    supply = KeysightE3631A(world("P25V"))
    assert tell(supply, *messages)[-1] == reply
    assert tell(supply, "SYST:ERR?") == ['+0,"No error"']


@pytest.mark.parametrize(
    ("message", "error"),
    [
        ("APPL P6V,7", -222), ("APPL N25V,5", -222), ("APPL P30V,5", -224), ("VOLT:PROT 7", -113),
        ("DISP:TEXT 'HI'", -113), ("OUTP ON,(@1)", -108),
        ("INST:NSEL 4", -222), ("SYST:REM", 514), ("APPL", -109),
    ],
)  # fmt: skip
def test_what_an_e3631a_refuses(message, error):
    supply = KeysightE3631A(world("P25V"))
    (reply,) = tell(supply, message, "SYST:ERR?")[1:]
    assert reply.startswith(f"{error:+d},")
    assert tell(supply, "APPL? P6V") == ['"0.000000,5.000000"']


def test_over_rs232_an_e3631a_wants_to_be_remote():
    supply = KeysightE3631A(world("P25V"), interface="rs232")
    assert tell(supply, "OUTP ON", "SYST:ERR?")[1].startswith("+550")
    assert tell(supply, "SYST:REM", "OUTP ON", "OUTP?") == [None, None, "1"]
    supply.press_local()
    assert tell(supply, "OUTP OFF", "SYST:ERR?")[1].startswith("+550")


def test_an_e3631a_feeds_the_block_and_limits_its_current():
    at = world("P25V")
    supply = KeysightE3631A(at)
    tell(supply, "APPL P25V,15,0.2", "OUTP ON")
    assert at.power.feeds_block(0.0)
    assert tell(supply, "MEAS:CURR? P25V;:STAT:QUES:INST:ISUM2:COND?") == ["+6.00000000E-02;+2"]
    tell(supply, "APPL P25V,15,0.03")
    assert tell(supply, "MEAS:VOLT? P25V;:STAT:QUES:INST:ISUM2:COND?") == ["+7.50000000E+00;+1"]
    assert not at.power.feeds_block(0.0)


def test_an_e3631a_measures_in_its_steps():
    at = world("P25V")
    supply = KeysightE3631A(at)
    tell(supply, "APPL P25V,15,0.2", "OUTP ON")
    at.power.change("P25V", 0.0, offset_v=-0.0004)
    assert tell(supply, "MEAS:VOLT? P25V") == ["+1.50000000E+01"]
    at.power.change("P25V", 0.0, offset_v=-0.0010)
    assert tell(supply, "MEAS:VOLT? P25V") == ["+1.49985000E+01"]


def test_without_mains_it_says_nothing_and_comes_back_as_it_is_switched_on():
    at = world("P25V")
    supply = KeysightE3631A(at)
    tell(supply, "APPL P25V,15,0.2", "OUTP ON")
    at.power.disturb(Disturbance("cut", 10.0, lasts_s=5.0))
    at.clock.sleep(12.0)
    assert tell(supply, "*IDN?") == [None]
    at.clock.sleep(12.0)
    assert tell(supply, "OUTP?;:APPL? P25V") == ['0;"0.000000,1.000000"']


@pytest.mark.parametrize(
    ("messages", "reply"),
    [
        (("*IDN?",), "Keysight Technologies,E36312A,MY00000001,1.0.4-1.0.0-1.00"),
        (
            ("VOLT 5,(@1)", "VOLT 15, (@2,3)", "VOLT? (@1:3)"),
            "+5.00000000E+00,+1.50000000E+01,+1.50000000E+01",
        ),
        (("VOLT? (@2)",), "+0.00000000E+00"),
        (("OUTP ON,(@2)", "OUTP? (@1,2,3)"), "0,1,0"),
        (("VOLT:PROT 17,(@2)", "VOLT:PROT? (@2);:VOLT:PROT:TRIP? (@2)"), "+1.70000000E+01;0"),
    ],
)
def test_an_e36312a_in_its_manuals_words(messages, reply):
    supply = KeysightE36300(world())
    assert tell(supply, *messages)[-1] == reply
    assert tell(supply, "SYST:ERR?") == ['+0,"No error"']


@pytest.mark.parametrize(
    ("message", "error"),
    [("VOLT 7,(@1)", -222), ("VOLT 5,(@4)", -222), ("VOLT 5,1", -104), ("OUTP ON,(@)", -109)],
)
def test_what_an_e36312a_refuses(message, error):
    supply = KeysightE36300(world())
    assert tell(supply, message, "SYST:ERR?")[1].startswith(f"{error:+d},")


def test_a_trip_of_an_e36312a_is_cleared_before_it_is_switched_on_again():
    at = world()
    supply = KeysightE36300(at)
    at.power.change("2", 0.0, trip_after_s=0.05)
    tell(supply, "VOLT:PROT 17,(@2)", "CURR 0.1,(@2)", "VOLT 15,(@2)", "OUTP ON,(@2)")
    at.power.disturb(Disturbance("load", 5.0, "2", size=4.0, lasts_s=5.0))
    at.clock.sleep(20.0)
    state = "OUTP? (@2);:CURR:PROT:TRIP? (@2);:STAT:QUES:INST:ISUM2:COND?"
    assert tell(supply, state) == ["0;1;+1024"]
    assert tell(supply, "OUTP ON,(@2)", state) == [None, "0;1;+1024"]
    assert tell(supply, "OUTP:PROT:CLE (@2)", "OUTP ON,(@2)", state) == [None, None, "1;0;+2"]


def test_an_aim_tti_in_its_manuals_words():
    at = world("1")
    supply = AimTti(at, model="CPX400DP")
    assert tell(supply, "V1 15;I1 0.2;OVP1 17", "V1?;I1?;OVP1?") == [
        None,
        "V1 15.000\r\nI1 0.200\r\nVP1 17.00",
    ]
    assert tell(supply, "OP1 1", "OP1?", "V1O?", "I1O?", "LSR1?") == [None, "1", "15.000V", "0.060A", "1"]
    assert at.power.feeds_block(0.0)
    assert tell(supply, "V1?", "OPALL 0", "OP1?") == ["V1 15.000", None, "0"]
    assert tell(supply, "*ESR?", "*ESR?", "EER?") == ["128", "0", "0"]


@pytest.mark.parametrize(
    ("message", "event", "error"),
    [
        ("V1 61", "16", "100"),
        ("V3 5", "16", "103"),
        ("V1", "32", "0"),
        ("VOLT 5", "32", "0"),
        ("deltav1 0.5", "32", "0"),
        ("OP1 2", "16", "100"),
    ],
)
def test_an_aim_tti_tells_by_registers_what_it_did_not_carry_out(message, event, error):
    supply = AimTti(world("1"), model="CPX400DP")
    assert tell(supply, "*ESR?", message, "*ESR?", "EER?", "EER?")[2:] == [event, error, "0"]


def test_a_pl_p_keeps_its_settings_without_mains_but_not_its_outputs():
    at = world("1")
    supply = AimTti(at)
    tell(supply, "V1 15;I1 0.2;OP1 1")
    supply.power_cycle()
    assert tell(supply, "OP1?;V1?;OVP1?") == ["0\r\nV1 15.000"]
