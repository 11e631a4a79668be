"""Free positions alone: what |a| = 1 g shows of a sensor, simulated and of a real board."""

from pathlib import Path

import numpy as np
import pytest

from bench.calibration import CalibrationError
from bench.diagnosis.free_positions import diagnose_free
from bench.diagnosis.free_records import make_rows
from bench.model import CATALOGUE, AppliedEffect, ForwardModel
from bench.readings.csv import read_csv
from bench.readings.table import all_free, make_readings
from bench.results.diagnosis_parts import gap_part

MIMU = Path(__file__).parents[1] / "data" / "mimu"
K = np.array([[2060.0, 12.0, -7.0], [0.0, 2045.0, 21.0], [0.0, 0.0, 2052.0]])
U0 = np.array([-55.0, 20.0, -110.0])
NOISE = 0.2
"""Counts: 0.1 mg."""


def positions(seed, count=36, *, add=None, zeros=(0.0, 0.0, 0.0), scale=1.0):
    """A record; `add` gives what comes to the signal, in g, of the force (n, 3) and the time (n,) in s."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(count, 3))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    time_s = 25.0 * np.arange(count) + 12.0
    extra = 0.0 if add is None else add(a, time_s)
    signal = (a + extra + np.array(zeros)) @ (K * scale).T + U0 + rng.normal(0.0, NOISE, (count, 3))
    return make_readings(
        ["F"] * count, [1] * count, list(range(1, count + 1)), np.full(count, np.nan), signal,
        source=f"record {seed}", unit="counts", time_s=time_s + seed,
    )  # fmt: skip


def board(records=range(1, 10), sensors=range(4)):
    labels = ("1", "2", "V")
    return [read_csv(MIMU / f"run{r}-sensor{s}.csv", labels) for r in records for s in sensors]


@pytest.mark.slow
def test_a_sensor_that_is_right_is_said_to_agree():
    verdicts = [diagnose_free([positions(seed)]).verdict for seed in range(20)]
    # 1 % or less of alarms: two of twenty would come by chance in 2 %
    assert verdicts.count("agrees") >= 19


def test_a_square_of_the_sensor_is_named_with_its_size():
    """K2 = 2 mg/g^2 of y, twenty times the noise."""
    found = diagnose_free([positions(1, 60, add=lambda a, t: a**2 * [0.0, 2e-3, 0.0])])
    first = found.effects[0]
    assert "quadratic_nonlinearity" in {first.name, *first.cannot_tell_from}
    assert first.odds[0].name in {first.name, *first.cannot_tell_from}
    assert 0.99 <= sum(one.probability for one in first.odds) <= 1.0
    if first.name == "quadratic_nonlinearity":
        value = next(one for one in first.parameters if (one.parameter, one.channel) == ("K2", "y"))
        assert abs(value.value - 2000.0) < 4 * value.u
    assert found.gap.after < 0.2 * found.gap.before


def test_a_zero_that_settles_in_time_is_found():
    def settling(a, t):
        return np.exp(-t / 300.0)[:, None] * [0.0, 0.0, 5e-3]

    found = diagnose_free([positions(2, 40, add=settling)])
    first = found.effects[0]
    assert "warm_up" in {first.name, *first.cannot_tell_from}
    assert found.gap.after_rms < 0.5 * found.gap.before_rms


def test_a_position_in_motion_stands_apart_and_is_left_out():
    moved = positions(3)
    moved.signal[7] *= 1.004
    found = diagnose_free([moved])
    assert found.verdict == "mistake"
    assert len(found.apart) == 1
    assert "point 8" in found.apart[0]
    assert not found.effects


@pytest.mark.slow
def test_zeros_of_each_record_are_found_and_their_ratio_held_out_by_record():
    rng = np.random.default_rng(4)
    records = [positions(seed, 25, zeros=rng.normal(0.0, 2e-3, 3)) for seed in range(6)]
    found = diagnose_free(records, one_sensor=True)
    assert found.verdict == "unknown"
    assert found.effects[0].name == "zeros_by_run"
    assert found.between.repeats.scatter > 10
    assert found.between.repeats.held_before.value > 10
    assert found.between.repeats.held_after.value < 3
    assert "the cause is not determined" in found.effects[0].words
    assert found.between.repeats.term.name == "restart"
    # 2 mg, widened for five degrees of freedom
    sizes = found.between.repeats.term.size / 1.31
    assert np.all((sizes > 1e-3) & (sizes < 4e-3))
    assert found.between.in_bench_file().startswith("uncertainty: {zero_repeats: {restart: [")


@pytest.mark.slow
def test_zeros_that_stay_are_not_said_to_change():
    found = diagnose_free([positions(seed, 25) for seed in range(6)])
    assert found.verdict == "agrees"
    # 18 numbers of 16 degrees of freedom each: about 1
    assert 0.6 < found.between.repeats.scatter < 1.6


def test_tables_with_the_same_times_are_sensors_side_by_side():
    rows = make_rows(board(range(1, 4)))
    assert rows.sensors == 4
    assert [len(np.unique(rows.record[rows.sensor == s])) for s in range(4)] == [3] * 4
    for number, table in enumerate(rows.tables):
        names = {Path(part).stem[-1] for part in table.source.split(" + ")}
        assert len(names) == 1, number


@pytest.mark.slow
def test_the_zeros_of_a_real_board_change_between_records_alike_in_all_sensors():
    """The data's own description: a scatter of 23 u, the z biases of all sensors together."""
    found = diagnose_free(board(range(1, 8), sensors=(0, 2)))
    assert found.effects[0].name == "zeros_by_run"
    assert found.verdict == "unknown"
    between = found.between
    assert 18 < between.repeats.scatter < 30
    assert between.common[2] > 0.8
    assert between.repeats.held_before.value > 10
    assert between.repeats.held_after.value < 2
    assert between.repeats.held_after.low < 1.0 < between.repeats.held_after.high
    words = found.effects[0].words
    assert "common to the sensors" in words
    assert "cause is not determined" in words
    assert found.gap.after < 2


def test_too_few_positions_are_refused_with_what_to_do():
    with pytest.raises(CalibrationError, match="measure 10 or more"):
        diagnose_free([positions(5, 8)])


def test_so_many_as_determine_the_coefficients_say_nothing_of_what_is_missing():
    with pytest.raises(
        CalibrationError,
        match=r"10 free positions are too few to show the noise: 1 degrees .* measure 2 more",
    ):
        diagnose_free([positions(5, 10)])
    # a fifth held out leaves too few: the gap is not measured, and nothing is named by it
    few = diagnose_free([positions(5, 13)])
    assert gap_part(few.gap).before is None
    assert few.verdict != "named"


def test_only_tables_of_free_positions_are_taken():
    assert all_free([positions(1)])
    assert not all_free([])


def test_an_effect_that_free_positions_cannot_have_is_named():
    class OfAngle(type(CATALOGUE["cubic_nonlinearity"])):
        name = "of_angle"

        def addition(self, values, seen):
            return super().addition(values, seen) * np.cos(seen.conditions.angle_rad)[:, None]

    size = next(p for p in OfAngle.parameters if p.is_size)
    applied = AppliedEffect(OfAngle(), {size.name: np.full(3, size.plausible)})
    model = ForwardModel({}, (applied,), name="mine")
    told = (
        "model mine: of_angle needs a head angle, a time or a temperature, which free positions lack; remove"
    )
    with pytest.raises(CalibrationError, match=told):
        make_rows([positions(1)], None, model)


def test_readings_in_motion_are_refused_and_not_explained():
    moving = positions(6, 60)
    moving.signal[:] *= np.random.default_rng(6).uniform(0.5, 1.5, (60, 1))
    with pytest.raises(CalibrationError, match=r"too much for readings at rest|do not lie on an ellipsoid"):
        diagnose_free([moving])


def test_of_one_sensor_each_table_is_a_record_though_the_times_are_the_same():
    tables = [positions(7, 25), positions(8, 25)]
    tables[1].time_s[:] = tables[0].time_s
    assert len(np.unique(make_rows(tables, one_sensor=True).record)) == 2
    assert make_rows(tables).sensors == 2
