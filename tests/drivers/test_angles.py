"""Angles as operators type them."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.angles import classic_slip, format_dms, parse_angle, read_angle, wrapped_rad

SECOND = math.radians(1.0 / 3600.0)


def dms(degrees: float, minutes: float = 0.0, seconds: float = 0.0) -> float:
    return math.radians(degrees + minutes / 60.0 + seconds / 3600.0)


@pytest.mark.parametrize(
    ("text", "angle_rad"),
    [
        ("45 00 10", dms(45, 0, 10)),
        ("  45   0  10 ", dms(45, 0, 10)),
        ("45°00'10\"", dms(45, 0, 10)),
        ("45°00′10″", dms(45, 0, 10)),
        ("45° 00' 10''", dms(45, 0, 10)),
        ("45º00’10”", dms(45, 0, 10)),
        ("45°00′10", dms(45, 0, 10)),
        ("45:00:10", dms(45, 0, 10)),
        ("45 00 10.5", dms(45, 0, 10.5)),
        ("45 00 10,5", dms(45, 0, 10.5)),
        ("45 30", dms(45, 30)),
        ("45", dms(45)),
        ("45°", dms(45)),
        ("45.0028", dms(45.0028)),
        ("45,0028", dms(45.0028)),
        ("-0 00 02", -2 * SECOND),
        ("−0°00′02″", -2 * SECOND),
        ("+1 00 00", dms(1)),
        ("360 00 00", math.tau),
        ("360 00 03", math.tau + 3 * SECOND),
    ],
)
def test_parse(text: str, angle_rad: float) -> None:
    assert parse_angle(text) == pytest.approx(angle_rad, abs=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "", "-", "abc", "45 60 00", "45 00 60", "45 00 10 1", "45.5 10", "45 10.5 3", "45.00.10", "1,234.5",
        "45°10″", "45'", "45:", "nan", "inf", "1e3", "45d", "- -45", "45 -10 00", "361", "450010",
    ],
)  # fmt: skip
def test_what_is_not_an_angle_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ValueError, match="such as 45 00 10") as caught:
        parse_angle(text)
    assert repr(text) in str(caught.value)


@pytest.mark.parametrize(
    ("text", "arcsec"), [('+5"', 5.0), ("-12″", -12.0), ("−0,5''", -0.5), ('+ 7.25"', 7.25)]
)
def test_a_deviation_from_the_commanded_angle_may_be_typed(text: str, arcsec: float) -> None:
    target_rad = math.radians(315.0)
    assert read_angle(text, target_rad, 1e-3) == pytest.approx(target_rad + math.radians(arcsec / 3600.0))


@pytest.mark.parametrize("text", ['5"', "+5", '+5 5"', '+"', '+12345"', "+5'"])
def test_a_deviation_has_its_sign_and_its_mark(text: str) -> None:
    with pytest.raises(ValueError, match=r"type|below"):
        read_angle(text, math.radians(90.0), 1e-3)


@pytest.mark.parametrize(
    ("angle_rad", "decimals", "text"),
    [
        (dms(45, 0, 10), 0, "45°00′10″"),
        (dms(359, 59, 59.9), 0, "360°00′00″"),
        (dms(44, 59, 59.96), 1, "45°00′00.0″"),
        (dms(45, 0, 10.26), 1, "45°00′10.3″"),
        (-2 * SECOND, 0, "-0°00′02″"),
        (-0.2 * SECOND, 0, "0°00′00″"),
        (0.0, 2, "0°00′00.00″"),
    ],
)
def test_format(angle_rad: float, decimals: int, text: str) -> None:
    assert format_dms(angle_rad, decimals) == text


@given(st.floats(-math.tau, math.tau), st.integers(0, 3))
def test_what_is_printed_reads_back_and_never_shows_sixty(angle_rad: float, decimals: int) -> None:
    text = format_dms(angle_rad, decimals)
    assert "60.0″" not in text
    assert "′60" not in text
    assert "°60" not in text
    assert abs(parse_angle(text) - angle_rad) <= 0.5 * SECOND / 10**decimals + 1e-12


@given(st.floats(-100.0, 100.0))
def test_wrapped_is_the_same_place(angle_rad: float) -> None:
    wrapped = wrapped_rad(angle_rad)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped - angle_rad) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("read", "target", "named"),
    [
        (dms(46, 0, 4), dms(45), "degree line is one off (1°)"),
        (dms(44, 0, -4), dms(45), "degree line is one off (1°)"),
        (dms(45, 10, 5), dms(45), "tens of minutes are one off (10′)"),
        (dms(44, 50), dms(45), "tens of minutes are one off (10′)"),
        (dms(45, 1, 3), dms(45), "minute line is one off (1′)"),
        (dms(44, 59), dms(45), "minute line is one off (1′)"),
        (dms(315, 0, 3), dms(45), "360° - x"),
        (dms(55), dms(45), "tens of degrees"),
        (dms(225, 0, 5), dms(45), "opposite side"),
        (dms(359), 0.0, "degree line"),
        (dms(54), dms(45), "two digits are swapped"),
        (dms(45, 21), dms(45, 12), "two digits are swapped"),
    ],
)
def test_classic_slips_are_named(read: float, target: float, named: str) -> None:
    slip = classic_slip(read, target, 30 * SECOND)
    assert slip is not None
    assert named in slip


@pytest.mark.parametrize(
    ("read", "target"),
    [
        (dms(45, 0, 10), dms(45)),
        (dms(0, 0, 3), math.tau),
        (dms(359, 59, 58), 0.0),
        (dms(45, 3, 20), dms(45)),
        (dms(47, 12), dms(45)),
    ],
)
def test_a_good_or_an_unexplained_reading_is_no_slip(read: float, target: float) -> None:
    assert classic_slip(read, target, 30 * SECOND) is None
