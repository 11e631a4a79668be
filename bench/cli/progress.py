"""How far a computation has come, drawn on standard error while a person waits for it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Final

from bench.base.computing import heard_by, quiet
from drivers.clock import Clock, SystemClock

if TYPE_CHECKING:
    from rich.console import Console

_REMEMBERED_S: Final = 3600.0
"""A part may take minutes: how fast the last ones were done is remembered for so long."""


@contextmanager
def shown(console: Console | None = None, clock: Clock | None = None) -> Iterator[None]:
    """Show what is computed, how much of it is done and the time left, as long as the context lasts.

    On a terminal only (standard error's, if no console is given), never with --quiet; nothing of it stays.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

    console = console or Console(stderr=True)
    if not console.is_terminal or quiet.get():
        yield
        return
    bar = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TimeRemainingColumn(),
        TextColumn("left"),
        console=console,
        transient=True,
        speed_estimate_period=_REMEMBERED_S,
        get_time=(clock or SystemClock()).now_s,
    )
    task = bar.add_task("…", total=None)

    def hear(what: str, done: int, total: int) -> None:
        if what != bar.tasks[0].description:
            bar.reset(task, description=what, total=total)
        bar.update(task, completed=done, refresh=True)

    with bar, heard_by(hear):
        yield


EVERY_S: Final = 30.0


@contextmanager
def in_lines(clock: Clock | None = None) -> Iterator[None]:
    """Say on standard error what `shown` shows, where that is no terminal: a line now and then, for a log.

    For what may take hours. Never with --quiet.
    """
    if sys.stderr.isatty() or quiet.get():
        yield
        return
    clock = clock or SystemClock()
    began_s = said_s = clock.now_s()

    def hear(what: str, done: int, total: int) -> None:
        nonlocal said_s
        now_s = clock.now_s()
        if done and now_s - said_s >= EVERY_S:
            left_s = round((now_s - began_s) / done * (total - done))
            print(
                f"{done:,} of {total:,} {what}, {timedelta(seconds=left_s)} left", file=sys.stderr, flush=True
            )
            said_s = now_s

    with heard_by(hear):
        yield
