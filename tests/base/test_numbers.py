"""Numbers as they are typed: what only Python takes for one is none."""

import pytest

from bench.api.errors import Refused
from bench.api.quantities import quantity
from bench.base.numbers import read_number
from bench.base.units import ACCELERATION, RATIO, parse_quantity
from drivers.angles import parse_angle
from drivers.typed import typed_supply, typed_temperature


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
