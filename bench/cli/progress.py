"""How far a computation has come, drawn on standard error while a person waits for it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from bench.base.progress import heard_by, quiet
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
