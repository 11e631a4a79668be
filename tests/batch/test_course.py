"""A batch on disk: parts, going on, what is told where something else is asked."""

import shutil

import pytest

from bench.batch import store as course_module
from bench.batch.job import CALIBRATE, Job
from bench.batch.outcome import asked_of, conclude
from bench.batch.store import PartWriter, Store, fingerprint, list_runs
from bench.catalogue.store import open_catalogue
from bench.catalogue.sync import sync
from bench.services.errors import Refused
from tests.support.many_runs import runs_in

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
            yield {
                "run": run,
                "name": "x",
                "verdict": "passed",
                "verdict_stored": "passed",
                "verdict_differs": False,
            }


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
    assert left.done == 4
    assert left.notes == ("4 runs are done, 2 are left",)
    assert sorted(first.asked + second.asked) == runs
    assert counted(tmp_path / "out") == dict.fromkeys(runs, 1)
    assert outcome.runs.to_dict() == {
        "listed": 6, "done": 6, "failed": 0, "computed": 6, "simulated": 0, "without_stored_verdict": 0,
    }  # fmt: skip


def test_rows_of_a_program_that_is_killed_are_those_of_whole_parts(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(course_module, "PART_ROWS", 2)
    monkeypatch.setattr(PartWriter, "_write", _written_when_full(PartWriter._write))
    with pytest.raises(Stopped):
        carried_out(tmp_path / "out", runs, Rows(stop=5))
    (tmp_path / "out" / "parts" / "part-0000003.parquet.writing").write_bytes(b"half")
    monkeypatch.undo()
    rows = Rows()
    left, _ = carried_out(tmp_path / "out", runs, rows)
    assert (left.done, len(rows.asked)) == (4, 2)
    assert counted(tmp_path / "out") == dict.fromkeys(runs, 1)
    assert not list((tmp_path / "out" / "parts").glob("*.writing"))


def _written_when_full(write):
    """A program that is killed writes nothing at its end."""

    def only_full(self):
        if len(self._rows) >= course_module.PART_ROWS:
            write(self)

    return only_full


def test_a_part_is_written_in_time_however_few_rows_it_has(runs, tmp_path):
    carried_out(tmp_path / "out", runs, Rows(), clock=Hours())
    assert len(list((tmp_path / "out" / "parts").glob("*.parquet"))) == 6


def test_a_run_that_changed_is_computed_again_and_counts_once(runs, tmp_path):
    carried_out(tmp_path / "out", runs, Rows())
    (tmp_path / "runs" / "run-3" / "verify.json").write_text("{}")
    rows = Rows()
    left, outcome = carried_out(tmp_path / "out", runs, rows)
    assert rows.asked == [runs[2]]
    assert "1 runs have changed since they were computed: they are computed again" in left.notes
    assert outcome.runs.done == 6
    assert counted(tmp_path / "out") == dict.fromkeys(runs, 1)


def test_runs_that_came_and_went_are_told(runs, tmp_path):
    carried_out(tmp_path / "out", runs[:-1], Rows())
    shutil.rmtree(runs[0])
    left, outcome = carried_out(tmp_path / "out", runs[1:], Rows())
    assert left.notes == (
        "1 runs that were computed are no longer there: the result is without them",
        "4 runs are done, 1 are left",
    )
    assert (outcome.runs.listed, outcome.runs.done) == (5, 5)


def test_another_command_is_told_with_all_that_differs(runs, tmp_path):
    carried_out(tmp_path / "out", runs, Rows(), Job(CALIBRATE, estimator="robust"))
    with pytest.raises(Refused) as told:
        carried_out(tmp_path / "out", runs, Rows(), Job(CALIBRATE, g_m_s2=9.81), over=["elsewhere/*"])
    assert (
        "--estimator was robust; --g was not given; --over was runs/*; go on as it was begun"
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
    with pytest.raises(Refused, match="holds other files"), Store(tmp_path):
        pass
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_damaged_part_is_named(runs, tmp_path):
    carried_out(tmp_path / "out", runs, Rows())
    part = tmp_path / "out" / "parts" / "part-0000001.parquet"
    part.write_bytes(part.read_bytes()[:100])
    with pytest.raises(Refused, match=r"part-0000001.parquet: damaged .* delete it"):
        carried_out(tmp_path / "out", runs, Rows())


def test_a_row_that_stands_twice_is_never_counted_twice(runs, tmp_path):
    carried_out(tmp_path / "out", runs, Rows())
    parts = tmp_path / "out" / "parts"
    shutil.copy(parts / "part-0000001.parquet", parts / "part-0000009.parquet")
    with pytest.raises(Refused, match="stands in another part, too"):
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
    with pytest.raises(Refused, match="the catalogue has no run of which this holds"):
        list_runs(["simulated=no"], tmp_path, where)
    with pytest.raises(Refused, match="no key colour"):
        list_runs(["colour=red"], tmp_path, where)


@pytest.mark.parametrize(
    ("over", "told"),
    [
        (["there/*"], "--over there/*: no run lies there"),
        (["unit=Q-17", "runs/*"], "--over runs/*: a pattern beside a query (unit=Q-17)"),
        ([""], "--over: say which runs"),
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
