"""A substitute for a message session in driver tests, which expects (sent, answered) pairs in order."""

import re
from collections.abc import Sequence

from drivers.interfaces import BadReading
from drivers.wire.visa import SerialSettings

Pairs = Sequence[tuple[str, str | BaseException | None]]


class Clock:
    """A clock that a test sets; a sleep advances it."""

    def __init__(self) -> None:
        self.time_s = 0.0

    def now_s(self) -> float:
        return self.time_s

    def sleep(self, duration_s: float) -> None:
        self.time_s += duration_s


def swapped(pairs: Pairs, command: str, reply: str | BaseException) -> Pairs:
    """Return the pairs with another reply to `command`."""
    assert command in [sent for sent, _ in pairs]
    return [(sent, reply if sent == command else answered) for sent, answered in pairs]


def until(pairs: Pairs, command: str) -> Pairs:
    """Return the pairs up to and including `command`."""
    return list(pairs)[: [sent for sent, _ in pairs].index(command) + 1]


class ScriptedSession:
    """A session that expects all `parts` in order; None is no reply. An exception or a malformed reply
    disconnects.
    """

    resource = "TCPIP::192.0.2.5::9888::SOCKET"
    timeout_s = 3.0
    serial = SerialSettings()

    def __init__(self, *parts: Pairs, clock: Clock | None = None) -> None:
        self.name = "instrument"
        self.left = [pair for part in parts for pair in part]
        self.connection: int | None = None
        self.made = 0
        self.clock = clock or Clock()
        self.sent_at_s: list[tuple[str, float]] = []
        self.timeouts_s: dict[str, float | None] = {}

    def _next(self, command: str) -> str | None:
        assert self.left, f"{command} was sent when nothing was expected"
        wanted, reply = self.left.pop(0)
        assert command == wanted
        self.open()
        self.sent_at_s.append((command, self.clock.now_s()))
        if isinstance(reply, BaseException):
            self.connection = None
            raise reply
        return reply

    def open(self) -> None:
        if self.connection is None:
            self.made += 1
            self.connection = self.made

    def write(self, command: str) -> None:
        assert self._next(command) is None

    def query(
        self,
        command: str,
        timeout_s: float | None = None,
        pattern: str | None = None,
        expected: str = "",
        lines: int = 1,
    ) -> str:
        self.timeouts_s[command] = timeout_s
        reply = self._next(command)
        assert reply is not None, f"{command} has no reply"
        if pattern is not None and re.fullmatch(pattern, reply) is None:
            self.connection = None
            raise BadReading(self.name, f"{reply} is not {expected}", "again")
        return reply

    def close(self) -> None:
        self.connection = None
