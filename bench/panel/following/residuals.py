"""The readings of a run against what was expected of each when it was taken, as the early warning judged it.

There is no second model: the same watcher is told the same events, and its judgements are kept. Of a long
run the last readings alone are gone through; those before teach little more.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from bench.files.bench.file import BenchFile
from bench.procedure.plan import Mount, Plan, Read
from bench.readings.reading import Reading
from bench.run.events import Event, EventType
from bench.run.watch.of_plan import watcher_of

MOST_POINTS: Final = 200
COVERAGE: Final = 2.0
"""The bands are ± so many standard uncertainties."""


@dataclass(frozen=True)
class Points:
    """Points as they were at a moment, see `Residuals`; `version` changes with those that stood before."""

    version: int = 0
    points: tuple[dict[str, Any], ...] = ()

    def since(self, told: Points) -> dict[str, Any]:
        """Return what is to be sent to who was told these: from which place on which points stand, and k."""
        begin = len(told.points) if told.version == self.version else 0
        return {"from": begin, "k": COVERAGE, "points": self.points[begin:]}


class Residuals:
    """Judges the readings of a run; `points` are told to those who look.

    A point: `n` of its event, `step`, `installation`, `series`, `pass`, `point`, `angle_deg`, `time_s`, per
    channel `residual` from the prediction and its standard uncertainty `u` (`unit`), `sigma`; `struck`,
    where it was taken again. `version` counts the changes of points that stood already.
    """

    def __init__(self, plan: Plan, bench: BenchFile) -> None:
        self._watcher = watcher_of(plan, bench)
        self._steps = plan.steps
        self._waiting: deque[Event] = deque()
        self._readings = 0
        self.points: list[dict[str, Any]] = []
        self.version = 0

    def note(self, event: Event) -> None:
        """Take note of an event, to be judged later: see `judge_next`."""
        if event.type not in _TOLD:
            return
        if event.type == EventType.STEP_DONE and not isinstance(self._steps[event.step], Read | Mount):
            return
        self._waiting.append(event)
        self._readings += _is_reading(event)
        while self._readings > MOST_POINTS:
            self._readings -= _is_reading(self._waiting.popleft())

    @property
    def waiting(self) -> bool:
        """Whether readings wait to be judged."""
        return self._readings > 0

    def judge_next(self) -> bool:
        """Judge the next of the readings that wait; say whether there was one."""
        while self._waiting:
            event = self._waiting.popleft()
            self._watcher.observe(event)
            match event.type:
                case EventType.REDO:
                    self._strike(event)
                case EventType.STEP_DONE if isinstance(reading := event.result, Reading):
                    self._readings -= 1
                    self._watcher.take(reading)
                    self._add(event, reading)
                    return True
        return False

    def _strike(self, redo: Event) -> None:
        steps = set(redo.steps)
        for point in self.points:
            if point["step"] in steps and not point["struck"]:
                point["struck"] = True
                self.version += 1

    def _add(self, event: Event, reading: Reading) -> None:
        judged = self._watcher.judged
        if judged is None or reading.angle_deg is None:
            return
        u = np.sqrt(np.diagonal(judged.covariance[0]))
        self.points.append(
            {
                "n": event.number,
                "step": event.step,
                "installation": reading.installation,
                "series": reading.series,
                "pass": reading.pass_number,
                "point": reading.point,
                "angle_deg": reading.angle_deg,
                "time_s": event.bench_s if reading.time_s is None else reading.time_s,
                "unit": reading.unit,
                "residual": [float(f"{value:.6g}") for value in judged.residual[0]],
                "u": [float(f"{value:.4g}") for value in u],
                "sigma": [float(f"{value:.3g}") for value in judged.sigma[0]],
                "struck": False,
            }
        )
        if len(self.points) > MOST_POINTS:
            del self.points[0]
            self.version += 1


_TOLD: Final = frozenset({EventType.STEP_DONE, EventType.REMOUNTED, EventType.REDO, EventType.WENT_ON})


def _is_reading(event: Event) -> bool:
    return "reading" in event.data
