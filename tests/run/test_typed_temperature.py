"""A temperature typed far from what is expected is asked about once, and what the person answers counts."""

import pytest

from bench.run.instruments import (
    Instruments,
    TemperatureCheck,
    told_around,
    told_at_mounting,
    told_at_reading,
)
from drivers.instruments.manual import ManualChamber, ManualThermometer
from drivers.person import Answer, PromptKind


class Typing:
    """A person who types these answers, one after the other; `asked` are the questions."""

    def __init__(self, *answers: str) -> None:
        self.answers = list(answers)
        self.asked = []

    def ask(self, prompt):
        self.asked.append(prompt)
        return Answer(prompt.id, self.answers.pop(0))

    @property
    def doubts(self) -> list[str]:
        """The questions whether a temperature is right."""
        return [prompt.text for prompt in self.asked if prompt.kind is PromptKind.CONFIRM]


def chamber(person: Typing) -> Instruments:
    return Instruments((), None, chamber=ManualChamber("chamber", person, minimum_c=-40.0, maximum_c=85.0))


def thermometer(person: Typing, of: str = "block") -> ManualThermometer:
    return ManualThermometer("t", person, minimum_c=-40.0, maximum_c=85.0, sensor="glass", of=of)


@pytest.mark.parametrize(
    ("typed", "before", "doubt"),
    [
        ("44", {}, "44 °C: 21 °C from the 23 °C of a usual room. Is that right?"),
        ("-23", {"last_c": 23.2}, "-23 °C: 46.2 °C from the 23.2 °C read before. Is that right?"),
        ("44", {"demanded_c": 55.0}, "44 °C: 11 °C from the 55 °C set. Is that right?"),
        (
            "28,4", {"last_c": 23.0, "demanded_c": 40.0},
            "28.4 °C: 5.4 °C from the 23 °C read before. Is that right?",
        ),
    ],
)  # fmt: skip
def test_an_unexpected_temperature_is_asked_about_once(typed, before, doubt):
    person = Typing(typed, "yes")
    found_c = told_at_mounting(chamber(person), "3/mount", TemperatureCheck(person, **before))
    assert found_c == float(typed.replace(",", "."))
    assert person.doubts == [doubt]
    assert person.asked[1].default is None  # Enter alone confirms nothing


@pytest.mark.parametrize(
    ("typed", "before"),
    [("31", {}), ("13.5", {}), ("27.9", {"last_c": 23.0}), ("-22", {"demanded_c": -20.0})],
)  # fmt: skip
def test_an_expected_temperature_is_not_asked_about(typed, before):
    person = Typing(typed)
    assert told_at_reading(chamber(person), None, "4/read", TemperatureCheck(person, **before)) == (
        float(typed),
        None,
    )
    assert person.doubts == []


def test_after_no_the_temperature_is_typed_again():
    person = Typing("44", "no", "33.2", "no", "23.2")
    block = Instruments((), None, thermometer=thermometer(person))
    assert told_at_mounting(block, "3/mount", TemperatureCheck(person, 23.0)) == 23.2
    assert len(person.doubts) == 2
    ids = [prompt.id for prompt in person.asked]
    assert ids[0] == "3/mount/thermometer#1"
    assert len(set(ids)) == len(ids)


def test_room_and_meters_are_compared_with_what_was_typed_before():
    person = Typing("32", "no", "23", "24")
    around = {"meter_temperature_c": thermometer(person, "meter"), "room_c": thermometer(person, "room")}
    before = {"meter_temperature_c": 23.5}
    told = told_around(
        Instruments((), None, around=around),
        {},
        None,
        "5/mount",
        lambda c: TemperatureCheck(person, before.get(c)),
    )
    assert told == {"meter_temperature_c": 23.0, "room_c": 24.0}
    assert person.doubts == ["32 °C: 8.5 °C from the 23.5 °C read before. Is that right?"]
