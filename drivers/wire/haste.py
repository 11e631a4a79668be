"""Less patience with instruments that do not answer, once a person has asked twice to stop."""

from __future__ import annotations

from typing import Final

HASTY_S: Final = 1.0
"""Long enough for an instrument that is there: its reply is waited for no longer in haste."""


class Haste:
    """Whether waiting is to be cut short; what was to be sent is sent all the same."""

    def __init__(self) -> None:
        self.asked = False

    def limited_s(self, timeout_s: float) -> float:
        """Return how long to wait for what may otherwise take `timeout_s`."""
        return min(timeout_s, HASTY_S) if self.asked else timeout_s
