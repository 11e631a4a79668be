"""The head and the chamber that ask a person."""

import math
from collections.abc import Sequence

import pytest

from drivers.instruments.manual import ManualChamber, ManualHead, ManualLevel, ManualThermometer
from drivers.instruments.manual_supply import ManualSupply
from drivers.interfaces import (
    BadReading,
    InstrumentRefused,
    LimitExceeded,
    NoAnswer,
    OutputLimits,
    OutputSettings,
    SetOtherwise,
    SupplyLimits,
)
from drivers.person import ATTEMPTS, Answer, Prompt, PromptKind

SECOND = math.radians(1.0 / 3600.0)
TOLERANCE = 30 * SECOND


class Script:
    """A person with prepared answers; an `Answer` is given as it is, a text to the prompt that asks."""

    def __init__(self, answers: Sequence[str | Answer]) -> None:
        self.answers = list(answers)
        self.prompts: list[Prompt] = []

    def ask(self, prompt: Prompt) -> Answer:
        self.prompts.append(prompt)
        if not self.answers:
            raise NoAnswer("script", "the answers ran out", "add some")
        answer = self.answers.pop(0)
        return answer if isinstance(answer, Answer) else Answer(prompt.id, answer)


def head(*answers: str | Answer) -> tuple[ManualHead, Script]:
    person = Script(answers)
    return ManualHead("head", person, tolerance_rad=TOLERANCE), person


def chamber(*answers: str | Answer) -> tuple[ManualChamber, Script]:
    person = Script(answers)
    return ManualChamber("chamber", person, minimum_c=-40.0, maximum_c=85.0), person


# --- head -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("typed", "seconds"), [("359 59 58", -2.0), ("0,001", 3.6), ("90", 324000.0)])
def test_a_head_that_stands_is_read_and_not_turned(typed: str, seconds: float) -> None:
    h, person = head("", "0 0 75", typed)
    assert h.stands_at("m") == pytest.approx(seconds * SECOND, abs=1e-9)
    assert [prompt.action["do"] for prompt in person.prompts] == ["read_head"] * 3
    assert person.prompts[1].text.startswith("Nothing was typed")
    assert "60 or more" in person.prompts[2].text
    with pytest.raises(BadReading, match=f"no angle in {ATTEMPTS} attempts"):
        head(*["x"] * ATTEMPTS)[0].stands_at("m")


def test_a_head_that_is_turned_away_and_back_is_read_after_its_return() -> None:
    h, person = head("5 00 00", "0 00 03")
    position = h.return_to(0.0, 1, "m", by_way_of_rad=math.radians(5.0))
    assert position.angle_rad == pytest.approx(3 * SECOND, abs=1e-9)
    assert person.prompts[0].text.startswith(
        "First turn the head away to 5°00′00″, roughly. Turn the head to 0°"
    )
    assert person.prompts[0].action["by_way_of_rad"] == pytest.approx(math.radians(5.0))
    assert "above the target" in person.prompts[1].text
    assert "away" not in person.prompts[1].text


def test_the_angle_read_comes_back_not_the_target() -> None:
    h, person = head("45 00 04")
    position = h.move(math.radians(45.0), 1, "12/turn")
    assert position.angle_rad == pytest.approx(math.radians(45.0) + 4 * SECOND, abs=1e-12)
    assert position.direction == 1
    prompt = person.prompts[0]
    assert prompt.id == "12/turn#1"
    assert prompt.kind is PromptKind.ANGLE
    assert prompt.default == "45°00′00″"
    assert prompt.action == {
        "do": "turn",
        "target_rad": math.radians(45.0),
        "direction": 1,
        "tolerance_rad": pytest.approx(30 * SECOND),
    }
    assert "45°00′00″" in prompt.text
    assert "approach with the angle rising, from below; clamp; read again" in prompt.text


def test_falling_approach_is_said_and_returned() -> None:
    h, person = head("")
    assert h.move(math.radians(90.0), -1, "k").direction == -1
    assert "falling, from above" in person.prompts[0].text


@pytest.mark.parametrize("degrees", [0.0, 22.5, 45.0, 360.0, 54.735610317, 51.0 + 25.0 / 60.0, -45.0])
def test_enter_accepts_the_target(degrees: float) -> None:
    h, _ = head("")
    assert h.move(math.radians(degrees), 1, "k").angle_rad == pytest.approx(
        math.radians(degrees), abs=5e-4 * SECOND
    )


def test_where_the_bench_file_says_so_the_angle_must_be_typed() -> None:
    person = Script(["", "45 00 02"])
    h = ManualHead("head", person, tolerance_rad=TOLERANCE, enter_accepts_target=False)
    assert h.move(math.radians(45.0), 1, "k").angle_rad == pytest.approx(math.radians(45.0) + 2 * SECOND)
    assert [prompt.default for prompt in person.prompts] == [None, None]
    assert person.prompts[1].text.startswith("Nothing was typed: read the scale")


@pytest.mark.parametrize(
    ("target_deg", "typed", "read_deg"),
    [
        (360.0, "0 00 03", 360.0 + 3 / 3600),
        (360.0, "359 59 57", 360.0 - 3 / 3600),
        (0.0, "359 59 57", -3 / 3600),
        (0.0, "-0 00 03", -3 / 3600),
        (0.0, "360 00 03", 3 / 3600),
        (-45.0, "315 00 00", -45.0),
        (45.0, "45 00 30", 45.0 + 30 / 3600),  # the tolerance itself is inside
    ],
)
def test_the_reading_is_unwrapped_next_to_the_target(target_deg: float, typed: str, read_deg: float) -> None:
    h, person = head(typed)
    assert h.move(math.radians(target_deg), 1, "k").angle_rad == pytest.approx(
        math.radians(read_deg), abs=1e-12
    )
    assert len(person.prompts) == 1


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("46 00 03", "probably the degree line is one off (1°)"),
        ("45 10 00", "probably the tens of minutes are one off (10′)"),
        ("315 00 00", "probably 360° - x was read"),
        ("45 03 20", "45°03′20″ is 0°03′20″ above the target, outside the 0°00′30″ allowed: turn the head"),
        ("44 57 00", "is 0°03′00″ below the target"),
        ("45 00 31", "0°00′31″ above the target"),
        ("fourty five", "'fourty five' is not an angle"),
        ("45 00 75", "minutes or seconds of 60 or more"),
        (Answer("11/turn#1", "45 00 00"), "belonged to an earlier question"),
    ],
)
def test_a_doubtful_answer_is_asked_again_with_the_reason(typed: str | Answer, said: str) -> None:
    h, person = head(typed, "45 00 02")
    assert h.move(math.radians(45.0), 1, "12/turn").angle_rad == pytest.approx(
        math.radians(45.0) + 2 * SECOND, abs=1e-12
    )
    assert [prompt.id for prompt in person.prompts] == ["12/turn#1", "12/turn#2"]
    assert said in person.prompts[1].text
    assert "Turn the head to 45°00′00″" in person.prompts[1].text


def test_outside_the_tolerance_is_never_accepted() -> None:
    """A tired person may be wrong often; only a program that answers is wrong so often that the head gives up."""
    h, person = head(*["45 01 40"] * ATTEMPTS)
    with pytest.raises(
        LimitExceeded, match=rf"no reading within 0°00′30″ of 45°00′00″ in {ATTEMPTS} attempts.*1′40″ above"
    ):
        h.move(math.radians(45.0), 1, "k")
    assert len(person.prompts) == ATTEMPTS
    assert head(*["45 01 40"] * 50, "45 00 04")[0].move(math.radians(45.0), 1, "k").angle_rad > 0.0


def test_no_answer_passes_through() -> None:
    for machine in (head()[0], head("nonsense")[0]):
        with pytest.raises(NoAnswer, match="ran out"):
            machine.move(0.0, 1, "k")


# --- chamber ----------------------------------------------------------------------------------------


def test_chamber_is_set_by_confirmation() -> None:
    c, person = chamber("")
    c.set_temperature(-20.0, "3/chamber")
    prompt = person.prompts[0]
    assert (prompt.id, prompt.kind, prompt.default) == ("3/chamber#1", PromptKind.CONFIRM, "yes")
    assert prompt.action == {"do": "set_temperature", "target_c": -20.0}
    assert "-20 °C" in prompt.text


def test_a_no_or_a_stale_yes_is_not_a_confirmation() -> None:
    c, person = chamber("no", Answer("2/chamber#1", "yes"), "Yes")
    c.set_temperature(20.0, "3/chamber")
    assert len(person.prompts) == 3
    c, person = chamber(*["no"] * 9, "yes")
    c.set_temperature(20.0, "3/chamber")
    assert len(person.prompts) == 10
    c, _ = chamber(*["perhaps"] * ATTEMPTS)
    with pytest.raises(InstrumentRefused, match="nobody confirmed"):
        c.set_temperature(20.0, "3/chamber")


@pytest.mark.parametrize("target_c", [-40.1, 85.1, math.nan])
def test_limits_are_checked_before_anybody_is_asked(target_c: float) -> None:
    c, person = chamber("yes")
    with pytest.raises(LimitExceeded, match="outside -40 to 85 °C"):
        c.set_temperature(target_c, "k")
    assert person.prompts == []


@pytest.mark.parametrize(
    ("typed", "temperature_c"),
    [("23.5", 23.5), ("23,5", 23.5), ("-20 °C", -20.0), ("−20", -20.0), ("+5C", 5.0), ("105", 105.0)],
)
def test_temperature_as_typed(typed: str, temperature_c: float) -> None:
    c, person = chamber(typed)
    assert c.temperature("k") == temperature_c
    prompt = person.prompts[0]
    assert (prompt.kind, prompt.unit, prompt.default) == (PromptKind.NUMBER, "°C", None)
    assert (prompt.minimum, prompt.maximum) == (-60.0, 105.0)
    assert prompt.action == {"do": "read_temperature"}


@pytest.mark.parametrize("typed", ["", "warm", "nan", "1e1", "105.1", "-60.1", Answer("old", "20")])
def test_implausible_temperatures_are_asked_again(typed: str | Answer) -> None:
    c, person = chamber(typed, "21.5")
    assert c.temperature("k") == 21.5
    assert [prompt.id for prompt in person.prompts] == ["k#1", "k#2"]
    assert person.prompts[1].text != person.prompts[0].text


def test_no_plausible_temperature_is_a_bad_reading() -> None:
    c, _ = chamber(*["200"] * ATTEMPTS)
    with pytest.raises(BadReading, match="no plausible temperature"):
        c.temperature("k")


def test_a_temperature_that_the_thermometer_cannot_show_is_asked_again() -> None:
    person = Script(["-", "999", "23,4 °C", *["hot"] * ATTEMPTS])
    thermometer = ManualThermometer("thermometer", person, minimum_c=-50.0, maximum_c=120.0, sensor="glass")
    assert thermometer.block_c("1/mount") == 23.4
    with pytest.raises(BadReading, match="within its range"):
        thermometer.block_c("1/mount")


# --- manual level -----------------------------------------------------------------------------------
# A bubble level read by a person: divisions or arcseconds, and what is asked again.

ARCSEC = math.pi / 648000.0


def level(person, **changes):
    options = {"division_rad": 4 * ARCSEC, "reading_divisions": 0.2, "most_divisions": 10.0, "scale": 0.05}
    return ManualLevel("level", person, **options | {"turn_rad": 0.02} | changes)


def test_divisions_are_counted_as_angles():
    person = Script(["-1.5", "2"])
    found = level(person).inclination("3/level", turned=False)
    assert (found.along_rad, found.across_rad) == pytest.approx((-6 * ARCSEC, 8 * ARCSEC))
    along, across = person.prompts
    assert "away from you" in along.text
    assert "to your right" in across.text
    assert along.action == {
        "do": "read_level", "axis": "along", "turned": False, "division_rad": 4 * ARCSEC,
        "most_divisions": 10.0,
    }  # fmt: skip


@pytest.mark.parametrize("typed", ["7 arcsec", "7″", '7"', "+7.0 ARCSEC"])
def test_arcseconds_may_be_typed(typed):
    found = level(Script([typed, "0"])).inclination("3/level", turned=True)
    assert found.along_rad == pytest.approx(7 * ARCSEC)


def test_what_is_off_the_vial_or_no_number_is_asked_again():
    person = Script(["in the middle", "12", "1,5", "0"])
    assert level(person).inclination("3/level", turned=True).along_rad == pytest.approx(6 * ARCSEC)
    assert "not a number of divisions" in person.prompts[1].text
    assert "off the vial's scale of ±10 divisions" in person.prompts[2].text
    assert len({prompt.id for prompt in person.prompts}) == 4


def test_a_bubble_that_never_comes_onto_the_scale_is_no_reading():
    with pytest.raises(BadReading, match="level the platform roughly"):
        level(Script(["99"] * ATTEMPTS)).inclination("3/level", turned=False)


def test_its_sizes_are_stated():
    sizes = level(Script([])).sizes
    assert sizes.reading_rad == pytest.approx(0.8 * ARCSEC)
    assert (sizes.scale, sizes.cross) == (0.05, 0.02)


# --- manual supply ----------------------------------------------------------------------------------
# A supply that a person works: asked in order, what is read held against what was demanded.

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


@pytest.mark.parametrize(("on", "remedy"), [(True, "protection has tripped"), (False, "switch it off, then")])
def test_a_switch_that_was_not_turned_is_told_with_its_own_remedy(on, remedy):
    hand = Hand(switch=["off" if on else "on"] * 2)
    hand.shows |= {"set_voltage": "15.00", "current_limit": "0.200"}
    driver = supply(hand)
    driver.set_up(WANTED, "1/supply")
    with pytest.raises(InstrumentRefused, match=f"is not {'on' if on else 'off'}; .*{remedy}"):
        driver.switch("+", on, "2")


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
    hand.says = {"voltage": ["?"] * ATTEMPTS}
    with pytest.raises(BadReading, match=f"{ATTEMPTS} attempts"):
        driver.state("3")
