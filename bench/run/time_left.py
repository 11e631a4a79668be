"""How long the rest of a run takes: what its plan expects, corrected by the pace so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any, Final

from bench.run.resume import steps_of

SLOW_TO_LEARN_S: Final = 1800.0
"""After so much bench time the pace of the run itself counts as much as the plan's expectation."""


class TimeLeft:
    """Says from the expected time of each step, s, how much is left at one that begins."""

    def __init__(self, step_s: Sequence[float]) -> None:
        self._step_s = list(step_s)
        self._out: set[int] = set()
        self._left_s = _from_each_on(self._step_s)
        self._begun: tuple[int, float] | None = None

    def choose(self, chosen: Mapping[str, Any]) -> None:
        """Take note of what was chosen: steps that are not needed, and the time expected of those not decided."""
        self._out |= steps_of(chosen["left_out"])
        self._out -= steps_of(chosen.get("taken_up", ()))
        step_s = [0.0 if i in self._out else seconds for i, seconds in enumerate(self._step_s)]
        if (open_s := chosen.get("undecided")) is not None:
            place = slice(int(open_s["first"]), int(open_s["last"]) + 1)
            whole_s = sum(step_s[place])
            part = float(open_s["takes_s"]) / whole_s if whole_s > 0 else 0.0
            step_s[place] = [part * seconds for seconds in step_s[place]]
        self._left_s = _from_each_on(step_s)

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


def _from_each_on(step_s: Sequence[float]) -> list[float]:
    """Return the time of each step with all after it, s; none at the end."""
    return [*reversed(list(accumulate(reversed(step_s)))), 0.0]
