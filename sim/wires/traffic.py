"""Who is busy on a simulated bench: a virtual clock waits for it before it moves."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from enum import Enum
from typing import TYPE_CHECKING, Final, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator

_SETTLE_LOOKS: Final = 2000
_SETTLE_LOOK_S: Final = 0.001


class Doing(Enum):
    """What a session does at the moment, as `Traffic` sees it."""

    LISTENING = "waiting for input"
    WORKING = "carrying out a message"
    WAITING = "waiting for time to pass, or for another client"


class Busy(Protocol):
    """A session, as far as time is concerned. `doing` is set through `Traffic.mark`."""

    doing: Doing

    def has_work(self) -> bool:
        """Whether it works, or has input to work on."""
        ...


class Traffic:
    """Knows what all the sessions of a bench do, so that time moves only when none has work left.

    Without it, a virtual clock could jump past a measurement whose start is still on another wire.
    """

    def __init__(self) -> None:
        self._sessions: set[Busy] = set()
        self._changed = threading.Condition()
        self._current = threading.local()

    def settle(self) -> None:
        """Wait until each session but the caller's listens with no input, or waits itself.

        A client that does not take its replies cannot hold the bench up for ever: after a few seconds
        it is passed over.
        """
        own: Busy | None = getattr(self._current, "session", None)
        with self._waiting(own):
            for _ in range(_SETTLE_LOOKS):
                with self._changed:
                    busy = [s for s in self._sessions if s is not own and s.has_work()]
                    if not busy:
                        return
                    self._changed.wait(_SETTLE_LOOK_S)

    def enter(self, session: Busy) -> None:
        """A session begins in the calling thread."""
        self._current.session = session
        with self._changed:
            self._sessions.add(session)

    def leave(self, session: Busy) -> None:
        """A session ends."""
        with self._changed:
            self._sessions.discard(session)
            self._changed.notify_all()

    def mark(self, session: Busy, doing: Doing) -> None:
        """Say what a session does from now on."""
        session.doing = doing
        if doing is not Doing.WORKING:
            with self._changed:
                self._changed.notify_all()

    @contextmanager
    def _waiting(self, session: Busy | None) -> Iterator[None]:
        if session is None:
            yield
            return
        self.mark(session, Doing.WAITING)
        try:
            yield
        finally:
            self.mark(session, Doing.WORKING)
