"""Processes of their own that read many folders, or reckon of many units."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from bench.api.errors import Refused


@contextmanager
def pool_of(processes: int, when_ended: str) -> Iterator[ProcessPoolExecutor]:
    """Give processes. Raises `Refused` with the words `when_ended` where one of them was ended from outside."""
    pool = ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn"))
    try:
        yield pool
    except BrokenProcessPool as error:
        raise Refused(when_ended) from error
    finally:
        pool.shutdown(cancel_futures=True)
