"""What `bench validate` compares of exported files."""

import pytest

from bench.validation.records import as_expected, expected


@pytest.mark.parametrize("factor", [1.0, 1.0003])
def test_an_expanded_uncertainty_that_is_off_by_parts_in_ten_thousand_is_found(factor):
    """An absolute tolerance, such as numpy's 1e-8, would hide it: u of the first coefficient is 1e-6 V/g."""
    rows = [(name, value, (u or 0.0) * factor, unit) for name, (value, u, unit) in expected().items()]
    assert as_expected("csv", rows).passed == (factor == 1.0)
