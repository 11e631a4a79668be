"""What the supply measured at the rails: in the record, in the table, in a file and back."""

import numpy as np
import pytest

from bench.readings.columns import Rail, between, columns_of, ranges_in_words
from bench.readings.csv import format_csv, read_csv
from bench.readings.reading import Reading, readings_of

RAILS = {"p15": Rail(15.01, 15.0, 0.061), "n15": Rail(-14.98, -15.0, 0.058)}


def reading(point, rails):
    return Reading(
        installation="1",
        series=1,
        pass_number=1,
        point=point,
        angle_deg=0.0,
        mean=(0.1, 0.2, 0.3),
        rails=rails,
    )


def test_a_reading_without_rails_is_recorded_as_before():
    assert "rails" not in reading(1, {}).to_json()
    assert Reading.from_json(reading(1, {}).to_json() | {"samples": {}}).rails == {}


def test_rails_come_back_from_the_record():
    assert Reading.from_json(reading(1, RAILS).to_json()).rails == RAILS


@pytest.mark.parametrize(
    "cell",
    [
        {"voltage_v": "15", "nominal_v": 15.0, "current_a": 0.1},
        {"voltage_v": 15.0},
        {"voltage_v": float("nan"), "nominal_v": 15.0, "current_a": 0.0},
    ],
)
def test_what_is_no_rail_is_refused(cell):
    with pytest.raises((ValueError, KeyError)):
        Reading.from_json(reading(1, {}).to_json() | {"rails": {"p15": cell}})


def test_what_is_recorded_is_the_mean_of_before_and_after():
    after = {"p15": Rail(15.03, 15.0, 0.063), "n15": Rail(-14.98, -15.0, 0.058)}
    assert between(RAILS, after)["p15"] == Rail(pytest.approx(15.02), 15.0, pytest.approx(0.062))


def test_rails_are_columns_of_the_table_and_of_its_file(tmp_path):
    table = readings_of([reading(1, RAILS), reading(2, {})], "here")
    (tmp_path / "r.csv").write_text(format_csv(table), encoding="utf-8", newline="")
    for known in (table, read_csv(tmp_path / "r.csv", ["1"])):
        assert known.extra["rail_p15_a"].tolist() == ["0.061", ""]
        assert known.extra["rail_n15_nominal_v"].tolist() == ["-15", ""]
        np.testing.assert_allclose(known.conditions().supply_v[0], [0.01, 0.02], atol=1e-12)


def test_a_table_without_a_supply_has_no_such_columns():
    assert not readings_of([reading(1, {})], "here").extra


def test_the_ranges_of_a_run_are_told_in_words():
    later = {"p15": Rail(15.04, 15.0, 0.0655), "n15": Rail(-14.98, -15.0, 0.058)}
    assert (
        ranges_in_words(columns_of([RAILS, later, {}]))
        == "p15 15.01 to 15.04 V, 61 to 65.5 mA; n15 -14.98 V, 58 mA"
    )
    assert ranges_in_words({}) == ""
