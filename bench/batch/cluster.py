"""Runs computed on a cluster: the same unit of work, by the workers of a Dask scheduler."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from importlib import import_module
from typing import Any, Final

from bench.batch.job import Job, Row, program
from bench.batch.processes import AHEAD, died_at
from bench.batch.work import worked
from bench.services.errors import Refused

_PATIENCE: Final = "10s"
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
        client = dask.Client(address, timeout=_PATIENCE, set_as_default=False)
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
        yield from _rows(dask, client, job, runs, address)
    finally:
        client.close(timeout=2)


def _rows(dask: Any, client: Any, job: Job, runs: Iterator[str], address: str) -> Iterator[Row]:
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
    return worked(job, run)
