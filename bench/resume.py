"""Where an interrupted run goes on: the first step without a result, or the turn that leads to it."""

from __future__ import annotations

from dataclasses import dataclass

from bench.plan import Mount, Plan, Read, Turn
from bench.record import History


@dataclass(frozen=True)
class ResumePoint:
    """The step to go on with, and the bench time (s since the run began) at which it was first begun.

    `finished` are the readings at or after that step that stand in the record: they are not taken again.
    """

    step: int
    bench_s: float
    finished: frozenset[int] = frozenset()


def resume_point(plan: Plan, history: History) -> ResumePoint:
    """Find where to go on. A point is a turn and its readings: an unfinished one begins with its turn again.

    The step is `len(plan.steps)` when nothing is left to do.
    """
    done = {int(e.data["step"]) for e in history.events if e.type == "step_done"}
    begun = {int(e.data["step"]): e.bench_s for e in history.events if e.type == "step_started"}
    last_s = history.events[-1].bench_s if history.events else 0.0
    open_step = next((i for i in range(len(plan.steps)) if i not in done), len(plan.steps))
    step = _turn_before(plan, open_step) if _reading_is_open(plan, open_step) else open_step
    finished = frozenset(i for i in done if i >= step and isinstance(plan.steps[i], Read))
    return ResumePoint(step, begun.get(step, last_s), finished)


def _reading_is_open(plan: Plan, step: int) -> bool:
    """Whether a reading is still to come at the point that `step` belongs to."""
    for later in plan.steps[step:]:
        if isinstance(later, Read):
            return True
        if isinstance(later, Turn | Mount):
            break
    return False


def _turn_before(plan: Plan, step: int) -> int:
    """The turn of the point that `step` belongs to: the head may have been moved since."""
    for index in range(step, -1, -1):
        if isinstance(plan.steps[index], Turn):
            return index
        if isinstance(plan.steps[index], Mount):
            break
    return step
