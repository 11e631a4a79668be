"""Voltmeters against their drivers' times and their data sheets; statistics against tables (seed 20261122)."""

import numpy as np
import pytest

from bench.run.commission.meters import (
    NOISE_SAMPLES,
    SIGNIFICANCE,
    check_noise,
    check_settings,
    check_time,
    check_together,
    largest_scatter_v,
    scatter_limit_v,
    zero_limit_v,
)
from bench.run.commission.session import State
from bench.run.instruments import Instruments
from tests.support.commission_bench import Head, Says, evening, meters

CHI2_29_AT_0_999 = 58.301
"""Tables of chi-square: 29 degrees of freedom, probability 0.999."""


def tonight(clock, **settings):
    made = meters(clock, **settings)
    return evening(Says(), clock, Instruments(made, Head("head", clock, (-0.1, 6.0))))


def states(given):
    return [(one.instrument, one.state) for one in given.findings]


def test_settings_are_two_and_came_back(clock):
    given = tonight(clock)
    check_settings(given)
    assert states(given) == [(f"voltmeter.{c}", State.WORKS) for c in "xyz"]
    assert "10 V with 10 NPLC and 1 NPLC" in given.findings[0].said


def test_a_reading_in_time_works_and_a_late_one_is_slower(clock):
    given = tonight(clock)
    given.instruments.voltmeters[1].sample_s = 0.47
    check_time(given)
    assert [state for _, state in states(given)] == [State.WORKS, State.SLOWER, State.WORKS]
    late = given.findings[1]
    assert "in 4.7 s where the driver expects 4.1 s" in late.said
    assert (late.figures[-1].value, late.figures[-1].unit) == (pytest.approx(4.7), "s")


def test_meters_started_one_after_the_other_do_not_sample_together(clock):
    given = tonight(clock)
    check_together(given)
    assert given.findings[0].state is State.WORKS
    given = tonight(clock, start_s=0.3)
    check_together(given)
    (found,) = given.findings
    assert found.state is State.SLOWER
    assert found.figures[0].value == pytest.approx(0.6)


def test_the_bound_of_the_scatter_is_that_of_the_tables():
    assert largest_scatter_v(1e-5, 30) == pytest.approx(1e-5 * np.sqrt(CHI2_29_AT_0_999 / 29), rel=1e-4)


def test_a_meter_within_the_bound_is_seldom_said_to_be_outside():
    """Of 20,000 meters that scatter just as much as they may, about one in a thousand (seed 20261122)."""
    generator = np.random.default_rng(20261122)
    s_v = generator.normal(0.0, 1e-5, (20_000, NOISE_SAMPLES)).std(axis=1, ddof=1)
    outside = int(np.sum(s_v > largest_scatter_v(1e-5, NOISE_SAMPLES)))
    expected = 20_000 * SIGNIFICANCE
    assert abs(outside - expected) < 4.0 * np.sqrt(expected)


def test_the_limits_are_the_data_sheets(clock):
    """34461A, 10 V range: 0.0005 % of the range at zero in 90 days; 6 1/2 digits (1e-6) at 10 NPLC."""
    given = tonight(clock)
    meter = given.instruments.voltmeters[0]
    assert zero_limit_v(given, meter) == pytest.approx(50e-6)
    assert scatter_limit_v(given, meter, 10.0) == pytest.approx(10e-6)
    assert scatter_limit_v(given, meter, 1.0) == pytest.approx(30e-6)


def test_shorted_inputs_are_asked_for_and_given_back(clock):
    given = tonight(clock)
    check_noise(given)
    sources = [prompt.action["source"] for prompt in given.person._person.asked]
    assert sources == ["short", "signal"]
    assert all(prompt.default is None for prompt in given.person._person.asked)
    assert [state for _, state in states(given)] == [State.WORKS] * 3


@pytest.mark.parametrize(
    ("samples_v", "said"),
    [
        ((2.14, 2.14), "x reads 2.14 V"),  # nobody shorted it
        ((40e-6, -40e-6), "x scatters by"),
        ((0.4e-3, 0.4e-3), "x reads 400 µV, more than 300 µV from zero"),  # the bench file's 0.3 mV
    ],
)
def test_what_is_not_within_the_limits_is_told(clock, samples_v, said):
    given = tonight(clock)
    given.instruments.voltmeters[0].samples_v = samples_v
    check_noise(given)
    assert given.findings[0].state is State.OTHER
    assert said in given.findings[0].said
    assert "short the input" in given.findings[0].remedy
    assert given.findings[1].state is State.WORKS
