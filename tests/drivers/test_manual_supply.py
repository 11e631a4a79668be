"""A supply that a person works: asked in order, what is read held against what was demanded."""

from __future__ import annotations

import pytest

from drivers.instruments.manual_supply import ManualSupply
from drivers.interfaces import (
    BadReading,
    InstrumentRefused,
    LimitExceeded,
    OutputLimits,
    OutputSettings,
    SetOtherwise,
    SupplyLimits,
)
from drivers.person import Answer

PLUS = OutputLimits((0.0, 30.0), (0.0, 3.0), 0.01, 0.001, (0.0, 33.0))
WANTED = {"+": OutputSettings(15.0, 0.2, 17.0)}


class Hand:
    """A person whose supply is a mapping; `says` are answers in place of what it shows."""

    def __init__(self, **says: list[str]) -> None:
        self.shows = {
            "switch": "off", "set_voltage": "0.00", "current_limit": "0.000", "voltage": "0.00", "current": "0.000",
        }  # fmt: skip
        self.says = says
        self.asked: list[str] = []
        self.careless = False

    def ask(self, prompt):
        action = prompt.action
        self.asked.append(action["do"] + ":" + str(action.get("what", "")))
        if action["do"] == "set_supply" and not self.careless:
            volts, amperes, _ = action["outputs"]["+"]
            self.shows |= {"set_voltage": f"{volts:.2f}", "current_limit": f"{amperes:.3f}"}
        elif action["do"] == "switch_supply":
            on = action["on"]
            self.shows |= {
                "switch": "on" if on else "off",
                "voltage": self.shows["set_voltage"] if on else "0.0",
            }
        elif action["do"] == "read_supply":
            said = self.says.get(action["what"])
            return Answer(prompt.id, said.pop(0) if said else self.shows[action["what"]])
        return Answer(prompt.id, "")


def supply(hand: Hand) -> ManualSupply:
    return ManualSupply("power_supply", hand, limits=SupplyLimits({"+": PLUS}), tolerance_v=0.1)


def test_it_is_set_read_back_switched_and_read():
    hand = Hand()
    driver = supply(hand)
    driver.set_up(WANTED, "1/supply")
    assert hand.asked == [
        "read_supply:switch", "set_supply:", "read_supply:set_voltage", "read_supply:current_limit",
    ]  # fmt: skip
    driver.switch("+", True, "2/on")
    hand.shows["current"] = "0.061"
    state = driver.state("3")["+"]
    assert (state.on, state.voltage_v, state.current_a, state.limiting, state.tripped) == (
        True,
        15.0,
        0.061,
        False,
        False,
    )
    hand.shows |= {"current": "0.200", "voltage": "9,1"}
    assert driver.state("4")["+"].limiting
    hand.shows |= {"current": "0.0", "voltage": "0.01"}
    assert driver.state("5")["+"].tripped
    assert driver.switch_all_off() == "switch its output + off by hand"


def test_what_was_set_otherwise_is_asked_again_and_then_refused():
    hand = Hand(set_voltage=["1.50"])
    driver = supply(hand)
    driver.set_up(WANTED, "1/supply")
    assert hand.asked.count("set_supply:") == 2
    hand = Hand()
    hand.careless = True
    with pytest.raises(InstrumentRefused, match="the voltage is 0 V, not 15 V"):
        supply(hand).set_up(WANTED, "1/supply")


def test_one_found_on_is_read_and_left():
    hand = Hand()
    hand.shows |= {"switch": "on", "set_voltage": "15.00", "current_limit": "0.2"}
    driver = supply(hand)
    driver.set_up(WANTED, "1/supply")
    assert "set_supply:" not in hand.asked
    hand.shows["set_voltage"] = "12"
    with pytest.raises(SetOtherwise, match="12 V, not 15 V"):
        driver.set_up(WANTED, "2/supply")


def test_limits_come_before_the_person():
    hand = Hand()
    with pytest.raises(LimitExceeded, match="0 to 30 V"):
        supply(hand).set_up({"+": OutputSettings(31.0, 0.2)}, "1/supply")
    assert hand.asked == []


def test_another_voltage_after_switching_on_is_refused():
    hand = Hand(voltage=["9.3"])
    driver = supply(hand)
    driver.set_up(WANTED, "1/supply")
    with pytest.raises(InstrumentRefused, match=r"gives 9\.3 V, not 15 V"):
        driver.switch("+", True, "2/on")


def test_what_is_no_number_is_asked_again():
    hand = Hand(voltage=["fifteen", "15.02 V"])
    driver = supply(hand)
    driver.set_up(WANTED, "1/supply")
    driver.switch("+", True, "2/on")
    hand.says = {"voltage": ["?"] * 5}
    with pytest.raises(BadReading, match="5 attempts"):
        driver.state("3")
