"""Known errors of the instruments taken away: their sign, once only, and what stays as it was read."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.calibration import calibrate
from bench.model import ForwardModel
from bench.model.geometry import INSTALLATION_1, INSTALLATION_2
from bench.readings.corrected import (
    EXCHANGED,
    REVERSED,
    RIGHT,
    SLIPS_RAD,
    Corrections,
    corrected,
    reflected_rad,
)
from bench.readings.table import JoinedPart, Outlier, Reading, make_readings, readings_of, together
from bench.validation.paper_bench import STAND_U, simulate
from drivers.angles import classic_slip

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


# --- joined -----------------------------------------------------------------------------------------
# Several tables as one body of data: what stays, what is renumbered, where the times go.

MODEL = ForwardModel({"1": INSTALLATION_1, "2": INSTALLATION_2})


def a_table(seed, source, times=True):
    made = simulate(np.random.default_rng(seed), 1e-4)
    return replace(made, source=source, time_s=5.0 + 120.0 * np.arange(54) if times else made.time_s)


def test_no_mounting_of_one_table_is_one_of_another():
    second = a_table(2, "b")
    second = replace(second, series=np.where(second.installation == "2", 2, 1))
    both = together([JoinedPart(a_table(1, "a")), JoinedPart(second), JoinedPart(a_table(3, "c"))])
    mounts = [str(mount) for mount in both.conditions().mounts]
    assert mounts == ["1", "2", "1/2", "2/3", "1/4", "2/4"]
    assert len(both) == 162
    assert both.source == "a + b + c"
    assert np.array_equal(both.signal[54:108], second.signal)


def test_real_beginnings_order_the_tables_and_set_them_apart():
    early, late = JoinedPart(a_table(1, "early"), 1000.0), JoinedPart(a_table(2, "late"), 1000.0 + 86400.0)
    both = together([late, early])
    assert both.source == "early + late"
    assert both.time_s[0] == 0.0
    assert both.time_s[54] - both.time_s[0] == 86400.0
    assert np.all(np.diff(both.time_s) > 0)


@pytest.mark.parametrize("began", [(None, None), (0.0, None), (0.0, 60.0)])
def test_without_beginnings_or_with_impossible_ones_an_hour_lies_between(began):
    both = together([JoinedPart(a_table(1, "a"), began[0]), JoinedPart(a_table(2, "b"), began[1])])
    assert both.time_s[54] - both.time_s[53] == 3600.0
    assert "set, not measured" in both.notes[1]


def test_a_table_without_times_gets_those_of_the_usual_pace():
    both = together([JoinedPart(a_table(1, "a", times=False)), JoinedPart(a_table(2, "b"))])
    assert np.all(np.isfinite(both.time_s))
    # the pace of a run without times: 120 s a setting, 1200 s more for the remount
    assert both.time_s[53] == 53 * 120.0 + 1200.0


def test_columns_of_one_table_alone_are_empty_in_the_other():
    first = replace(a_table(1, "a"), extra={"range_v": np.full(54, "10")}, verification_missing=1)
    both = together([JoinedPart(first), JoinedPart(replace(a_table(2, "b"), notes=("a comment",)))])
    assert set(both.extra["range_v"][:54]) == {"10"}
    assert set(both.extra["range_v"][54:]) == {""}
    assert both.verification_missing == 1
    assert "b: a comment" in both.notes


def test_units_must_agree():
    with pytest.raises(ValueError, match="a in V, b in counts"):
        together([JoinedPart(a_table(1, "a")), JoinedPart(replace(a_table(2, "b"), unit="counts"))])


def test_two_runs_of_one_block_halve_the_variance_of_what_noise_alone_makes_uncertain():
    # without stand errors and settings all uncertainty is noise: 2 x the data, sqrt(2) less u
    tables = [
        simulate(np.random.default_rng(s), 1e-4, stand_u=dict.fromkeys(STAND_U, 0.0), setting_u_rad=0.0)
        for s in (1, 2)
    ]
    u_one = calibrate(tables[0], MODEL, {}, 9.81).u
    u_both = calibrate(together([JoinedPart(t) for t in tables]), MODEL, {}, 9.81).u
    # the noise is estimated from 96 and 192 signals: sd of the ratio about 9 %
    assert np.allclose(u_one / u_both, np.sqrt(2), rtol=0.3)


# --- mistaken ---------------------------------------------------------------------------------------
# The vocabulary of mistakes: what is said of a wiring is what it does, and its matrix undoes it.

TRUE = np.array([1.0, 20.0, 300.0])


def shown_by(wiring):
    """What the channels x, y, z show of the true signals, from the sentence alone."""
    says = dict(part.split(" shows ") for part in wiring.shown.split(", "))
    return np.array([TRUE["xyz".index(says[channel])] for channel in "xyz"])


@pytest.mark.parametrize("wiring", [RIGHT, *EXCHANGED])
def test_the_matrix_undoes_what_the_words_say(wiring):
    assert (wiring.matrix @ shown_by(wiring)).tolist() == TRUE.tolist()
    assert wiring.channels == tuple(
        c for c, s, t in zip("xyz", shown_by(wiring), TRUE, strict=True) if s != t
    )


def test_every_exchange_and_every_reversal_is_there_once():
    assert len({wiring.order for wiring in EXCHANGED}) == 5
    assert [wiring.channels for wiring in REVERSED] == [("x",), ("y",), ("z",)]
    assert [(wiring.matrix @ TRUE).tolist() for wiring in REVERSED] == [
        [-1.0, 20.0, 300.0],
        [1.0, -20.0, 300.0],
        [1.0, 20.0, -300.0],
    ]


@pytest.mark.parametrize("sign", [1, -1])
def test_slips_are_those_at_which_a_person_is_asked_again(sign):
    assert list(SLIPS_RAD) == ["10°", "1°", "10′", "1′"]
    for size, slip in SLIPS_RAD.items():
        words = classic_slip(0.7 + sign * slip, 0.7, 1e-4)
        assert words is not None
        assert words.endswith(f"({size})")


def test_an_angle_counted_backwards_is_off_by_the_shorter_way():
    angle = np.radians([0.0, 10.0, 90.0, 170.0, 315.0, 359.0])
    assert np.degrees(reflected_rad(angle)) == pytest.approx([0.0, -20.0, -180.0, 20.0, 90.0, 2.0])


# --- reading ----------------------------------------------------------------------------------------
# One reading: from an event and back without a difference, and as a row of the table.

EVENTS = Path(__file__).parents[1] / "data" / "records" / "finished" / "events.jsonl"
ROWS = [
    row
    for line in EVENTS.read_text(encoding="utf-8").splitlines()
    if (row := json.loads(line).get("reading"))
]


def test_recorded_readings_are_written_as_they_were_read():
    """Key order included: 22 readings with and without outliers."""
    assert len(ROWS) == 22
    assert any(any(row["outlier"]) for row in ROWS)
    for row in ROWS:
        assert json.dumps(Reading.from_json(row).to_json()) == json.dumps(row)


def test_what_a_record_holds_has_types():
    row = next(row for row in ROWS if row["outlier"][1])
    reading = Reading.from_json(row)
    assert reading.place == (row["series"], row["installation"], row["pass"], row["point"])
    assert reading.outlier[1] == Outlier(**row["outlier"][1])
    assert reading.mean == tuple(row["mean"])


def test_what_an_older_version_did_not_record_is_not_known_and_what_a_later_one_does_is_left():
    newer = {"samples", "drift", "drift_p", "outlier", "reference_v", "scan_order", "unit"}
    old = {key: value for key, value in ROWS[0].items() if key not in newer}
    reading = Reading.from_json(old | {"humidity": 0.4})
    assert (reading.unit, reading.scan_order, reading.reference_v) == ("V", "", None)
    assert reading.outlier == reading.drift == (None, None, None)
    assert readings_of([reading], "old").extra == {}


def test_a_table_has_what_was_not_given_as_nan_and_further_columns_where_any_reading_has_them():
    shorted = {"installation": "S", "angle_deg": None, "target_deg": None, "temperature_c": None}
    rows = [ROWS[0], ROWS[1] | shorted | {"sd": [None] * 3, "reference_v": 5.0, "scan_order": ""}]
    table = readings_of([Reading.from_json(row) for row in rows], "run")
    assert np.isnan([table.angle_rad[1], table.target_rad[1], table.temperature_c[1]]).all()
    assert np.isnan(table.signal_sd[1]).all()
    assert np.degrees(table.angle_rad[0]) == pytest.approx(ROWS[0]["angle_deg"], abs=1e-12)
    assert table.extra["reference_v"].tolist() == ["", "5.0"]
    assert table.extra["scan_order"].tolist() == ["xyz", ""]


@pytest.mark.parametrize(
    "key", ["series", "pass", "point", "samples_taken", "direction", "mean", "unit", "time_s"]
)
@pytest.mark.parametrize("value", [{}, [1], "1", 1.5, True, 10**30, -7, float("nan")])
def test_what_is_none_of_a_reading_is_refused_or_reckoned_with(key, value):
    """Whoever makes the chain anew may write anything; a table is made of what is taken."""
    try:
        reading = Reading.from_json(ROWS[0] | {key: value})
    except (KeyError, TypeError, ValueError):
        return
    assert len(readings_of([reading], "memory")) == 1
