"""Connections to the panel: how many there may be, how long a request may take, what is logged of them."""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from typing import Any, Final

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

LOG: Final = logging.getLogger("uvicorn.error")
"""Where the server writes its warnings, and the panel those about a client."""

MOST_CONNECTIONS: Final = 200
REQUEST_S: Final = 10.0
"""A request, head and body, must have arrived within this time."""

_UNFINISHED: Final = frozenset({h11.IDLE, h11.SEND_BODY})


class Connection(H11Protocol):
    """A connection that is closed where its request takes too long, or where there are too many connections."""

    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for a request; beyond `MOST_CONNECTIONS` the one that has waited longest is closed, or this one."""
        super().connection_made(transport)
        self._watch()
        living = [
            one for one in self.connections if isinstance(one, Connection) and not one.transport.is_closing()
        ]
        if len(living) > MOST_CONNECTIONS:
            waiting = {one: one._late.when() for one in living if one._late}
            min(waiting, key=waiting.__getitem__).transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no longer."""
        if self._late:
            self._late.cancel()
        super().connection_lost(exc)

    def handle_events(self) -> None:
        """Take what has arrived; see whether the request is whole now."""
        super().handle_events()
        self._watch()

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP, unless it follows a request that was answered before its body had come."""
        if self.cycle is not None:
            self.cycle.disconnected = True  # what a page still answers has nowhere to go
            self.cycle.message_event.set()
        with suppress(h11.LocalProtocolError):
            super().send_400_response(msg)
        self.transport.close()

    def _watch(self) -> None:
        if self.conn.their_state in _UNFINISHED:
            self._late = self._late or self.loop.call_later(REQUEST_S, self.transport.abort)
        elif self._late:
            self._late.cancel()
            self._late = None


class OncePerMinute(logging.Filter):
    """Passes each warning once in a minute: what a client does wrong must not fill the disk. Errors pass."""

    def __init__(self) -> None:
        super().__init__()
        self._last: dict[Any, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is written."""
        if record.levelno > logging.WARNING:
            return True
        before = self._last.get(record.msg)
        if before is not None and record.created - before < 60.0:
            return False
        self._last[record.msg] = record.created
        return True


ONCE: Final = OncePerMinute()
