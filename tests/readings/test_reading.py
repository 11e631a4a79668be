"""One reading: from an event and back without a difference, and as a row of the table."""

import json
from pathlib import Path

import numpy as np
import pytest

from bench.readings.reading import Outlier, Reading, readings_of

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
