"""A message session that proves its instrument: at once, and again after each reconnection.

A connection that was made anew may lead to an instrument that was switched off meanwhile, or to another one.
What is asked is asked again after a failure of the wire, over a new connection; what is commanded is sent once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, TypeVar

from drivers.interfaces import BadReading, InstrumentLost

if TYPE_CHECKING:
    from drivers.clock import Clock
    from drivers.wire.visa import MessageSession

ATTEMPTS: Final = 3

_T = TypeVar("_T")


class ProvedSession:
    """Commands and queries over a `MessageSession`, none before the instrument was proved.

    `prove` identifies the instrument, by calls of this session, and raises what is wrong with it.
    `write_gap_s` is how long the instrument wants to be left alone after a command without reply.
    """

    def __init__(
        self,
        session: MessageSession,
        clock: Clock,
        prove: Callable[[], object],
        *,
        write_gap_s: float = 0.0,
    ) -> None:
        self._session = session
        self._clock = clock
        self._prove = prove
        self._write_gap_s = write_gap_s
        self._wrote_s = -math.inf
        self._proved: int | None = None
        self._proving = False

    @property
    def resource(self) -> str:
        """The VISA name of the instrument."""
        return self._session.resource

    @property
    def opened(self) -> bool:
        """Whether the instrument was proved and not let go since."""
        return self._proved is not None

    def open(self) -> None:
        """Connect and prove. Raises `InstrumentLost`, `BadReading` and what `prove` raises."""
        self._proved = None
        self._session.open()
        self.repeating(self.ensure_proved)

    def close(self) -> None:
        """Let the wire go. Never raises."""
        self._proved = None
        self._session.close()

    def ensure_proved(self) -> None:
        """Prove the instrument unless that was done over the present connection."""
        if self._proving or (self._proved is not None and self._proved == self._session.connection):
            return
        self._proving = True
        try:
            self._prove()
            self._proved = self._session.connection
        finally:
            self._proving = False

    def repeating(self, exchange: Callable[[], _T]) -> _T:
        """Return what `exchange` returns; it is done again over a new connection when the wire failed.

        After a `BadReading` three times at most, after an `InstrumentLost` once: whoever stays silent twice
        is not there. Within a proof nothing is repeated: the whole proof is.
        """
        lost = 0
        for _ in range(ATTEMPTS - 1):
            try:
                return exchange()
            except (BadReading, InstrumentLost) as error:
                lost += isinstance(error, InstrumentLost)
                if self._proving or lost > 1:
                    raise
        return exchange()

    def ask(self, command: str, pattern: str, expected: str, timeout_s: float | None = None) -> str:
        """Send a query that may be repeated and return its reply. Raises as `MessageSession.query`."""
        return self.repeating(lambda: self.command(command, pattern, expected, timeout_s))

    def command(self, command: str, pattern: str, expected: str, timeout_s: float | None = None) -> str:
        """Send once what is answered and return the reply. Raises as `MessageSession.query`."""
        self.ensure_proved()
        self._leave_alone()
        return self._session.query(command, timeout_s=timeout_s, pattern=pattern, expected=expected)

    def urgent(self, command: str, pattern: str, expected: str) -> str:
        """Send at once, proved or not, what is answered: a stop must not wait for a proof."""
        return self._session.query(command, pattern=pattern, expected=expected)

    def write(self, command: str) -> None:
        """Send once what has no reply. Raises as `MessageSession.write`."""
        self.ensure_proved()
        self._leave_alone()
        self._session.write(command)
        self._wrote_s = self._clock.now_s()

    def _leave_alone(self) -> None:
        left_s = self._wrote_s + self._write_gap_s - self._clock.now_s()
        if left_s > 0.0:
            self._clock.sleep(left_s)
