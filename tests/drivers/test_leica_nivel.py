"""The Nivel's blocks as its manual prints them, and what is refused."""

import math

import pytest

from drivers.facts import leica_nivel as facts
from drivers.instruments.leica_nivel import LeicaNivel
from drivers.interfaces import BadReading, Identity, InstrumentRefused
from tests.support.scripted_session import ScriptedSession

FROM_THE_MANUAL = [
    ("C1N1 X:+0.766", (0x02, 0xD1)),
    ("C1N1 ON", (1, 176)),
    ("C1N1 X:-0.084 Y:+0.296 T:+24.4", (6, 74)),
    ("C1N1 000005 1.0", (2, 231)),
    ("C1N1 008", (1, 171)),
]


def sent(command):
    return f"\x16\x02N1C1 {command}\x03"


def answered(said, total=None):
    tail = facts.check_sum(f"C1N1 {said}") if total is None else bytes(total)
    return f"\x16\x02C1N1 {said}\x03" + tail.decode("latin-1")


OPENED = [
    (sent("RB D"), answered("000005 1.0", (2, 231))),
    (sent("RS C"), answered("ON", (1, 176))),
    (sent("RS M"), answered("CONT")),
    (sent("W N 008"), None),
    (sent("R N"), answered("008", (1, 171))),
]


def opened(*further, options=None):
    session = ScriptedSession(OPENED, further)
    level = LeicaNivel("level", session, session.clock, **(options or {}))
    assert level.open() == Identity("Leica", "Nivel200", "000005", "1.0")
    return level, session


@pytest.mark.parametrize(("said", "total"), FROM_THE_MANUAL)
def test_the_check_sum_is_that_of_the_manual(said, total):
    assert facts.check_sum(said) == bytes(total)


def test_inclinations_are_read_as_the_manual_prints_them():
    level, session = opened(
        (sent("R N"), answered("008")),
        (sent("G P"), answered("OK", (1, 173))),
        (sent("G A"), answered("X:-0.084 Y:+0.296 T:+24.4", (6, 74))),
    )
    found = level.inclination("1/level", turned=False)
    assert (found.along_rad, found.across_rad) == pytest.approx((0.296e-3, -0.084e-3))
    assert session.left == []
    asked = dict(session.sent_at_s)
    assert asked[sent("G A")] >= 8.0, "a mean of eight measurements, one a second, is of this position"


def test_axes_may_lie_the_other_way():
    level, _ = opened(
        (sent("R N"), answered("008")),
        (sent("G P"), answered("OK")),
        (sent("G A"), answered("X:-0.084 Y:+0.296 T:+24.4")),
        options={"along": "-X", "across": "+Y"},
    )
    found = level.inclination("1/level", turned=False)
    assert (found.along_rad, found.across_rad) == pytest.approx((0.084e-3, 0.296e-3))
    with pytest.raises(ValueError, match="not both X"):
        LeicaNivel("level", ScriptedSession([]), None, along="+X", across="-X")


@pytest.mark.parametrize(
    ("exchanges", "told"),
    [
        ([(sent("R N"), answered("008")), (sent("G P"), answered("F"))], "exceeds its range"),
        ([(sent("R N"), answered("008", (1, 172)))] * 3, "check sum"),
    ],
)
def test_out_of_range_or_with_a_wrong_check_sum_it_is_no_inclination(exchanges, told):
    level, _ = opened(*exchanges)
    with pytest.raises(BadReading, match=told):
        level.inclination("1/level", turned=False)


def test_one_that_corrects_nothing_is_refused():
    session = ScriptedSession([OPENED[0], (sent("RS C"), answered("OFF", (1, 238)))])
    with pytest.raises(InstrumentRefused, match="corrections"):
        LeicaNivel("level", session, session.clock).open()


def test_its_size_is_that_of_the_data_sheet():
    session = ScriptedSession([])
    sizes = LeicaNivel("level", session, session.clock).sizes
    assert sizes.reading_rad == pytest.approx(4.71e-6, rel=0.01)
    assert sizes.cross == pytest.approx(math.radians(math.hypot(1.0, 2.0)) / math.sqrt(3.0))
