"""The same work by the workers of a Dask scheduler: real processes on this machine, one of them killed."""

import os
import signal

import pytest

from bench.batch import processes
from bench.batch.job import CALIBRATE, Job, program
from bench.batch.outcome import asked_of, conclude
from bench.batch.processes import by_scheduler, of_program
from bench.batch.store import Course, Store
from bench.batch.work import worked
from bench.services.errors import Refused
from tests.support.many_runs import runs_in

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def workers():
    """A scheduler on loopback with two workers, processes of their own."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
    ) as made:
        yield made


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
        Course(store, job.command).carry_out(left, computed)
        outcome = conclude(store)
    assert len(killed) == 1
    assert outcome.runs.computed == len(runs)
    assert outcome.verdicts.same == len(runs)
    with asked_of(tmp_path / "out") as ask:
        counted = dict(ask.execute("SELECT run, count(*) FROM changes GROUP BY run").fetchall())
        ((found,),) = ask.execute("SELECT Kxx FROM changes LIMIT 1").fetchall()
    assert counted == dict.fromkeys(runs, 1)
    assert found == worked(job, runs[0])["Kxx"]  # as this process finds it


def test_a_worker_with_another_program_is_refused(workers, tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "program", lambda: {**program(), "version": "0.0.9"})
    with pytest.raises(Refused, match=r"a worker has another program: its version is .*, here 0\.0\.9"):
        list(by_scheduler(Job(CALIBRATE), iter(["/runs/1"]), workers.scheduler_address))


def test_a_scheduler_that_is_not_there_is_told(monkeypatch):
    monkeypatch.setattr(processes, "_SCHEDULER_PATIENCE", "200ms")
    with pytest.raises(Refused, match="no Dask scheduler answers there"):
        list(by_scheduler(Job(CALIBRATE), iter([]), "tcp://127.0.0.1:9"))
    with pytest.raises(Refused, match="no Dask scheduler answers there"):
        list(by_scheduler(Job(CALIBRATE), iter([]), "nonsense://x"))


def test_the_program_is_compared_before_a_run_is_touched():
    with pytest.raises(RuntimeError, match="another program: its code is"):
        of_program({**program(), "code": "0" * 16}, Job(CALIBRATE), "/runs/1")
