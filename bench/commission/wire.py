"""What passes on the wires while instruments are looked at: how long each answer takes, and what fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from drivers.clock import SystemClock

Wire = Callable[[str, str, str], None]
"""A wire log as a message session takes it: instrument, `>` sent, `<` received or `!` failed, the text."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """A command and how long its answer took, s."""

    instrument: str
    command: str
    took_s: float


class WireWatch:
    """A `Wire` that notes exchanges and failures and passes everything on; `time_s` is the clock it goes by."""

    def __init__(self, log: Wire | None, time_s: Callable[[], float] | None = None) -> None:
        self.time_s = time_s or SystemClock().now_s
        self._log = log
        self._sent: dict[str, tuple[str, float]] = {}
        self._exchanges: list[Exchange] = []
        self._failures: list[tuple[str, str]] = []

    def __call__(self, instrument: str, direction: str, text: str) -> None:
        """Take one message."""
        now_s = self.time_s()
        if direction == ">":
            self._sent[instrument] = (text, now_s)
        elif direction == "!":
            self._sent.pop(instrument, None)
            self._failures.append((instrument, text))
        elif instrument in self._sent:
            command, sent_s = self._sent.pop(instrument)
            self._exchanges.append(Exchange(instrument, command, now_s - sent_s))
        if self._log is not None:
            self._log(instrument, direction, text)

    def mark(self) -> tuple[int, int]:
        """Return the place up to which all was seen."""
        return len(self._exchanges), len(self._failures)

    def exchanges(self, mark: tuple[int, int], instrument: str) -> list[Exchange]:
        """Return the exchanges of an instrument since a mark."""
        return [one for one in self._exchanges[mark[0] :] if one.instrument == instrument]

    def failures(self, mark: tuple[int, int], instrument: str) -> list[str]:
        """Return what failed on an instrument's wire since a mark."""
        return [text for name, text in self._failures[mark[1] :] if name == instrument]
