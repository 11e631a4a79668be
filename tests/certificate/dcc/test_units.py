r"""Units of D-SI: written, multiplied, read."""

import pytest

from bench.certificate.dcc.nodes import VOLT_PER_MS2, product, read_unit


@pytest.mark.parametrize(
    ("text", "factor", "dimension"),
    [
        (r"\volt", 1.0, {"V": 1}),
        (r"\milli\volt", 1e-3, {"V": 1}),
        (r"\volt\metre\tothe{-1}\second\tothe{2}", 1.0, {"V": 1, "m": -1, "s": 2}),
        (r"\volt\per\metre\second\tothe{2}", 1.0, {"V": 1, "m": -1, "s": 2}),
        (r"\micro\volt\tothe{2}", 1e-12, {"V": 2}),
        (r"\one", 1.0, {}),
        (r"\degree", 0.017453292519943295, {}),
        (r"\kilo\metre\per\hour", 1000 / 3600, {"m": 1, "s": -1}),
    ],
)
def test_units_are_read(text, factor, dimension):
    size, powers = read_unit(text)
    assert size == pytest.approx(factor, rel=1e-15)
    assert powers == dimension


@pytest.mark.parametrize(
    "text", ["V", "", r"\volt V", r"\vold", r"\milli", r"\tothe{2}", r"\volt\per", r"\volt\tothe"]
)
def test_what_is_no_unit_is_refused(text):
    with pytest.raises(ValueError, match="unit"):
        read_unit(text)


def test_products_have_the_dimension_of_both():
    assert read_unit(product(VOLT_PER_MS2, r"\volt")) == (1.0, {"V": 2, "m": -1, "s": 2})
    assert read_unit(product(VOLT_PER_MS2, VOLT_PER_MS2)) == (1.0, {"V": 2, "m": -2, "s": 4})
    assert product(r"\one", r"\one") == r"\one"
    assert product(r"\one", r"\volt") == r"\volt"
