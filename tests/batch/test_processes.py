"""Real processes: one that is killed, a run that no process survives, processes that never come up."""

import os
import signal

import pytest

from bench.batch import processes
from bench.batch.job import CALIBRATE, Job
from bench.batch.processes import by_processes
from tests.support.many_runs import runs_in

pytestmark = pytest.mark.slow


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


def test_runs_of_a_process_that_is_killed_are_computed_by_another(runs, pools):
    rows, taken = [], []
    for row in by_processes(Job(CALIBRATE), (taken.append(run) or run for run in runs), 2):
        rows.append(row)
        assert len(taken) <= len(rows) + 2 * processes.AHEAD + 2  # few are at hand, however many there are
        if len(rows) in {1, 3}:
            pools.kill_one()
    assert sorted(row["run"] for row in rows) == runs
    assert [row for row in rows if row.get("failed")] == []


def test_a_process_ends_after_so_many_runs_and_another_takes_its_place(runs, pools):
    seen = set()
    rows = []
    for row in by_processes(Job(CALIBRATE), iter(runs), 1, recycled=3):
        rows.append(row["run"])
        seen |= {worker.process.pid for worker in pools.made[-1]._workers}
    assert sorted(rows) == runs
    assert len(seen) == 3


def test_a_batch_that_stops_leaves_no_process(runs, pools):
    rows = by_processes(Job(CALIBRATE), iter(runs), 2)
    next(rows)
    rows.close()
    assert [worker.process.is_alive() for worker in pools.made[-1]._workers] == [False, False]
