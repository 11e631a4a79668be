"""How long the rest of a run takes: what its plan expects, corrected by the pace so far."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Final

SLOW_TO_LEARN_S: Final = 1800.0
"""After so much bench time the pace of the run itself counts as much as the plan's expectation."""


class TimeLeft:
    """Says from the expected time of each step, s, how much is left at one that begins."""

    def __init__(self, step_s: Sequence[float]) -> None:
        self._left_s = [*reversed(list(accumulate(reversed(step_s)))), 0.0]
        self._begun: tuple[int, float] | None = None

    def begin(self, index: int, bench_s: float) -> None:
        """Say at which step, and when, what sets the pace began."""
        self._begun = (index, bench_s)

    def at(self, index: int, bench_s: float) -> float:
        """Return the time left at the step `index` that begins at `bench_s`; the first asked about began the
        run."""
        if self._begun is None:
            self._begun = (index, bench_s)
        first, begun_s = self._begun
        expected_s = self._left_s[first] - self._left_s[index]
        pace = (bench_s - begun_s + SLOW_TO_LEARN_S) / (expected_s + SLOW_TO_LEARN_S)
        return pace * self._left_s[index]
