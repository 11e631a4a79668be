"""A command of the bench started as a process of its own: in a session of its own, its output in a file."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bench.base.regular import open_regular
from bench.base.visible import visible
from bench.panel.access.people import Refusal
from drivers.clock import Clock, SystemClock

BENCH: Final = ("-c", "from bench.cli.program import main; main()")
NAP_S: Final = 0.05
LONGEST_START_S: Final = 30.0
LAST_WORDS: Final = 4000


@dataclass(frozen=True)
class Started:
    """A process that was started, and the file that its output goes to."""

    process: subprocess.Popen[bytes]
    log: Path

    @property
    def status(self) -> int | None:
        """Exit status, None as long as it lives."""
        return self.process.poll()

    def last_words(self) -> str:
        """Return the end of what it has written."""
        return last_words(self.log)


def start(arguments: Sequence[str], log: Path, *, program: Sequence[str] = BENCH) -> Started:
    """Start a command that no end of this program ends. Raises `OSError`.

    The arguments are given one by one, never to a shell.
    """
    with log.open("wb") as out:
        process = subprocess.Popen(  # noqa: S603 - a program of ours, arguments that were checked
            [sys.executable, *program, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    # somebody must take note of its end, else it stays as a zombie as long as this program lives
    threading.Thread(target=process.wait, daemon=True).start()
    return Started(process, log)


def wait_until(begun: Callable[[], bool], started: Started, clock: Clock | None = None) -> bool:
    """Wait until a process has begun; false where it takes long. Raises `Refusal` where it ended before."""
    clock = clock or SystemClock()
    until_s = clock.now_s() + LONGEST_START_S
    while not begun():
        if (status := started.status) is not None:
            if begun():
                return True
            raise Refusal(409, f"it did not begin (exit status {status}): {started.last_words()}")
        if clock.now_s() > until_s:
            return False
        clock.sleep(NAP_S)
    return True


def last_words(log: Path) -> str:
    """Return the end of what a process has written into its file."""
    try:
        with open_regular(log) as file:
            file.seek(max(file.seek(0, 2) - LAST_WORDS, 0))
            return visible(file.read().decode(errors="replace")).strip()
    except OSError:
        return ""
