"""A bubble level read by a person: divisions or arcseconds, and what is asked again."""

from __future__ import annotations

import math

import pytest

from drivers.instruments.manual import ManualLevel
from drivers.interfaces import BadReading
from drivers.person import Answer

ARCSEC = math.pi / 648000.0


class Answers:
    def __init__(self, *texts):
        self.texts, self.prompts = list(texts), []

    def ask(self, prompt):
        self.prompts.append(prompt)
        return Answer(prompt.id, self.texts.pop(0))


def level(person, **changes):
    options = {"division_rad": 4 * ARCSEC, "reading_divisions": 0.2, "most_divisions": 10.0, "scale": 0.05}
    return ManualLevel("level", person, **options | {"turn_rad": 0.02} | changes)


def test_divisions_are_counted_as_angles():
    person = Answers("-1.5", "2")
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
    found = level(Answers(typed, "0")).inclination("3/level", turned=True)
    assert found.along_rad == pytest.approx(7 * ARCSEC)


def test_what_is_off_the_vial_or_no_number_is_asked_again():
    person = Answers("in the middle", "12", "1,5", "0")
    assert level(person).inclination("3/level", turned=True).along_rad == pytest.approx(6 * ARCSEC)
    assert "not a number of divisions" in person.prompts[1].text
    assert "off the vial's scale of ±10 divisions" in person.prompts[2].text
    assert len({prompt.id for prompt in person.prompts}) == 4


def test_a_bubble_that_never_comes_onto_the_scale_is_no_reading():
    with pytest.raises(BadReading, match="level the platform roughly"):
        level(Answers(*["99"] * 5)).inclination("3/level", turned=False)


def test_its_sizes_are_stated():
    sizes = level(Answers()).sizes
    assert sizes.reading_rad == pytest.approx(0.8 * ARCSEC)
    assert (sizes.scale, sizes.cross) == (0.05, 0.02)
