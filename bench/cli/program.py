"""The program `bench` from start to end: one Ctrl-C ends it with a line, without a traceback."""

from __future__ import annotations

import gc
import os
import signal
import sys
from contextlib import suppress

from bench.cli.streams import keep_writable

TYPE_CHECKING = False  # the import of typing would delay the handling of Ctrl-C
if TYPE_CHECKING:
    from types import FrameType

_STOPPED = 2
_SAID = "stopped by Ctrl-C"


def main() -> None:
    """Run the command line of `sys.argv` and exit with its status.

    A Ctrl-C during the import of the commands is handled as well. A second Ctrl-C ends the program at once; a
    Ctrl-C while the message is printed is ignored. Code that must leave a bench safe handles signals itself
    (`bench.run.interrupts`).
    """
    gc.set_threshold(50_000, 20, 20)  # garbage collection in imports would take a tenth of a short command
    try:
        try:
            signal.signal(signal.SIGINT, _once)
            from bench.run.interrupts import Interrupts

            with Interrupts([signal.SIGINT]) as interrupts:
                interrupts.release(_SAID)
                keep_writable()
                from bench.cli.app import main as command_line

                command_line()
        finally:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
    except KeyboardInterrupt as stop:
        if isinstance(stop.__context__, SystemExit):
            raise stop.__context__ from None  # Ctrl-C came while the program was exiting: keep its status
        print(f"bench: {_SAID}", file=sys.stderr)
        _leave(_STOPPED)
    except SystemExit as end:
        if end.code == _STOPPED and Interrupts.heard:
            _leave(_STOPPED)
        raise


def _leave(status: int) -> None:
    """End the process at once, without the slow teardown of imported modules."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):  # the terminal may have been closed
            stream.flush()
    os._exit(status)


def _once(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt
