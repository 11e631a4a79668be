"""What slips or is changed in single passes, against geometry of the tests' own."""

import numpy as np
import pytest

from bench.model.effects.base import pass_label, rows_of
from tests.support.effect_bench import CONDITIONS, DIRECTION, SECOND, U0, K, added, effect, force, readings
from tests.support.paper_bench import ARCSEC

ANGLE = 300 * ARCSEC
OTHER = np.where(DIRECTION < 0, 2, 1)
"""The falling pass of each installation is its second."""


def by_pass():
    from dataclasses import replace

    return replace(CONDITIONS, pass_number=OTHER)


@pytest.mark.parametrize(
    ("parameter", "turned"),
    [("mounting_error", "alpha3"), ("mounting_offset", "alpha2"), ("mounting_roll", "alpha5")],
)
def test_a_slip_turns_the_block_in_the_passes_named(parameter, turned):
    conditions = by_pass()
    rows = SECOND & (OTHER == 2)
    got = readings(effect("block_slip", ("2 pass 2",), **{parameter: ANGLE}), conditions=conditions)
    expected = force(**{turned: np.where(rows, ANGLE, 0.0)}) @ K.T + U0
    np.testing.assert_allclose(got, expected, atol=1e-9)


def test_a_zero_is_another_in_a_pass_and_a_mounting():
    labels = ("1 pass 2", "2")
    rows = SECOND | (OTHER == 2)
    got = readings(effect("head_zero_shift", labels, angle=ANGLE), conditions=by_pass())
    np.testing.assert_allclose(got, force(phi=np.where(rows, ANGLE, 0.0)) @ K.T + U0, atol=1e-9)


def test_exchanged_meters_differ_by_as_much_at_either_channel():
    """z reads with x's meter and x with z's: what one gains the other loses, in parts of its own voltage."""
    got = added("meters_exchanged", zx_gain=40e-6, zx_zero=70e-6)
    volts = readings()
    expected = np.zeros_like(volts)
    expected[:, 2] = 40e-6 * volts[:, 2] + 70e-6
    expected[:, 0] = -(40e-6 * volts[:, 0] + 70e-6)
    np.testing.assert_allclose(got, expected, atol=1e-12)


def test_rows_of_mountings_and_of_passes():
    conditions = by_pass()
    assert pass_label("2/3", 4) == "2/3 pass 4"
    np.testing.assert_array_equal(rows_of(("1", "2 pass 1"), conditions), ~SECOND | (OTHER == 1))
    assert not rows_of(("3", "1 pass 7"), conditions).any()
