"""Numbers: as pages have them (JCGM 100:2008, 7.2.6), and as they are typed."""

import random
from decimal import Decimal

import pytest

from bench.base.numbers import MINUS, read_number, rounded, uncertainty
from bench.base.units import ACCELERATION, RATIO, parse_quantity
from bench.services.errors import Refused, quantity
from drivers.angles import parse_angle, typed_supply, typed_temperature


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
