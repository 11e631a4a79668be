"""The program `bench` from its first moment to its last: one Ctrl-C is heard, and leaves a line, no traceback."""

from __future__ import annotations

import gc
import io
import os
import signal
import sys
from contextlib import suppress

TYPE_CHECKING = False  # as in `bench`
if TYPE_CHECKING:
    from types import FrameType

_STOPPED = 2
_SAID = "stopped by Ctrl-C"


def main() -> None:
    """Run the command line of `sys.argv` and exit with its status.

    Even the import of the commands takes long enough to be interrupted. A second one ends the program at once;
    those that come while that is told are not heard. What must be left safe hears signals by itself
    (`bench.run.interrupts`).
    """
    gc.set_threshold(50_000, 20, 20)  # or a tenth of a short command is a search for garbage in its imports
    try:
        try:
            signal.signal(signal.SIGINT, _once)
            from bench.run.interrupts import Interrupts

            with Interrupts([signal.SIGINT]) as interrupts:
                interrupts.release(_SAID)
                if isinstance(sys.stdout, io.TextIOWrapper):
                    # a terminal that knows no µ is no reason to stop
                    sys.stdout.reconfigure(errors="backslashreplace")
                from bench.cli.app import main as command_line

                command_line()
        finally:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
    except KeyboardInterrupt as stop:
        if isinstance(stop.__context__, SystemExit):
            raise stop.__context__ from None  # it came when the program was done, with its own status
        print(f"bench: {_SAID}", file=sys.stderr)
        _leave(_STOPPED)
    except SystemExit as end:
        if end.code == _STOPPED and Interrupts.any_heard:
            _leave(_STOPPED)
        raise


def _leave(status: int) -> None:
    """End the program now: who has asked it to stop need not wait until all that was imported is taken down."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):  # the terminal may be what went
            stream.flush()
    os._exit(status)


def _once(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt
