"""One run in, one row out."""

import json

import numpy as np
import pytest

from bench.batch.job import CALIBRATE, COLUMNS, DIAGNOSE, Job, arrow_schema
from bench.batch.work import CalibrationValues, change_in_u, changes, worked
from bench.model.geometry import COEFFICIENTS
from tests.support.many_runs import edited, runs_in

PASSED = "passed (conditional pass)"


@pytest.fixture
def run(tmp_path):
    return runs_in(tmp_path, 1)[0]


def found(values, u, unit="V", p=0.5):
    return CalibrationValues("gls", "paper", unit, 9.81, np.array(values, float), np.array(u, float), p, 54)


def test_a_run_whose_stored_result_is_of_today_has_not_changed(run):
    row = worked(Job(CALIBRATE), str(run))
    assert row.get("failed") is None
    assert row["largest_change_in_u"] < 1e-6
    assert (row["least_u_ratio"], row["most_u_ratio"]) == pytest.approx((1.0, 1.0))
    assert (row["verdict_stored"], row["verdict"], row["verdict_differs"]) == (PASSED, PASSED, False)
    assert row["fit_differs"] is False
    assert len(row["covariance"]) == 144


def test_nothing_is_written_into_the_folder_of_a_run(run):
    before = {file.name: file.stat().st_mtime_ns for file in run.iterdir()}
    worked(Job(CALIBRATE, estimator="closed-form"), str(run))
    assert {file.name: file.stat().st_mtime_ns for file in run.iterdir()} == before


def test_every_value_of_a_row_has_a_column_of_its_kind(run):
    import pyarrow

    row = worked(Job(CALIBRATE), str(run))
    assert row.keys() <= COLUMNS[CALIBRATE].keys()
    (read,) = pyarrow.Table.from_pylist([row], schema=arrow_schema(CALIBRATE)).to_pylist()
    assert {name: value for name, value in read.items() if value is not None} == {
        name: value for name, value in row.items() if value is not None
    }


def test_another_limit_gives_another_verdict_and_the_same_coefficients(run):
    row = worked(Job(CALIBRATE, limit_g=1e-6), str(run))
    assert row["verdict"].startswith("failed")
    assert row["verdict_differs"] is True
    assert row["largest_change_in_u"] < 1e-6


def test_a_change_is_in_units_of_the_u_that_was_stated(run):
    def moved(told):
        told["coefficients"]["Kyz"]["value"] += 3.0 * told["coefficients"]["Kyz"]["u"]

    edited(run / "calibrate.json", moved)
    row = worked(Job(CALIBRATE), str(run))
    assert row["Kyz_change_in_u"] == pytest.approx(-3.0)
    assert (row["largest_change_of"], row["largest_change_in_u"]) == ("Kyz", pytest.approx(3.0))


def test_what_has_no_u_has_changed_by_nothing_or_by_what_nobody_can_say():
    before = found(np.zeros(12), [0.0, 0.0, 0.0, 2.0, *np.ones(8)])
    now = found([0.0, 1.0, 4.0, 4.0, *np.zeros(8)], [0.0, 0.0, 2.0, 1.0, *np.ones(8)])
    change = change_in_u(before, now)
    assert change[:4] == pytest.approx([0.0, np.nan, 2.0, 2.0], nan_ok=True)
    row = changes(before, now)
    assert row[f"{COEFFICIENTS[1]}_change_in_u"] is None
    assert row["largest_change_in_u"] == 2.0


def test_results_in_other_units_are_not_compared():
    row = changes(found(np.ones(12), np.ones(12), unit="g"), found(np.zeros(12), np.ones(12)))
    assert "largest_change_in_u" not in row
    assert (row["signal_unit_stored"], row["signal_unit"]) == ("g", "V")


def test_a_fit_that_is_judged_otherwise_is_told():
    one, two = found(np.ones(12), np.ones(12), p=0.5), found(np.ones(12), np.ones(12), p=1e-4)
    assert changes(one, two)["fit_differs"] is True
    assert (two.fit, found(np.ones(12), np.ones(12), p=None).fit) == ("does not fit", "not judged")


def test_without_a_stored_result_there_is_nothing_to_compare(tmp_path):
    (run,) = runs_in(tmp_path, 1, stored=False)
    row = worked(Job(CALIBRATE), str(run))
    assert row["verdict"] == PASSED
    assert "verdict_differs" not in row
    assert "largest_change_in_u" not in row


@pytest.mark.parametrize("text", ["{", "[]", '{"coefficients": 3}', "[1, 2]"])
def test_a_stored_result_that_cannot_be_read_is_noted_and_the_run_computed(run, text):
    (run / "calibrate.json").write_text(text)
    row = worked(Job(CALIBRATE), str(run))
    assert row.get("failed") is None
    assert "the stored calibrate.json cannot be read" in row["notes"]
    assert row["verdict_differs"] is False


def test_a_stored_result_of_another_state_of_the_record_is_noted(run):
    edited(run / "calibrate.json", lambda told: told["record"].update(head="0" * 64))
    assert "another state of the record" in worked(Job(CALIBRATE), str(run))["notes"]


def test_a_bad_run_is_a_row_with_its_sentence(run):
    (run / "bench.yaml").write_text("bench: other\n")
    row = worked(Job(CALIBRATE), str(run))
    assert "bench.yaml was changed since the run began" in row["failed"]
    assert "covariance" not in row
    assert row["simulated"] is True


def test_a_mistake_of_the_program_is_a_sentence_too(run, monkeypatch):
    def broken(*_, **__):
        raise ZeroDivisionError("lost")

    monkeypatch.setattr("bench.batch.work.calibration_of", broken)
    assert worked(Job(CALIBRATE), str(run))["failed"] == (
        "stopped by a mistake of the program (ZeroDivisionError: lost)"
    )


def test_a_diagnosis_is_held_against_the_stored_one(run, monkeypatch):
    told = {
        "verdict": "named",
        "effects": [{"name": "scale_of_x", "cannot_tell_from": ["scale_of_y"]}, {"name": "cable_torque"}],
        "gap": {"before": 4.0, "after": 1.1},
    }
    (run / "diagnose.json").write_text(json.dumps(told | {"verdict": "unknown", "effects": []}))
    monkeypatch.setattr("bench.batch.work._diagnosis", lambda source: told)
    row = worked(Job(DIAGNOSE), str(run))
    assert (row["verdict_stored"], row["verdict"], row["verdict_differs"]) == ("unknown", "named", True)
    assert (row["names_stored"], row["names"]) == ("", "scale_of_x or scale_of_y, cable_torque")
    assert json.loads(row["result"])["gap"]["before"] == row["gap_before"] == 4.0
    assert row.keys() <= COLUMNS[DIAGNOSE].keys()
