"""Wishes left in a run's folder, heard while the run goes on; the wish to stop is heard whatever is waited for.

A wish to stop is what Ctrl-C is. The program may be in the middle of a movement, of samples or of a question then,
where nobody listens: a thread of its own looks into the folder, and interrupts the program as Ctrl-C does.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Final

from bench.run.control import ControlFile, RunControl, Stopped
from bench.run.signals import interrupt_main
from bench.run.states import Wish

LISTEN_S: Final = 0.1
"""So often is looked for what was left in a run's folder."""


class WishListener:
    """The wishes left in a folder (`Controls`); within its context one to stop interrupts the program.

    `stopped` is the first wish to stop that was heard.
    """

    def __init__(self, controls: ControlFile, interrupt: Callable[[], None] = interrupt_main) -> None:
        self.stopped: RunControl | None = None
        self._controls = controls
        self._interrupt = interrupt
        self._waiting: deque[RunControl] = deque()
        self._taking = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="wishes", daemon=True)

    def __enter__(self) -> WishListener:
        if threading.current_thread() is threading.main_thread():
            self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def poll(self) -> RunControl | None:
        """Return the next wish, None where there is none. Raises `Stopped` for one to stop."""
        if (stop := self._take_in()) is not None:
            raise Stopped(stop)
        return self._waiting.popleft() if self._waiting else None

    def _listen(self) -> None:
        while not self._over.wait(LISTEN_S):
            if self._take_in() is not None:
                self._interrupt()

    def _take_in(self) -> RunControl | None:
        """Take in what was left; return a wish to stop, which comes before all others."""
        with self._taking:
            while (control := self._controls.poll()) is not None:
                if control.wish is Wish.STOP:
                    self.stopped = self.stopped or control
                    return control
                self._waiting.append(control)
        return None
