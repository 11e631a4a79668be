"""Runs computed side by side: by processes here, one that dies begins its run again; by workers of a cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from multiprocessing.connection import Connection, wait
from pathlib import Path
from threading import Thread
from typing import Any, Final

from bench.base.computing import THREADS
from bench.batch.job import DIAGNOSE, Job, Row, program
from bench.services.errors import Refused

AHEAD: Final = 2
"""Runs that a process has at hand: it need not wait for the next one."""
TRIES: Final = 3
"""A run at which so many processes have died is listed as failed; so many that never came up end the batch."""
RECYCLED: Final = 2000
RECYCLED_DIAGNOSES: Final = 100
"""A process ends after so many runs, and another takes its place: what libraries keep is given back."""
_PATIENCE_S: Final = 5.0


def by_processes(job: Job, runs: Iterator[str], count: int, recycled: int | None = None) -> Iterator[Row]:
    """Yield the rows of runs as they are done, in any order, computed by `count` processes.

    Only so many runs as these have at hand are taken from `runs`. Raises `Refused` where no process comes up.
    """
    usual = RECYCLED_DIAGNOSES if job.command == DIAGNOSE else RECYCLED
    pool = _Pool(job, runs, count, recycled or usual)
    try:
        yield from pool.rows()
    finally:
        pool.end()


@dataclass(eq=False)
class _Worker:
    """A process, the wire to it, and the runs that it has at hand, the first of them in work."""

    process: Any
    wire: Connection
    ready: bool = False
    given: int = 0
    at_hand: deque[str] = field(default_factory=deque)


class _Pool:
    def __init__(self, job: Job, runs: Iterator[str], count: int, recycled: int) -> None:
        self._job, self._runs, self._count, self._recycled = job, runs, count, recycled
        self._again: deque[str] = deque()
        self._deaths: Counter[str] = Counter()
        self._stillborn = 0
        self._context = _context()
        self._workers: list[_Worker] = []
        self._next: deque[str] = deque()

    def rows(self) -> Iterator[Row]:
        """Yield rows until all runs are done."""
        while self._filled():
            ready = wait([part for one in self._workers for part in (one.wire, one.process.sentinel)])
            for worker in list(self._workers):
                if worker.wire in ready or worker.process.sentinel in ready:
                    yield from self._heard(worker)

    def end(self) -> None:
        """End all processes, whatever they do."""
        for worker in self._workers:
            worker.wire.close()
            worker.process.kill()
        for worker in self._workers:
            worker.process.join(_PATIENCE_S)

    # --- giving -------------------------------------------------------------------------------------

    def _filled(self) -> bool:
        """Give runs to those that have room, begin as many processes as there is work for; False at the end."""
        for worker in self._workers:
            while worker.ready and len(worker.at_hand) < AHEAD and worker.given < self._recycled:
                run = self._take()
                if run is None:
                    break
                worker.at_hand.append(run)
                worker.given += 1
                with suppress(OSError):  # it has died: that is heard
                    worker.wire.send(run)
        for worker in [w for w in self._workers if w.ready and not w.at_hand and w.given >= self._recycled]:
            self._let_go(worker)
        while len(self._workers) < self._count and self._there_is_more(self._waiting_workers() + 1):
            self._begin()
        if not any(worker.at_hand for worker in self._workers) and not self._there_is_more(1):
            return False
        return bool(self._workers)

    def _waiting_workers(self) -> int:
        return sum(not worker.ready for worker in self._workers)

    def _take(self) -> str | None:
        if self._again:
            return self._again.popleft()
        return self._next.popleft() if self._next else next(self._runs, None)

    def _there_is_more(self, count: int) -> bool:
        """Whether so many runs are left to be given."""
        while len(self._again) + len(self._next) < count:
            run = next(self._runs, None)
            if run is None:
                return False
            self._next.append(run)
        return True

    def _begin(self) -> None:
        ours, its = self._context.Pipe()
        process = self._context.Process(target=_work, args=(self._job, its), daemon=True)
        try:
            process.start()
        except (
            EOFError,
            OSError,
        ) as problem:  # the one of which they are copies has died: there will be another
            ours.close()
            self._came_to_nothing(f"{type(problem).__name__} {problem}".strip())
        else:
            self._workers.append(_Worker(process, ours))
        finally:
            its.close()

    def _came_to_nothing(self, how: str) -> None:
        """Count a process that never was ready. Raises `Refused` where none comes up."""
        self._stillborn += 1
        if self._stillborn >= TRIES * self._count:
            raise Refused(f"the processes that compute end before they begin ({how})")

    def _let_go(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        worker.wire.close()  # by that it ends

    # --- hearing ------------------------------------------------------------------------------------

    def _heard(self, worker: _Worker) -> Iterator[Row]:
        """Yield the rows that a process has sent; where it has died, see to what it had at hand."""
        try:
            while worker.wire.poll():
                row = worker.wire.recv()
                if row is None:
                    worker.ready, self._stillborn = True, 0
                    continue
                worker.at_hand.popleft()
                yield row
        except (EOFError, OSError):
            yield from self._died(worker)
            return
        if not worker.process.is_alive() and not worker.wire.poll():
            yield from self._died(worker)

    def _died(self, worker: _Worker) -> Iterator[Row]:
        worker.process.join(_PATIENCE_S)
        how = _how(worker.process.exitcode)
        self._let_go(worker)
        if not worker.ready:
            self._came_to_nothing(how)
            return
        if not worker.at_hand:
            return
        in_work = worker.at_hand.popleft()
        self._again.extend(worker.at_hand)
        self._deaths[in_work] += 1
        if self._deaths[in_work] < TRIES:
            self._again.appendleft(in_work)
            return
        yield died_at(in_work, f"{TRIES} processes ended at it, the last {how}")


def died_at(run: str, why: str) -> Row:
    """Return the row of a run at which processes die."""
    told = f"no process gets through this run: {why}; try it alone"
    return {"run": run, "name": Path(run).name, "failed": told}


def _how(code: int | None) -> str:
    if code is None:
        return "in a way that is not known"
    return f"by signal {signal.Signals(-code).name}" if code < 0 else f"with status {code}"


def _context() -> Any:
    """Return how processes are begun: as copies of one that has imported everything, where the system can."""
    for name in THREADS:
        os.environ[name] = "1"  # side by side, each computes on one core
    if "forkserver" in multiprocessing.get_all_start_methods():
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["bench.batch.work"])
        return context
    return multiprocessing.get_context("spawn")


# --- in the process ---------------------------------------------------------------------------------


def _work(job: Job, wire: Connection) -> None:
    """Compute runs as they come, until none can come any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for the program that gives the work
    Thread(target=_end_with_parent, daemon=True).start()
    from bench.batch.work import worked

    try:
        wire.send(None)
        while True:
            run = wire.recv()
            wire.send(worked(job, run))
    except (EOFError, OSError):
        return


def _end_with_parent() -> None:
    """End with the program that gives the work, though a run be in work: nobody waits for its row."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


# --- on a cluster -------------------------------------------------------------------------------------

_SCHEDULER_PATIENCE: Final = "10s"
_PATIENCE_WITH_WORKERS_S: Final = 60.0
_LOOKED_AGAIN: Final = 100
"""After so many rows is asked how many workers there are."""


def by_scheduler(job: Job, runs: Iterator[str], address: str) -> Iterator[Row]:
    """Yield the rows of runs as they are done, in any order, computed by the workers of a scheduler.

    Paths of runs hold at the workers as they do here. Only so many runs as the workers have at hand are taken from
    `runs`. Raises `Refused` where no scheduler answers, where a worker has another program, or where it goes away.
    """
    dask: Any = import_module("distributed")

    for name in [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what it has to say is said below
    try:
        client = dask.Client(address, timeout=_SCHEDULER_PATIENCE, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as problem:
        raise Refused(
            f"--scheduler {address}: no Dask scheduler answers there ({type(problem).__name__}); begin one with "
            "'dask scheduler', and its workers with 'dask worker ADDRESS --nthreads 1'"
        ) from None
    try:
        client.wait_for_workers(1, timeout=_PATIENCE_WITH_WORKERS_S)
    except (OSError, TimeoutError):
        client.close(timeout=2)
        raise Refused(
            f"--scheduler {address}: no worker is there; begin some with 'dask worker {address} --nthreads 1'"
        ) from None
    try:
        yield from _rows_of(dask, client, job, runs, address)
    finally:
        client.close(timeout=2)


def _rows_of(dask: Any, client: Any, job: Job, runs: Iterator[str], address: str) -> Iterator[Row]:
    mine = dict(program())
    done = dask.as_completed(loop=client.loop)
    in_work: dict[str, str] = {}
    room = _room(client)

    def fill() -> None:
        while len(in_work) < room and (run := next(runs, None)) is not None:
            future = client.submit(of_program, mine, job, run, pure=False)
            in_work[future.key] = run
            done.add(future)

    fill()
    for heard, future in enumerate(done, 1):
        run = in_work.pop(future.key)
        yield _row(dask, future, run, address)
        if heard % _LOOKED_AGAIN == 0 or len(in_work) < room // 2:
            room = _room(client)
        fill()


def _room(client: Any) -> int:
    return max(1, int(AHEAD * sum(client.nthreads().values())))


def _row(dask: Any, future: Any, run: str, address: str) -> Row:
    try:
        row: Row = future.result()
        return row
    except dask.scheduler.KilledWorker as killed:
        return died_at(run, f"{killed.allowed_failures + 1} workers ended at it")
    except (dask.CancelledError, dask.client.FutureCancelledError, OSError, TimeoutError):
        raise Refused(f"--scheduler {address}: the scheduler has gone away") from None
    except Exception as problem:
        told = " ".join(str(problem).split())
        raise Refused(
            f"--scheduler {address}: its workers cannot do it ({type(problem).__name__}: {told})"
        ) from None


def of_program(asked: dict[str, str], job: Job, run: str) -> Row:
    """Return the row of a run, as `worked`. Raises `RuntimeError` where this worker has another program."""
    mine = dict(program())
    other = [
        f"{name} is {mine.get(name)}, here {asked[name]}" for name in asked if mine.get(name) != asked[name]
    ]
    if other:
        raise RuntimeError(f"a worker has another program: its {'; its '.join(other)}")
    from bench.batch.work import worked

    return worked(job, run)
