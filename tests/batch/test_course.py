"""A batch on disk: parts, going on; one run in, one row out."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from bench.batch import store as course_module
from bench.batch.job import CALIBRATE, COLUMNS, DIAGNOSE, Job, arrow_schema
from bench.batch.outcome import asked_of, conclude
from bench.batch.store import PartWriter, Store, fingerprint, list_runs
from bench.batch.work import CalibrationValues, change_in_u, changes, worked
from bench.catalogue.store import open_catalogue
from bench.catalogue.sync import sync
from bench.model.geometry import COEFFICIENTS
from bench.services.errors import Refused
from tests.support.commands import printed
from tests.support.known_inputs import twin
from tests.support.many_runs import edited, runs_in

OVER = ["runs/*"]


class Stopped(Exception):
    """Stands for whatever ends a batch in its middle."""


class Hours:
    """A clock that a batch reads; an hour passes at each look."""

    def __init__(self):
        self.time_s = 0.0

    def now_s(self):
        self.time_s += 3600.0
        return self.time_s

    def sleep(self, duration_s):
        self.time_s += duration_s


@pytest.fixture
def runs(empty_folder, tmp_path):
    return [str(run) for run in runs_in(tmp_path / "runs", 6, stored=False)]


class Rows:
    """Computes rows of what is asked, notes which, and stops before the `stop`-th."""

    def __init__(self, stop=None):
        self.asked, self.stop = [], stop

    def __call__(self, runs):
        for run in runs:
            if len(self.asked) == self.stop:
                raise Stopped
            self.asked.append(run)
            passed = {"verdict": "passed", "verdict_stored": "passed", "verdict_differs": False}
            yield {"run": run, "name": "x", **passed}


def carried_out(folder, runs, rows, job=None, over=OVER, clock=None):
    job = job or Job(CALIBRATE)
    with Store(folder) as store:
        left = store.begin(job, over, runs)
        PartWriter(store, job.command, *([clock] if clock else [])).carry_out(left, rows)
        return left, conclude(store)


def counted(folder):
    with asked_of(folder) as ask:
        return dict(ask.execute("SELECT run, count(*) FROM changes GROUP BY run").fetchall())


def test_what_is_done_is_not_done_again(runs, tmp_path):
    first = Rows(stop=4)
    with pytest.raises(Stopped):
        carried_out(tmp_path / "out", runs, first)
    second = Rows()
    left, outcome = carried_out(tmp_path / "out", runs, second)
    assert len(left.pending) == 2
    assert left.notes == ("4 runs are done, 2 are left",)
    assert sorted(first.asked + second.asked) == runs
    assert counted(tmp_path / "out") == dict.fromkeys(runs, 1)
    assert outcome.runs.to_dict() == {
        "listed": 6, "done": 6, "failed": 0, "computed": 6, "simulated": 0, "without_stored_verdict": 0,
    }  # fmt: skip


@pytest.mark.slow
def test_rows_of_a_program_that_is_killed_are_those_of_whole_parts(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(course_module, "PART_ROWS", 2)
    monkeypatch.setattr(PartWriter, "_write", _written_when_full(PartWriter._write))
    with pytest.raises(Stopped):
        carried_out(tmp_path / "out", runs, Rows(stop=5))
    (tmp_path / "out" / "parts" / "part-0000003.parquet.writing").write_bytes(b"half")
    monkeypatch.undo()
    rows = Rows()
    left, _ = carried_out(tmp_path / "out", runs, rows)
    assert (len(left.pending), len(rows.asked)) == (2, 2)
    assert counted(tmp_path / "out") == dict.fromkeys(runs, 1)
    assert not list((tmp_path / "out" / "parts").glob("*.writing"))


def _written_when_full(write):
    """A program that is killed writes nothing at its end."""

    def only_full(self):
        if len(self._rows) >= course_module.PART_ROWS:
            write(self)

    return only_full


@pytest.mark.slow
def test_a_part_is_written_in_time_however_few_rows_it_has(runs, tmp_path):
    carried_out(tmp_path / "out", runs, Rows(), clock=Hours())
    assert len(list((tmp_path / "out" / "parts").glob("*.parquet"))) == 6


@pytest.mark.slow
def test_a_run_that_changed_is_computed_again_and_counts_once(runs, tmp_path):
    carried_out(tmp_path / "out", runs, Rows())
    (tmp_path / "runs" / "run-3" / "verify.json").write_text("{}")
    rows = Rows()
    left, outcome = carried_out(tmp_path / "out", runs, rows)
    assert rows.asked == [runs[2]]
    assert "1 runs changed since they were computed; they are computed again" in left.notes
    assert outcome.runs.done == 6
    assert counted(tmp_path / "out") == dict.fromkeys(runs, 1)


@pytest.mark.slow
def test_runs_that_came_and_went_are_told(runs, tmp_path):
    carried_out(tmp_path / "out", runs[:-1], Rows())
    shutil.rmtree(runs[0])
    left, outcome = carried_out(tmp_path / "out", runs[1:], Rows())
    assert left.notes == (
        "1 computed runs no longer exist; the result omits them",
        "4 runs are done, 1 are left",
    )
    assert (outcome.runs.listed, outcome.runs.done) == (5, 5)


def test_another_command_is_told_with_all_that_differs(runs, tmp_path):
    carried_out(tmp_path / "out", runs, Rows(), Job(CALIBRATE, estimator="robust"))
    with pytest.raises(Refused) as told:
        carried_out(tmp_path / "out", runs, Rows(), Job(CALIBRATE, g_m_s2=9.81), over=["elsewhere/*"])
    assert (
        "--estimator was robust; --g was not given; --over was runs/*; use the same options"
        in told.value.typed
    )


def test_a_changed_model_file_is_another_command(runs, tmp_path):
    model = tmp_path / "found.yaml"
    model.write_text("one")
    carried_out(tmp_path / "out", runs, Rows(), Job(CALIBRATE, model=str(model)))
    model.write_text("two")
    with pytest.raises(Refused, match=r"model was .*found.yaml \(SHA-256 7692c3ad3540…\)"):
        carried_out(tmp_path / "out", runs, Rows(), Job(CALIBRATE, model=str(model)))


def test_another_program_is_told(runs, tmp_path, monkeypatch):
    carried_out(tmp_path / "out", runs, Rows())
    monkeypatch.setattr("bench.batch.store.program", lambda: {"version": "9.9"})
    with pytest.raises(Refused, match=r"the program's version was \d"):
        carried_out(tmp_path / "out", runs, Rows())


def test_two_programs_never_carry_out_one_batch(tmp_path):
    with Store(tmp_path / "out"), pytest.raises(Refused, match="another program"), Store(tmp_path / "out"):
        pass


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("years")
    with pytest.raises(Refused, match="has other files"), Store(tmp_path):
        pass
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_damaged_part_is_named(runs, tmp_path):
    carried_out(tmp_path / "out", runs, Rows())
    part = tmp_path / "out" / "parts" / "part-0000001.parquet"
    part.write_bytes(part.read_bytes()[:100])
    with pytest.raises(Refused, match=r"part-0000001.parquet: damaged .* delete this file"):
        carried_out(tmp_path / "out", runs, Rows())


def test_a_row_that_stands_twice_is_never_counted_twice(runs, tmp_path):
    carried_out(tmp_path / "out", runs, Rows())
    parts = tmp_path / "out" / "parts"
    shutil.copy(parts / "part-0000001.parquet", parts / "part-0000009.parquet")
    with pytest.raises(Refused, match="is in another part, too"):
        carried_out(tmp_path / "out", runs, Rows())


# --- which runs -------------------------------------------------------------------------------------


def test_patterns_name_runs_folders_of_runs_and_runs_by_name(runs, tmp_path):
    here = tmp_path / "runs"
    (here / "nothing").mkdir()
    (here / "a.log").touch()
    listed = list_runs(["runs/*"], here)
    assert (list(listed.runs), listed.no_runs) == (runs, ("runs/nothing",))
    assert list_runs([str(here)], here).runs == tuple(runs)
    assert list_runs(["run-[12]", "run-2"], here).runs == tuple(runs[:2])
    assert list_runs(["**/run-1"], here).runs == (runs[0],)


def test_a_query_asks_the_catalogue(runs, tmp_path):
    where = str(tmp_path / "catalogue.sqlite")
    with open_catalogue(where) as opened:
        sync(opened, [tmp_path / "runs"])
    asked = ["procedure=* simulated=yes", "type=triaxial block of the paper"]
    assert list_runs(asked, tmp_path, where).runs == (runs[0],)  # the others are copies of it
    with pytest.raises(Refused, match="no run in the catalogue matches"):
        list_runs(["simulated=no"], tmp_path, where)
    with pytest.raises(Refused, match="no key colour"):
        list_runs(["colour=red"], tmp_path, where)


@pytest.mark.parametrize(
    ("over", "told"),
    [
        (["there/*"], "--over there/*: no run is there"),
        (
            ["unit=Q-17", "runs/*"],
            "--over runs/*: patterns of names and conditions (unit=Q-17) cannot be mixed",
        ),
        ([""], "--over names no run"),
    ],
)
def test_what_names_no_run_is_refused(runs, tmp_path, over, told):
    with pytest.raises(Refused) as error:
        list_runs(over, tmp_path / "runs")
    assert error.value.typed.startswith(told)


def test_a_fingerprint_is_of_what_a_row_is_made_from(runs, tmp_path):
    before = fingerprint(runs[0])
    (tmp_path / "runs" / "run-1" / "report.html").write_text("page")
    assert fingerprint(runs[0]) == before
    (tmp_path / "runs" / "run-1" / "calibrate.json").write_text("{}")
    assert fingerprint(runs[0]) != before


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
    assert "an earlier state of the record" in worked(Job(CALIBRATE), str(run))["notes"]


def test_a_bad_run_is_a_row_with_its_sentence(run):
    (run / "bench.yaml").write_text("bench: other\n")
    row = worked(Job(CALIBRATE), str(run))
    assert "bench.yaml was changed since the run began" in row["failed"]
    assert "covariance" not in row
    assert row["simulated"] is True


def test_a_mistake_of_the_program_is_a_sentence_too(run, monkeypatch):
    def broken(*_, **__):
        raise ZeroDivisionError("lost")

    monkeypatch.setattr("bench.batch.work.calibrated", broken)
    assert worked(Job(CALIBRATE), str(run))["failed"] == (
        "stopped by an error of the program (ZeroDivisionError: lost)"
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


@pytest.mark.slow
def test_a_record_at_a_known_input_has_gain_and_offset_and_their_change(bench, tmp_path, monkeypatch):
    """The twin of a meter at 1 V: at one level the offset is hidden, and the gain holds what the record tells."""
    monkeypatch.setattr("bench.diagnosis.record_model.BINS", 150)  # half of the means, and of the time
    printed(bench("import", str(twin(tmp_path, 3)), "--name", "record"))
    printed(bench("calibrate", "record", "--json", "runs/record/calibrate.json"))
    row = worked(Job(CALIBRATE), str(Path("runs/record").absolute()))
    assert "failed" not in row
    assert set(row) <= set(COLUMNS[CALIBRATE])
    assert row["gain_x"] == pytest.approx(1.0, abs=1e-4)
    assert row["gain_x"] == row["gain_x_stored"]
    assert (row["largest_change_in_u"], "offset_v_x" in row) == (0.0, False)
    refused = worked(Job(CALIBRATE, join_verification=True), row["run"])
    assert "do not apply to a record at a known input" in refused["failed"]
    found = worked(Job(DIAGNOSE), row["run"])
    assert "voltmeter_thermal" in found["names"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", r"it lacks format, command, .*begun\)"),
        ("[1]", "it lacks format"),
        ("{", r"not a readable batch"),
    ],
)
def test_a_damaged_batch_says_what_is_wrong(tmp_path, text, words):
    (tmp_path / "batch.json").write_text(text)
    with pytest.raises(Refused, match=words):
        Store(tmp_path).noted()
