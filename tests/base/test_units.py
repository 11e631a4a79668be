"""Quantities with units in files, and gravity by latitude and height."""

import math
import random
from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.base.numbers import MINUS, read_number, rounded, uncertainty
from bench.base.units import (
    ACCELERATION,
    ANGLE,
    DURATION,
    FREQUENCY,
    GRAVITY,
    RATIO,
    SCALE_FACTOR,
    TEMPERATURE,
    VOLTAGE,
    QuantityKind,
    parse_quantity,
)
from bench.model.geometry import normal_gravity_m_s2
from bench.services.errors import Refused, quantity
from drivers.angles import parse_angle, typed_supply, typed_temperature

CURVATURE = QuantityKind("a value of K2", "30 ug/g^2", "ug/g^2")
SLOPE = QuantityKind("a slope", "60 ug/K", "ug/K")


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [
        ("90 arcsec", ANGLE, 90 * math.pi / 648000),
        ("90″", ANGLE, 90 * math.pi / 648000),
        ("5′", ANGLE, 5 * math.pi / 10800),
        ("-45°", ANGLE, -math.pi / 4),
        ("0.3 mV", VOLTAGE, 3e-4),
        ("20µV", VOLTAGE, 2e-5),
        ("1 h", DURATION, 3600.0),
        ("1.5e2 ms", DURATION, 0.15),
        ("-40 degC", TEMPERATURE, -40.0),
        ("23 °C", TEMPERATURE, 23.0),
        ("−2.18 V/g", SCALE_FACTOR, -2.18),
        ("3e-4 g", ACCELERATION, 3e-4),
        ("9.81 m/s²", GRAVITY, 9.81),
        ("50 Hz", FREQUENCY, 50.0),
        ("35 ppm", RATIO, 3.5e-5),
        ("1 %", RATIO, 0.01),
        ("0.01", RATIO, 0.01),
        ("60 µg/g²", CURVATURE, 60.0),
        ("0.1 mg/K", SLOPE, 100.0),
    ],
)
def test_a_quantity_becomes_si(text, kind, value):
    assert parse_quantity(text, kind) == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize(
    ("text", "kind", "sentence"),
    [
        ("90 mV", ANGLE, "expected an angle such as '90 arcsec', got '90 mV'"),
        ("90", ANGLE, "expected an angle such as '90 arcsec', got '90' without a unit"),
        ("90 arcsek", ANGLE, "got '90 arcsek' (unknown unit 'arcsek', did you mean 'arcsec'?)"),
        ("1 kg", ACCELERATION, "unknown unit 'kg'"),
        ("23 K", TEMPERATURE, "expected a temperature such as '23 degC', got '23 K'"),
        ("1 V + 3 V", VOLTAGE, "got '1 V + 3 V'"),
        ("1 2 V", VOLTAGE, "got '1 2 V'"),
        ("nan V", VOLTAGE, "got 'nan V'"),
        ("1e999 V", VOLTAGE, "which is too large"),
        ("3 g", GRAVITY, "expected an acceleration such as '9.81 m/s^2', got '3 g'"),
        (None, VOLTAGE, "got nothing"),
        ({}, VOLTAGE, "got a mapping"),
        (10, VOLTAGE, "got 10"),
    ],
)
def test_anything_else_is_refused_in_one_sentence(text, kind, sentence):
    with pytest.raises(ValueError, match=r"^expected a") as error:
        parse_quantity(text, kind)
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)


@given(st.floats(-1e6, 1e6, allow_subnormal=False))
def test_degrees_minutes_and_seconds_are_the_same_angle(degrees):
    in_degrees = parse_quantity(f"{degrees!r} deg", ANGLE)
    assert in_degrees == pytest.approx(math.radians(degrees), rel=1e-15, abs=1e-300)
    assert parse_quantity(f"{degrees * 60!r} arcmin", ANGLE) == pytest.approx(in_degrees, rel=1e-14)
    assert parse_quantity(f"{degrees * 3600!r} arcsec", ANGLE) == pytest.approx(in_degrees, rel=1e-14)


def test_normal_gravity_agrees_with_published_values():
    # WGS 84: derived constants of the standard (equator, pole).
    assert normal_gravity_m_s2(0.0) == pytest.approx(9.7803253359, abs=1e-11)
    assert normal_gravity_m_s2(math.pi / 2) == pytest.approx(9.8321849378, abs=2e-10)
    # Moritz, Geodetic Reference System 1980: 9.806199203 at 45°; WGS 84 is 0.0000014356 lower at the equator.
    assert normal_gravity_m_s2(math.pi / 4) == pytest.approx(9.806199203 - 1.4356e-6, abs=2e-8)


@pytest.mark.parametrize("latitude_deg", [0, 30, 50.45, 90])
@pytest.mark.parametrize("height_m", [150.0, 2500.0])
def test_gravity_falls_with_height_as_published(latitude_deg, height_m):
    # Free-air reduction to second order, Hinze et al. (2005), Geophysics 70(4), J25: mGal, metres.
    s2 = math.sin(math.radians(latitude_deg)) ** 2
    mgal = -(0.3087691 - 0.0004398 * s2) * height_m + 7.2125e-8 * height_m**2
    latitude_rad = math.radians(latitude_deg)
    fall = normal_gravity_m_s2(latitude_rad, height_m) - normal_gravity_m_s2(latitude_rad)
    assert fall == pytest.approx(mgal * 1e-5, rel=5e-5)


@pytest.mark.parametrize("latitude_deg", [91, -500, math.nan])
def test_there_is_no_gravity_beyond_the_pole(latitude_deg):
    with pytest.raises(ValueError, match=f"between -90° and 90°, not {latitude_deg:g}°"):
        normal_gravity_m_s2(math.radians(latitude_deg))


# --- numbers ----------------------------------------------------------------------------------------
# Numbers: as pages have them (JCGM 100:2008, 7.2.6), and as they are typed.


@pytest.mark.parametrize(
    ("value", "u", "shown"),
    [
        (10.05762, 0.027, ("10.058", "0.027")),  # both of the GUM
        (10.05762, 0.01047, ("10.058", "0.011")),
        (28.4, 28.05, ("28", "28")),
        (93.4, 187.0, ("90", "190")),
        (-2.0, 177.3, ("0", "180")),
        (-55.2, 177.7, (f"{MINUS}60", "180")),
        (9.81057, 0.0010194, ("9.8106", "0.0010")),
        (1.0, 0.0996, ("1.00", "0.10")),
        (1234.0, 99.6, ("1230", "100")),
        (1.0, 0.0, ("1.000000000", "0")),
    ],
)
def test_an_estimate_ends_at_the_place_of_its_uncertainty(value, u, shown):
    assert (rounded(value, u), uncertainty(u)) == shown


def test_rounding_takes_little_off_an_uncertainty_and_ends_where_the_estimate_does():
    """Over nine decades, seed 27: never 3 % less nor a tenth more; two digits; the estimate has the same place."""
    rng = random.Random(27)  # noqa: S311 - sizes, no secret
    for _ in range(5_000):
        u = 10.0 ** rng.uniform(-6.0, 3.0)
        shown = Decimal(uncertainty(u))
        assert 0.97 * u <= float(shown) <= 1.10 * u
        assert len(shown.normalize().as_tuple().digits) <= 2
        value = rounded(rng.uniform(1.0, 9.0) * 1e4, u)
        assert len(value.partition(".")[2]) == len(uncertainty(u).partition(".")[2])
        if u >= 99.5:  # the last digits are zeros, of both alike
            assert int(value) % 10 == 0


@pytest.mark.parametrize("text", ["1", "-2.5", "+1e-3", " 7 ", ".5"])
def test_a_number_is_read(text):
    assert read_number(text) == float(text)


@pytest.mark.parametrize("text", ["\u0661\u0662", "\uff11", "1_000", "1\u0662", "\u0967.5", "", "1,5"])
def test_digits_of_other_alphabets_are_none(text):
    with pytest.raises(ValueError, match=r"number|could not"):
        read_number(text)
    for read in (parse_angle, typed_temperature, lambda typed: typed_supply(typed, "V")):
        if text != "1,5":
            with pytest.raises(ValueError, match=r"number|angle|temperature"):
                read(text)
    with pytest.raises(ValueError, match="expected"):
        parse_quantity(text, RATIO)
    with pytest.raises(Refused):
        quantity("--accuracy", text, ACCELERATION)
