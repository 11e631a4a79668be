"""Runs computed side by side: processes that are killed or never come up, workers of a cluster."""

import os
import signal
from collections import deque

import pytest

from bench.batch import processes
from bench.batch.job import CALIBRATE, Job, program
from bench.batch.outcome import asked_of, conclude
from bench.batch.processes import TRIES, _Pool, by_processes, by_scheduler, of_program
from bench.batch.store import PartWriter, Store
from bench.batch.work import worked
from bench.services.errors import Refused
from tests.support.many_runs import runs_in


class Wire:
    """A wire whose other end computes at once, or dies."""

    def __init__(self, process):
        self.process, self.news = process, deque()

    def send(self, run):
        if run in self.process.deadly:
            self.process.exitcode = -9
        if self.process.exitcode is None:
            self.news.append({"run": run})

    def poll(self):
        return bool(self.news)

    def recv(self):
        return self.news.popleft()

    def close(self):
        pass


class Process:
    """A process that is none: it dies at the `deadly` runs, or before it is ready."""

    def __init__(self, deadly, stillborn=False):
        self.deadly, self.sentinel = deadly, object()
        self.exitcode = 1 if stillborn else None
        self.wire = Wire(self)
        if not stillborn:
            self.wire.news.append(None)

    def start(self):
        pass

    def is_alive(self):
        return self.exitcode is None

    def join(self, timeout_s):
        pass


class Context:
    """Begins such processes."""

    def __init__(self, **how):
        self.how, self.last = how, None

    def Pipe(self):  # noqa: N802 - as the library has it
        self.last = Process(**self.how)
        return self.last.wire, self.last.wire

    def Process(self, target, args, daemon):  # noqa: N802
        return self.last


def rows_of(monkeypatch, runs, count, **how):
    monkeypatch.setattr(processes, "_context", lambda: Context(**how))
    monkeypatch.setattr(processes, "wait", lambda parts: parts)
    return list(_Pool(Job(CALIBRATE), iter(runs), count, 1000).rows())


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_run_that_no_process_survives_is_listed_and_the_others_are_computed(monkeypatch, count):
    runs = [f"/runs/{number}" for number in range(20)]
    rows = rows_of(monkeypatch, runs, count, deadly={"/runs/7", "/runs/8"})
    assert sorted(row["run"] for row in rows) == sorted(runs)
    failed = {row["run"]: row["failed"] for row in rows if "failed" in row}
    assert failed.keys() == {"/runs/7", "/runs/8"}
    assert failed["/runs/7"] == (
        f"every process failed at this run: {TRIES} processes ended at it, the last by signal SIGKILL; try it alone"
    )


def test_processes_that_never_come_up_end_the_batch(monkeypatch):
    with pytest.raises(Refused, match=r"died while they started \(with status 1\)"):
        rows_of(monkeypatch, ["/runs/1", "/runs/2"], 2, deadly=(), stillborn=True)


def test_without_runs_nothing_is_begun(monkeypatch):
    assert rows_of(monkeypatch, [], 3, deadly=()) == []


def test_a_process_that_cannot_be_begun_is_tried_again(monkeypatch):
    failures = iter([EOFError(), ConnectionRefusedError("nobody there")])

    class Flaky(Context):
        def Process(self, target, args, daemon):  # noqa: N802
            process = super().Process(target, args, daemon)
            failure = next(failures, None)
            if failure is not None:
                process.start = lambda: (_ for _ in ()).throw(failure)
            return process

    monkeypatch.setattr(processes, "_context", lambda: Flaky(deadly=()))
    monkeypatch.setattr(processes, "wait", lambda parts: parts)
    rows = list(_Pool(Job(CALIBRATE), iter(["/runs/1", "/runs/2"]), 1, 1000).rows())
    assert [row["run"] for row in rows] == ["/runs/1", "/runs/2"]


@pytest.fixture
def runs(tmp_path):
    return [str(run) for run in runs_in(tmp_path, 8, stored=False)]


class Pools:
    """The pools that were made, to reach their processes."""

    def __init__(self, monkeypatch):
        made = self.made = []

        class Kept(processes._Pool):
            def __init__(self, *arguments):
                super().__init__(*arguments)
                made.append(self)

        monkeypatch.setattr(processes, "_Pool", Kept)

    def kill_one(self):
        os.kill(self.made[-1]._workers[0].process.pid, signal.SIGKILL)


@pytest.fixture
def pools(monkeypatch):
    return Pools(monkeypatch)


@pytest.mark.slow
def test_runs_of_a_process_that_is_killed_are_computed_by_another(runs, pools):
    rows, taken = [], []
    for row in by_processes(Job(CALIBRATE), (taken.append(run) or run for run in runs), 2):
        rows.append(row)
        assert len(taken) <= len(rows) + 2 * processes.AHEAD + 2  # few are at hand, however many there are
        if len(rows) in {1, 3}:
            pools.kill_one()
    assert sorted(row["run"] for row in rows) == runs
    assert [row for row in rows if row.get("failed")] == []


@pytest.mark.slow
def test_a_process_ends_after_so_many_runs_and_another_takes_its_place(runs, pools):
    seen = set()
    rows = []
    for row in by_processes(Job(CALIBRATE), iter(runs), 1, recycled=3):
        rows.append(row["run"])
        seen |= {worker.process.pid for worker in pools.made[-1]._workers}
    assert sorted(rows) == runs
    assert len(seen) == 3


@pytest.mark.slow
def test_a_batch_that_stops_leaves_no_process(runs, pools):
    rows = by_processes(Job(CALIBRATE), iter(runs), 2)
    next(rows)
    rows.close()
    assert [worker.process.is_alive() for worker in pools.made[-1]._workers] == [False, False]


@pytest.fixture(scope="module")
def workers():
    """A scheduler on loopback with a worker that is a process of its own, and is begun anew when it ends."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
    ) as made:
        yield made


@pytest.mark.slow(10)
def test_a_worker_killed_in_the_middle_loses_and_repeats_nothing(workers, tmp_path):
    runs = [str(run) for run in runs_in(tmp_path / "runs", 10)]
    job, killed = Job(CALIBRATE), []

    def computed(left):
        for number, row in enumerate(by_scheduler(job, left, workers.scheduler_address)):
            yield row
            if number == 2:
                (worker, *_) = workers.workers.values()
                killed.append(worker.pid)
                os.kill(worker.pid, signal.SIGKILL)

    with Store(tmp_path / "out") as store:
        left = store.begin(job, ["runs"], runs)
        PartWriter(store, job.command).carry_out(left, computed)
        outcome = conclude(store)
    assert len(killed) == 1
    assert outcome.runs.computed == len(runs)
    assert outcome.verdicts.same == len(runs)
    with asked_of(tmp_path / "out") as ask:
        counted = dict(ask.execute("SELECT run, count(*) FROM changes GROUP BY run").fetchall())
        ((found,),) = ask.execute("SELECT Kxx FROM changes LIMIT 1").fetchall()
    assert counted == dict.fromkeys(runs, 1)
    assert found == worked(job, runs[0])["Kxx"]  # as this process finds it


@pytest.mark.slow
def test_a_worker_with_another_program_is_refused(workers, tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "program", lambda: {**program(), "version": "0.0.9"})
    with pytest.raises(
        Refused,
        match=r"a worker has other versions than this computer; install .*: its version is .*, here 0\.0\.9",
    ):
        list(by_scheduler(Job(CALIBRATE), iter(["/runs/1"]), workers.scheduler_address))


@pytest.mark.slow
def test_a_scheduler_that_is_not_there_is_told(monkeypatch):
    monkeypatch.setattr(processes, "_SCHEDULER_PATIENCE", "200ms")
    with pytest.raises(Refused, match="no Dask scheduler answers there"):
        list(by_scheduler(Job(CALIBRATE), iter([]), "tcp://127.0.0.1:9"))
    with pytest.raises(Refused, match="no Dask scheduler answers there"):
        list(by_scheduler(Job(CALIBRATE), iter([]), "nonsense://x"))


@pytest.mark.slow(5)
def test_the_program_is_compared_before_a_run_is_touched():
    with pytest.raises(
        RuntimeError, match="other versions than this computer; install the same ones there: its code is"
    ):
        of_program({**program(), "code": "0" * 16}, Job(CALIBRATE), "/runs/1")
