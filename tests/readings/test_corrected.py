"""Known errors of the instruments taken away: their sign, once only, and what stays as it was read."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.readings.corrected import Corrections, corrected
from bench.readings.table import JoinedPart, make_readings, together
from tests.support.paper_bench import simulate

N = 4
TRUE_V = np.array([[1.0, -2.0, 0.5], [2.1, 0.3, -1.7], [-0.4, 1.9, 2.0], [0.0, -1.1, 1.2]])


def table(signal, **columns):
    return make_readings(
        ["1"] * N, [1] * N, [1, 2, 3, 4], np.radians([0.0, 90.0, 359.0, 405.0]), signal, **columns
    )


def test_a_meter_that_reads_too_much_is_corrected_to_less():
    too_much = np.array([100e-6, 0.0, -30e-6])
    zero_v = np.array([50e-6, -20e-6, 0.0])
    shown = TRUE_V * (1.0 + too_much) + zero_v
    by = Corrections(gain=(-100e-6, 0.0, 30e-6), offset_v=(-50e-6, 20e-6, 0.0))
    found = corrected(table(shown), by)
    # of second order in the errors: (100 ppm)² of 2 V and 100 ppm of 50 µV
    assert np.allclose(found.signal, TRUE_V, atol=3e-8, rtol=0)
    assert np.max(np.abs(shown - TRUE_V)) > 1e-4


def test_the_table_of_the_head_is_drawn_straight_and_goes_round():
    by = Corrections(
        head=((math.radians(10.0), 1e-5), (math.radians(100.0), 3e-5), (math.radians(350.0), -1e-5))
    )
    added = corrected(table(TRUE_V), by).angle_rad - table(TRUE_V).angle_rad
    # 0° lies in the middle of 350° and 10°, 359° at 9/20 of the way, 405° at 35/90 of that from 10° to 100°
    middle = 1e-5 + 80.0 / 90.0 * 2e-5
    assert added == pytest.approx([0.0, middle, -1e-5 + 9 / 20 * 2e-5, 1e-5 + 35 / 90 * 2e-5], abs=1e-12)


def test_beyond_its_ends_a_thermometer_has_the_correction_of_the_end():
    read_c = np.array([-10.0, 10.0, 20.0, np.nan])
    found = corrected(table(TRUE_V, temperature_c=read_c), Corrections(thermometer=((0.0, 0.2), (20.0, 0.6))))
    assert found.temperature_c[:3] == pytest.approx([-9.8, 10.4, 20.6])
    assert np.isnan(found.temperature_c[3])


def test_readings_are_corrected_once():
    by = Corrections(gain=(-1e-4, 0.0, 0.0))
    once = corrected(table(TRUE_V), by)
    assert once.corrected
    assert corrected(once, by) is once
    assert corrected(once.select(np.array([True, False, True, True])), by).signal[0, 0] == once.signal[0, 0]


def test_signals_that_are_no_volts_stay():
    found = corrected(table(TRUE_V, unit="counts"), Corrections(gain=(-1e-4, 0.0, 0.0)))
    assert np.array_equal(found.signal, TRUE_V)


def test_the_last_digit_stays_that_of_what_was_read():
    read = table(np.round(TRUE_V, 4))
    found = corrected(read, Corrections(gain=(-12e-6, 0.0, 0.0)))
    assert read.resolution == found.resolution == 0.1
    assert replace(found, resolution_read=None).resolution < 1e-6  # what its digits would say
    fine = replace(simulate(None, 0.0), source="fine")
    assert (
        together([JoinedPart(corrected(fine, Corrections(gain=(1e-6, 0.0, 0.0))))]).resolution
        == fine.resolution
    )


def test_nothing_to_correct_leaves_the_readings_alone():
    read = table(TRUE_V)
    assert corrected(read, Corrections()) is read
