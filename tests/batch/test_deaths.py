"""Processes that die, without processes: what becomes of the runs that they had at hand."""

from collections import deque

import pytest

from bench.batch import processes
from bench.batch.job import CALIBRATE, Job
from bench.batch.processes import TRIES, _Pool
from bench.services.errors import Refused


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
        f"no process gets through this run: {TRIES} processes ended at it, the last by signal SIGKILL; try it alone"
    )


def test_processes_that_never_come_up_end_the_batch(monkeypatch):
    with pytest.raises(Refused, match=r"end before they begin \(with status 1\)"):
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
