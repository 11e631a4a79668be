"""Runs computed in parallel, by local processes (which are replaced if they die) or by a cluster."""

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
"""Number of runs queued at each process, so that it need not wait for the next one."""
TRIES: Final = 3
"""A run fails if this many processes die computing it; as many failed starts per process end the batch."""
RECYCLED: Final = 2000
RECYCLED_DIAGNOSES: Final = 100
"""A process is replaced after this many runs or diagnoses, to release the memory that libraries keep."""
_PATIENCE_S: Final = 5.0


def by_processes(job: Job, runs: Iterator[str], count: int, recycled: int | None = None) -> Iterator[Row]:
    """Yield the rows of runs as `count` processes compute them. Raises `Refused` if no process starts.

    A process is replaced after `recycled` runs, by default `RECYCLED` runs or `RECYCLED_DIAGNOSES` diagnoses.
    """
    usual = RECYCLED_DIAGNOSES if job.command == DIAGNOSE else RECYCLED
    pool = _Pool(job, runs, count, recycled or usual)
    try:
        yield from pool.rows()
    finally:
        pool.end()


@dataclass(eq=False)
class _Worker:
    """A worker process: its connection, and the runs queued for it, the first of which it is computing."""

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
        self._early_deaths = 0
        self._context = _context()
        self._workers: list[_Worker] = []
        self._next: deque[str] = deque()

    def rows(self) -> Iterator[Row]:
        """Yield rows until all runs are done."""
        while self._filled():
            ready = wait([part for one in self._workers for part in (one.wire, one.process.sentinel)])
            for worker in list(self._workers):
                if worker.wire in ready or worker.process.sentinel in ready:
                    yield from self._received_rows(worker)

    def end(self) -> None:
        """End all processes, even those that are computing."""
        for worker in self._workers:
            worker.wire.close()
            worker.process.kill()
        for worker in self._workers:
            worker.process.join(_PATIENCE_S)

    # --- handing out runs --------------------------------------------------------------------------------

    def _filled(self) -> bool:
        """Hand runs to idle processes and start processes as needed; return False when all runs are done."""
        for worker in self._workers:
            while worker.ready and len(worker.at_hand) < AHEAD and worker.given < self._recycled:
                run = self._take()
                if run is None:
                    break
                worker.at_hand.append(run)
                worker.given += 1
                with suppress(OSError):  # it has died, which `_received_rows` notices
                    worker.wire.send(run)
        for worker in [w for w in self._workers if w.ready and not w.at_hand and w.given >= self._recycled]:
            self._let_go(worker)
        while len(self._workers) < self._count:
            if not self._has_more(1 + sum(not worker.ready for worker in self._workers)):
                break
            self._begin()
        if not any(worker.at_hand for worker in self._workers) and not self._has_more(1):
            return False
        return bool(self._workers)

    def _take(self) -> str | None:
        if self._again:
            return self._again.popleft()
        return self._next.popleft() if self._next else next(self._runs, None)

    def _has_more(self, count: int) -> bool:
        """Whether at least `count` runs still have to be handed out."""
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
        except (EOFError, OSError) as problem:  # the fork server has died: another one will start
            ours.close()
            self._count_early_death(f"{type(problem).__name__} {problem}".strip())
        else:
            self._workers.append(_Worker(process, ours))
        finally:
            its.close()

    def _count_early_death(self, how: str) -> None:
        """Count a process that died before it was ready. Raises `Refused` if too many processes did."""
        self._early_deaths += 1
        if self._early_deaths >= TRIES * self._count:
            raise Refused(
                f"the worker processes died while they started ({how}); try --workers 1, or compute one run alone"
            )

    def _let_go(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        worker.wire.close()  # a closed connection ends the process

    # --- receiving rows ----------------------------------------------------------------------------------

    def _received_rows(self, worker: _Worker) -> Iterator[Row]:
        """Yield the rows that a process has sent; if it has died, reassign the runs that it had queued."""
        try:
            while worker.wire.poll():
                row = worker.wire.recv()
                if row is None:
                    worker.ready, self._early_deaths = True, 0
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
            self._count_early_death(how)
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
    """Return the row of a run whose process died repeatedly; `why` is the reason that the row states."""
    told = f"every process failed at this run: {why}; try it alone"
    return {"run": run, "name": Path(run).name, "failed": told}


def _how(code: int | None) -> str:
    if code is None:
        return "for an unknown reason"
    return f"by signal {signal.Signals(-code).name}" if code < 0 else f"with status {code}"


def _context() -> Any:
    """Return the multiprocessing context: where available, a fork server that has imported all modules."""
    for name in THREADS:
        os.environ[name] = "1"  # side by side, each computes on one core
    if "forkserver" in multiprocessing.get_all_start_methods():
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["bench.batch.work"])
        return context
    return multiprocessing.get_context("spawn")


# --- in the process ---------------------------------------------------------------------------------


def _work(job: Job, wire: Connection) -> None:
    """Compute the runs received over `wire` until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the program that hands out runs handles Ctrl-C
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
    """End this process when its parent ends, even during a run, because nobody would read the row."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


# --- on a cluster -------------------------------------------------------------------------------------

_SCHEDULER_PATIENCE: Final = "10s"
_PATIENCE_WITH_WORKERS_S: Final = 60.0
_LOOKED_AGAIN: Final = 100
"""The number of workers is queried again after this many rows."""


def by_scheduler(job: Job, runs: Iterator[str], address: str) -> Iterator[Row]:
    """Yield the rows of runs as they are done, in any order, computed by the workers of a scheduler.

    The paths of runs must be valid on the computers of the workers, too. `runs` is read only as fast as
    workers need runs. Raises `Refused` if no scheduler answers at `address`, if the scheduler has no worker
    or disconnects, or if a worker fails, for example because its program has other versions or code.
    """
    dask: Any = import_module("distributed")

    for name in [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # the messages below replace its own
    try:
        client = dask.Client(address, timeout=_SCHEDULER_PATIENCE, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as problem:
        raise Refused(
            f"--scheduler {address}: no Dask scheduler answers there ({type(problem).__name__}); start "
            "one with 'dask scheduler', and its workers with 'dask worker ADDRESS --nthreads 1'"
        ) from None
    try:
        client.wait_for_workers(1, timeout=_PATIENCE_WITH_WORKERS_S)
    except (OSError, TimeoutError):
        client.close(timeout=2)
        raise Refused(
            f"--scheduler {address}: the scheduler has no worker; start workers with 'dask worker {address} "
            "--nthreads 1'"
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
        raise Refused(
            f"--scheduler {address}: the connection to the scheduler was lost; start it and "
            "repeat the command"
        ) from None
    except Exception as problem:
        told = " ".join(str(problem).split())
        raise Refused(
            f"--scheduler {address}: its workers failed ({type(problem).__name__}: {told}); install the packages "
            "of this computer on theirs, too"
        ) from None


def of_program(asked: dict[str, str], job: Job, run: str) -> Row:
    """Return the row of a run, as `worked` does. Raises `RuntimeError` if the two computers' programs differ.

    `asked` is the result of `program` on the computer that started the batch.
    """
    mine = dict(program())
    other = [
        f"{name} is {mine.get(name)}, here {asked[name]}" for name in asked if mine.get(name) != asked[name]
    ]
    if other:
        raise RuntimeError(
            "a worker has other versions than this computer; install the same ones there: its "
            f"{'; its '.join(other)}"
        )
    from bench.batch.work import worked

    return worked(job, run)
