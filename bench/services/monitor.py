"""Stability monitors: a few positions of one installation, charted over days."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from bench.base.files import to_text
from bench.history.control_chart import CheckRun, ControlChart
from bench.history.monitor import monitor_chart, monitor_run
from bench.model.geometry import STAND_ANGLES, Block
from bench.results.monitor import MonitorResult, monitor_figures, monitor_result
from bench.services.arguments import python_call
from bench.services.coefficients import date_of
from bench.services.errors import Refused
from bench.services.requests.history import Monitor
from bench.services.source import Source, load_sources, reading


@dataclass(frozen=True)
class Monitored:
    """The chart of a series of monitors, and the sources from which it was computed."""

    chart: ControlChart
    sources: tuple[Source, ...]

    @property
    def result(self) -> MonitorResult:
        """The result for JSON."""
        return monitor_result(self.chart)

    def files(self, out: Path) -> Iterator[tuple[str, Path, str]]:
        """Yield description, path and text of each file in `out`."""
        yield "result", out / "monitor.json", to_text(self.result.to_dict())
        for name, figure in monitor_figures(self.chart).items():
            yield "chart", out / f"monitor-{name}.svg", figure


def monitored(request: Monitor) -> Monitored:
    """Return the chart of monitors; the first `baseline` set the limits. Raises `Refused`, `CalibrationError`."""
    sources = tuple(load_sources(reading(request, *request.sources)))
    for source in sources:
        if source.made_at is None:
            raise Refused(f"{source.name}: has no date; use runs, or a file that 'bench export' wrote")
    return Monitored(monitor_chart([check_run(source) for source in sources], request.baseline), sources)


def check_run(source: Source) -> CheckRun:
    """Return a monitor as a run for a chart (day 1970-01-01 if unknown). Raises `CalibrationError`."""
    conditions = source.readings.conditions()
    stand = np.zeros((len(conditions.mounts), len(STAND_ANGLES)))
    force = source.model.specific_force(conditions, stand, Block(np.eye(3), np.zeros(3)))
    when = date_of(source.made_at, source.name) or datetime(1970, 1, 1, tzinfo=UTC)
    return monitor_run(source.name, when, source.readings.signal, force)


monitor = python_call(Monitor, monitored)
