"""What slips or is changed in single passes, against geometry of the tests' own."""

import numpy as np
import pytest

from bench.model.effects.base import pass_label, rows_of
from bench.validation.paper_bench import ARCSEC
from tests.support.effect_bench import (
    CONDITIONS,
    DIRECTION,
    SECOND,
    TIME_S,
    U0,
    K,
    added,
    effect,
    force,
    readings,
)

ANGLE = 300 * ARCSEC
OTHER = np.where(DIRECTION < 0, 2, 1)
"""The falling pass of each installation is its second."""
SINCE_MOUNTING_S = TIME_S - np.where(SECOND, TIME_S[18], TIME_S[0])
EXCHANGES = [f"{pair}_{what}" for pair in ("xy", "yz", "zx") for what in ("gain", "zero")]


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


@pytest.mark.parametrize(
    ("parameter", "turned"),
    [("mounting_error", "alpha3"), ("mounting_offset", "alpha2"), ("mounting_roll", "alpha5")],
)
@pytest.mark.parametrize("mounts", [(), ("2",)])
def test_a_block_that_creeps_settles_from_the_first_reading_of_its_mounting_on(parameter, turned, mounts):
    left = ANGLE * np.exp(-SINCE_MOUNTING_S / 2100.0) * (SECOND if mounts else 1.0)
    got = readings(effect("mounting_creep", mounts, **{parameter: ANGLE, "tau": 2100.0}))
    np.testing.assert_allclose(got, force(**{turned: left}) @ K.T + U0, atol=1e-9)


def test_a_step_of_scale_is_of_the_passes_named_and_of_its_channel():
    step = np.array([0.0, 80e-6, -50e-6])
    rows = SECOND | (OTHER == 2)
    got = added("scale_step", ("1 pass 2", "2"), conditions=by_pass(), step=step)
    expected = np.where(rows[:, None], force() * np.diag(K) * step, 0.0)
    np.testing.assert_allclose(got, expected, atol=1e-12)


def test_a_step_of_the_reference_is_a_factor_of_all_voltages():
    got = added("reference_step", ("2 pass 2",), conditions=by_pass(), step=40e-6)
    rows = SECOND & (OTHER == 2)
    expected = np.where(rows[:, None], 40e-6 * (force() @ K.T + U0), 0.0)
    np.testing.assert_allclose(got, expected, atol=1e-12)


def test_exchanged_meters_are_no_change_of_all_gains():
    """Two meters at each other's channels change two gains by opposite parts; a rotation of three sums to zero."""
    changed = sum(
        np.outer([1.0, -1.0, 0.0] if pair == "xy" else [0.0, 1.0, -1.0], [1.0]) * part
        for pair, part in (("xy", 30e-6), ("yz", -50e-6))
    ).ravel()
    got = added("meters_exchanged", xy_gain=30e-6, yz_gain=-50e-6)
    np.testing.assert_allclose(got, readings() * changed, atol=1e-12)
    of_all = added("scale_step", step=np.full(3, 40e-6))
    exchanged = [added("meters_exchanged", **{name: 1e-4}) for name in EXCHANGES]
    columns = np.stack([one.ravel() for one in exchanged], axis=1)
    left = of_all.ravel() - columns @ np.linalg.lstsq(columns, of_all.ravel(), rcond=None)[0]
    assert np.linalg.norm(left) > 0.9 * np.linalg.norm(of_all)


def test_rows_of_mountings_and_of_passes():
    conditions = by_pass()
    assert pass_label("2/3", 4) == "2/3 pass 4"
    np.testing.assert_array_equal(rows_of(("1", "2 pass 1"), conditions), ~SECOND | (OTHER == 1))
    assert not rows_of(("3", "1 pass 7"), conditions).any()
