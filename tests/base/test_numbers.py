"""Numbers as pages have them: u and U to two digits, estimates to the same place (JCGM 100:2008, 7.2.6)."""

import random
from decimal import Decimal

import pytest

from bench.base.numbers import MINUS, rounded, uncertainty


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
