"""Waiting for other processes and threads, as long as a slow machine may need."""

import subprocess
import threading
import time
from collections.abc import Callable
from typing import Any

PATIENCE_S = 600.0
"""Ends a test that hangs. What works needs a hundredth of it, so that no verdict depends on the machine's speed."""


def wait_for(reached: Callable[[], bool], process: subprocess.Popen[Any]) -> None:
    """Wait until `reached` returns true; fail if the process ends before."""
    give_up = time.monotonic() + PATIENCE_S
    while not reached():
        assert process.poll() is None, f"the process ended with {process.returncode}"
        assert time.monotonic() < give_up, "nothing happened"
        time.sleep(0.01)


def together(*calls: Callable[[], object]) -> None:
    """Make all calls at once, each in its own thread, and wait until they end."""
    threads = [threading.Thread(target=call) for call in calls]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
