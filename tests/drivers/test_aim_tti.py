"""An Aim-TTi in its own dialect: V1 sets, V1? answers V1 …, V1O? measures; trips are told once and remembered."""

import pytest

from drivers.facts import aim_tti as facts
from drivers.instruments.aim_tti import AimTti
from drivers.interfaces import BadReading, InstrumentRefused, OutputSettings, SupplyLimits
from tests.support.scripted_session import ScriptedSession

OPENED = [("*IDN?", "THURLBY THANDAR, CPX400DP, 123456, 1.02-1.02"), ("*ESR?", "128")]
WANTED = {"1": OutputSettings(15.0, 0.2, 17.0)}


def of(output, on="0", volts="1.000", limit="1.000", protection="66.00", given=("0.000", "0.000"), event="0"):
    return [
        (f"OP{output}?", on), (f"V{output}?", f"V{output} {volts}"), (f"I{output}?", f"I{output} {limit}"),
        (f"OVP{output}?", f"VP{output} {protection}"), (f"V{output}O?", f"{given[0]}V"),
        (f"I{output}O?", f"{given[1]}A"), (f"LSR{output}?", event),
    ]  # fmt: skip


OFF = [*of(1), *of(2)]
SET = [*of(1, volts="15.000", limit="0.200", protection="17.00"), *of(2)]
ON = [*of(1, "1", "15.000", "0.200", "17.00", ("14.998", "0.061"), "1"), *of(2)]
LIMITS = [*of(1, "1", "15.000", "0.200", "17.00", ("9.012", "0.200"), "3"), *of(2)]
TRIPPED = [*of(1, "0", "15.000", "0.200", "17.00", event="4"), *of(2)]
SETTING_UP = [
    *OFF, ("CONFIG?", "2"), ("OVP1 17.0", None), ("I1 0.200", None), ("V1 15.000", None), ("*ESR?", "0"), *SET,
]  # fmt: skip


def made(exchanges):
    session = ScriptedSession(exchanges)
    limits = SupplyLimits.of(facts, "CPX400DP")
    return AimTti("power_supply", session, session.clock, limits=limits, model="CPX400DP"), session


def test_it_is_set_up_switched_on_and_seen_to_limit_its_current():
    supply, session = made(
        [*OPENED, *SETTING_UP, *SET, ("OP1 1", None), *ON, ("*ESR?", "0"), *LIMITS, ("LOCAL", None)]
    )
    assert supply.open().maker == "THURLBY THANDAR"
    supply.set_up(WANTED, "1/supply")
    supply.switch("1", True, "2/on")
    state = supply.state("3")["1"]
    assert (state.on, state.limiting, state.voltage_v) == (True, True, 9.012)
    supply.close()
    assert session.left == []


def test_a_trip_that_the_register_tells_once_is_remembered():
    supply, session = made([*OPENED, *TRIPPED, *SET])
    supply.open()
    assert supply.state("1")["1"].tripped
    assert supply.state("2")["1"].tripped
    assert session.left == []


@pytest.mark.parametrize(
    ("exchanges", "told"),
    [
        ([*SETTING_UP[: SETTING_UP.index(("*ESR?", "0"))], ("*ESR?", "16"), ("EER?", "100"), *OFF],
         r"execution error 100 \(out of range\)"),
        ([*OFF, ("CONFIG?", "0")], "tracking"),
    ],
)  # fmt: skip
def test_what_was_not_carried_out_and_tracking_outputs_are_told(exchanges, told):
    supply, _ = made([*OPENED, *exchanges])
    supply.open()
    with pytest.raises(InstrumentRefused, match=told):
        supply.set_up(WANTED, "1/supply")


def test_half_a_number_is_no_reading():
    half = ("V1O?", "15.V")
    supply, session = made([*OPENED, *OFF[:4], half, *OPENED, half, *OPENED, half])
    supply.open()
    with pytest.raises(BadReading):
        supply.state("1")
    assert session.left == []
